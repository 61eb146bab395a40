"""The one robust problem: lens and road directions together, every residual in observed pixels.

Unknowns are the lens (focal length, principal point, k1), the rotation of the ground plane and the angle of
each road in it. Each track's great circle contains its road's direction, which leaves it one angle; that
angle is solved inside, in closed form (variable projection), so that the problem stays small.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from autocalib_ros.camera import Camera, image_centre
from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.great_circles import (
    Rays,
    TrackSet,
    dot,
    fit_circles,
    fit_circles_through,
    rays_of,
    scatter,
)
from autocalib_ros.estimation.uncertainty import cluster_covariance, propagate
from autocalib_ros.estimation.vanishing_points import Directions, distances2_through

PATH_FREEDOM = 4.0
"""Independent deviations of one driven path: a few slow sways, however many images show it."""
TIGHTENING = (8.0, 4.0, 2.0) + 12 * (1.0,)
"""Squared distance at which a track's influence has fallen to a quarter, in medians, round by round.

The bulk of the tracks says what noise is; a lane change or a slow turn a few pixels beyond it is few in number
but long in lever. From loose to tight, so that a start some per cent off still reaches the best solution; then
until assignment, influence and state stand still.
"""
EVALUATIONS = 4
"""Evaluations of the residuals in one round."""
HELD = 1e-6
"""Prior sigma of a parameter that is held."""
SETTLED, SETTLED_SIGMAS = 3e-4, 3e-3
"""The rounds end when log f and all angles (radians), and what is counted in prior sigmas, move by less."""
MIN_TRACKS = 4
"""Fewer tracks on any road do not go on with a solution: it is judged, and refused, as it stands."""
OUTLIER_PX = 4.0
"""A track farther than this from every road, root mean square, belongs to none."""
EXPLAINED = 2.0
"""A track counts for its road when it is no farther from it than so many medians."""
DISCRIMINATION = 5.0
"""A track tells two roads apart when it is so many times farther from the one than from the other."""
DIFFERENCE = 1e-6
"""Step of the lens parameters, in their sigmas or in log f, by which the residuals are differentiated."""
SCALE_PX = 1.0
"""Distance at which a track stops being evidence for a solution when solutions are compared."""


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


class Problem:
    """Parameters as steps from a state, and the residuals over labelled tracks."""

    def __init__(self, base: State, tracks: TrackSet, labels: np.ndarray, influence: np.ndarray,
                 options: JointOptions, perpendicular: bool) -> None:
        used = labels >= 0
        self.all_labels = labels
        self.base, self.tracks, self.labels = base, tracks.subset(used), labels[used]
        self.options, self.perpendicular = options, perpendicular
        self.root = np.sqrt(self.tracks.weights * influence[used, None])
        self.scale = _pixel_scale(base, self.tracks)
        self.groups = np.repeat(self.tracks.vehicles, self.tracks.weights.shape[1])
        self.turns = 3 if len(base.angles_rad) > 1 else 2
        self.free_angles = 0 if perpendicular else len(base.angles_rad) - 1

    @property
    def size(self) -> int:
        """Number of parameters: log f, principal point in sigmas, k1 in sigmas, rotation, angles."""
        return 4 + self.turns + self.free_angles

    def state(self, step: np.ndarray) -> State:
        """Return the state at a step from the base."""
        base, options = self.base, self.options
        width = base.camera.width
        shift = step[1:3] * options.principal_point_sigma * width
        cx, cy = np.asarray(base.camera.principal_point_px) + shift
        k1 = base.camera.k[0] + step[3] * options.k1_sigma
        camera = replace(base.camera, focal_px=base.camera.focal_px * float(np.exp(np.clip(step[0], -1, 1))),
                         principal_point_px=(float(cx), float(cy)), k=(float(k1), *base.camera.k[1:]))
        turn = np.zeros(3)
        turn[3 - self.turns:] = step[4:4 + self.turns]
        angles = base.angles_rad.copy()
        angles[1:1 + self.free_angles] += step[4 + self.turns:]
        return State(camera, base.rotation @ Rotation.from_rotvec(turn).as_matrix(), angles)

    def residuals(self, step: np.ndarray) -> np.ndarray:
        """Weighted pixel distances of all points, then the priors."""
        state = self.state(step)
        rays = rays_of(state.camera, self.tracks.pixels)
        normals = self.circles(state, rays)
        distances = rays.distance_px(normals[:, None]) * self.root
        return np.concatenate([distances.ravel(), prior_deviations(state.camera, self.options)])

    def circles(self, state: State, rays: Rays) -> np.ndarray:
        """Normals (tracks, 3) of each track's best circle through its road's direction.

        `scale` only weighs the points when the circle is fitted; distances from it are exact.
        """
        matrix = scatter(rays, self.tracks.weights, self.scale)
        normals, _ = fit_circles_through(matrix, state.directions[self.labels])
        return normals

    def jacobian(self, step: np.ndarray) -> np.ndarray:
        """Derivative of `residuals`, shape (residuals, parameters), circles refitted.

        The lens by differences, because a lens also changes what a pixel is worth, and that term decides where
        the minimum lies. The roads in closed form: a direction d that moves by dd turns a normal n by
        -(n.dd) d, and the circle's own angle is projected out (Kaufman 1975).
        """
        state = self.state(step)
        rays = rays_of(state.camera, self.tracks.pixels)
        normals = self.circles(state, rays)[:, None]
        directions = state.directions[self.labels]
        here = self.residuals(step)
        lens = [(self.residuals(step + DIFFERENCE * unit) - here) / DIFFERENCE for unit in np.eye(self.size)[:4]]
        scale = rays.pixel_scale(normals)
        across = dot(rays.bearings, normals) * scale**2
        # distance over gradient: the second term is how the gradient itself turns with the normal
        pull = rays.bearings - across[..., None] * (dot(rays.radial, normals)[..., None] * rays.radial
                                                    + dot(rays.tangential, normals)[..., None] * rays.tangential)
        pull *= (scale * self.root)[..., None]
        free = np.einsum('tmi,ti->tm', pull, np.cross(directions, normals[:, 0]))
        weight = np.maximum((free * free).sum(-1), 1e-12)
        columns = []
        for turn in self._turns(state):
            column = np.einsum('tmi,ti->tm', pull, -dot(normals[:, 0], turn)[:, None] * directions)
            column -= free * ((free * column).sum(-1) / weight)[:, None]
            columns.append(np.concatenate([column.ravel(), np.zeros(3)]))
        return np.column_stack([*lens, *columns])

    def _turns(self, state: State) -> list[np.ndarray]:
        """Change (tracks, 3) of each track's direction with each parameter of the roads."""
        flat = state.in_plane
        axes = np.eye(3)[3 - self.turns:]
        turns = [np.cross(axis, flat)[self.labels] @ state.rotation.T for axis in axes]
        sideways = np.cross([0.0, 0.0, 1.0], flat)[self.labels] @ state.rotation.T
        return turns + [sideways * (self.labels == road + 1)[:, None] for road in range(self.free_angles)]


