"""Direction and bend of a straight road through a given lens, and how probable its tracks are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import known_lens
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.single_road.bent_road import BEND_LOG_PRIOR, BENDS, Bend, BentRoad, RoadPlane
from autocalib_ros.geometry.great_circles import (
    circle_pixel_scale,
    orthonormal_basis,
    quadratic_forms,
    scatter,
    squared_distances,
    unproject_rays,
)
from autocalib_ros.geometry.robust_kernels import cauchy_weight, geman_mcclure_bounded_loss
from autocalib_ros.geometry.small_matrices import smallest_eigenvectors
from autocalib_ros.lens.camera import Camera

REWEIGHTINGS = 4
"""Rounds of the search for the direction where most planes meet."""
ROAD_OFFSETS = np.stack(np.meshgrid(*2 * (np.arange(-2.0, 3.0),)), axis=-1).reshape(-1, 2)
SEARCH_REACH_RAD = 0.12 * 0.55 ** np.arange(11)
"""Offsets of the search for the direction of the road, in units of its reach; and the reach, round by round."""
BEND_SEARCH, COARSE_BENDS = 5, slice(None, None, 2)
"""Rounds of the search that are left out about the direction of the straight road, and the bends that choose it."""
MIN_FREEDOM, MAX_FREEDOM = 1.0, 1.6
"""Independent observations that a straight track may count as. One: all that is left of a path through the place where
the road vanishes is its direction, if drivers differ in that. Nine real cameras show 1.0 to 2.6, a median of 1.2. Where
more is seen, the distances of tracks are alike for another reason: all follow one bend."""
FREEDOMS = np.linspace(MIN_FREEDOM, MAX_FREEDOM, 7)
"""Numbers of observations between which is interpolated, shape (n,)."""
MEDIANS = 2.0 * gammaincinv(FREEDOMS / 2, 0.5)
LOWER_TO_MEDIAN = 2.0 * gammaincinv(FREEDOMS / 2, 0.25) / MEDIANS
"""Median of chi squared with these degrees of freedom, and its lower quartile over the median, shape (n,)."""
MIN_DISTANCE_PX, ROBUST_LIMIT = 0.2, 4.0
"""Least typical distance of a track from its path, and the squared distance, in units of the typical one, at which a
track weighs a quarter."""


@dataclass(frozen=True)
class RoadThrough:
    """Finds the direction of the road through a given lens."""

    start: Adjustment
    tracks: TrackSet
    turns_rad: tuple[float, ...] = ()
    """Turns of the plane about the road at which bends are tried; none: the road is straight."""

    def on_planes(self, turns_rad: tuple[float, ...]) -> RoadThrough:
        """Return the same for a road that may bend, in planes with these turns about the road."""
        return replace(self, turns_rad=turns_rad)

    @cached_property
    def _squared(self) -> np.ndarray:
        """Squared distances of the tracks that follow the road from their paths, px^2."""
        return np.asarray(self.start.distance_px[self.start.inliers()] ** 2)

    @cached_property
    def scale(self) -> float:
        """Typical squared distance of a track from its path, px^2."""
        return max(float(np.median(self._squared)), MIN_DISTANCE_PX**2)

    @property
    def information(self) -> float:
        """Independent observations that a track counts as, times the typical squared distance over the mean one.

        Squared distances are about chi squared: the fewer independent deviations each sums up, the more they vary
        between tracks (Satterthwaite 1946). Their lower quartile is not moved by those that do not follow the road.
        """
        ratio = float(np.quantile(self._squared, 0.25)) / max(float(np.median(self._squared)), 1e-12)
        return float(np.interp(ratio, LOWER_TO_MEDIAN, MEDIANS))

    @cached_property
    def weights(self) -> np.ndarray:
        """Weight of each track in the log likelihood, shape (tracks,)."""
        return 0.5 * self.information * self.tracks.kish_weight(self.start.problem.config.vehicle_correlation)

    def __call__(self, camera: Camera) -> tuple[np.ndarray, float, Bend | None]:
        """Return direction (3,) of the road through a lens, negative log likelihood of the tracks, and the bend.

        By distances in the image, with one scale for all lenses: a longer lens does not gain by deviations that are
        given as angles. Found by a search that narrows about the place where the road vanishes. A bend of the road is
        integrated out: it looks like barrel distortion.
        """
        state, samples = self.start.state, self.tracks.weights
        rays = unproject_rays(camera, self.tracks.pixels)
        scale = circle_pixel_scale(rays, samples)
        matrix = scatter(rays, samples, scale)
        # the road vanishes in the same place of the image, or where most planes through tracks and camera meet
        place = unproject_rays(camera, state.camera.project(state.directions[:1])[0]).bearings[0]
        straight = quadratic_forms(matrix)
        starts = np.array([place, _common_direction(smallest_eigenvectors(matrix)[0], self.weights)])
        along = starts[np.argmin(self._losses(straight, starts))]
        along = along * (np.sign(along @ state.directions[0]) or 1.0)
        along, cost = self._search(straight, along, SEARCH_REACH_RAD)
        if not self.turns_rad:
            return along, cost, None
        squared_scale = samples * scale * scale
        weights = self.weights[:, None] * (samples > 0)

        def bent(turn_rad: float) -> BentRoad:
            return BentRoad.on(RoadPlane.under(along, turn_rad, rays.bearings, weights), rays.bearings, squared_scale)

        # the more probable plane and bend, the direction at that, and all bends there
        roads = [bent(turn) for turn in self.turns_rad]
        costs = np.array([self._bend_costs(road, along, COARSE_BENDS) for road in roads])
        plane, bend = np.unravel_index(np.argmin(costs), costs.shape)
        along, _ = self._search(roads[plane].forms(BENDS[COARSE_BENDS][[bend]]), along, SEARCH_REACH_RAD[BEND_SEARCH:])
        road = bent(self.turns_rad[plane])
        costs = self._bend_costs(road, along, slice(None))
        return along, -float(np.logaddexp.reduce(-costs)), Bend(road.plane, float(BENDS[np.argmin(costs)]))

    def _search(self, forms: np.ndarray, along: np.ndarray, reaches: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the most probable direction (3,) near `along`, and its negative log likelihood."""
        cost = np.inf
        for reach in reaches:
            tried = along + reach * ROAD_OFFSETS @ orthonormal_basis(along)
            tried /= np.linalg.norm(tried, axis=1, keepdims=True)
            costs = self._losses(forms, tried)
            along, cost = tried[np.argmin(costs)], float(costs.min())
        return along, cost

    def _bend_costs(self, road: BentRoad, along: np.ndarray, chosen: slice) -> np.ndarray:
        """Return the negative log of likelihood and prior probability of chosen `BENDS`, at one direction (3,)."""
        return self._losses(road.forms(BENDS[chosen]), along[None]) - BEND_LOG_PRIOR[chosen]

    def _losses(self, forms: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the negative log likelihood at directions (n, 3), or at one for the forms of n bends, shape (n,)."""
        distances = squared_distances(forms, directions).reshape(-1, len(self.weights))
        return geman_mcclure_bounded_loss(distances / self.scale, ROBUST_LIMIT) @ self.weights

    def adjusted(self, camera: Camera, along: np.ndarray) -> Adjustment:
        """Return the adjustment of the road along a direction (3,) through a lens, with its covariance."""
        state, config = self.start.state, self.start.problem.config
        turn, _ = Rotation.align_vectors(along[None], state.directions[:1])
        moved = AdjustmentState(camera, turn.as_matrix() @ state.rotation, np.zeros(1))
        return adjust(moved, self.tracks, replace(config, prior=known_lens(camera)), refine=True)


def _common_direction(normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the direction (3,) that is perpendicular to most unit normals (n, 3), by iterated reweighting."""
    kept = weights
    for _ in range(REWEIGHTINGS):
        along = np.linalg.eigh((normals * kept[:, None]).T @ normals)[1][:, 0]
        off = np.abs(normals @ along)
        kept = weights * cauchy_weight((off / max(float(np.median(off)), 1e-6)) ** 2)
    return along
