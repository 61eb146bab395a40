"""The kinds of residuals of the joint problem, and their derivatives by its parameters.

A row is one track against its road, one window against a motion in the plane, or one life of a rigid body. Residuals
are whitened: divided by what they are expected to be. What a row has unknown of its own is solved inside (variable
projection, Kaufman 1975), so that the problem stays small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.adjustment.noise_model import locate_on_road, whitening_matrices
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState, Parameterisation, upward_normal
from autocalib_ros.estimation.motion.planar_motion import (
    PlanarMotion,
    WindowRays,
    initial_motion,
    refined,
    robust_weight,
)
from autocalib_ros.estimation.motion.rigid_bodies import StructureAndMotion, TrackletBundle, damped
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks
from autocalib_ros.estimation.observations.vehicle_grouping import corroboration_weights, heading_error_deg
from autocalib_ros.geometry.great_circles import Rays, fit_circles_through, unproject_rays
from autocalib_ros.geometry.small_matrices import cross, dot

DIFFERENTIATION_STEP = 1e-6
"""Step of the parameters, in their units, by which distances are differentiated where no closed form is used."""


@dataclass(frozen=True)
class LinearisedRows:
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
    def of(cls, residuals: np.ndarray, slopes: np.ndarray, dof: np.ndarray, influence: np.ndarray) -> LinearisedRows:
        """Sum up residuals (rows, samples) and slopes (rows, samples, parameters)."""
        transposed = slopes.transpose(0, 2, 1)
        return cls(
            (residuals**2).sum(axis=1) / dof,
            (transposed @ residuals[..., None])[..., 0],
            transposed @ slopes,
            influence,
        )


class StraightTrackBlock:
    """Labelled tracks, each on a great circle through the direction of its road."""

    def __init__(
        self,
        parameters: Parameterisation,
        tracks: TrackSet,
        labels: np.ndarray,
        unprojected: UnprojectedTracks,
        vehicle_weight: np.ndarray,
    ) -> None:
        self._parameters, self._tracks, self._labels = parameters, tracks, labels
        self.vehicle_ids, self.vehicle_weight = tracks.vehicles, vehicle_weight
        self._mask = tracks.weights > 0
        base, config = parameters.base, parameters.config
        self.dof = np.maximum(self._mask.sum(axis=1) - 1, 1)
        self._directions = base.directions[labels]
        self._rays = unprojected.rays
        normals, _ = fit_circles_through(unprojected.matrix, self._directions)
        self._scale = self._rays.pixel_scale(normals[:, None])
        self._up = upward_normal(base, config, self._rays)
        self._road = locate_on_road(self._rays, normals, self._directions, self._up, config.height_m)
        self.whiten = whitening_matrices(
            tracks.pixels, self._mask, self._road, config.options, drifting=config.drifting
        )
        self._normals = self._circles(base, self._rays)
        self._scale = self._rays.pixel_scale(self._normals[:, None])
        self._normals = self._circles(base, self._rays)

    def _circles(self, state: AdjustmentState, rays: Rays) -> np.ndarray:
        """Normals (tracks, 3) of each track's best circle through its road's direction, in whitened distances."""
        whitened = self.whiten @ (rays.bearings * self._scale[..., None])
        normals, _ = fit_circles_through(whitened.transpose(0, 2, 1) @ whitened, state.directions[self._labels])
        return normals

    def at(self, step: np.ndarray) -> tuple[None, np.ndarray]:
        """Mean squared whitened distance of each track from its circle, shape (tracks,); nothing to go on from."""
        state = self._parameters.state(step)
        rays = unproject_rays(state.camera, self._tracks.pixels)
        distance = rays.distance_px(self._circles(state, rays)[:, None])
        return None, ((self.whiten @ distance[..., None])[..., 0] ** 2).sum(axis=1) / self.dof

    def distances_px(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Observed pixels (n, 2), their distances from the circles (n,), and their tracks (n,), at the base."""
        track, sample = np.nonzero(self._mask)
        distance = np.abs(self._rays.distance_px(self._normals[:, None]))
        return self._tracks.pixels[track, sample], distance[track, sample], track

    def log_density(self) -> np.ndarray:
        """Logarithm of the determinant of each track's whitening, shape (tracks,)."""
        diagonal = np.diagonal(self.whiten, axis1=1, axis2=2)
        return np.where(self._mask, np.log(np.where(self._mask, diagonal, 1.0)), 0.0).sum(axis=1)

    def linearise(self) -> LinearisedRows:
        """Residuals at the base and their derivatives.

        The lens by differences of the exact residual: its gradient changes with the lens too, and that small
        term decides where the minimum lies. The roads in closed form: a direction d that moves by dd turns a
        normal n by -(n.dd) d. The circle's own angle is projected out.
        """
        rays, normals, parameters = self._rays, self._normals[:, None], self._parameters
        scale = rays.pixel_scale(normals)
        here = dot(rays.bearings, normals) * scale
        columns = [(self._distance(unit, normals) - here) / DIFFERENTIATION_STEP for unit in np.eye(parameters.lens)]
        across = here * scale
        # distance over gradient: the second term is how the gradient itself turns with the normal
        pull = rays.bearings - across[..., None] * (
            dot(rays.radial, normals)[..., None] * rays.radial
            + dot(rays.tangential, normals)[..., None] * rays.tangential
        )
        pull *= scale[..., None]
        free = (pull @ cross(self._directions, self._normals)[..., None])[..., 0]
        columns += [
            (pull @ (-dot(self._normals, turn)[:, None] * self._directions)[..., None])[..., 0]
            for turn in self._turns()
        ]
        slopes = self.whiten @ np.stack([free, *columns], axis=-1)
        free, slopes = slopes[..., :1], slopes[..., 1:]
        along = (free * slopes).sum(axis=1, keepdims=True) / np.maximum((free * free).sum(axis=1, keepdims=True), 1e-12)
        return LinearisedRows.of(
            (self.whiten @ here[..., None])[..., 0], slopes - free * along, self.dof, self._lane_keeping_weights(here)
        )

    def _distance(self, unit: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return unproject_rays(self._parameters.camera(DIFFERENTIATION_STEP * unit), self._tracks.pixels).distance_px(
            normals
        )

    def _turns(self) -> list[np.ndarray]:
        """Change (tracks, 3) of each track's direction with each parameter of the roads."""
        base = self._parameters.base
        turns = [cross(axis, base.in_plane)[self._labels] @ base.rotation.T for axis in self._parameters.axes]
        sideways = cross(np.array([0.0, 0.0, 1.0]), base.in_plane)[self._labels] @ base.rotation.T
        return turns + [sideways * (self._labels == road)[:, None] for road in self._parameters.free_angles]

    def _lane_keeping_weights(self, distance_px: np.ndarray) -> np.ndarray:
        """Influence (tracks,) of tracks by whether their vehicles keep to their roads; 1 where nothing drifts."""
        if not self._parameters.config.drifting:
            return np.ones(len(self._tracks))
        side = np.where(self._normals @ self._up < 0, -1.0, 1.0)[:, None]
        off, error = heading_error_deg(side * distance_px, self._road.px_per_m, self._road.along_m, self._mask)
        return corroboration_weights(off, error, self._tracks.vehicles, self._labels)


class PlanarMotionBlock:
    """Windows, each with the motion in the plane that suits it best; `motion` is one near it, None unknown."""

    def __init__(self, parameters: Parameterisation, motion: PlanarMotion | None) -> None:
        self._parameters, self._windows = parameters, parameters.config.windows
        self.vehicle_ids, self.vehicle_weight = self._windows.bodies, self._windows.body_weights
        self._base = view = self._view(parameters.base)
        self.warm_start = initial_motion(view) if motion is None else refined(view, motion)
        self._here = view.distances(self.warm_start)
        self._slopes = view.slopes(self.warm_start, self._here)
        self._root = np.sqrt(robust_weight(self._here))
        self.dof = np.maximum(view.mask.sum(axis=1) - 2, 1)

    def _view(self, state: AdjustmentState) -> WindowRays:
        return WindowRays.of(self._windows, state.camera, state.rotation, self._parameters.config.options)

    def at(self, step: np.ndarray) -> tuple[PlanarMotion, np.ndarray]:
        """Motion at a step and mean squared distances, shape (windows,)."""
        view = self._view(self._parameters.state(step))
        motion = refined(view, self.warm_start)
        return motion, ((self._root * view.distances(motion)) ** 2).sum(axis=1) / self.dof

    def linearise(self) -> LinearisedRows:
        """Residuals at the base and their derivatives, by differences; the window's own motion projected out."""
        parameters = self._parameters
        columns = [(self._distances_at(unit) - self._here) / DIFFERENTIATION_STEP for unit in np.eye(parameters.size)]
        slopes = self._root[..., None] * np.stack(columns, axis=-1)
        own = self._root[..., None] * self._slopes
        matrix = own.transpose(0, 2, 1) @ own + 1e-9 * np.eye(2)
        slopes = slopes - own @ np.linalg.solve(matrix, own.transpose(0, 2, 1) @ slopes)
        return LinearisedRows.of(self._root * self._here, slopes, self.dof, np.ones(len(self.dof)))

    def distances_px(self) -> tuple[np.ndarray, np.ndarray]:
        """Observed pixels (n, 2) and how far each misses the motion of its window (n,), at the base."""
        window, point = np.nonzero(self._base.mask)
        distance = np.abs(self._here * self._base.sigma_px)
        return self._windows.second_px[window, point], distance[window, point]

    def _distances_at(self, unit: np.ndarray) -> np.ndarray:
        """Distances a small step away, the motions as they are."""
        lens, turns = self._parameters.lens, self._parameters.lens + len(self._parameters.axes)
        if unit[turns:].any():
            return self._here  # the angle of a road is nothing to a window
        view = (
            self._base.turned(self._parameters.turned(DIFFERENTIATION_STEP * unit[lens:turns]))
            if unit[lens:].any()
            else (self._view(self._parameters.state(DIFFERENTIATION_STEP * unit)))
        )
        return view.distances(self.warm_start)


class RigidBodyBlock:
    """Lives of rigid bodies, each with the shape and the way that suit it best; `shapes` are near, None unknown."""

    def __init__(self, parameters: Parameterisation, bundle: TrackletBundle, shapes: StructureAndMotion | None) -> None:
        self._parameters, self._bundle, base = parameters, bundle, parameters.base
        self.vehicle_ids, self.vehicle_weight, self.dof = bundle.lives.bodies, bundle.lives.body_weights, bundle.dof
        self.warm_start = (
            bundle.initialised(base.camera, base.rotation)
            if shapes is None
            else bundle.refined(base.camera, base.rotation, shapes)
        )
        here = bundle.residuals(base.camera, base.rotation, self.warm_start)
        self._root = np.sqrt(bundle.robust_weight(here))[:, :, None, None]
        self._here = here
        self._follow: np.ndarray | None = None
        """How the unknowns of each life change with a step, shape (lives, unknowns, parameters)."""

    def at(self, step: np.ndarray) -> tuple[StructureAndMotion, np.ndarray]:
        """Shapes at a step and mean squared residuals, shape (lives,)."""
        state = self._parameters.state(step)
        near = self.warm_start if self._follow is None else self.warm_start.stepped(-(self._follow @ step))
        shapes = self._bundle.refined(state.camera, state.rotation, near)
        residuals = self._root * self._bundle.residuals(state.camera, state.rotation, shapes)
        return shapes, (residuals**2).sum(axis=(1, 2, 3)) / self.dof

    def linearise(self) -> LinearisedRows:
        """Residuals at the base and their derivatives; what is unknown of each life projected out."""
        parameters, bundle, base = self._parameters, self._bundle, self._parameters.base
        slopes, by_place = bundle.slopes(base.camera, base.rotation, self.warm_start)
        lenses = [parameters.camera(DIFFERENTIATION_STEP * unit) for unit in np.eye(parameters.lens)]
        columns = [
            change / DIFFERENTIATION_STEP
            for change in bundle.residual_changes(lenses, base.camera, base.rotation, self.warm_start)
        ]
        columns += [bundle.rotation_jacobian(axis, by_place, self.warm_start) for axis in parameters.axes]
        columns += [np.zeros(self._here.shape)] * len(parameters.free_angles)
        own, here = bundle.weighted_system(slopes, self._here)
        shared = (self._root[..., None] * np.stack(columns, axis=-1)).reshape(len(own), -1, parameters.size)
        matrix = damped(own.transpose(0, 2, 1) @ own, np.zeros(len(own)))
        self._follow = np.linalg.solve(matrix, own.transpose(0, 2, 1) @ shared)
        return LinearisedRows.of(here, shared - own @ self._follow, self.dof, np.ones(len(own)))

    def distances_px(self) -> tuple[np.ndarray, np.ndarray]:
        """Observed pixels (n, 2) and how far each is from its place on the body (n,), at the base."""
        base, lives = self._parameters.base, self._bundle.lives
        away = self._bundle.reprojection_errors_px(base.camera, base.rotation, self.warm_start)
        return lives.pixels[lives.mask], np.hypot(*away[lives.mask].T)