def prior_deviations(camera: Camera, options: JointOptions) -> np.ndarray:
    """Deviations of a lens from the prior one in sigmas, shape (3,): principal point x, y and k1."""
    shift = np.asarray(camera.principal_point_px) - image_centre(camera.width, camera.height)
    return np.array([*(shift / max(options.principal_point_sigma * camera.width, 1e-6)),
                     camera.k[0] / max(options.k1_sigma, 1e-6)])


@dataclass(frozen=True)
class JointFit:
    """A solved state with what its uncertainty is made of."""

    state: State
    labels: np.ndarray
    """Road of each track, -2 for none, shape (tracks,)."""
    distance_px: np.ndarray
    """Root mean square distance of each track from its nearest road's circle, shape (tracks,)."""
    cost: float
    """Robust cost over all tracks, comparable between fits of the same tracks."""
    jacobian: np.ndarray
    """Of the weighted residuals, tracks then priors, shape (residuals, parameters)."""
    residuals: np.ndarray
    """Shape (residuals,)."""
    groups: np.ndarray
    """Vehicle of each residual, -1 for a prior, shape (residuals,)."""
    problem: Problem
    """The problem at the solution: steps from there are the parameters of the covariance."""

    @property
    def median_px(self) -> float:
        """Median distance of the tracks that follow a road."""
        on_road = self.distance_px[self.labels >= 0]
        return float(np.median(on_road)) if len(on_road) else float('inf')

    def explained(self) -> np.ndarray:
        """Which tracks follow their road as closely as the bulk does, shape (tracks,)."""
        typical = max(self.median_px, self.problem.options.noise_px)
        return (self.labels >= 0) & (self.distance_px < EXPLAINED * typical)

    def covariance(self) -> np.ndarray:
        """Covariance of the parameters, shape (parameters, parameters)."""
        return cluster_covariance(self.jacobian, self.residuals, self.groups)

    def sigma(self, function: Callable[[State], np.ndarray]) -> np.ndarray:
        """Standard deviation of a function of the state, shape of its result."""
        return propagate(lambda step: function(self.problem.state(step)), self.problem.size, self.covariance())


