"""Normal equations of tracklets, each of which has many points that share the poses of one body.

A residual depends on one point and on the poses. The points are eliminated one by one (Schur complement, as in the
bundle adjustment of Triggs et al. 2000), so that only the poses of a body are solved for together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RELATIVE_LIFT, LEAST_LIFT = 1e-9, 1e-9
"""Damping, relative to the largest diagonal element and absolute, of what a tracklet does not constrain: unseen points
and the size of the body stay as they are."""


@dataclass(frozen=True)
class TrackletJacobian:
    """Derivatives of the residuals of each tracklet; those of a point are the n of its instants, x and y."""

    by_point: np.ndarray
    """By the position of the residual's own point, shape (tracklets, points, n, 3)."""
    by_pose: np.ndarray
    """By the poses of the body, shape (tracklets, points, n, poses)."""

    def weighted(self, root: np.ndarray) -> TrackletJacobian:
        """Return the derivatives times a factor (tracklets, points) of each point."""
        return TrackletJacobian(self.by_point * root[..., None, None], self.by_pose * root[..., None, None])

    def equations(self) -> TrackletEquations:
        """Return the blocks of J^T J."""
        flat = self.by_pose.reshape(len(self.by_pose), -1, self.by_pose.shape[-1])
        transposed = self.by_point.swapaxes(-1, -2)
        return TrackletEquations(transposed @ self.by_point, transposed @ self.by_pose, flat.swapaxes(-1, -2) @ flat)

    def pulled(self, residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return J^T r of residuals (tracklets, points, n, k).

        By the points, shape (tracklets, points, 3, k), and by the poses, shape (tracklets, poses, k).
        """
        count, columns = len(residuals), residuals.shape[-1]
        flat = self.by_pose.reshape(count, -1, self.by_pose.shape[-1])
        return (
            self.by_point.swapaxes(-1, -2) @ residuals,
            flat.swapaxes(-1, -2) @ residuals.reshape(count, -1, columns),
        )

    def times(self, by_points: np.ndarray, by_poses: np.ndarray) -> np.ndarray:
        """Return J x of unknowns as those of `TrackletEquations.solve`, shape (tracklets, points, n, k)."""
        return self.by_point @ by_points + self.by_pose @ by_poses[:, None]


@dataclass(frozen=True)
class TrackletEquations:
    """Blocks of the normal equations of each tracklet."""

    points: np.ndarray
    """Of each point, shape (tracklets, points, 3, 3)."""
    mixed: np.ndarray
    """Of each point and the poses, shape (tracklets, points, 3, poses)."""
    poses: np.ndarray
    """Of the poses, shape (tracklets, poses, poses)."""

    @property
    def matrix(self) -> np.ndarray:
        """The whole matrix, points first, shape (tracklets, 3 points + poses, 3 points + poses)."""
        count, points, _, poses = self.mixed.shape
        matrix = np.zeros((count, 3 * points + poses, 3 * points + poses))
        for point in range(points):
            rows = slice(3 * point, 3 * point + 3)
            matrix[:, rows, rows] = self.points[:, point]
            matrix[:, rows, 3 * points :] = self.mixed[:, point]
            matrix[:, 3 * points :, rows] = self.mixed[:, point].swapaxes(-1, -2)
        matrix[:, 3 * points :, 3 * points :] = self.poses
        return matrix

    def damped(self, damping: np.ndarray) -> TrackletEquations:
        """Return the equations with a damping (tracklets,), a fraction of each diagonal element."""
        of_points, of_poses = np.einsum('tpii->tpi', self.points), np.einsum('tii->ti', self.poses)
        largest = np.maximum(of_points.max(axis=(1, 2), initial=0.0), of_poses.max(axis=1, initial=0.0))
        least = RELATIVE_LIFT * largest + LEAST_LIFT
        lift_points = damping[:, None, None] * of_points + least[:, None, None]
        lift_poses = damping[:, None] * of_poses + least[:, None]
        return TrackletEquations(
            self.points + lift_points[..., None] * np.eye(3),
            self.mixed,
            self.poses + lift_poses[..., None] * np.eye(self.poses.shape[-1]),
        )

    def solve(self, points: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the unknowns of right sides.

        Of both, those of the points have the shape (tracklets, points, 3, k) and those of the poses (tracklets, poses,
        k).
        """
        count, number, _, size = self.mixed.shape
        inverse = np.linalg.inv(self.points)
        gain = inverse @ self.mixed
        flat, pull = self.mixed.reshape(count, 3 * number, size), gain.reshape(count, 3 * number, size)
        reduced = self.poses - flat.swapaxes(-1, -2) @ pull
        right = poses - pull.swapaxes(-1, -2) @ points.reshape(count, 3 * number, -1)
        by_poses = np.linalg.solve(reduced, right)
        return inverse @ points - gain @ by_poses[:, None], by_poses
