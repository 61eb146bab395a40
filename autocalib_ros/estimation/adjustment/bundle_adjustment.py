"""Robust bundle adjustment of lens, ground plane and road directions, with all residuals in observed pixels.

Unknowns: focal length, principal point, k1 (and k2 where it is free), the rotation of the ground plane and the angle
of each road in it. Residuals: distances of straight tracks from the great circle through their road's direction, and
reprojection errors of turning vehicles as rigid bodies in planar motion. Residuals are whitened by the noise model.
Iteratively reweighted Gauss-Newton with the kernel of Geman & McClure (1985) on the mean squared whitened residual of
each track, two-frame window or tracklet; the kernel tightens round by round (graduated non-convexity).
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
from autocalib_ros.estimation.adjustment.problem import MIN_RESIDUAL_SCALE, Problem, WarmStart
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks
from autocalib_ros.estimation.observations.vehicle_grouping import group_into_bodies
from autocalib_ros.geometry.great_circles import squared_distances_through, unproject_rays
from autocalib_ros.geometry.ground_plane import depression_sine
from autocalib_ros.geometry.robust_kernels import geman_mcclure_loss, geman_mcclure_weight

ROBUST_LIMIT_SCHEDULE = (8.0, 4.0, 2.0)
FINAL_ROBUST_LIMIT = 1.0
"""Squared residual at which the weight of a row is a quarter, in medians of the squared residual, iteration by
iteration; the final value holds until convergence.

The median row defines the noise. A lane change or a slow turn a few pixels beyond it is rare but has much leverage.
Tightening from loose to strict lets a start some per cent away reach the best minimum (judgement, on synthetic
traffic).
"""
MAX_ITERATIONS = 16
"""Iterations at the final limit; a state that has not converged by then oscillates between two assignments of a few
tracks."""
CONVERGED_STEP, CONVERGED_STEP_SIGMAS = 3e-4, 3e-3
"""Largest step at convergence: of log f and all angles (radians), and of parameters in units of their prior sigma."""
MAX_BACKTRACKS = 4
"""Halvings of a step that increases the cost."""
MIN_RESIDUAL_ROWS = 4
"""Fewest tracks on roads, windows and tracklets for another iteration; with fewer, the state is evaluated as it is,
and the gates refuse it."""
ROAD_OUTLIER_PX = 4.0
"""Root mean square distance in pixels beyond which a track is assigned to no road. Judgement."""
MIN_DEPRESSION_GROUPING_RAD = 0.03
"""Smallest depression angle in radians of points placed on the road for grouping: 33 camera heights away."""
INLIER_MEDIANS = 3.0
"""A track is an inlier when its mean squared whitened distance is below this many medians. Judgement."""
UNMODELLED_FOCAL, UNMODELLED_RAD = 0.001, np.radians(0.03)
"""Standard deviations of model errors that residuals do not show: relative focal length (real lenses deviate from
their family) and ground normal in radians (a road is crowned by about a degree to either side, not planar)."""
HEADING_BIAS_RAD = np.radians(0.15)
"""Standard deviation of the common heading error of all vehicles of one driving direction, radians: 0 to 0.25 degrees
against the truth of rendered scenes."""
MIN_ROAD_DISTANCE_RATIO = 5.0
"""A track discriminates between two roads when its distance from one is at least this multiple of that from the other.
Judgement."""


@dataclass(frozen=True)
class Adjustment:
    """An adjusted state with its residuals and the matrices of its uncertainty."""

    state: AdjustmentState
    labels: np.ndarray
    """Road of each track, -2 for none, shape (tracks,)."""
    distance_px: np.ndarray
    """Root mean square distance of each track from its nearest road's circle, shape (tracks,)."""
    whitened2: np.ndarray
    """Mean squared whitened distance of each track from its road, inf for none, shape (tracks,)."""
    turning2: np.ndarray
    """Mean squared whitened residual of each window and tracklet, shape (windows + tracklets,)."""
    scales: np.ndarray
    """Median of the squared residuals of tracks, windows and tracklets: 1 where the noise options hold, shape (3,)."""
    problem: Problem
    """The problem linearised at the solution; the covariance is of its parameter steps."""
    covariance: np.ndarray
    """Of the parameters, shape (parameters, parameters)."""
    information: np.ndarray
    """Information of the evidence, without the prior, about the parameters, shape (parameters, parameters)."""
    turning_information: np.ndarray
    """Part of the information that comes from turning vehicles, shape (parameters, parameters)."""
    vehicle_correlation: float
    """Intraclass correlation, 0 to 1, of the scores of one vehicle's tracks."""

    @property
    def plane_known(self) -> bool:
        """Whether the rotation about the first road is observable: by a second road or by turning vehicles."""
        return len(self.state.angles_rad) > 1 or self.problem.config.turning

    @property
    def scale(self) -> float:
        """Median of the mean squared whitened distances of the tracks on roads."""
        return float(self.scales[0])

    @property
    def crossing_known(self) -> bool:
        """Whether the angle between the first two roads was given or assumed."""
        return self.problem.parameters.crossing_known

    @property
    def focal_sigma(self) -> float:
        """Relative standard deviation of the focal length."""
        return float(self.sigma(lambda state: np.array([np.log(state.camera.focal_px)]))[0])

    def inliers(self) -> np.ndarray:
        """Return the mask (tracks,) of tracks within `INLIER_MEDIANS` of their road."""
        return (self.labels >= 0) & (self.whitened2 < INLIER_MEDIANS * max(self.scale, MIN_RESIDUAL_SCALE))

    def sigma(self, function: Callable[[AdjustmentState], np.ndarray]) -> np.ndarray:
        """Return the standard deviation of a function of the state, shape of its result."""
        return propagate_sigma(
            lambda step: function(self.problem.parameters.probed(step)), self.problem.parameters.size, self.covariance
        )

    def covariance_of(self, function: Callable[[AdjustmentState], np.ndarray]) -> np.ndarray:
        """Return the covariance (n, n) of a function of the state with n results."""
        return propagate_covariance(
            lambda step: function(self.problem.parameters.probed(step)), self.problem.parameters.size, self.covariance
        )


