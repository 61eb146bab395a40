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

from autocalib_ros.camera import Camera
from autocalib_ros.estimation.great_circles import Seen, TrackSet, rays_of
from autocalib_ros.estimation.lens_prior import LensPrior
from autocalib_ros.estimation.path_noise import USUAL_HEIGHT_M
from autocalib_ros.estimation.planar_motion import Motion
from autocalib_ros.estimation.rows import MotionRows, RoadRows, Rows
from autocalib_ros.estimation.state import Setting, State, Steps, crossed, ground_up
from autocalib_ros.estimation.uncertainty import cluster_covariance, correlation_within, propagate
from autocalib_ros.estimation.vanishing_points import distances2_through
from autocalib_ros.estimation.vehicles import bodies

TIGHTENING = (8.0, 4.0, 2.0)
TIGHTEST = 1.0
"""Squared distance at which a row's influence has fallen to a quarter, in medians, round by round.

The bulk of the tracks says what noise is; a lane change or a slow turn a few pixels beyond it is few in number
but long in lever. From loose to tight, so that a start some per cent off still reaches the best solution; then
until assignment, influence and state stand still.
"""
ROUNDS = 16
"""Most rounds; a state that has not settled by then swings between two assignments of a few tracks."""
SETTLED, SETTLED_SIGMAS = 3e-4, 3e-3
"""The rounds end when log f and all angles (radians), and what is counted in prior sigmas, move by less."""
BACKTRACKS = 4
LEAST_SCALE = 0.05
"""Traffic without noise, as tests make it, still has a spread to divide by."""
MIN_ROWS = 4
"""Fewer tracks on roads, and windows, do not go on with a solution: it is judged, and refused, as it stands."""
OUTLIER_PX = 4.0
"""A track farther than this from every road, root mean square, belongs to none."""
NEAREST_HORIZON = 0.03
"""Least angle below the horizon at which a point is placed on the road, radians."""
EXPLAINED = 3.0
"""A track or a window is explained when its mean squared whitened distance is below so many medians."""
DISCRIMINATION = 5.0
"""A track tells two roads apart when it is so many times farther from the one than from the other."""


class Problem:
    """Labelled tracks and windows at a state: whitened residuals, and their derivatives by a step from there."""

    def __init__(self, base: State, tracks: TrackSet, labels: np.ndarray, setting: Setting,
                 motion: Motion | None = None, seen: Seen | None = None) -> None:
        self.steps = Steps(base, setting)
        self.used = np.flatnonzero(labels >= 0)
        """Indices of the tracks that are on a road: the first rows; the windows follow."""
        on_roads, windows = tracks.subset(self.used), setting.windows
        seen = seen or Seen.through(base.camera, tracks)
        self.roads = RoadRows(self.steps, on_roads, labels[self.used], seen.subset(self.used))
        self.motions = MotionRows(self.steps, motion)
        self.of_window = np.repeat([False, True], [len(self.used), len(windows)])
        self.clusters = np.concatenate([on_roads.vehicles, windows.bodies + on_roads.vehicles.max(initial=-1) + 1])
        self.share = np.concatenate([tracks.independence(setting.vehicle_correlation)[self.used],
                                     windows.share_of_body])

    @property
    def setting(self) -> Setting:
        """What the solution was given."""
        return self.steps.setting

    def residuals(self, state: State) -> tuple[np.ndarray, Motion]:
        """Whitened distances (rows, samples) at a state, and the motions there."""
        motion, distances = self.motions.at(state)
        return np.concatenate([self.roads.residuals(state), distances]), motion

    def linearised(self) -> Rows:
        """Residuals at the base and their derivatives by the parameters."""
        parts = self.roads.linearised(), self.motions.linearised()
        return Rows(*(np.concatenate([getattr(part, name) for part in parts])
                      for name in ('residuals', 'slopes', 'freedom', 'influence')))

    def scales(self, squared: np.ndarray) -> np.ndarray:
        """Median of the mean squared distances (rows,) over each kind of row, for each row (rows,)."""
        result = np.ones(len(squared))
        for kind in (self.of_window, ~self.of_window):
            if kind.any():
                result[kind] = max(float(np.median(squared[kind])), LEAST_SCALE)
        return result


