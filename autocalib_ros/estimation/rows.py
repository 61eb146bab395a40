"""The two kinds of residuals of the joint problem, and their derivatives by its parameters.

A row is one track against its road, or one window against a motion in the plane; both have `SAMPLES` residuals,
whitened: divided by what they are expected to be. What a row has unknown of its own, the angle of its circle or the
motion of its window, is solved inside (variable projection, Kaufman 1975), so that the problem stays small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.great_circles import (
    Rays,
    Seen,
    TrackSet,
    fit_circles_through,
    rays_of,
)
from autocalib_ros.estimation.path_noise import on_road, whitening
from autocalib_ros.estimation.planar_motion import Motion, View, first_motion, settled, trust
from autocalib_ros.estimation.small_matrices import cross, dot
from autocalib_ros.estimation.state import State, Steps, ground_up
from autocalib_ros.estimation.vehicles import corroborated, heading_off_deg

DIFFERENCE = 1e-6
"""Step of the parameters, in their units, by which distances are differentiated where no closed form is used."""


@dataclass(frozen=True)
class Rows:
    """Residuals (rows, SAMPLES), their derivatives (rows, SAMPLES, parameters) and what tells their weight."""

    residuals: np.ndarray
    slopes: np.ndarray
    freedom: np.ndarray
    """Residuals of each row beyond the unknowns of its own, shape (rows,)."""
    influence: np.ndarray
    """Weight by what speaks for a row besides its own residuals, shape (rows,)."""


class RoadRows:
    """Labelled tracks, each on a great circle through the direction of its road."""

    def __init__(self, steps: Steps, tracks: TrackSet, labels: np.ndarray, seen: Seen) -> None:
        self._steps, self._tracks, self._labels = steps, tracks, labels
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

    def residuals(self, state: State) -> np.ndarray:
        """Whitened distances from the circles, shape (tracks, samples)."""
        rays = rays_of(state.camera, self._tracks.pixels)
        distance = rays.distance_px(self._circles(state, rays)[:, None])
        return (self.whiten @ distance[..., None])[..., 0]

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
        return Rows((self.whiten @ here[..., None])[..., 0], slopes - free * along, self.freedom,
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
        self._steps = steps
        self._base = view = self._view(steps.base)
        self.motion = first_motion(view) if motion is None else settled(view, motion)
        self._here = view.distances(self.motion)
        self._slopes = view.slopes(self.motion, self._here)
        self._root = np.sqrt(trust(self._here))
        self.freedom = np.maximum(view.mask.sum(axis=1) - 2, 1)

    def _view(self, state: State) -> View:
        setting = self._steps.setting
        return View.of(setting.windows, state.camera, state.rotation, setting.options)

    def at(self, state: State) -> tuple[Motion, np.ndarray]:
        """Motion and residuals (windows, samples) at a state."""
        view = self._view(state)
        motion = settled(view, self.motion)
        return motion, self._root * view.distances(motion)

    def linearised(self) -> Rows:
        """Residuals at the base and their derivatives, by differences; the window's own motion projected out."""
        steps = self._steps
        columns = [(self._moved(unit) - self._here) / DIFFERENCE for unit in np.eye(steps.size)]
        slopes = self._root[..., None] * np.stack(columns, axis=-1)
        own = self._root[..., None] * self._slopes
        matrix = own.transpose(0, 2, 1) @ own + 1e-9 * np.eye(2)
        slopes = slopes - own @ np.linalg.solve(matrix, own.transpose(0, 2, 1) @ slopes)
        return Rows(self._root * self._here, slopes, self.freedom, np.ones(len(self.freedom)))

    def _moved(self, unit: np.ndarray) -> np.ndarray:
        """Distances a small step away, the motions as they are."""
        lens, turns = self._steps.lens, self._steps.lens + len(self._steps.axes)
        if unit[turns:].any():
            return self._here  # the angle of a road is nothing to a window
        view = self._base.turned(self._steps.turned(DIFFERENCE * unit[lens:turns])) if unit[lens:].any() else (
            self._view(self._steps.state(DIFFERENCE * unit)))
        return view.distances(self.motion)