def assign_roads(
    state: AdjustmentState, unprojected: UnprojectedTracks, limit_px: float = ROAD_OUTLIER_PX
) -> tuple[np.ndarray, np.ndarray]:
    """Assign each track to its nearest road.

    Returns the road (tracks,), -2 beyond `limit_px`, and the mean squared distance in px^2 (tracks,), inf without
    roads.
    """
    if not len(state.angles_rad):
        return np.full(len(unprojected.matrix), -2), np.full(len(unprojected.matrix), np.inf)
    distance2 = squared_distances_through(unprojected.matrix, state.directions)
    nearest = np.argmin(distance2, axis=0)
    smallest = distance2[nearest, np.arange(len(nearest))]
    return np.where(smallest < limit_px**2, nearest, -2), smallest


def adjust(
    start: AdjustmentState,
    tracks: TrackSet,
    config: AdjustmentConfig,
    *,
    refine: bool = False,
    warm_start: WarmStart = (None, None, None),
) -> Adjustment:
    """Adjust a state: alternate the assignment of tracks to roads with a robust Gauss-Newton step.

    With `refine` the start is near the minimum, and only the final robust limit is used. `warm_start` holds the
    eliminated unknowns of the same windows and tracklets at the start.
    """
    state, problem = with_crossing_angle(start, None if config.crossing_sigma_rad > 0 else config.crossing_rad), None
    for robust_limit in (() if refine else ROBUST_LIMIT_SCHEDULE) + MAX_ITERATIONS * (FINAL_ROBUST_LIMIT,):
        # at a coarse start, inliers may be farther away than any outlier limit: reject only in the final rounds
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
    turning = len(config.windows) + (0 if config.bundle is None else len(config.bundle.tracklets))
    return np.count_nonzero(labels >= 0) + turning >= MIN_RESIDUAL_ROWS