@dataclass(frozen=True)
class JointFit:
    """A solved state with what its uncertainty is made of."""

    state: State
    labels: np.ndarray
    """Road of each track, -2 for none, shape (tracks,)."""
    distance_px: np.ndarray
    """Root mean square distance of each track from its nearest road's circle, shape (tracks,)."""
    whitened2: np.ndarray
    """Mean squared whitened distance of each track from its road, inf for none, shape (tracks,)."""
    scale: float
    """Median of `whitened2` over the tracks on roads: 1 when noise and wander are as the options say."""
    motion: Motion
    """Motion of each window."""
    windows2: np.ndarray
    """Mean squared whitened distance of each window's points, shape (windows,)."""
    window_scale: float
    """Median of `windows2`."""
    problem: Problem
    """The problem at the solution: steps from there are the parameters of the covariance."""
    covariance: np.ndarray
    """Of the parameters, shape (parameters, parameters)."""
    information: np.ndarray
    """Of the evidence alone about the parameters, shape (parameters, parameters)."""
    motion_information: np.ndarray
    """The same of the vehicles that turn alone."""
    vehicle_correlation: float
    """How much the pulls of one vehicle's tracks on the solution correlate, 0 to 1."""

    @property
    def plane_known(self) -> bool:
        """Whether anything tells how the plane lies about its first road: another road, or vehicles that turn."""
        return len(self.state.angles_rad) > 1 or len(self.problem.setting.windows) > 0

    @property
    def crossing_held(self) -> bool:
        """Whether the angle between the first two roads was held."""
        return self.problem.setting.crossing_rad is not None and len(self.state.angles_rad) > 1

    def explained(self) -> np.ndarray:
        """Which tracks follow their road as closely as the bulk does, shape (tracks,)."""
        return (self.labels >= 0) & (self.whitened2 < EXPLAINED * max(self.scale, LEAST_SCALE))

    def explained_windows(self) -> np.ndarray:
        """Which windows move in the plane as closely as the bulk does, shape (windows,)."""
        return self.windows2 < EXPLAINED * max(self.window_scale, LEAST_SCALE)

    def sigma(self, function: Callable[[State], np.ndarray]) -> np.ndarray:
        """Standard deviation of a function of the state, shape of its result."""
        return propagate(lambda step: function(self.problem.steps.state(step)), self.problem.steps.size,
                         self.covariance)


def assign(state: State, seen: Seen, limit_px: float = OUTLIER_PX) -> tuple[np.ndarray, np.ndarray]:
    """Give each track its nearest road (-2 beyond `limit_px`) and its mean squared distance in px^2, inf for none."""
    if not len(state.angles_rad):
        return np.full(len(seen.matrix), -2), np.full(len(seen.matrix), np.inf)
    distance2 = distances2_through(seen.matrix, state.directions)
    nearest = np.argmin(distance2, axis=0)
    least = distance2[nearest, np.arange(len(nearest))]
    return np.where(least < limit_px**2, nearest, -2), least


def solve_joint(start: State, tracks: TrackSet, setting: Setting, *, refine: bool = False,
                motion: Motion | None = None) -> JointFit:
    """Alternate between assigning tracks to roads and a robust Gauss-Newton step, from a start.

    With `refine` the start is a solution already, and nothing is loosened first. `motion` is that of the windows
    near the start, where it is known.
    """
    state, problem = crossed(start, setting.crossing_rad), None
    for tightness in (() if refine else TIGHTENING) + ROUNDS * (TIGHTEST,):
        # a start may be off by more than a true track ever is: only the last rounds cut off
        seen = Seen.through(state.camera, tracks)
        labels, _ = assign(state, seen, OUTLIER_PX if tightness <= TIGHTEST else np.inf)
        if not _enough(labels, setting):
            break
        problem = Problem(state, tracks, labels, setting, motion, seen)
        step, state, motion = _stepped(problem, tightness)
        if tightness <= TIGHTEST and _settled(step, setting.prior):
            break
    return _judged(problem or Problem(state, tracks, np.zeros(len(tracks), int), setting), state, motion, tracks)


