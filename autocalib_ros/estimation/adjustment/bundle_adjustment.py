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

from autocalib_ros.estimation.adjustment.covariance import cluster_covariance, correlation_within, propagate, propagated
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.noise_model import USUAL_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import Setting, State, Steps, crossed, ground_up
from autocalib_ros.estimation.adjustment.residual_blocks import LifeRows, MotionRows, RoadRows, Rows
from autocalib_ros.estimation.motion.planar_motion import Motion
from autocalib_ros.estimation.motion.rigid_bodies import Shapes
from autocalib_ros.estimation.observations.track_set import Seen, TrackSet
from autocalib_ros.estimation.observations.vehicle_grouping import bodies
from autocalib_ros.geometry.great_circles import distances2_through, rays_of
from autocalib_ros.lens.camera import Camera

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
"""A track is explained when its mean squared whitened distance is below so many medians."""
UNMODELLED_FOCAL, UNMODELLED_RAD = 0.001, np.radians(0.03)
"""What no residual shows, as standard deviations of the relative focal length and of the plane: a lens is not quite of
its family, and a road not quite a plane (its crown falls by a degree to either side)."""
DISCRIMINATION = 5.0
"""A track tells two roads apart when it is so many times farther from the one than from the other."""


Inner = tuple[None, Motion | None, Shapes | None]
"""What is solved inside the rows of each kind and goes on from step to step: motions of windows, shapes of lives."""
KINDS = 3
"""Tracks on roads, windows, lives."""


class Problem:
    """Labelled tracks and vehicles that turn, at a state: residuals, and their derivatives by a step from there."""

    def __init__(self, base: State, tracks: TrackSet, labels: np.ndarray, setting: Setting,
                 inner: Inner = (None, None, None), seen: Seen | None = None) -> None:
        self.steps = Steps(base, setting)
        self.used = np.flatnonzero(labels >= 0)
        """Indices of the tracks that are on a road: the first rows; windows and lives follow."""
        seen = seen or Seen.through(base.camera, tracks)
        share = tracks.independence(setting.vehicle_correlation)[self.used]
        self.kinds: list[RoadRows | MotionRows | LifeRows] = [
            RoadRows(self.steps, tracks.subset(self.used), labels[self.used], seen.subset(self.used), share),
            MotionRows(self.steps, inner[1])]
        if setting.bundle is not None:
            self.kinds.append(LifeRows(self.steps, setting.bundle, inner[2]))
        self.kind = np.repeat(np.arange(len(self.kinds)), [len(kind.freedom) for kind in self.kinds])
        """Index of the kind of each row, shape (rows,)."""
        self.freedom = np.concatenate([kind.freedom for kind in self.kinds])
        self.share = np.concatenate([kind.share for kind in self.kinds])

    @property
    def setting(self) -> Setting:
        """What the solution was given."""
        return self.steps.setting

    @property
    def inner(self) -> Inner:
        """What was solved inside each kind, to go on from."""
        return (None, self.kinds[1].inner, self.kinds[2].inner if len(self.kinds) > 2 else None)

    @property
    def owners(self) -> np.ndarray:
        """Vehicle of each row, shape (rows,): those on roads and those that turn are told apart."""
        on_roads, *turning = (kind.owners for kind in self.kinds)
        return np.concatenate([on_roads, *(owners + on_roads.max(initial=-1) + 1 for owners in turning)])

    def at(self, step: np.ndarray) -> tuple[Inner, np.ndarray]:
        """What is solved inside at a step, and the mean squared residuals there (rows,)."""
        parts = [kind.at(step) for kind in self.kinds]
        inner = [part[0] for part in parts] + [None]
        return (None, inner[1], inner[2]), np.concatenate([part[1] for part in parts])

    def linearised(self) -> Rows:
        """Sums over the residuals at the base and their derivatives by the parameters."""
        parts = [kind.linearised() for kind in self.kinds]
        return Rows(*(np.concatenate([getattr(part, name) for part in parts])
                      for name in ('squared', 'gradient', 'curvature', 'influence')))

    def scales(self, squared: np.ndarray) -> np.ndarray:
        """Median of the mean squared distances (rows,) over each kind of row, 1 where there is none; (kinds,)."""
        return np.array([max(float(np.median(squared[self.kind == kind])), LEAST_SCALE)
                         if (self.kind == kind).any() else 1.0 for kind in range(KINDS)])


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
        return len(self.state.angles_rad) > 1 or self.problem.setting.turning

    @property
    def scale(self) -> float:
        """Median of the mean squared whitened distances of the tracks on roads."""
        return float(self.scales[0])

    @property
    def crossing_held(self) -> bool:
        """Whether the angle between the first two roads was held."""
        return self.problem.setting.crossing_rad is not None and len(self.state.angles_rad) > 1

    @property
    def focal_sigma(self) -> float:
        """Standard deviation of the focal length, relative."""
        return float(self.sigma(lambda state: np.array([np.log(state.camera.focal_px)]))[0])

    def explained(self) -> np.ndarray:
        """Which tracks follow their road as closely as the bulk does, shape (tracks,)."""
        return (self.labels >= 0) & (self.whitened2 < EXPLAINED * max(self.scale, LEAST_SCALE))

    def sigma(self, function: Callable[[State], np.ndarray]) -> np.ndarray:
        """Standard deviation of a function of the state, shape of its result."""
        return propagate(lambda step: function(self.problem.steps.state(step)), self.problem.steps.size,
                         self.covariance)

    def covariance_of(self, function: Callable[[State], np.ndarray]) -> np.ndarray:
        """Covariance (n, n) of a function of the state with n results."""
        return propagated(lambda step: function(self.problem.steps.state(step)), self.problem.steps.size,
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
                inner: Inner = (None, None, None)) -> JointFit:
    """Alternate between assigning tracks to roads and a robust Gauss-Newton step, from a start.

    With `refine` the start is a solution already, and nothing is loosened first; `inner` is what was solved inside
    there, for the same windows and lives.
    """
    state, problem = crossed(start, setting.crossing_rad), None
    for tightness in (() if refine else TIGHTENING) + ROUNDS * (TIGHTEST,):
        # a start may be off by more than a true track ever is: only the last rounds cut off
        seen = Seen.through(state.camera, tracks)
        labels, _ = assign(state, seen, OUTLIER_PX if tightness <= TIGHTEST else np.inf)
        if not _enough(labels, setting):
            break
        problem = Problem(state, tracks, labels, setting, inner, seen)
        step, state, inner = _stepped(problem, tightness)
        if tightness <= TIGHTEST and _settled(step, setting.prior):
            break
    return _judged(problem or Problem(state, tracks, np.zeros(len(tracks), int), setting), state, inner, tracks)


