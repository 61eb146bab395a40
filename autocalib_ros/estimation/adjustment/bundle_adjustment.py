"""The one robust problem: lens, ground plane and roads together, every residual in observed pixels.

Unknowns are the lens (focal length, principal point, k1, k2 where it is set free), the rotation of the ground
plane and the angle of each road in it. Two kinds of residuals share them: tracks on great circles through the
direction of their road, and vehicles that turn, as rigid bodies in the plane. Distances are whitened by what is
expected of them; a track or a window counts by a redescending weight of its mean squared whitened distance (Geman &
McClure 1985).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.estimation.adjustment.covariance import (
    intraclass_correlation,
    jackknife_covariance,
    propagate_covariance,
    propagate_sigma,
)
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import (
    AdjustmentConfig,
    AdjustmentState,
    Parameterisation,
    upward_normal,
    with_crossing_angle,
)
from autocalib_ros.estimation.adjustment.residual_blocks import (
    LinearisedRows,
    PlanarMotionBlock,
    RigidBodyBlock,
    StraightTrackBlock,
)
from autocalib_ros.estimation.motion.planar_motion import PlanarMotion
from autocalib_ros.estimation.motion.rigid_bodies import StructureAndMotion
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks
from autocalib_ros.estimation.observations.vehicle_grouping import group_into_bodies
from autocalib_ros.geometry.great_circles import squared_distances_through, unproject_rays
from autocalib_ros.lens.camera import Camera

ROBUST_LIMIT_SCHEDULE = (8.0, 4.0, 2.0)
FINAL_ROBUST_LIMIT = 1.0
"""Squared distance at which a row's influence has fallen to a quarter, in medians, round by round.