def _gauss_newton_step(problem: Problem, robust_limit: float) -> tuple[np.ndarray, AdjustmentState, WarmStart]:
    """Take one Gauss-Newton step on the robust cost, halved until the cost does not increase."""
    rows, parameters = problem.linearise(), problem.parameters
    scale = problem.scales(rows.squared)[problem.block_of_row]
    row_weight = problem.vehicle_weight * rows.influence / scale
    weight = row_weight * geman_mcclure_weight(rows.squared, robust_limit * scale)
    gradient, prior_information = parameters.prior_gradient(parameters.base)
    matrix = np.tensordot(weight, rows.curvature, 1) + np.diag(prior_information)
    step = -np.linalg.lstsq(matrix, gradient + weight @ rows.gradient, rcond=1e-12)[0]

    def cost(squared: np.ndarray, state: AdjustmentState) -> float:
        loss = geman_mcclure_loss(squared, robust_limit * scale)
        return float((row_weight * problem.dof * loss).sum()) + parameters.prior_cost(state)

    base_cost = cost(rows.squared, parameters.base)
    for _ in range(MAX_BACKTRACKS):
        state = parameters.state(step)
        warm_start, squared = problem.at(step)
        if cost(squared, state) <= base_cost:
            return step, state, warm_start
        step = step / 2
    return np.zeros_like(step), parameters.base, problem.warm_start


def _converged(step: np.ndarray, prior: LensPrior) -> bool:
    limit = np.full(len(step), CONVERGED_STEP)
    limit[: len(prior.free)][np.isfinite(prior.sigma[prior.free])] = CONVERGED_STEP_SIGMAS
    return bool((np.abs(step) < limit).all())


def _evaluate(last: Problem, state: AdjustmentState, warm_start: WarmStart, tracks: TrackSet) -> Adjustment:
    """Evaluate a state: residuals, robust weights, covariance and information.

    `last` is kept as the problem where too few rows are left at the state.
    """
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
    row_weight = problem.vehicle_weight * rows.influence / scale
    robust_weight = geman_mcclure_weight(rows.squared, limit)
    weight = row_weight * robust_weight
    # the Hessian also has the derivative of the robust weight: a multiple of g g^T
    second_order = -4.0 / limit / dof * row_weight / (1.0 + rows.squared / limit) ** 3
    _, prior = problem.parameters.prior_gradient(state)
    covariance = jackknife_covariance(rows.gradient, rows.curvature, weight, second_order, problem.vehicle_ids, prior)
    covariance += np.diag(_unmodelled_sigmas(problem.parameters) ** 2)
    road = problem.block_of_row == 0
    information = np.tensordot(weight, rows.curvature, 1)
    covariance += _heading_bias_covariance(problem, rows.curvature[road], weight[road], information + np.diag(prior))
    whitened2 = np.full(len(tracks), np.inf)
    whitened2[problem.used] = rows.squared[road]
    scores = rows.gradient[road] * np.sqrt(robust_weight[road])[:, None]
    scores = scores / np.sqrt(np.maximum(np.diag(information), 1e-12))
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
        vehicle_correlation=intraclass_correlation(problem.vehicle_ids[road], scores),
    )


