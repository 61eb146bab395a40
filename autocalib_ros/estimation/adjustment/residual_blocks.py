"""Residual blocks of the bundle adjustment and their derivatives by its parameters.

A row of a block is one track against its road, one two-frame window against a planar motion, or one tracklet against
a rigid body. Residuals are whitened by the noise model. The unknowns of a row (circle, motion, shape) are eliminated
by variable projection (Kaufman 1975), so that only the shared parameters remain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.adjustment.noise_model import RoadPositions, locate_on_road, whitening_matrices
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState, Parameterisation, upward_normal
from autocalib_ros.estimation.motion.planar_motion import (
    PlanarMotion,
    WindowRays,
    initial_motion,
    refined,
    robust_weight,
)
from autocalib_ros.estimation.motion.rigid_bodies import StructureAndMotion, TrackletBundle, flat_unknowns
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks
from autocalib_ros.estimation.observations.vehicle_grouping import corroboration_weights, heading_error_deg
from autocalib_ros.geometry.great_circles import Rays, fit_circles_through, unproject_rays
from autocalib_ros.geometry.lens_slopes import PolarRays
from autocalib_ros.geometry.small_matrices import cross, dot


@dataclass(frozen=True)
class LinearisedRows:
    """Gradient and Gauss-Newton matrix of each row, from residuals r and Jacobians J with eliminated unknowns."""

    squared: np.ndarray
    """Mean squared residual, r^T r over the degrees of freedom, shape (rows,)."""
    gradient: np.ndarray
    """J^T r, shape (rows, parameters)."""
    curvature: np.ndarray
    """J^T J, shape (rows, parameters, parameters)."""
    influence: np.ndarray
    """Weight from evidence outside the row's residuals (corroboration by other tracks), shape (rows,)."""

    @classmethod
    def none(cls, parameters: int) -> LinearisedRows:
        """Return no rows."""
        return cls(np.zeros(0), np.zeros((0, parameters)), np.zeros((0, parameters, parameters)), np.zeros(0))

    @classmethod
    def of(cls, residuals: np.ndarray, jacobian: np.ndarray, dof: np.ndarray, influence: np.ndarray) -> LinearisedRows:
        """Sum residuals (rows, samples) and Jacobians `jacobian` (rows, samples, parameters) over the samples."""
        transposed = jacobian.transpose(0, 2, 1)
        return cls(
            (residuals**2).sum(axis=1) / dof,
            (transposed @ residuals[..., None])[..., 0],
            transposed @ jacobian,
            influence,
        )