The bulk of the tracks says what noise is; a lane change or a slow turn a few pixels beyond it is few in number
but long in lever. From loose to tight, so that a start some per cent off still reaches the best solution; then
until assignment, influence and state stand still.
"""
MAX_ITERATIONS = 16
"""Most rounds; a state that has not settled by then swings between two assignments of a few tracks."""
CONVERGED_STEP, CONVERGED_STEP_SIGMAS = 3e-4, 3e-3
"""The rounds end when log f and all angles (radians), and what is counted in prior sigmas, move by less."""
MAX_BACKTRACKS = 4
MIN_RESIDUAL_SCALE = 0.05
"""Traffic without noise, as tests make it, still has a spread to divide by."""
MIN_RESIDUAL_ROWS = 4
"""Fewer tracks on roads, and windows, do not go on with a solution: it is judged, and refused, as it stands."""
ROAD_OUTLIER_PX = 4.0
"""A track farther than this from every road, root mean square, belongs to none."""
MIN_DEPRESSION_GROUPING_RAD = 0.03
"""Least angle below the horizon at which a point is placed on the road, radians."""
INLIER_MEDIANS = 3.0
"""A track is explained when its mean squared whitened distance is below so many medians."""
UNMODELLED_FOCAL, UNMODELLED_RAD = 0.001, np.radians(0.03)
"""What no residual shows, as standard deviations of the relative focal length and of the plane: a lens is not quite of
its family, and a road not quite a plane (its crown falls by a degree to either side)."""
MIN_ROAD_DISTANCE_RATIO = 5.0
"""A track tells two roads apart when it is so many times farther from the one than from the other."""


WarmStart = tuple[None, PlanarMotion | None, StructureAndMotion | None]
"""What is solved inside the rows of each kind and goes on from step to step: motions of windows, shapes of lives."""
BLOCK_COUNT = 3
"""Tracks on roads, windows, lives."""


class Problem:
    """Labelled tracks and vehicles that turn, at a state: residuals, and their derivatives by a step from there."""

    def __init__(
        self,
        base: AdjustmentState,
        tracks: TrackSet,
        labels: np.ndarray,
        config: AdjustmentConfig,
        warm_start: WarmStart = (None, None, None),
        unprojected: UnprojectedTracks | None = None,
    ) -> None:
        self.parameters = Parameterisation(base, config)
        self.used = np.flatnonzero(labels >= 0)
        """Indices of the tracks that are on a road: the first rows; windows and lives follow."""
        unprojected = unprojected or UnprojectedTracks.through(base.camera, tracks)
        vehicle_weight = tracks.kish_weight(config.vehicle_correlation)[self.used]
        self.blocks: list[StraightTrackBlock | PlanarMotionBlock | RigidBodyBlock] = [
            StraightTrackBlock(
                self.parameters,
                tracks.subset(self.used),
                labels[self.used],
                unprojected.subset(self.used),
                vehicle_weight,
            ),
            PlanarMotionBlock(self.parameters, warm_start[1]),
        ]
        if config.bundle is not None:
            self.blocks.append(RigidBodyBlock(self.parameters, config.bundle, warm_start[2]))
        self.block_of_row = np.repeat(
            np.arange(len(self.blocks)), [len(block_of_row.dof) for block_of_row in self.blocks]
        )
        """Index of the kind of each row, shape (rows,)."""
        self.dof = np.concatenate([block_of_row.dof for block_of_row in self.blocks])
        self.vehicle_weight = np.concatenate([block_of_row.vehicle_weight for block_of_row in self.blocks])

    @property
    def config(self) -> AdjustmentConfig:
        """What the solution was given."""
        return self.parameters.config

    @property
    def warm_start(self) -> WarmStart:
        """What was solved inside each kind, to go on from."""
        return (None, self.blocks[1].warm_start, self.blocks[2].warm_start if len(self.blocks) > 2 else None)

    @property
    def vehicle_ids(self) -> np.ndarray:
        """Vehicle of each row, shape (rows,): those on roads and those that turn are told apart."""
        on_roads, *turning = (block_of_row.vehicle_ids for block_of_row in self.blocks)
        return np.concatenate([on_roads, *(vehicle_ids + on_roads.max(initial=-1) + 1 for vehicle_ids in turning)])

    def at(self, step: np.ndarray) -> tuple[WarmStart, np.ndarray]:
        """What is solved inside at a step, and the mean squared residuals there (rows,)."""
        parts = [block_of_row.at(step) for block_of_row in self.blocks]
        warm_start = [part[0] for part in parts] + [None]
        return (None, warm_start[1], warm_start[2]), np.concatenate([part[1] for part in parts])

    def linearise(self) -> LinearisedRows:
        """Sums over the residuals at the base and their derivatives by the parameters."""
        parts = [block_of_row.linearise() for block_of_row in self.blocks]
        return LinearisedRows(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in ('squared', 'gradient', 'curvature', 'influence')
            )
        )

    def scales(self, squared: np.ndarray) -> np.ndarray:
        """Median of the mean squared distances (rows,) over each kind of row, 1 where there is none; (kinds,)."""
        return np.array(
            [
                max(float(np.median(squared[self.block_of_row == block_of_row])), MIN_RESIDUAL_SCALE)
                if (self.block_of_row == block_of_row).any()
                else 1.0
                for block_of_row in range(BLOCK_COUNT)
            ]
        )


@dataclass(frozen=True)
class Adjustment:
    """A solved state with what its uncertainty is made of."""

    state: AdjustmentState
    labels: np.ndarray
    """Road of each track, -2 for none, shape (tracks,)."""
    distance_px: np.ndarray
    """Root mean square distance of each track from its nearest road's circle, shape (tracks,)."""
    whitened2: np.ndarray
    """Mean squared whitened distance of each track from its road, inf for none, shape (tracks,)."""
    turning2: np.ndarray
    """The same of the windows and lives, shape (windows + lives,)."""
    scales: np.ndarray
    """Median of them over tracks on roads, windows and lives: 1 when noise and wander are as the options say; (3,)."""
    problem: Problem
    """The problem at the solution: steps from there are the parameters of the covariance."""
    covariance: np.ndarray
    """Of the parameters, shape (parameters, parameters)."""
    information: np.ndarray
    """Of the evidence alone about the parameters, shape (parameters, parameters)."""
    turning_information: np.ndarray
    """The same of the vehicles that turn alone."""
    vehicle_correlation: float
    """How much the pulls of one vehicle's tracks on the solution correlate, 0 to 1."""

    @property
    def plane_known(self) -> bool:
        """Whether anything tells how the plane lies about its first road: another road, or vehicles that turn."""
        return len(self.state.angles_rad) > 1 or self.problem.config.turning

    @property
    def scale(self) -> float:
        """Median of the mean squared whitened distances of the tracks on roads."""
        return float(self.scales[0])

    @property
    def crossing_fixed(self) -> bool:
        """Whether the angle between the first two roads was held."""
        return self.problem.config.crossing_rad is not None and len(self.state.angles_rad) > 1

    @property
    def focal_sigma(self) -> float:
        """Standard deviation of the focal length, relative."""
        return float(self.sigma(lambda state: np.array([np.log(state.camera.focal_px)]))[0])

    def inliers(self) -> np.ndarray:
        """Which tracks follow their road as closely as the bulk does, shape (tracks,)."""
        return (self.labels >= 0) & (self.whitened2 < INLIER_MEDIANS * max(self.scale, MIN_RESIDUAL_SCALE))

    def sigma(self, function: Callable[[AdjustmentState], np.ndarray]) -> np.ndarray:
        """Standard deviation of a function of the state, shape of its result."""
        return propagate_sigma(
            lambda step: function(self.problem.parameters.state(step)), self.problem.parameters.size, self.covariance
        )

    def covariance_of(self, function: Callable[[AdjustmentState], np.ndarray]) -> np.ndarray:
        """Covariance (n, n) of a function of the state with n results."""
        return propagate_covariance(
            lambda step: function(self.problem.parameters.state(step)), self.problem.parameters.size, self.covariance
        )