def _enough(labels: np.ndarray, setting: Setting) -> bool:
    return np.count_nonzero(labels >= 0) + len(setting.windows) >= MIN_ROWS


def _stepped(problem: Problem, tightness: float) -> tuple[np.ndarray, State, Motion]:
    """Take one Gauss-Newton step on the robust cost, shortened until the cost does not grow."""
    rows, prior = problem.linearised(), problem.setting.prior
    squared = (rows.residuals**2).sum(axis=1) / rows.freedom
    scale = problem.scales(squared)
    share = problem.share * rows.influence / scale
    weight = share * influence(squared, tightness * scale)
    gradient, known = problem.steps.prior_gradient(problem.steps.base.camera)
    matrix = information_of(rows.slopes, weight) + np.diag(known)
    weighted = (weight[:, None] * rows.residuals).ravel()
    gradient = gradient + weighted @ rows.slopes.reshape(-1, len(gradient))
    step = -np.linalg.lstsq(matrix, gradient, rcond=1e-12)[0]

    def cost(whitened: np.ndarray, camera: Camera) -> float:
        apart = (whitened**2).sum(axis=1) / rows.freedom
        deviations = prior.deviations(camera)
        return float((share * rows.freedom * loss(apart, tightness * scale)).sum() + deviations @ deviations)

    here = cost(rows.residuals, problem.steps.base.camera)
    for _ in range(BACKTRACKS):
        state = problem.steps.state(step)
        residuals, motion = problem.residuals(state)
        if cost(residuals, state.camera) <= here:
            return step, state, motion
        step = step / 2
    return np.zeros_like(step), problem.steps.base, problem.motions.motion