class StraightTrackBlock:
    """Labelled tracks, one a row: distances from the great circle through the direction of the track's road."""

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
        if not len(labels):  # empty arrays cost as much as small ones
            nowhere, samples = np.zeros(self._mask.shape), self._mask.shape[1]
            self._normals, self._road = np.zeros((0, 3)), RoadPositions(nowhere, nowhere)
            self.whiten = np.zeros((0, samples, samples))
            return
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
        """Return the normals (tracks, 3) of the circles through the roads that minimise whitened distances."""
        whitened = self.whiten @ (rays.bearings * self._scale[..., None])
        normals, _ = fit_circles_through(whitened.transpose(0, 2, 1) @ whitened, state.directions[self._labels])
        return normals

    def at(self, step: np.ndarray, rays: Rays | None = None) -> np.ndarray:
        """Return the mean squared whitened distance of each track at a parameter step, shape (tracks,).

        `rays` are those of the tracks through the lens at the step, if they are known.
        """
        if not len(self.dof):
            return np.zeros(0)
        state = self._parameters.state(step)
        rays = rays or unproject_rays(state.camera, self._tracks.pixels)
        distance = rays.distance_px(self._circles(state, rays)[:, None])
        return ((self.whiten @ distance[..., None])[..., 0] ** 2).sum(axis=1) / self.dof

    def driving_directions(self) -> np.ndarray:
        """Return a number for road and sense of each track, shape (tracks,): one for each driving direction."""
        along = np.where(self._mask, self._road.along_m, np.nan)
        forward = np.nanmean(np.diff(along, axis=1), axis=1) > 0
        return 2 * self._labels + forward

    def distances_px(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return observed pixels (n, 2), their distances from the circles (n,) and their tracks (n,), at the base."""
        track, sample = np.nonzero(self._mask)
        distance = np.abs(self._rays.distance_px(self._normals[:, None]))
        return self._tracks.pixels[track, sample], distance[track, sample], track

    def log_density(self) -> np.ndarray:
        """Return the log determinant of each track's whitening matrix, shape (tracks,)."""
        diagonal = np.diagonal(self.whiten, axis1=1, axis2=2)
        return np.where(self._mask, np.log(np.where(self._mask, diagonal, 1.0)), 0.0).sum(axis=1)

    def linearise(self) -> LinearisedRows:
        """Return the rows at the base.

        Derivatives are closed-form. Those by the lens are of the exact residual: its pixel scale changes with the
        lens, and that small term shifts the minimum. A direction d that moves by dd turns a normal n by -(n.dd) d. The
        circle's angle about its direction is projected out.
        """
        if not len(self.dof):  # empty arrays cost as much as small ones
            return LinearisedRows.none(self._parameters.size)
        rays, normals, parameters = self._rays, self._normals[:, None], self._parameters
        scale = rays.pixel_scale(normals)
        distance = dot(rays.bearings, normals) * scale
        prior = parameters.config.prior
        lens = PolarRays(parameters.base.camera, self._tracks.pixels, rays.bearings)
        columns = [
            slope * unit for slope, unit in zip(lens.distance_slopes(normals, prior.free), prior.units, strict=True)
        ]
        across = distance * scale
        # derivative by the normal of n.b over its gradient norm: the second term is the change of the norm
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
        jacobian = self.whiten @ np.stack([free, *columns], axis=-1)
        free, jacobian = jacobian[..., :1], jacobian[..., 1:]
        along = (free * jacobian).sum(axis=1, keepdims=True) / np.maximum(
            (free * free).sum(axis=1, keepdims=True), 1e-12
        )
        return LinearisedRows.of(
            (self.whiten @ distance[..., None])[..., 0],
            jacobian - free * along,
            self.dof,
            self._lane_keeping_weights(distance),
        )

    def _turns(self) -> list[np.ndarray]:
        """Return the derivative (tracks, 3) of each track's direction by each rotation and road angle."""
        base = self._parameters.base
        turns = [cross(axis, base.in_plane)[self._labels] @ base.rotation.T for axis in self._parameters.axes]
        sideways = cross(np.array([0.0, 0.0, 1.0]), base.in_plane)[self._labels] @ base.rotation.T
        return turns + [sideways * (self._labels == road)[:, None] for road in self._parameters.free_angles]

    def _lane_keeping_weights(self, distance_px: np.ndarray) -> np.ndarray:
        """Return weights (tracks,) for whether the tracks' vehicles drive along their roads; 1 without point drift."""
        if not self._parameters.config.drifting:
            return np.ones(len(self._tracks))
        side = np.where(self._normals @ self._up < 0, -1.0, 1.0)[:, None]
        off, error = heading_error_deg(side * distance_px, self._road.px_per_m, self._road.along_m, self._mask)
        return corroboration_weights(off, error, self._tracks.vehicles, self._labels)


class PlanarMotionBlock:
    """Two-frame windows, one a row: Sampson distances from the best planar motion of each window.

    `motion` is the warm start, None where there is none.
    """

    def __init__(self, parameters: Parameterisation, motion: PlanarMotion | None) -> None:
        self._parameters, self._windows = parameters, parameters.config.windows
        self.vehicle_ids, self.vehicle_weight = self._windows.bodies, self._windows.body_weights
        self._base = view = self._view(parameters.base)
        self.warm_start = initial_motion(view) if motion is None else refined(view, motion)
        self._distances, *slopes = view.distances_and_jacobian(self.warm_start)
        self._slopes = np.stack(slopes, axis=-1)
        self._root = np.sqrt(robust_weight(self._distances))
        self.dof = np.maximum(view.mask.sum(axis=1) - 2, 1)
        self._follow: np.ndarray | None = None
        """Derivative of the motion of each window by the parameters, shape (windows, 2, parameters)."""

    def _view(self, state: AdjustmentState) -> WindowRays:
        return WindowRays.of(self._windows, state.camera, state.rotation, self._parameters.config.options)

    def at(self, step: np.ndarray) -> tuple[PlanarMotion, np.ndarray]:
        """Return the motions and the mean squared distances (windows,) at a parameter step."""
        if not len(self.dof):
            return self.warm_start, np.zeros(0)
        view = self._view(self._parameters.state(step))
        near = self.warm_start if self._follow is None else self.warm_start.moved(*-(self._follow @ step).T)
        motion = refined(view, near)
        return motion, ((self._root * view.distances(motion)) ** 2).sum(axis=1) / self.dof

    def linearise(self) -> LinearisedRows:
        """Return the rows at the base, with closed derivatives; the motion of each window is projected out."""
        parameters = self._parameters
        if not len(self.dof):  # as in most adjustments
            return LinearisedRows.none(parameters.size)
        prior, base, lens = parameters.config.prior, parameters.base, parameters.lens
        polar = PolarRays(base.camera, self._windows.ends_px, self._base.rays.bearings)
        columns = self._base.shared_slopes(self.warm_start, polar, prior.free, parameters.axes)
        columns[:lens] = [slope * unit for slope, unit in zip(columns, prior.units, strict=False)]
        # windows do not depend on road angles
        columns += [np.zeros(self._distances.shape)] * len(parameters.free_angles)
        jacobian = self._root[..., None] * np.stack(columns, axis=-1)
        own = self._root[..., None] * self._slopes
        matrix = own.transpose(0, 2, 1) @ own + 1e-9 * np.eye(2)
        self._follow = np.linalg.solve(matrix, own.transpose(0, 2, 1) @ jacobian)
        return LinearisedRows.of(
            self._root * self._distances, jacobian - own @ self._follow, self.dof, np.ones(len(self.dof))
        )

    def distances_px(self) -> tuple[np.ndarray, np.ndarray]:
        """Return observed pixels (n, 2) and their distances (n,) from the motions of their windows, at the base."""
        window, point = np.nonzero(self._base.mask)
        distance = np.abs(self._distances * self._base.sigma_px)
        return self._windows.second_px[window, point], distance[window, point]


class RigidBodyBlock:
    """Tracklets of rigid bodies, one a row: reprojection errors of the best shape and motion of each tracklet.

    `unknowns` is the warm start, None where there is none.
    """

    def __init__(
        self, parameters: Parameterisation, bundle: TrackletBundle, unknowns: StructureAndMotion | None
    ) -> None:
        self._parameters, self._bundle, base = parameters, bundle, parameters.base
        self.vehicle_ids, self.vehicle_weight, self.dof = (
            bundle.tracklets.bodies,
            bundle.tracklets.body_weights,
            bundle.dof,
        )
        self.warm_start = (
            bundle.initialised(base.camera, base.rotation)
            if unknowns is None
            else bundle.refined(base.camera, base.rotation, unknowns)
        )
        self._residuals = bundle.residuals(base.camera, base.rotation, self.warm_start)
        self._root = np.sqrt(bundle.robust_weight(self._residuals))
        self._follow: np.ndarray | None = None
        """Derivative of the unknowns of each tracklet by the parameters, shape (tracklets, unknowns, parameters)."""

    def at(self, step: np.ndarray) -> tuple[StructureAndMotion, np.ndarray]:
        """Return the shapes and the mean squared residuals (tracklets,) at a parameter step."""
        state = self._parameters.state(step)
        near = self.warm_start if self._follow is None else self.warm_start.stepped(-(self._follow @ step))
        unknowns = self._bundle.refined(state.camera, state.rotation, near)
        residuals = self._root[..., None, None] * self._bundle.residuals(state.camera, state.rotation, unknowns)
        return unknowns, (residuals**2).sum(axis=(1, 2, 3)) / self.dof

    def linearise(self) -> LinearisedRows:
        """Return the rows at the base; shape and motion of each tracklet are projected out."""
        parameters, bundle, base = self._parameters, self._bundle, self._parameters.base
        jacobian, by_place = bundle.jacobian(base.camera, base.rotation, self.warm_start)
        prior = parameters.config.prior
        slopes = bundle.lens_jacobian(prior.free, base.camera, base.rotation, self.warm_start)
        columns = [slope * unit for slope, unit in zip(slopes, prior.units, strict=True)]
        columns += [bundle.rotation_jacobian(axis, by_place, self.warm_start) for axis in parameters.axes]
        columns += [np.zeros(self._residuals.shape)] * len(parameters.free_angles)
        own, count = jacobian.weighted(self._root), len(self._root)
        columns = [bundle.rows_of(column, self._root) for column in columns]
        shared = np.concatenate(columns, axis=-1)
        follow = own.equations().damped(np.zeros(count)).solve(*own.pulled(shared))
        self._follow = flat_unknowns(*follow)
        return LinearisedRows.of(
            bundle.rows_of(self._residuals, self._root).reshape(count, -1),
            (shared - own.times(*follow)).reshape(count, -1, parameters.size),
            self.dof,
            np.ones(count),
        )

    def distances_px(self) -> tuple[np.ndarray, np.ndarray]:
        """Return observed pixels (n, 2) and their reprojection errors (n,), at the base."""
        base, tracklets = self._parameters.base, self._bundle.tracklets
        away = self._bundle.reprojection_errors_px(base.camera, base.rotation, self.warm_start)
        return tracklets.pixels[tracklets.mask], np.hypot(*away[tracklets.mask].T)
