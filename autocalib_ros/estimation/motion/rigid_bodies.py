"""Bundle adjustment of rigid bodies: each vehicle moves in the ground plane, with points fixed on it.

Lengths are in units of the camera height above the plane of the points. That scale is unobservable and irrelevant:
each body has a size of its own, and lens and ground normal do not depend on it. The unknowns of a tracklet are the
positions of its points at a reference instant, and the pose of the body at the other instants. They are eliminated
from the adjustment of lens and plane. Residuals are in observed pixels, whitened by the drift of tracked points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.motion.tracklet_equations import TrackletJacobian
from autocalib_ros.estimation.observations.point_drift import drift_covariance, tracked_path_px
from autocalib_ros.estimation.observations.tracklets import Tracklets
from autocalib_ros.geometry.great_circles import unproject_rays
from autocalib_ros.geometry.projection_slopes import ProjectedPoints
from autocalib_ros.geometry.robust_kernels import cauchy_loss, cauchy_weight
from autocalib_ros.lens.camera import Camera

START_DAMPING = 1e-4
"""Damping of the first iteration, as a fraction of the diagonal."""
CAUCHY_SCALE, START_CAUCHY_SCALE = 2.0, 50.0
"""Standard deviations at which a point has half its weight (Cauchy kernel): bodies contain points of other vehicles.
The second value is for the initialisation. Judgement."""
START_MIN_DEPRESSION_RAD = 0.03
"""Smallest angle below the horizon at which points are placed on the ground for the initial guess."""
MIN_EIGENVALUE_FRACTION = 1e-7
"""Smaller eigenvalues, relative to the largest, belong to what a tracklet does not constrain: unseen points, its
size."""
WARM_START_ROUNDS, COLD_START_ROUNDS = 1, 12
"""Iterations on each tracklet after a small change of lens and plane, and from the initial guess."""


@dataclass(frozen=True)
class StructureAndMotion:
    """Unknowns of each tracklet, in the frame of the plane."""

    points: np.ndarray
    """Positions of the points at the reference instant, shape (tracklets, points, 3)."""
    translations: np.ndarray
    """Translation to each instant, shape (tracklets, instants, 2)."""
    turns_rad: np.ndarray
    """Rotation to each instant, shape (tracklets, instants)."""

    def stepped(self, step: np.ndarray) -> StructureAndMotion:
        """Return the unknowns after a step (tracklets, 3 points + 3 instants)."""
        tracklets, points, _ = self.points.shape
        poses = step[:, 3 * points :].reshape(tracklets, -1, 3)
        return StructureAndMotion(
            self.points + step[:, : 3 * points].reshape(tracklets, points, 3),
            self.translations + poses[..., :2],
            self.turns_rad + poses[..., 2],
        )

    def subset(self, keep: np.ndarray) -> StructureAndMotion:
        """Return the unknowns of the tracklets that `keep` selects."""
        return StructureAndMotion(self.points[keep], self.translations[keep], self.turns_rad[keep])

    def where(self, better: np.ndarray, other: StructureAndMotion) -> StructureAndMotion:
        """Return these unknowns, with those of the other for the tracklets (tracklets,) where it is better."""
        return StructureAndMotion(
            np.where(better[:, None, None], other.points, self.points),
            np.where(better[:, None, None], other.translations, self.translations),
            np.where(better[:, None], other.turns_rad, self.turns_rad),
        )


class TrackletBundle:
    """Tracklets with everything their residuals need that does not depend on lens and plane."""

    def __init__(self, tracklets: Tracklets, noise_px: float, drift_px: float) -> None:
        self.tracklets, self.mask, self._noise_px, self.drift_px = tracklets, tracklets.mask, noise_px, drift_px
        covariance = drift_covariance(tracked_path_px(tracklets.pixels, self.mask), drift_px)
        covariance *= self.mask[..., :, None] & self.mask[..., None, :]
        diagonal = np.arange(self.mask.shape[2])
        covariance[..., diagonal, diagonal] += np.where(self.mask, noise_px**2, 1.0)
        size = self.mask.shape[2]
        factors = np.linalg.inv(np.linalg.cholesky(covariance.reshape(-1, size, size))).reshape(covariance.shape)
        self.whiten = factors * self.mask[..., None, :] * self.mask[..., :, None]
        seen_points, seen_instants = self.mask.any(axis=2), self.mask.any(axis=1)
        # one fewer, because the size of the body is free
        unknowns = 3 * seen_points.sum(axis=1) + 3 * (seen_instants.sum(axis=1) - 1) - 1
        self.dof = np.maximum(2 * self.mask.sum(axis=(1, 2)) - unknowns, 1)
        self._point_dof = np.maximum(2 * self.mask.sum(axis=2) - 3, 1)
        self.reference = np.argmax(self.mask.sum(axis=1), axis=1)
        """The instant with most points, where the frame of the body is that of the plane, shape (tracklets,)."""

    def subset(self, keep: np.ndarray) -> TrackletBundle | None:
        """Return the tracklets that `keep` selects, None if it selects none."""
        tracklets = self.tracklets.subset(keep)
        return TrackletBundle(tracklets, self._noise_px, self.drift_px) if len(tracklets) else None

    def without_drift(self) -> TrackletBundle:
        """Return the same tracklets with points that do not drift."""
        return TrackletBundle(self.tracklets, self._noise_px, 0.0)

    def noise_cost(self, camera: Camera, camera_from_plane: np.ndarray, unknowns: StructureAndMotion) -> float:
        """Return twice the negative log-likelihood of the residuals near the best fit.

        The likelihood is restricted (Patterson & Thompson 1971) and its scale is fitted: the unknowns absorb part of
        the noise, and more of it if the noise is correlated.
        """
        unknowns = self.refined(camera, camera_from_plane, unknowns)
        residuals = self.residuals(camera, camera_from_plane, unknowns)
        scale = float(np.median((residuals**2).sum(axis=(1, 2, 3)) / self.dof))
        diagonal = np.diagonal(self.whiten, axis1=-2, axis2=-1)
        density = 2.0 * np.log(np.where(self.mask, diagonal, 1.0)).sum(axis=(1, 2))
        jacobian, _ = self.jacobian(camera, camera_from_plane, unknowns)
        eigenvalues = np.linalg.eigvalsh(jacobian.equations().matrix)
        volume = np.log(np.where(eigenvalues > MIN_EIGENVALUE_FRACTION * eigenvalues[:, -1:], eigenvalues, 1.0)).sum(
            axis=1
        )
        return float((self.dof * np.log(max(scale, 1e-9)) - 2.0 * density + volume).sum())

    def initial_guess(self, camera: Camera, camera_from_plane: np.ndarray) -> StructureAndMotion:
        """Guess the unknowns: points on the ground at first sight, moved as a rigid body from instant to instant."""
        bearings = unproject_rays(camera, self.tracklets.pixels).bearings @ camera_from_plane
        side = float(np.sign(np.median(bearings[..., 2][self.mask]))) if self.mask.any() else 1.0
        ground = bearings[..., :2] / np.maximum(side * bearings[..., 2:], START_MIN_DEPRESSION_RAD)
        count, points, instants = self.mask.shape
        unknowns = StructureAndMotion(
            np.zeros((count, points, 3)), np.zeros((count, instants, 2)), np.zeros((count, instants))
        )
        unknowns.points[..., 2] = side
        for tracklet in range(count):
            placed = np.full((points, 2), np.nan)
            seen_instants = np.flatnonzero(self.mask[tracklet].any(axis=0))
            nearest_first = np.argsort(np.abs(seen_instants - self.reference[tracklet]), kind='stable')
            for instant in seen_instants[nearest_first]:
                here, seen = ground[tracklet, :, instant], self.mask[tracklet, :, instant]
                known = seen & np.isfinite(placed[:, 0])
                turn, move = _rigid_transform(placed[known], here[known]) if known.sum() >= 2 else (0.0, np.zeros(2))
                unknowns.turns_rad[tracklet, instant], unknowns.translations[tracklet, instant] = turn, move
                new = seen & ~known
                placed[new] = (here[new] - move) @ _rotation(turn)
            unknowns.points[tracklet, :, :2] = np.nan_to_num(placed)
        return unknowns

    def residuals(self, camera: Camera, camera_from_plane: np.ndarray, unknowns: StructureAndMotion) -> np.ndarray:
        """Whitened residuals (tracklets, points, instants, 2)."""
        return self.whiten @ self.reprojection_errors_px(camera, camera_from_plane, unknowns)

    def reprojection_errors_px(
        self, camera: Camera, camera_from_plane: np.ndarray, unknowns: StructureAndMotion
    ) -> np.ndarray:
        """Projected minus observed pixels, shape (tracklets, points, instants, 2)."""
        pixels, _ = camera.project(self._positions(unknowns) @ camera_from_plane.T)
        return (pixels - self.tracklets.pixels) * self.mask[..., None]

    def _positions(self, unknowns: StructureAndMotion) -> np.ndarray:
        """Positions of the points (tracklets, points, instants, 3) in the frame of the plane."""
        cosine, sine = np.cos(unknowns.turns_rad)[:, None], np.sin(unknowns.turns_rad)[:, None]
        x, y, z = (unknowns.points[:, :, None, axis] for axis in range(3))
        right, ahead = (unknowns.translations[:, None, :, axis] for axis in range(2))
        return np.stack(
            [cosine * x - sine * y + right, sine * x + cosine * y + ahead, np.broadcast_to(z, self.mask.shape)], axis=-1
        )

    def robust_weight(self, residuals: np.ndarray, cauchy_scale: float = CAUCHY_SCALE) -> np.ndarray:
        """Cauchy weight (tracklets, points) of the points by their mean squared residuals."""
        return cauchy_weight(self._scaled_squares(residuals, cauchy_scale))

    def cost(self, residuals: np.ndarray, cauchy_scale: float = CAUCHY_SCALE) -> np.ndarray:
        """Cauchy loss (tracklets,) whose weight is `robust_weight`."""
        return (self._point_dof * cauchy_scale**2 * cauchy_loss(self._scaled_squares(residuals, cauchy_scale))).sum(
            axis=1
        )

    def _scaled_squares(self, residuals: np.ndarray, cauchy_scale: float) -> np.ndarray:
        """Mean squared residual of each point over the squared scale, shape (tracklets, points)."""
        return (residuals**2).sum(axis=(2, 3)) / self._point_dof / cauchy_scale**2

    def jacobian(
        self, camera: Camera, camera_from_plane: np.ndarray, unknowns: StructureAndMotion
    ) -> tuple[TrackletJacobian, np.ndarray]:
        """Derivatives of the residuals by the unknowns of each tracklet, and of the pixels by the positions.

        The latter have the shape (tracklets, points, instants, 2, 3).
        """
        placed = self._positions(unknowns)
        slopes = ProjectedPoints(camera, placed @ camera_from_plane.T).place_slopes()
        by_place = (slopes * self.mask[..., None, None]) @ camera_from_plane
        cosine, sine = (part[:, None, :, None] for part in (np.cos(unknowns.turns_rad), np.sin(unknowns.turns_rad)))
        x, y, z = np.moveaxis(by_place, -1, 0)
        tracklets, points, instants = self.mask.shape
        by_point = np.stack([x * cosine + y * sine, y * cosine - x * sine, z], axis=-1)
        by_point = self.whiten @ by_point.reshape(tracklets, points, instants, -1)
        about = placed[..., :2] - unknowns.translations[:, None]
        by_pose = np.stack([x, y, y * about[..., :1] - x * about[..., 1:]], axis=-1)
        # the pose at the reference instant is fixed
        by_pose[np.arange(tracklets), :, self.reference] = 0.0
        poses = self.whiten[:, :, :, None, :, None] * by_pose.transpose(0, 1, 3, 2, 4)[:, :, None]
        rows = (tracklets, points, 2 * instants)
        return TrackletJacobian(by_point.reshape(*rows, 3), poses.reshape(*rows, 3 * instants)), by_place

    def lens_jacobian(
        self, parameters: np.ndarray, camera: Camera, camera_from_plane: np.ndarray, unknowns: StructureAndMotion
    ) -> list[np.ndarray]:
        """Whitened derivatives (tracklets, points, instants, 2) by lens parameters, see `geometry.lens_slopes`."""
        projected = ProjectedPoints(camera, self._positions(unknowns) @ camera_from_plane.T)
        return [self.whiten @ (slope * self.mask[..., None]) for slope in projected.lens_slopes(parameters)]

    def rotation_jacobian(self, axis: np.ndarray, by_place: np.ndarray, unknowns: StructureAndMotion) -> np.ndarray:
        """Whitened derivative (tracklets, points, instants, 2) by rotation of the plane about its axis (3,)."""
        lever = np.cross(axis, self._positions(unknowns))
        return self.whiten @ (by_place @ lever[..., None])[..., 0]

    def initialised(self, camera: Camera, camera_from_plane: np.ndarray) -> StructureAndMotion:
        """Solve from an initial guess; outliers are down-weighted only once point heights are estimated."""
        unknowns = self.initial_guess(camera, camera_from_plane)
        for cauchy_scale in (START_CAUCHY_SCALE, CAUCHY_SCALE):
            unknowns = self.refined(camera, camera_from_plane, unknowns, COLD_START_ROUNDS, cauchy_scale)
        return unknowns

    def refined(
        self,
        camera: Camera,
        camera_from_plane: np.ndarray,
        unknowns: StructureAndMotion,
        rounds: int = WARM_START_ROUNDS,
        cauchy_scale: float = CAUCHY_SCALE,
    ) -> StructureAndMotion:
        """Refine the unknowns by Levenberg-Marquardt iterations, each tracklet on its own."""
        damping = np.full(len(self.tracklets), START_DAMPING)
        here = self.residuals(camera, camera_from_plane, unknowns)
        cost = self.cost(here, cauchy_scale)
        for _ in range(rounds):
            jacobian, _ = self.jacobian(camera, camera_from_plane, unknowns)
            root = np.sqrt(self.robust_weight(here, cauchy_scale))
            own = jacobian.weighted(root)
            step = own.equations().damped(damping).solve(*own.pulled(self.rows_of(here, root)))
            trial = unknowns.stepped(-flat_unknowns(*step)[..., 0])
            there = self.residuals(camera, camera_from_plane, trial)
            cost_there = self.cost(there, cauchy_scale)
            better = cost_there <= cost
            gain = np.max(cost - cost_there, initial=0.0, where=better)
            unknowns = unknowns.where(better, trial)
            here = np.where(better[:, None, None, None], there, here)
            cost = np.where(better, cost_there, cost)
            damping = np.where(better, np.maximum(damping / 3, 1e-7), np.minimum(damping * 6, 1e4))
            if better.all() and gain < 1e-3:
                break
        return unknowns

    def rows_of(self, residuals: np.ndarray, root: np.ndarray) -> np.ndarray:
        """Return residuals (tracklets, points, instants, 2) times a factor of each point, as rows of the equations.

        The shape is that of `TrackletJacobian.pulled`, (tracklets, points, 2 instants, 1).
        """
        return (residuals * root[:, :, None, None]).reshape(*self.mask.shape[:2], -1, 1)


def flat_unknowns(by_points: np.ndarray, by_poses: np.ndarray) -> np.ndarray:
    """Return unknowns as those of `TrackletEquations.solve` in one row, shape (tracklets, 3 points + poses, k)."""
    count, columns = len(by_poses), by_poses.shape[-1]
    return np.concatenate([by_points.reshape(count, -1, columns), by_poses], axis=1)


def _rotation(angle_rad: float) -> np.ndarray:
    """Rotation matrix (2, 2)."""
    return np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])


def _rigid_transform(before: np.ndarray, after: np.ndarray) -> tuple[float, np.ndarray]:
    """Rotation and translation that best align points (n, 2) with others (Kabsch 1976, in the plane)."""
    middle, other = before.mean(axis=0), after.mean(axis=0)
    first, second = before - middle, after - other
    turn = float(np.arctan2((first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum(), (first * second).sum()))
    return turn, other - _rotation(turn) @ middle