def assign_roads(
    state: AdjustmentState, unprojected: UnprojectedTracks, limit_px: float = ROAD_OUTLIER_PX
) -> tuple[np.ndarray, np.ndarray]:
    """Give each track its nearest road (-2 beyond `limit_px`) and its mean squared distance in px^2, inf for none."""
    if not len(state.angles_rad):
        return np.full(len(unprojected.matrix), -2), np.full(len(unprojected.matrix), np.inf)
    distance2 = squared_distances_through(unprojected.matrix, state.directions)
    nearest = np.argmin(distance2, axis=0)
    least = distance2[nearest, np.arange(len(nearest))]
    return np.where(least < limit_px**2, nearest, -2), least


def adjust(
    start: AdjustmentState,
    tracks: TrackSet,
    config: AdjustmentConfig,
    *,
    refine: bool = False,
    warm_start: WarmStart = (None, None, None),
) -> Adjustment:
    """Alternate between assigning tracks to roads and a robust Gauss-Newton step, from a start.

    With `refine` the start is a solution already, and nothing is loosened first; `warm_start` is what was solved inside
    there, for the same windows and lives.
    """
    state, problem = with_crossing_angle(start, config.crossing_rad), None
    for robust_limit in (() if refine else ROBUST_LIMIT_SCHEDULE) + MAX_ITERATIONS * (FINAL_ROBUST_LIMIT,):
        # a start may be off by more than a true track ever is: only the last rounds cut off
        unprojected = UnprojectedTracks.through(state.camera, tracks)
        labels, _ = assign_roads(state, unprojected, ROAD_OUTLIER_PX if robust_limit <= FINAL_ROBUST_LIMIT else np.inf)
        if not _enough_rows(labels, config):
            break
        problem = Problem(state, tracks, labels, config, warm_start, unprojected)
        step, state, warm_start = _gauss_newton_step(problem, robust_limit)
        if robust_limit <= FINAL_ROBUST_LIMIT and _converged(step, config.prior):
            break
    return _evaluate(problem or Problem(state, tracks, np.zeros(len(tracks), int), config), state, warm_start, tracks)


