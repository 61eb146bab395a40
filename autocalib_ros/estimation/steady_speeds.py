"""How the speeds of vehicles change with their distance: in the right plane they do not, as far as traffic flows.

A length on the road far away against one nearby depends on the place of the horizon, to which straight tracks of one
road give only the direction. A vehicle that keeps its speed measures it: it covers equal lengths in equal times. Points
above the road move as on the road, farther away by one factor, so that their heights do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.lanes.lane_dashes import SLOPE_SIGMA, MeanLog
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.verification.scale import speed_variation
from autocalib_ros.geometry.ground_plane import ground_points
from autocalib_ros.geometry.robust_kernels import MAD_TO_SIGMA, student_weight
from autocalib_ros.lens.camera import Camera

MIN_DISTANCE_RATIO = 1.1
"""Least ratio of the largest distance of a track from the camera to the least: less shows no change with distance."""
FARTHEST_STEADY_HEIGHTS = 15.0
"""Farthest places, camera heights: farther away, a pixel is longer than what a change of speed moves."""
MIN_STEADY_VEHICLES = 15
"""Fewest vehicles that measure a change of the speed, and how much it varies between them. Judgement."""
COMMON_SHARE = 0.25
"""Correlation of the changes of speed of two vehicles on one road: drivers brake and speed up in the same places. Where
traffic flows, each changes its speed by little, and all of them by less. Judgement."""
MAX_VARIATION = 0.25
"""Largest standard deviation between vehicles of the change of speed, and of the speed itself (relative), up to which
traffic flows: by about a fifth on free roads, far more before stop lines and in jams, where all brake in one place."""
MIN_INFORMATION = 1e-12
"""Added to the information of a way that is farther away than any road, in a plane that is tried."""
MEAN_ROUNDS = 5
"""Rounds of the robust mean."""


@dataclass(frozen=True)
class SteadySpeeds:
    """Tracks that measure the change of speed with distance, as a function of lens and plane."""

    tracks: TrackSet
    weights: np.ndarray
    """Weight of each track, shape (tracks,)."""
    sigma: float
    """Standard deviation of the change for exact lens and plane."""

    @property
    def vehicles(self) -> int:
        """Number of vehicles."""
        return len(np.unique(self.tracks.vehicles))

    def change_with_distance(self, camera: Camera, normal: np.ndarray) -> MeanLog:
        """Return the change of the log speed by the log distance, which is 0 where traffic is steady."""
        changes, _ = _changes(camera, normal, self.tracks)
        return MeanLog(float(self.weights @ changes / self.weights.sum()), self.sigma)


def measure_steady_speeds(camera: Camera, normal: np.ndarray, flow: TrackSet) -> SteadySpeeds | None:
    """Return the tracks along a road that measure the change of speed with distance; None if too few do."""
    tracks = flow.subset(_reaching(camera, normal, flow))
    vehicles = len(np.unique(tracks.vehicles))
    if vehicles < MIN_STEADY_VEHICLES:
        return None
    changes, sigmas = _changes(camera, normal, tracks)
    middle, spread = float(np.median(changes)), 0.0
    for _ in range(MEAN_ROUNDS):
        off = changes - middle
        spread = np.sqrt(max((MAD_TO_SIGMA * np.median(np.abs(off))) ** 2 - np.median(sigmas) ** 2, 0.0))
        total = np.hypot(sigmas, spread)
        weights = tracks.vehicle_weight * student_weight(off, total) / total**2
        middle = float(weights @ changes / weights.sum())
    if max(spread, speed_variation(camera, normal, tracks)) > MAX_VARIATION:
        return None
    alone = float((weights @ (changes - middle) ** 2 / weights.sum() / vehicles) ** 0.5)
    return SteadySpeeds(tracks, weights, float(np.linalg.norm([alone, spread * COMMON_SHARE**0.5, SLOPE_SIGMA])))


def _places(camera: Camera, normal: np.ndarray, tracks: TrackSet) -> np.ndarray:
    """Return the places (tracks, samples, 2) on the road, camera heights."""
    return ground_points(camera, normal, 1.0, tracks.pixels.reshape(-1, 2)).reshape(tracks.pixels.shape)


def _reaching(camera: Camera, normal: np.ndarray, tracks: TrackSet) -> np.ndarray:
    """Return the mask of tracks with at least four samples that reach from near to far."""
    if not len(tracks):
        return np.zeros(0, bool)
    bearings, valid = camera.unproject(tracks.pixels.reshape(-1, 2))
    near = (valid & (bearings @ normal < -1.0 / FARTHEST_STEADY_HEIGHTS)).reshape(tracks.weights.shape).all(axis=1)
    away = np.linalg.norm(_places(camera, normal, tracks), axis=-1)
    several = (np.diff(tracks.sample_times_s, axis=1) > 0).sum(axis=1) >= 3  # times of damaged evidence may stand still
    return near & several & (away.max(axis=1) > MIN_DISTANCE_RATIO * away.min(axis=1))


def _changes(camera: Camera, normal: np.ndarray, tracks: TrackSet) -> tuple[np.ndarray, np.ndarray]:
    """Return the change of log speed by log distance of each track, and its standard deviation by pixel noise.

    By weighted least squares with the way as a polynomial of the second degree of time.
    """
    places = _places(camera, normal, tracks)
    away = np.linalg.norm(places, axis=-1)
    ways = places - places[:, :1]
    ahead = ways[:, -1] / np.linalg.norm(ways[:, -1], axis=1, keepdims=True)
    ways = np.einsum('tsk,tk->ts', ways, ahead)
    last = tracks.sample_times_s - tracks.sample_times_s[:, :1]
    times = last / last[:, -1:] - 0.5
    design = np.stack([np.ones_like(times), times, times * times], axis=-1)
    # the length of road that a pixel covers grows with the square of the distance from the camera
    weights = (tracks.weights > 0) / (1.0 + away * away) ** 2
    inverse = np.linalg.inv(np.einsum('tsi,ts,tsj->tij', design, weights, design) + MIN_INFORMATION * np.eye(3))
    fitted = np.einsum('tij,tsj,ts,ts->ti', inverse, design, weights, ways)
    left = ways - np.einsum('tsi,ti->ts', design, fitted)
    noise2 = float(np.median((weights * left * left).sum(axis=1) / ((weights > 0).sum(axis=1) - design.shape[-1])))
    speed, gain = fitted[:, 1], 2.0 * fitted[:, 2]
    reach = np.log(away[:, -1] / away[:, 0])
    return gain / speed / reach, 2.0 * np.sqrt(noise2 * inverse[:, 2, 2]) / np.abs(speed * reach)