def _heading_bias_covariance(
    problem: Problem, curvatures: np.ndarray, weight: np.ndarray, information: np.ndarray
) -> np.ndarray:
    """Return the covariance (parameters, parameters) from a common heading error of the tracks of each direction.

    The errors of vehicles are independent, but for this one: the view of a body changes alike for all that drive the
    same way, and their tracked points drift alike. `curvatures` (tracks, parameters, parameters) and `weight` (tracks,)
    are of the tracks on roads, `information` (parameters, parameters) of all rows and the prior.
    """
    parameters = problem.parameters
    heading = np.flatnonzero(np.abs(parameters.axes[:, 2]) > 0.5)
    if not len(curvatures) or not len(heading) or not np.isfinite(information).all():
        return np.zeros((parameters.size, parameters.size))
    of_heading = curvatures[:, :, parameters.lens + int(heading[0])]  # J^T j by a turn of the track's road in the plane
    inverse = np.linalg.pinv(information, hermitian=True)
    directions = problem.straight.driving_directions()
    shifts = [inverse @ ((weight * (directions == each)) @ of_heading) for each in np.unique(directions)]
    return HEADING_BIAS_RAD**2 * np.array(shifts).T @ np.array(shifts)


def _unmodelled_sigmas(parameters: Parameterisation) -> np.ndarray:
    """Return the standard deviation (parameters,) of model errors that the residuals do not show."""
    sigma = np.zeros(parameters.size)
    sigma[: parameters.lens][parameters.config.prior.free == 0] = UNMODELLED_FOCAL
    sigma[parameters.lens : parameters.lens + len(parameters.axes)] = UNMODELLED_RAD
    return sigma


def regroup_vehicles(fit: Adjustment, tracks: TrackSet) -> TrackSet:
    """Return the tracks with vehicle ids from grouping into rigid bodies on the ground plane of a solution."""
    rays = unproject_rays(fit.state.camera, tracks.pixels)
    up = upward_normal(fit.state, fit.problem.config, rays)
    height = fit.problem.config.height_m or DEFAULT_CAMERA_HEIGHT_M
    below = depression_sine(rays.bearings, up, MIN_DEPRESSION_GROUPING_RAD)
    ground_m = height * (rays.bearings @ fit.state.rotation[:, :2]) / below[..., None]
    return replace(tracks, vehicles=group_into_bodies(tracks, ground_m))


def evaluate_with(fit: Adjustment, tracks: TrackSet, config: AdjustmentConfig) -> Adjustment:
    """Evaluate the uncertainty of a solution under another configuration, such as one with more free parameters."""
    warm_start = fit.problem.warm_start
    return _evaluate(Problem(fit.state, tracks, fit.labels, config, warm_start), fit.state, warm_start, tracks)


def evaluate_at(
    state: AdjustmentState, tracks: TrackSet, config: AdjustmentConfig, covariance: np.ndarray
) -> Adjustment:
    """Evaluate tracks at a state from another estimator, with that estimator's covariance.

    The covariance is of the parameters of `Parameterisation(state, config)`.
    """
    labels, _ = assign_roads(state, UnprojectedTracks.through(state.camera, tracks))
    fit = _evaluate(Problem(state, tracks, labels, config), state, (None, None, None), tracks)
    return replace(fit, covariance=covariance)


def road_support(fit: Adjustment, tracks: TrackSet) -> list[np.ndarray]:
    """Return for each road the mask (tracks,) of inliers that no other road explains.

    A spurious direction, close to the first or supported only by short tracks, shares its inliers with the first
    road. Tracks of a real road miss the circles of the other road by many times the noise.
    """
    unprojected = UnprojectedTracks.through(fit.state.camera, tracks)
    distance = np.sqrt(squared_distances_through(unprojected.matrix, fit.state.directions))
    inliers = fit.inliers()
    typical = float(np.median(fit.distance_px[inliers])) if inliers.any() else np.inf
    support = []
    for road in range(len(distance)):
        others = np.delete(distance, road, axis=0)
        nearest_other = others.min(axis=0) if len(others) else np.full(len(tracks), np.inf)
        discriminating = nearest_other > MIN_ROAD_DISTANCE_RATIO * np.maximum(distance[road], typical)
        support.append(inliers & (fit.labels == road) & discriminating)
    return support