def information_of(slopes: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Sum of weight (rows,) times J^T J of slopes (rows, samples, parameters); shape (parameters, parameters)."""
    weighted = (slopes * weight[:, None, None]).reshape(-1, slopes.shape[2])
    return weighted.T @ slopes.reshape(-1, slopes.shape[2])


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


def _settled(step: np.ndarray, prior: LensPrior) -> bool:
    limit = np.full(len(step), SETTLED)
    limit[:len(prior.free)][np.isfinite(prior.sigma[prior.free])] = SETTLED_SIGMAS
    return bool((np.abs(step) < limit).all())


def _judged(last: Problem, state: State, motion: Motion | None, tracks: TrackSet) -> JointFit:
    """Measure a solution: distances, cost, covariance and information."""
    seen = Seen.through(state.camera, tracks)
    labels, distance2 = assign(state, seen)
    problem = Problem(state, tracks, labels, last.setting, motion, seen) if _enough(labels, last.setting) else last
    rows = problem.linearised()
    squared = (rows.residuals**2).sum(axis=1) / rows.freedom
    scale = problem.scales(squared)
    limit = TIGHTEST * scale
    shared = problem.share * rows.influence / scale
    _, prior = problem.steps.prior_gradient(state.camera)
    whitened2 = np.full(len(tracks), np.inf)
    whitened2[problem.used] = squared[~problem.of_window]
    weight = shared * influence(squared, limit)
    information = information_of(rows.slopes, weight)
    bend = -4.0 / limit / rows.freedom * shared / (1.0 + squared / limit) ** 3
    covariance = cluster_covariance(rows.slopes, rows.residuals, weight, bend, problem.clusters, prior)
    road = ~problem.of_window
    pulls = (rows.slopes[road].transpose(0, 2, 1) @ rows.residuals[road][..., None])[..., 0]
    pulls = pulls * np.sqrt(influence(squared, limit)[road])[:, None] / np.sqrt(np.maximum(np.diag(information), 1e-12))
    return JointFit(
        state=state, labels=labels, distance_px=np.sqrt(distance2), whitened2=whitened2,
        scale=float(scale[road][0]) if road.any() else 1.0, motion=problem.motions.motion,
        windows2=squared[problem.of_window], window_scale=float(scale[~road][0]) if not road.all() else 1.0,
        problem=problem, covariance=covariance, information=information,
        motion_information=information_of(rows.slopes[~road], weight[~road]),
        vehicle_correlation=correlation_within(problem.clusters[road], pulls))


def noise_cost(fit: JointFit, tracks: TrackSet, *, drifting: bool) -> float:
    """Twice the negative logarithm of how probable the residuals are with or without drift, their scale fitted.

    Infinite where hardly a track is explained.
    """
    labels = np.where(fit.explained(), fit.labels, -2)
    if np.count_nonzero(labels >= 0) < MIN_ROWS:
        return np.inf
    steps = Steps(fit.state, replace(fit.problem.setting, drifting=drifting))
    used = labels >= 0
    on_roads = tracks.subset(used)
    rows = RoadRows(steps, on_roads, labels[used], Seen.through(fit.state.camera, on_roads))
    squared = (rows.residuals(fit.state)**2).sum(axis=1) / rows.freedom
    scale = max(float(np.median(squared)), LEAST_SCALE)
    return float((rows.freedom * np.log(scale) - 2.0 * rows.log_density()).sum())


def with_bodies(fit: JointFit, tracks: TrackSet) -> TrackSet:
    """Return the tracks with vehicles that are bodies on the ground of a solution."""
    rays = rays_of(fit.state.camera, tracks.pixels)
    up = ground_up(fit.state, fit.problem.setting, rays)
    height = fit.problem.setting.height_m or USUAL_HEIGHT_M
    below = np.maximum(-(rays.bearings @ up), NEAREST_HORIZON)
    ground_m = height * (rays.bearings @ fit.state.rotation[:, :2]) / below[..., None]
    return replace(tracks, vehicles=bodies(tracks, ground_m))


def judged_with(fit: JointFit, tracks: TrackSet, setting: Setting) -> JointFit:
    """Measure the uncertainty of a solution under another setting, such as one that holds less."""
    problem = Problem(fit.state, tracks, fit.labels, setting, fit.motion)
    return _judged(problem, fit.state, fit.motion, tracks)


def cost_at_scale(fit: JointFit, tracks: TrackSet, scale: float, window_scale: float) -> float:
    """Twice the negative logarithm of a fit's probability, for comparison between fits of the same evidence.

    All at one scale for tracks and one for windows, with the prior and, by Laplace's approximation, the volume that
    the evidence leaves of it.
    """
    freedom = np.maximum((tracks.weights > 0).sum(axis=1) - 1, 1)
    share = tracks.independence(fit.problem.setting.vehicle_correlation)
    cost = (share / scale * freedom * bounded_loss(fit.whitened2, TIGHTEST * scale)).sum()
    windows = fit.problem.setting.windows
    cost += (windows.share_of_body / window_scale * fit.problem.motions.freedom
             * bounded_loss(fit.windows2, TIGHTEST * window_scale)).sum()
    deviations, prior = fit.problem.steps.prior_gradient(fit.state.camera)
    volume = np.linalg.slogdet(fit.information + np.diag(prior) + 1e-9 * np.eye(len(prior)))[1]
    return float(cost + deviations @ deviations + volume)


def road_support(fit: JointFit, tracks: TrackSet) -> list[np.ndarray]:
    """For each road, which tracks (masks, shape (tracks,)) it explains and no other road could.

    A second direction close to the first, or met only by short tracks, is an echo of the first; a real road's
    tracks miss the other road's circles by many times the noise.
    """
    seen = Seen.through(fit.state.camera, tracks)
    distance = np.sqrt(distances2_through(seen.matrix, fit.state.directions))
    explained = fit.explained()
    typical = float(np.median(fit.distance_px[explained])) if explained.any() else np.inf
    support = []
    for road in range(len(distance)):
        others = np.delete(distance, road, axis=0)
        nearest_other = others.min(axis=0) if len(others) else np.full(len(tracks), np.inf)
        apart = nearest_other > DISCRIMINATION * np.maximum(distance[road], typical)
        support.append(explained & (fit.labels == road) & apart)
    return support
