"""The kinds of residuals of the joint problem, and their derivatives by its parameters.

A row is one track against its road, one window against a motion in the plane, or one life of a rigid body. Residuals
are whitened: divided by what they are expected to be. What a row has unknown of its own is solved inside (variable
projection, Kaufman 1975), so that the problem stays small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.adjustment.noise_model import on_road, whitening
from autocalib_ros.estimation.adjustment.parameters import State, Steps, ground_up
from autocalib_ros.estimation.motion.planar_motion import Motion, View, first_motion, settled, trust
from autocalib_ros.estimation.motion.rigid_bodies import Bundle, Shapes, lifted
from autocalib_ros.estimation.observations.track_set import Seen, TrackSet
from autocalib_ros.estimation.observations.vehicle_grouping import corroborated, heading_off_deg
from autocalib_ros.geometry.great_circles import Rays, fit_circles_through, rays_of
from autocalib_ros.geometry.small_matrices import cross, dot

DIFFERENCE = 1e-6
"""Step of the parameters, in their units, by which distances are differentiated where no closed form is used."""


@dataclass(frozen=True)
class Rows:
    """What each row tells at the base, its own unknowns solved: its residuals r and their derivatives J, in sums."""

    squared: np.ndarray
    """Mean squared residual, r^T r over the freedom, shape (rows,)."""
    gradient: np.ndarray
    """J^T r, shape (rows, parameters)."""
    curvature: np.ndarray
    """J^T J, shape (rows, parameters, parameters)."""
    influence: np.ndarray
    """Weight by what speaks for a row besides its own residuals, shape (rows,)."""

    @classmethod
    def of(cls, residuals: np.ndarray, slopes: np.ndarray, freedom: np.ndarray, influence: np.ndarray) -> Rows:
        """Sum up residuals (rows, samples) and slopes (rows, samples, parameters)."""
        transposed = slopes.transpose(0, 2, 1)
        return cls((residuals**2).sum(axis=1) / freedom, (transposed @ residuals[..., None])[..., 0],
                   transposed @ slopes, influence)


class RoadRows:
    """Labelled tracks, each on a great circle through the direction of its road."""

    def __init__(self, steps: Steps, tracks: TrackSet, labels: np.ndarray, seen: Seen,
                 share: np.ndarray) -> None:
        self._steps, self._tracks, self._labels = steps, tracks, labels
        self.owners, self.share = tracks.vehicles, share
        self._mask = tracks.weights > 0
        base, setting = steps.base, steps.setting
        self.freedom = np.maximum(self._mask.sum(axis=1) - 1, 1)
        self._directions = base.directions[labels]
        self._rays = seen.rays
        normals, _ = fit_circles_through(seen.matrix, self._directions)
        self._scale = self._rays.pixel_scale(normals[:, None])
        self._up = ground_up(base, setting, self._rays)
        self._road = on_road(self._rays, normals, self._directions, self._up, setting.height_m)
        self.whiten = whitening(tracks.pixels, self._mask, self._road, setting.options, drifting=setting.drifting)
        self._normals = self._circles(base, self._rays)
        self._scale = self._rays.pixel_scale(self._normals[:, None])
        self._normals = self._circles(base, self._rays)

    def _circles(self, state: State, rays: Rays) -> np.ndarray:
        """Normals (tracks, 3) of each track's best circle through its road's direction, in whitened distances."""
        whitened = self.whiten @ (rays.bearings * self._scale[..., None])
        normals, _ = fit_circles_through(whitened.transpose(0, 2, 1) @ whitened, state.directions[self._labels])
        return normals

    def at(self, step: np.ndarray) -> tuple[None, np.ndarray]:
        """Mean squared whitened distance of each track from its circle, shape (tracks,); nothing to go on from."""
        state = self._steps.state(step)
        rays = rays_of(state.camera, self._tracks.pixels)
        distance = rays.distance_px(self._circles(state, rays)[:, None])
        return None, ((self.whiten @ distance[..., None])[..., 0]**2).sum(axis=1) / self.freedom

    def distances_px(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Observed pixels (n, 2), their distances from the circles (n,), and their tracks (n,), at the base."""
        track, sample = np.nonzero(self._mask)
        distance = np.abs(self._rays.distance_px(self._normals[:, None]))
        return self._tracks.pixels[track, sample], distance[track, sample], track

    def log_density(self) -> np.ndarray:
        """Logarithm of the determinant of each track's whitening, shape (tracks,)."""
        diagonal = np.diagonal(self.whiten, axis1=1, axis2=2)
        return np.where(self._mask, np.log(np.where(self._mask, diagonal, 1.0)), 0.0).sum(axis=1)

    def linearised(self) -> Rows:
        """Residuals at the base and their derivatives.

        The lens by differences of the exact residual: its gradient changes with the lens too, and that small
        term decides where the minimum lies. The roads in closed form: a direction d that moves by dd turns a
        normal n by -(n.dd) d. The circle's own angle is projected out.
        """
        rays, normals, steps = self._rays, self._normals[:, None], self._steps
        scale = rays.pixel_scale(normals)
        here = dot(rays.bearings, normals) * scale
        columns = [(self._distance(unit, normals) - here) / DIFFERENCE for unit in np.eye(steps.lens)]
        across = here * scale
        # distance over gradient: the second term is how the gradient itself turns with the normal
        pull = rays.bearings - across[..., None] * (dot(rays.radial, normals)[..., None] * rays.radial
                                                    + dot(rays.tangential, normals)[..., None] * rays.tangential)
        pull *= scale[..., None]
        free = (pull @ cross(self._directions, self._normals)[..., None])[..., 0]
        columns += [(pull @ (-dot(self._normals, turn)[:, None] * self._directions)[..., None])[..., 0]
                    for turn in self._turns()]
        slopes = self.whiten @ np.stack([free, *columns], axis=-1)
        free, slopes = slopes[..., :1], slopes[..., 1:]
        along = (free * slopes).sum(axis=1, keepdims=True) / np.maximum((free * free).sum(axis=1, keepdims=True), 1e-12)
        return Rows.of((self.whiten @ here[..., None])[..., 0], slopes - free * along, self.freedom,
                       self._vehicles_influence(here))

    def _distance(self, unit: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return rays_of(self._steps.camera(DIFFERENCE * unit), self._tracks.pixels).distance_px(normals)

    def _turns(self) -> list[np.ndarray]:
        """Change (tracks, 3) of each track's direction with each parameter of the roads."""
        base = self._steps.base
        turns = [cross(axis, base.in_plane)[self._labels] @ base.rotation.T for axis in self._steps.axes]
        sideways = cross(np.array([0.0, 0.0, 1.0]), base.in_plane)[self._labels] @ base.rotation.T
        return turns + [sideways * (self._labels == road)[:, None] for road in self._steps.free_angles]

    def _vehicles_influence(self, distance_px: np.ndarray) -> np.ndarray:
        """Influence (tracks,) of tracks by whether their vehicles keep to their roads; 1 where nothing drifts."""
        if not self._steps.setting.drifting:
            return np.ones(len(self._tracks))
        side = np.where(self._normals @ self._up < 0, -1.0, 1.0)[:, None]
        off, error = heading_off_deg(side * distance_px, self._road.px_per_m, self._road.along_m, self._mask)
        return corroborated(off, error, self._tracks.vehicles, self._labels)


class MotionRows:
    """Windows, each with the motion in the plane that suits it best; `motion` is one near it, None unknown."""

    def __init__(self, steps: Steps, motion: Motion | None) -> None:
        self._steps, self._windows = steps, steps.setting.windows
        self.owners, self.share = self._windows.bodies, self._windows.share_of_body
        self._base = view = self._view(steps.base)
        self.inner = first_motion(view) if motion is None else settled(view, motion)
        self._here = view.distances(self.inner)
        self._slopes = view.slopes(self.inner, self._here)
        self._root = np.sqrt(trust(self._here))
        self.freedom = np.maximum(view.mask.sum(axis=1) - 2, 1)

    def _view(self, state: State) -> View:
        return View.of(self._windows, state.camera, state.rotation, self._steps.setting.options)

    def at(self, step: np.ndarray) -> tuple[Motion, np.ndarray]:
        """Motion at a step and mean squared distances, shape (windows,)."""
        view = self._view(self._steps.state(step))
        motion = settled(view, self.inner)
        return motion, ((self._root * view.distances(motion))**2).sum(axis=1) / self.freedom

    def linearised(self) -> Rows:
        """Residuals at the base and their derivatives, by differences; the window's own motion projected out."""
        steps = self._steps
        columns = [(self._moved(unit) - self._here) / DIFFERENCE for unit in np.eye(steps.size)]
        slopes = self._root[..., None] * np.stack(columns, axis=-1)
        own = self._root[..., None] * self._slopes
        matrix = own.transpose(0, 2, 1) @ own + 1e-9 * np.eye(2)
        slopes = slopes - own @ np.linalg.solve(matrix, own.transpose(0, 2, 1) @ slopes)
        return Rows.of(self._root * self._here, slopes, self.freedom, np.ones(len(self.freedom)))

    def distances_px(self) -> tuple[np.ndarray, np.ndarray]:
        """Observed pixels (n, 2) and how far each misses the motion of its window (n,), at the base."""
        window, point = np.nonzero(self._base.mask)
        distance = np.abs(self._here * self._base.sigma_px)
        return self._windows.second_px[window, point], distance[window, point]

    def _moved(self, unit: np.ndarray) -> np.ndarray:
        """Distances a small step away, the motions as they are."""
        lens, turns = self._steps.lens, self._steps.lens + len(self._steps.axes)
        if unit[turns:].any():
            return self._here  # the angle of a road is nothing to a window
        view = self._base.turned(self._steps.turned(DIFFERENCE * unit[lens:turns])) if unit[lens:].any() else (
            self._view(self._steps.state(DIFFERENCE * unit)))
        return view.distances(self.inner)


class LifeRows:
    """Lives of rigid bodies, each with the shape and the way that suit it best; `shapes` are near, None unknown."""

    def __init__(self, steps: Steps, bundle: Bundle, shapes: Shapes | None) -> None:
        self._steps, self._bundle, base = steps, bundle, steps.base
        self.owners, self.share, self.freedom = bundle.lives.bodies, bundle.lives.share_of_body, bundle.freedom
        self.inner = (bundle.begun(base.camera, base.rotation) if shapes is None
                      else bundle.settled(base.camera, base.rotation, shapes))
        here = bundle.residuals(base.camera, base.rotation, self.inner)
        self._root = np.sqrt(bundle.trust(here))[:, :, None, None]
        self._here = here
        self._follow: np.ndarray | None = None
        """How the unknowns of each life change with a step, shape (lives, unknowns, parameters)."""

    def at(self, step: np.ndarray) -> tuple[Shapes, np.ndarray]:
        """Shapes at a step and mean squared residuals, shape (lives,)."""
        state = self._steps.state(step)
        near = self.inner if self._follow is None else self.inner.stepped(-(self._follow @ step))
        shapes = self._bundle.settled(state.camera, state.rotation, near)
        residuals = self._root * self._bundle.residuals(state.camera, state.rotation, shapes)
        return shapes, (residuals**2).sum(axis=(1, 2, 3)) / self.freedom

    def linearised(self) -> Rows:
        """Residuals at the base and their derivatives; what is unknown of each life projected out."""
        steps, bundle, base = self._steps, self._bundle, self._steps.base
        slopes, by_place = bundle.slopes(base.camera, base.rotation, self.inner)
        lenses = [steps.camera(DIFFERENCE * unit) for unit in np.eye(steps.lens)]
        columns = [change / DIFFERENCE
                   for change in bundle.by_lens(lenses, base.camera, base.rotation, self.inner)]
        columns += [bundle.by_turn(axis, by_place, self.inner) for axis in steps.axes]
        columns += [np.zeros(self._here.shape)] * len(steps.free_angles)
        own, here = bundle.flat(slopes, self._here)
        shared = (self._root[..., None] * np.stack(columns, axis=-1)).reshape(len(own), -1, steps.size)
        matrix = lifted(own.transpose(0, 2, 1) @ own, np.zeros(len(own)))
        self._follow = np.linalg.solve(matrix, own.transpose(0, 2, 1) @ shared)
        return Rows.of(here, shared - own @ self._follow, self.freedom, np.ones(len(own)))

    def distances_px(self) -> tuple[np.ndarray, np.ndarray]:
        """Observed pixels (n, 2) and how far each is from its place on the body (n,), at the base."""
        base, lives = self._steps.base, self._bundle.lives
        away = self._bundle.misses_px(base.camera, base.rotation, self.inner)
        return lives.pixels[lives.mask], np.hypot(*away[lives.mask].T)