def _enough_rows(labels: np.ndarray, config: AdjustmentConfig) -> bool:
    turning = len(config.windows) + (0 if config.bundle is None else len(config.bundle.lives))
    return np.count_nonzero(labels >= 0) + turning >= MIN_RESIDUAL_ROWS


def _gauss_newton_step(problem: Problem, robust_limit: float) -> tuple[np.ndarray, AdjustmentState, WarmStart]:
    """Take one Gauss-Newton step on the robust cost, shortened until the cost does not grow."""
    rows, prior = problem.linearise(), problem.config.prior
    scale = problem.scales(rows.squared)[problem.block_of_row]
    vehicle_weight = problem.vehicle_weight * rows.influence / scale
    weight = vehicle_weight * influence(rows.squared, robust_limit * scale)
    gradient, known = problem.parameters.prior_gradient(problem.parameters.base.camera)
    matrix = np.tensordot(weight, rows.curvature, 1) + np.diag(known)
    step = -np.linalg.lstsq(matrix, gradient + weight @ rows.gradient, rcond=1e-12)[0]

    def cost(squared: np.ndarray, camera: Camera) -> float:
        deviations = prior.deviations(camera)
        return float(
            (vehicle_weight * problem.dof * loss(squared, robust_limit * scale)).sum() + deviations @ deviations
        )

    here = cost(rows.squared, problem.parameters.base.camera)
    for _ in range(MAX_BACKTRACKS):
        state = problem.parameters.state(step)
        warm_start, squared = problem.at(step)
        if cost(squared, state.camera) <= here:
            return step, state, warm_start
        step = step / 2
    return np.zeros_like(step), problem.parameters.base, problem.warm_start


def influence(squared: np.ndarray, limit: float) -> np.ndarray:
    """Geman-McClure weight of a mean squared distance: 1 at 0, a quarter at `limit`."""
    return 1.0 / (1.0 + squared / limit) ** 2


def loss(squared: np.ndarray, limit: float) -> np.ndarray:
    """Loss whose derivative by `squared` is `influence`."""
    return squared / (1.0 + squared / limit)


def bounded_loss(squared: np.ndarray, limit: float) -> np.ndarray:
    """`loss` with its bound, `limit`, for tracks infinitely far away."""
    far = ~np.isfinite(squared)
    return np.where(far, limit, loss(np.where(far, 0.0, squared), limit))


def _converged(step: np.ndarray, prior: LensPrior) -> bool:
    limit = np.full(len(step), CONVERGED_STEP)
    limit[: len(prior.free)][np.isfinite(prior.sigma[prior.free])] = CONVERGED_STEP_SIGMAS
    return bool((np.abs(step) < limit).all())


def _evaluate(last: Problem, state: AdjustmentState, warm_start: WarmStart, tracks: TrackSet) -> Adjustment:
    """Measure a solution: distances, cost, covariance and information."""
    unprojected = UnprojectedTracks.through(state.camera, tracks)
    labels, distance2 = assign_roads(state, unprojected)
    problem = (
        Problem(state, tracks, labels, last.config, warm_start, unprojected)
        if _enough_rows(labels, last.config)
        else last
    )
    rows, dof = problem.linearise(), problem.dof
    scales = problem.scales(rows.squared)
    scale = scales[problem.block_of_row]
    limit = FINAL_ROBUST_LIMIT * scale
    shared = problem.vehicle_weight * rows.influence / scale
    weight = shared * influence(rows.squared, limit)
    second_order = -4.0 / limit / dof * shared / (1.0 + rows.squared / limit) ** 3
    _, prior = problem.parameters.prior_gradient(state.camera)
    covariance = jackknife_covariance(rows.gradient, rows.curvature, weight, second_order, problem.vehicle_ids, prior)
    covariance += np.diag(_unmodelled(problem.parameters) ** 2)
    road = problem.block_of_row == 0
    whitened2 = np.full(len(tracks), np.inf)
    whitened2[problem.used] = rows.squared[road]
    information = np.tensordot(weight, rows.curvature, 1)
    pulls = rows.gradient[road] * np.sqrt(influence(rows.squared, limit)[road])[:, None]
    pulls = pulls / np.sqrt(np.maximum(np.diag(information), 1e-12))
    return Adjustment(
        state=state,
        labels=labels,
        distance_px=np.sqrt(distance2),
        whitened2=whitened2,
        turning2=rows.squared[~road],
        scales=scales,
        problem=problem,
        covariance=covariance,
        information=information,
        turning_information=np.tensordot(weight[~road], rows.curvature[~road], 1),
        vehicle_correlation=intraclass_correlation(problem.vehicle_ids[road], pulls),
    )


