"""Where roads lead in evidence that gives no calibration: a sketch through a usual lens, for people and not for use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, level_normal
from autocalib_ros.estimation.observations.track_set import TrackSet, select_tracks
from autocalib_ros.estimation.single_road.barrel_lens import LensChoice
from autocalib_ros.estimation.single_road.road_solution import most_followed, roads_through
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import MIN_FRACTION_BELOW_HORIZON, orient_upward
from autocalib_ros.lens.camera import Camera

MAX_SKETCHED_TRACKS = 150
"""Tracks in a sketch, spread over the picture: its roads need no precision."""
MIN_SKETCHED_TRACKS = 8
"""Fewest tracks that show where a road leads; as many vehicles as a single road needs."""
MAX_SKETCHED_ROLL_DEG = 45.0
"""Largest roll of a horizon that is shown, degrees: nobody mounts a camera on its side and then looks for a horizon."""
MIN_SHARE = 0.15
"""Least share of the vehicles on a road that is shown: on bends fewer follow any straight line, by chance."""


@dataclass(frozen=True)
class RoadSketch:
    """Roads through a lens that was assumed."""

    camera: Camera
    directions: np.ndarray
    """Unit vectors of the roads, camera frame, shape (roads, 3)."""
    horizon: np.ndarray | None
    """Unit normal (3,) of the plane, camera frame, up; None if no horizon has the traffic below it."""
    is_of_two_roads: bool
    """Whether the horizon is that of two roads, and not of one road and a camera without roll."""
    shares: tuple[float, ...]
    """Share of the vehicles that follow each road."""
    labels: np.ndarray
    """Index of the road of each track of the evidence, -1 if it was not used, -2 if it follows none."""


def sketch_roads(evidence: Evidence, options: Options) -> RoadSketch | None:
    """Return the roads that most vehicles follow through a usual lens; None without any."""
    tracks = select_tracks(evidence, MAX_SKETCHED_TRACKS)
    if len(tracks) < MIN_SKETCHED_TRACKS:
        return None
    aspect = options.lens.pixel_aspect_or(evidence.pixel_aspect)
    prior = lens_priors(evidence.image_size, options.joint, evidence.picture, aspect, options.lens)[0]
    config, generator = AdjustmentConfig(prior, options.joint), np.random.default_rng(options.random_seed)
    fits = [fit for _, fit in roads_through(LensChoice(prior, options.joint), tracks, config, generator)]
    return _sketched(most_followed(fits, tracks), tracks, evidence.track_count) if fits else None


def _sketched(fit: Adjustment, tracks: TrackSet, count: int) -> RoadSketch | None:
    followed, weight = fit.inliers(), tracks.vehicle_weight
    shares = [
        float(weight @ (followed & (fit.labels == road)) / weight.sum()) for road in range(len(fit.state.angles_rad))
    ]
    shown = [road for road in np.argsort(shares)[::-1].tolist() if shares[road] >= MIN_SHARE]
    if not shown:
        return None
    labels = np.full(count, -1)
    labels[tracks.indices] = -2
    for index, road in enumerate(shown):
        labels[tracks.indices[followed & (fit.labels == road)]] = index
    directions = fit.state.directions[shown]
    bearings, _ = fit.state.camera.unproject(tracks.pixels.reshape(-1, 2))
    of_roads = plausible_horizon(fit.state.rotation[:, 2], bearings) if len(shown) > 1 else None
    horizon = plausible_horizon(level_normal(directions[0]), bearings) if of_roads is None else of_roads
    sizes = tuple(shares[road] for road in shown)
    return RoadSketch(fit.state.camera, directions, horizon, of_roads is not None, sizes, labels)


def plausible_horizon(normal: np.ndarray, bearings: np.ndarray) -> np.ndarray | None:
    """Return the upward normal (3,) of a plane with a nearly level horizon above the bearings (n, 3), else None."""
    up, below = orient_upward(normal, bearings)
    is_level = -up[1] >= np.hypot(up[0], up[1]) * np.cos(np.radians(MAX_SKETCHED_ROLL_DEG))
    return up if is_level and below >= MIN_FRACTION_BELOW_HORIZON else None