def _pixel_scale(state: State, tracks: TrackSet) -> np.ndarray:
    """Pixels per radian at each point (tracks, samples), across its track's own great circle."""
    rays = rays_of(state.camera, tracks.pixels)
    normals, _, _ = fit_circles(rays, tracks.weights)
    return rays.pixel_scale(normals[:, None])


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


def solve_joint(start: State, tracks: TrackSet, options: JointOptions, *, perpendicular: bool = False) -> JointFit:
    """Alternate between assigning tracks to roads and robust least squares, from a start.

    One road alone cannot tell k1 and the principal point from the focal length: there they stay where the start
    has them; what their priors leave open is still part of the uncertainty.
    """
    one_road = len(start.angles_rad) == 1
    solved = replace(options, k1_sigma=HELD, principal_point_sigma=HELD) if one_road else options
    state = squared(start) if perpendicular else start
    share = np.sqrt(tracks.share_of_vehicle)
    for tightness in TIGHTENING:
        # a start may be off by more than a true track ever is: only the last rounds cut off
        labels, distance2 = assign(state, tracks, OUTLIER_PX if tightness <= 1.0 else np.inf)
        if np.count_nonzero(labels >= 0) < MIN_TRACKS:
            break
        noise2 = max(options.noise_px**2, _typical(distance2[labels >= 0]))
        influence = PATH_FREEDOM * share / noise2 / (1.0 + distance2 / (tightness * noise2)) ** 2
        problem = Problem(state, tracks, labels, influence, solved, perpendicular)
        solution = least_squares(problem.residuals, np.zeros(problem.size), problem.jacobian, method='lm',
                                 max_nfev=EVALUATIONS, xtol=1e-6, ftol=1e-7)
        state = problem.state(solution.x)
        if tightness <= 1.0 and _settled(solution.x):
            break
    final = Problem(state, tracks, problem.all_labels, influence, options, perpendicular)
    here = np.zeros(final.size)
    labels, distance2 = assign(state, tracks)
    return JointFit(state, labels, np.sqrt(distance2), robust_cost(state, distance2, tracks, options),
                    final.jacobian(here), final.residuals(here), np.concatenate([final.groups, np.full(3, -1)]), final)


def _settled(step: np.ndarray) -> bool:
    shape, rest = np.abs(step[1:4]), np.abs(np.delete(step, (1, 2, 3)))
    return bool(shape.max() < SETTLED_SIGMAS and rest.max() < SETTLED)


def squared(state: State) -> State:
    """Return the state with its second road perpendicular to the first."""
    angles = state.angles_rad.copy()
    angles[1] = np.copysign(np.pi / 2, np.sin(angles[1]))
    return replace(state, angles_rad=angles)


def _typical(distance2: np.ndarray) -> float:
    return float(np.median(distance2)) if len(distance2) else 0.0


def robust_cost(state: State, distance2: np.ndarray, tracks: TrackSet, options: JointOptions) -> float:
    """Logarithmic cost over all tracks, roads or not, with the priors; vehicles count once."""
    priors = np.square(prior_deviations(state.camera, options)).sum()
    share = np.sqrt(tracks.share_of_vehicle)
    return float(PATH_FREEDOM * (share * np.log1p(distance2 / SCALE_PX**2)).sum() + priors)


def road_support(fit: JointFit, tracks: TrackSet) -> list[np.ndarray]:
    """For each road, which tracks (masks, shape (tracks,)) it explains and no other road could.

    A second direction close to the first, or met only by short tracks, is an echo of the first; a real road's
    tracks miss the other road's circles by many times the noise.
    """
    rays = rays_of(fit.state.camera, tracks.pixels)
    _, _, matrix = fit_circles(rays, tracks.weights)
    distance = np.sqrt(distances2_through(matrix, fit.state.directions))
    explained = fit.explained()
    support = []
    for road in range(len(distance)):
        others = np.delete(distance, road, axis=0)
        nearest_other = others.min(axis=0) if len(others) else np.full(len(tracks), np.inf)
        apart = nearest_other > DISCRIMINATION * np.maximum(distance[road], fit.median_px)
        support.append(explained & (fit.labels == road) & apart)
    return support