def _unmodelled(parameters: Parameterisation) -> np.ndarray:
    """Standard deviation (parameters,) of each parameter that the residuals know nothing of."""
    sigma = np.zeros(parameters.size)
    sigma[: parameters.lens][parameters.config.prior.free == 0] = UNMODELLED_FOCAL
    sigma[parameters.lens : parameters.lens + len(parameters.axes)] = UNMODELLED_RAD
    return sigma


def regroup_vehicles(fit: Adjustment, tracks: TrackSet) -> TrackSet:
    """Return the tracks with vehicles that are bodies on the ground of a solution."""
    rays = unproject_rays(fit.state.camera, tracks.pixels)
    up = upward_normal(fit.state, fit.problem.config, rays)
    height = fit.problem.config.height_m or DEFAULT_CAMERA_HEIGHT_M
    below = np.maximum(-(rays.bearings @ up), MIN_DEPRESSION_GROUPING_RAD)
    ground_m = height * (rays.bearings @ fit.state.rotation[:, :2]) / below[..., None]
    return replace(tracks, vehicles=group_into_bodies(tracks, ground_m))


def evaluate_with(fit: Adjustment, tracks: TrackSet, config: AdjustmentConfig) -> Adjustment:
    """Measure the uncertainty of a solution under another setting, such as one that holds less."""
    warm_start = fit.problem.warm_start
    return _evaluate(Problem(fit.state, tracks, fit.labels, config, warm_start), fit.state, warm_start, tracks)


def evaluate_at(
    state: AdjustmentState, tracks: TrackSet, config: AdjustmentConfig, covariance: np.ndarray
) -> Adjustment:
    """See how tracks follow the roads of a state that was found otherwise, with the covariance that it has from there.

    Its parameters are those of `Parameterisation(state, setting)`.
    """
    labels, _ = assign_roads(state, UnprojectedTracks.through(state.camera, tracks))
    fit = _evaluate(Problem(state, tracks, labels, config), state, (None, None, None), tracks)
    return replace(fit, covariance=covariance)


def road_support(fit: Adjustment, tracks: TrackSet) -> list[np.ndarray]:
    """For each road, which tracks (masks, shape (tracks,)) it explains and no other road could.

    A second direction close to the first, or met only by short tracks, is an echo of the first; a real road's
    tracks miss the other road's circles by many times the noise.
    """
    unprojected = UnprojectedTracks.through(fit.state.camera, tracks)
    distance = np.sqrt(squared_distances_through(unprojected.matrix, fit.state.directions))
    inliers = fit.inliers()
    typical = float(np.median(fit.distance_px[inliers])) if inliers.any() else np.inf
    support = []
    for road in range(len(distance)):
        others = np.delete(distance, road, axis=0)
        nearest_other = others.min(axis=0) if len(others) else np.full(len(tracks), np.inf)
        apart = nearest_other > MIN_ROAD_DISTANCE_RATIO * np.maximum(distance[road], typical)
        support.append(inliers & (fit.labels == road) & apart)
    return support
