"""The one robust problem: lens and road directions together, every residual in observed pixels.

Unknowns are the lens (focal length, principal point, k1, k2 where it is set free), the rotation of the ground
plane and the angle of each road in it. Each track's great circle contains its road's direction, which leaves it
one angle; that angle is solved inside, in closed form (variable projection), so that the problem stays small.
Distances are in observed pixels, whitened by what a driver's wander is worth there; a track counts by a
redescending weight of its mean squared whitened distance (Geman & McClure 1985).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.camera import Camera
from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.great_circles import (
    Rays,
    TrackSet,
    dot,
    fit_circles,
    fit_circles_through,
    rays_of,
)
from autocalib_ros.estimation.lens_prior import LensPrior
from autocalib_ros.estimation.path_noise import USUAL_HEIGHT_M, on_road, whitening
from autocalib_ros.estimation.uncertainty import cluster_covariance, correlation_within, propagate
from autocalib_ros.estimation.vanishing_points import Directions, distances2_through
from autocalib_ros.estimation.vehicles import bodies, corroborated, heading_off_deg

TIGHTENING = (8.0, 4.0, 2.0)
TIGHTEST = 1.0
"""Squared distance at which a track's influence has fallen to a quarter, in medians, round by round.

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
MIN_TRACKS = 4
"""Fewer tracks on any road do not go on with a solution: it is judged, and refused, as it stands."""
OUTLIER_PX = 4.0
"""A track farther than this from every road, root mean square, belongs to none."""
ALONG_X = 0.2
"""Sine of the angle to the camera's x axis below which a road does not tell the plane of a camera without roll."""
NEAREST_HORIZON = 0.03
"""Least angle below the horizon at which a point is placed on the road, radians."""
EXPLAINED = 3.0
"""A track counts for its road when its mean squared whitened distance is below so many medians."""
DISCRIMINATION = 5.0
"""A track tells two roads apart when it is so many times farther from the one than from the other."""
DIFFERENCE = 1e-6
"""Step of the lens parameters, in their units, by which distances are differentiated."""


@dataclass(frozen=True)
class State:
    """Lens and roads: road j runs along `rotation` applied to (cos, sin, 0) of `angles_rad[j]`; the first is 0."""

    camera: Camera
    rotation: np.ndarray
    """camera_from_plane, shape (3, 3): its third column is the ground normal when there are two roads."""
    angles_rad: np.ndarray
    """Shape (roads,)."""

    @property
    def in_plane(self) -> np.ndarray:
        """The roads' unit vectors in the frame of their plane, shape (roads, 3)."""
        return np.column_stack([np.cos(self.angles_rad), np.sin(self.angles_rad), np.zeros(len(self.angles_rad))])

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors in the camera frame, shape (roads, 3)."""
        return self.in_plane @ self.rotation.T


@dataclass(frozen=True)
class Setting:
    """What a solution is given besides tracks and a start."""

    prior: LensPrior
    options: JointOptions
    height_m: float = 0.0
    """Height of the camera, 0 unknown: it weighs near against far, no more."""
    crossing_rad: float | None = None
    """Angle of the second road to the first where that is held."""
    drifting: bool = False
    """Whether tracked points drift; then one track hardly tells a slight turn, and those of one body are judged
    together."""
    vehicle_correlation: float = 0.3
    """How much the errors of one vehicle's tracks correlate, 0 to 1: a guess until a fit has measured it."""