def _enough(labels: np.ndarray, setting: Setting) -> bool:
    turning = len(setting.windows) + (0 if setting.bundle is None else len(setting.bundle.lives))
    return np.count_nonzero(labels >= 0) + turning >= MIN_ROWS


def _stepped(problem: Problem, tightness: float) -> tuple[np.ndarray, State, Inner]:
    """Take one Gauss-Newton step on the robust cost, shortened until the cost does not grow."""
    rows, prior = problem.linearised(), problem.setting.prior
    scale = problem.scales(rows.squared)[problem.kind]
    share = problem.share * rows.influence / scale
    weight = share * influence(rows.squared, tightness * scale)
    gradient, known = problem.steps.prior_gradient(problem.steps.base.camera)
    matrix = np.tensordot(weight, rows.curvature, 1) + np.diag(known)
    step = -np.linalg.lstsq(matrix, gradient + weight @ rows.gradient, rcond=1e-12)[0]

    def cost(squared: np.ndarray, camera: Camera) -> float:
        deviations = prior.deviations(camera)
        return float((share * problem.freedom * loss(squared, tightness * scale)).sum() + deviations @ deviations)

    here = cost(rows.squared, problem.steps.base.camera)
    for _ in range(BACKTRACKS):
        state = problem.steps.state(step)
        inner, squared = problem.at(step)
        if cost(squared, state.camera) <= here:
            return step, state, inner
        step = step / 2
    return np.zeros_like(step), problem.steps.base, problem.inner


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


def _judged(last: Problem, state: State, inner: Inner, tracks: TrackSet) -> JointFit:
    """Measure a solution: distances, cost, covariance and information."""
    seen = Seen.through(state.camera, tracks)
    labels, distance2 = assign(state, seen)
    problem = Problem(state, tracks, labels, last.setting, inner, seen) if _enough(labels, last.setting) else last
    rows, freedom = problem.linearised(), problem.freedom
    scales = problem.scales(rows.squared)
    scale = scales[problem.kind]
    limit = TIGHTEST * scale
    shared = problem.share * rows.influence / scale
    weight = shared * influence(rows.squared, limit)
    bend = -4.0 / limit / freedom * shared / (1.0 + rows.squared / limit) ** 3
    _, prior = problem.steps.prior_gradient(state.camera)
    covariance = cluster_covariance(rows.gradient, rows.curvature, weight, bend, problem.owners, prior)
    covariance += np.diag(_unmodelled(problem.steps) ** 2)
    road = problem.kind == 0
    whitened2 = np.full(len(tracks), np.inf)
    whitened2[problem.used] = rows.squared[road]
    information = np.tensordot(weight, rows.curvature, 1)
    pulls = rows.gradient[road] * np.sqrt(influence(rows.squared, limit)[road])[:, None]
    pulls = pulls / np.sqrt(np.maximum(np.diag(information), 1e-12))
    return JointFit(
        state=state, labels=labels, distance_px=np.sqrt(distance2), whitened2=whitened2, turning2=rows.squared[~road],
        scales=scales, problem=problem, covariance=covariance, information=information,
        turning_information=np.tensordot(weight[~road], rows.curvature[~road], 1),
        vehicle_correlation=correlation_within(problem.owners[road], pulls))


def _unmodelled(steps: Steps) -> np.ndarray:
    """Standard deviation (parameters,) of each parameter that the residuals know nothing of."""
    sigma = np.zeros(steps.size)
    sigma[:steps.lens][steps.setting.prior.free == 0] = UNMODELLED_FOCAL
    sigma[steps.lens:steps.lens + len(steps.axes)] = UNMODELLED_RAD
    return sigma


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
    inner = fit.problem.inner
    return _judged(Problem(fit.state, tracks, fit.labels, setting, inner), fit.state, inner, tracks)


def judged_at(state: State, tracks: TrackSet, setting: Setting, covariance: np.ndarray) -> JointFit:
    """See how tracks follow the roads of a state that was found otherwise, with the covariance that it has from there.

    Its parameters are those of `Steps(state, setting)`.
    """
    labels, _ = assign(state, Seen.through(state.camera, tracks))
    fit = _judged(Problem(state, tracks, labels, setting), state, (None, None, None), tracks)
    return replace(fit, covariance=covariance)


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