class Problem:
    """Labelled tracks at a state: whitened residuals, and their derivatives by a step from there."""

    def __init__(self, base: State, tracks: TrackSet, labels: np.ndarray, setting: Setting) -> None:
        used = labels >= 0
        self.base, self.setting, self.used = base, setting, used
        self.tracks, self.labels = tracks.subset(used), labels[used]
        self.mask = self.tracks.weights > 0
        self.freedom = np.maximum(self.mask.sum(axis=1) - 1, 1)
        self.turns = 3 if len(base.angles_rad) > 1 else 2
        held = 1 if setting.crossing_rad is not None and len(base.angles_rad) > 1 else 0
        self.free_angles = range(1 + held, len(base.angles_rad))
        self.lens = len(setting.prior.free)
        rays = rays_of(base.camera, self.tracks.pixels)
        normals, _, matrix = fit_circles(rays, self.tracks.weights)
        normals, _ = fit_circles_through(matrix, base.directions[self.labels])
        self.scale = rays.pixel_scale(normals[:, None])
        self.corroboration = np.ones(len(self.tracks))
        self.up = ground_up(base, rays)
        self.road = on_road(rays, normals, base.directions[self.labels], self.up, setting.height_m)
        self.whiten = whitening(self.tracks.pixels, self.mask, self.road, setting.options,
                                drifting=setting.drifting)

    @property
    def size(self) -> int:
        """Number of parameters: free ones of the lens in their units, rotation, angles of the roads."""
        return self.lens + self.turns + len(self.free_angles)

    def state(self, step: np.ndarray) -> State:
        """Return the state at a step from the base."""
        turn = np.zeros(3)
        turn[3 - self.turns:] = step[self.lens:self.lens + self.turns]
        angles = self.base.angles_rad.copy()
        angles[list(self.free_angles)] += step[self.lens + self.turns:]
        return State(self.setting.prior.moved(self.base.camera, step[:self.lens]),
                     self.base.rotation @ Rotation.from_rotvec(turn).as_matrix(), angles)

    def circles(self, state: State, rays: Rays) -> np.ndarray:
        """Normals (tracks, 3) of each track's best circle through its road's direction, in whitened distances."""
        whitened = self.whiten @ (rays.bearings * self.scale[..., None])
        normals, _ = fit_circles_through(whitened.transpose(0, 2, 1) @ whitened, state.directions[self.labels])
        return normals

    def residuals(self, state: State) -> np.ndarray:
        """Whitened distances, shape (tracks, samples)."""
        rays = rays_of(state.camera, self.tracks.pixels)
        distance = rays.distance_px(self.circles(state, rays)[:, None])
        return np.einsum('tij,tj->ti', self.whiten, distance)

    def vehicles_influence(self, distance_px: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Influence (tracks,) of tracks by whether their vehicles keep to their roads; 1 where nothing drifts."""
        if not self.setting.drifting:
            return np.ones(len(self.tracks))
        side = np.where(normals @ self.up < 0, -1.0, 1.0)[:, None]
        off, error = heading_off_deg(side * distance_px, self.road.px_per_m, self.road.along_m, self.mask)
        return corroborated(off, error, self.tracks.vehicles, self.labels)

    def linearised(self) -> tuple[np.ndarray, np.ndarray]:
        """Whitened distances (tracks, samples) at the base and their derivatives (tracks, samples, parameters).

        The lens by differences of the exact distance, because a lens also changes what a pixel is worth, and that
        term decides where the minimum lies. The roads in closed form: a direction d that moves by dd turns a
        normal n by -(n.dd) d. The circle's own angle is projected out (Kaufman 1975).
        """
        rays = rays_of(self.base.camera, self.tracks.pixels)
        self.scale = rays.pixel_scale(self.circles(self.base, rays)[:, None])
        normals = self.circles(self.base, rays)[:, None]
        directions = self.base.directions[self.labels]
        scale = rays.pixel_scale(normals)
        here = dot(rays.bearings, normals) * scale
        columns = [(self._distance(unit, normals) - here) / DIFFERENCE for unit in np.eye(self.lens)]
        across = here * scale
        # distance over gradient: the second term is how the gradient itself turns with the normal
        pull = rays.bearings - across[..., None] * (dot(rays.radial, normals)[..., None] * rays.radial
                                                    + dot(rays.tangential, normals)[..., None] * rays.tangential)
        pull *= scale[..., None]
        free = np.einsum('tmi,ti->tm', pull, np.cross(directions, normals[:, 0]))
        columns += [np.einsum('tmi,ti->tm', pull, -dot(normals[:, 0], turn)[:, None] * directions)
                    for turn in self._turns()]
        slopes = self.whiten @ np.stack([free, *columns], axis=-1)
        free, slopes = slopes[..., :1], slopes[..., 1:]
        along = (free * slopes).sum(axis=1, keepdims=True) / np.maximum((free * free).sum(axis=1, keepdims=True), 1e-12)
        self.corroboration = self.vehicles_influence(here, normals[:, 0])
        return np.einsum('tij,tj->ti', self.whiten, here), slopes - free * along

    def _distance(self, unit: np.ndarray, normals: np.ndarray) -> np.ndarray:
        camera = self.setting.prior.moved(self.base.camera, DIFFERENCE * unit)
        return rays_of(camera, self.tracks.pixels).distance_px(normals)

    def _turns(self) -> list[np.ndarray]:
        """Change (tracks, 3) of each track's direction with each parameter of the roads."""
        flat = self.base.in_plane
        axes = np.eye(3)[3 - self.turns:]
        turns = [np.cross(axis, flat)[self.labels] @ self.base.rotation.T for axis in axes]
        sideways = np.cross([0.0, 0.0, 1.0], flat)[self.labels] @ self.base.rotation.T
        return turns + [sideways * (self.labels == road)[:, None] for road in self.free_angles]

    def prior_gradient(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (parameters,) and information (parameters,) of the prior at a camera."""
        gradient, information = np.zeros(self.size), np.zeros(self.size)
        gradient[:self.lens] = self.setting.prior.deviations(camera)
        information[:self.lens] = self.setting.prior.information
        return gradient, information


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
    problem: Problem
    """The problem at the solution: steps from there are the parameters of the covariance."""
    covariance: np.ndarray
    """Of the parameters, shape (parameters, parameters)."""
    information: np.ndarray
    """Of the evidence alone about the parameters, shape (parameters, parameters)."""
    vehicle_correlation: float
    """How much the pulls of one vehicle's tracks on the solution correlate, 0 to 1."""

    @property
    def crossing_held(self) -> bool:
        """Whether the angle between the first two roads was held."""
        return self.problem.setting.crossing_rad is not None

    def explained(self) -> np.ndarray:
        """Which tracks follow their road as closely as the bulk does, shape (tracks,)."""
        return (self.labels >= 0) & (self.whitened2 < EXPLAINED * max(self.scale, LEAST_SCALE))

    def sigma(self, function: Callable[[State], np.ndarray]) -> np.ndarray:
        """Standard deviation of a function of the state, shape of its result."""
        return propagate(lambda step: function(self.problem.state(step)), self.problem.size, self.covariance)


def ground_up(state: State, rays: Rays) -> np.ndarray:
    """Normal (3,) of the plane away from the traffic; with one road that of a camera that is not rolled.

    Such a plane contains the camera's x axis and the road; a road along that axis leaves the one across the image.
    """
    normal = state.rotation[:, 2]
    if len(state.angles_rad) == 1:
        along = state.directions[0]
        level = np.cross(along, [1.0, 0.0, 0.0])
        image_up = along[1] * along - [0.0, 1.0, 0.0]
        normal = level if np.linalg.norm(level) > ALONG_X else image_up
        normal = normal / max(np.linalg.norm(normal), 1e-9)
    return -normal if np.mean(rays.bearings @ normal > 0) > 0.5 else normal


def assign(state: State, tracks: TrackSet, limit_px: float = OUTLIER_PX) -> tuple[np.ndarray, np.ndarray]:
    """Give each track its nearest road (-2 beyond `limit_px`) and its mean squared distance in px^2."""
    rays = rays_of(state.camera, tracks.pixels)
    _, _, matrix = fit_circles(rays, tracks.weights)
    distance2 = distances2_through(matrix, state.directions)
    nearest = np.argmin(distance2, axis=0)
    least = distance2[nearest, np.arange(len(tracks))]
    return np.where(least < limit_px**2, nearest, -2), least


def initial_state(camera: Camera, found: Directions) -> State:
    """Build the state of directions found by consensus: the first is x, the plane is that of the first two."""
    first = found.directions[0]
    second = found.directions[1] if len(found.directions) > 1 else np.roll(first, 1)
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal)
    rotation = np.column_stack([first, np.cross(normal, first), normal])
    inplane = found.directions @ rotation
    return State(camera, rotation, np.arctan2(inplane[:, 1], inplane[:, 0]))


def solve_joint(start: State, tracks: TrackSet, setting: Setting, *, refine: bool = False) -> JointFit:
    """Alternate between assigning tracks to roads and a robust Gauss-Newton step, from a start.

    With `refine` the start is a solution already, and nothing is loosened first.
    """
    state = crossed(start, setting.crossing_rad)
    share = tracks.independence(setting.vehicle_correlation)
    problem = None
    for tightness in (() if refine else TIGHTENING) + ROUNDS * (TIGHTEST,):
        # a start may be off by more than a true track ever is: only the last rounds cut off
        labels, _ = assign(state, tracks, OUTLIER_PX if tightness <= TIGHTEST else np.inf)
        if np.count_nonzero(labels >= 0) < MIN_TRACKS:
            break
        problem = Problem(state, tracks, labels, setting)
        step, state = _stepped(problem, share[problem.used], tightness)
        if tightness <= TIGHTEST and _settled(step, setting.prior):
            break
    return _judged(problem or Problem(state, tracks, np.zeros(len(tracks), int), setting), state, tracks, share)


def _stepped(problem: Problem, share: np.ndarray, tightness: float) -> tuple[np.ndarray, State]:
    """Take one Gauss-Newton step on the robust cost, shortened until the cost does not grow."""
    residuals, slopes = problem.linearised()
    share = share * problem.corroboration
    squared = (residuals**2).sum(axis=1) / problem.freedom
    scale = max(float(np.median(squared)), LEAST_SCALE)
    weight = share / scale * influence(squared, tightness * scale)
    gradient, prior = problem.prior_gradient(problem.base.camera)
    matrix = np.einsum('t,tmp,tmq->pq', weight, slopes, slopes, optimize=True) + np.diag(prior)
    gradient = gradient + np.einsum('t,tmp,tm->p', weight, slopes, residuals, optimize=True)
    step = -np.linalg.lstsq(matrix, gradient, rcond=1e-12)[0]

    def cost(whitened: np.ndarray, camera: Camera) -> float:
        apart = (whitened**2).sum(axis=1) / problem.freedom
        deviations = problem.setting.prior.deviations(camera)
        return float((share / scale * problem.freedom * loss(apart, tightness * scale)).sum() + deviations @ deviations)

    here = cost(residuals, problem.base.camera)
    for _ in range(BACKTRACKS):
        state = problem.state(step)
        if cost(problem.residuals(state), state.camera) <= here:
            return step, state
        step = step / 2
    return np.zeros_like(step), problem.base


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


def crossed(state: State, crossing_rad: float | None) -> State:
    """Return the state with its second road at an angle to the first, on the side where it is."""
    if crossing_rad is None or len(state.angles_rad) < 2:
        return state
    angles = state.angles_rad.copy()
    sides = np.array([crossing_rad, crossing_rad - np.pi, -crossing_rad, np.pi - crossing_rad])
    angles[1] = sides[np.argmin(np.abs(np.angle(np.exp(1j * (sides - angles[1])))))]
    return replace(state, angles_rad=angles)


def _judged(last: Problem, state: State, tracks: TrackSet, share: np.ndarray) -> JointFit:
    """Measure a solution: distances, cost, covariance and information."""
    labels, distance2 = assign(state, tracks)
    problem = Problem(state, tracks, labels, last.setting) if np.count_nonzero(labels >= 0) >= MIN_TRACKS else last
    residuals, slopes = problem.linearised()
    squared = (residuals**2).sum(axis=1) / problem.freedom
    scale = max(float(np.median(squared)), LEAST_SCALE)
    limit = TIGHTEST * scale
    shared = share[problem.used] * problem.corroboration / scale
    _, prior = problem.prior_gradient(state.camera)
    whitened2 = np.full(len(tracks), np.inf)
    whitened2[problem.used] = squared
    weight = shared * influence(squared, limit)
    information = np.einsum('t,tmp,tmq->pq', weight, slopes, slopes, optimize=True)
    pulls = np.einsum('tmp,tm->tp', slopes, residuals) * np.sqrt(influence(squared, limit))[:, None]
    pulls = pulls / np.sqrt(np.maximum(np.diag(information), 1e-12))
    bend = -4.0 / limit / problem.freedom * shared / (1.0 + squared / limit) ** 3
    covariance = cluster_covariance(slopes, residuals, weight, bend, problem.tracks.vehicles, prior)
    return JointFit(state, labels, np.sqrt(distance2), whitened2, scale, problem, covariance, information,
                    correlation_within(problem.tracks.vehicles, pulls))


def noise_cost(fit: JointFit, tracks: TrackSet, *, drifting: bool) -> float:
    """Twice the negative logarithm of how probable the residuals are with or without drift, their scale fitted.

    Infinite where hardly a track is explained.
    """
    labels = np.where(fit.explained(), fit.labels, -2)
    if np.count_nonzero(labels >= 0) < MIN_TRACKS:
        return np.inf
    problem = Problem(fit.state, tracks, labels, replace(fit.problem.setting, drifting=drifting))
    residuals, _ = problem.linearised()
    scale = max(float(np.median((residuals**2).sum(axis=1) / problem.freedom)), LEAST_SCALE)
    diagonal = np.diagonal(problem.whiten, axis1=1, axis2=2)
    logarithms = np.where(problem.mask, np.log(np.where(problem.mask, diagonal, 1.0)), 0.0).sum(axis=1)
    return float((problem.freedom * np.log(scale) - 2.0 * logarithms).sum())


def with_bodies(fit: JointFit, tracks: TrackSet) -> TrackSet:
    """Return the tracks with vehicles that are bodies on the ground of a solution."""
    rays = rays_of(fit.state.camera, tracks.pixels)
    up = ground_up(fit.state, rays)
    height = fit.problem.setting.height_m or USUAL_HEIGHT_M
    below = np.maximum(-(rays.bearings @ up), NEAREST_HORIZON)
    ground_m = height * (rays.bearings @ fit.state.rotation[:, :2]) / below[..., None]
    return replace(tracks, vehicles=bodies(tracks, ground_m))


def judged_with(fit: JointFit, tracks: TrackSet, setting: Setting) -> JointFit:
    """Measure the uncertainty of a solution under another setting, such as one that holds less."""
    problem = Problem(fit.state, tracks, fit.labels, setting)
    return _judged(problem, fit.state, tracks, tracks.independence(setting.vehicle_correlation))


def cost_at_scale(fit: JointFit, tracks: TrackSet, scale: float) -> float:
    """Twice the negative logarithm of a fit's probability, for comparison between fits of one set of tracks.

    All at one `scale`, with the prior and, by Laplace's approximation, the volume that the evidence leaves of it.
    """
    limit = TIGHTEST * scale
    freedom = np.maximum((tracks.weights > 0).sum(axis=1) - 1, 1)
    cost = bounded_loss(fit.whitened2, limit)
    share = tracks.independence(fit.problem.setting.vehicle_correlation)
    deviations, prior = fit.problem.prior_gradient(fit.state.camera)
    volume = np.linalg.slogdet(fit.information + np.diag(prior) + 1e-9 * np.eye(len(prior)))[1]
    return float((share / scale * freedom * cost).sum() + deviations @ deviations + volume)


def road_support(fit: JointFit, tracks: TrackSet) -> list[np.ndarray]:
    """For each road, which tracks (masks, shape (tracks,)) it explains and no other road could.

    A second direction close to the first, or met only by short tracks, is an echo of the first; a real road's
    tracks miss the other road's circles by many times the noise.
    """
    rays = rays_of(fit.state.camera, tracks.pixels)
    _, _, matrix = fit_circles(rays, tracks.weights)
    distance = np.sqrt(distances2_through(matrix, fit.state.directions))
    explained = fit.explained()
    typical = float(np.median(fit.distance_px[explained])) if explained.any() else np.inf
    support = []
    for road in range(len(distance)):
        others = np.delete(distance, road, axis=0)
        nearest_other = others.min(axis=0) if len(others) else np.full(len(tracks), np.inf)
        apart = nearest_other > DISCRIMINATION * np.maximum(distance[road], typical)
        support.append(explained & (fit.labels == road) & apart)
    return support
