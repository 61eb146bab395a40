"""The pose of the camera over the road: rotation from road directions, translation from the height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.lens.camera import Camera

MIN_FRACTION_BELOW_HORIZON = 0.95
"""Vehicles drive on the road: at least this share of what moves lies below the horizon."""


def orient_upward(normal: np.ndarray, bearings: np.ndarray) -> tuple[np.ndarray, float]:
    """Turn a plane normal (3,) away from the road, and say which share of the bearings (n, 3) lies below."""
    below = bearings @ normal < 0
    return (normal, float(below.mean())) if below.mean() >= 0.5 else (-normal, float(1 - below.mean()))


def ground_plane(normal: np.ndarray, direction: np.ndarray, height: float, *, metric: bool) -> GroundPlane:
    """Return the plane with z along the upward `normal` (3,) and x along the road `direction` (3,), camera frame.

    Of the two ways along the road x takes the one that leads away from the camera.
    """
    z = normal / np.linalg.norm(normal)
    x = direction - (direction @ z) * z
    x /= np.linalg.norm(x)
    forward = np.array([0.0, 0.0, 1.0])
    if x @ forward < 0:
        x = -x
    return GroundPlane(np.stack([x, np.cross(z, x), z]), float(height), metric)


def tilt_and_roll_deg(normal: np.ndarray) -> np.ndarray:
    """Angles (2,) of the upward normal (3,): the optical axis below the horizontal, and the roll about it."""
    return np.degrees([np.arcsin(np.clip(-normal[2], -1, 1)), np.arctan2(-normal[0] + 0.0, -normal[1])])


def focal_from_vanishing_points(first: np.ndarray, second: np.ndarray) -> float | None:
    """The paper's f_new from two vanishing points (2,) of perpendicular roads, relative to the principal point.

    Its equation `(ux-cx)(vx-cx) + (uy-cy)(vy-cy) + f^2 = 0`; None where no focal length satisfies it.
    """
    squared = -float(first @ second)
    return squared**0.5 if squared > 0 else None


def rotation_from_vanishing_points(first: np.ndarray, second: np.ndarray, focal_px: float) -> np.ndarray:
    """The paper's R, shape (3, 3): its columns are the roads and their normal in the camera frame; nearest by SVD."""
    columns = [np.append(point, focal_px) / np.hypot(np.linalg.norm(point), focal_px) for point in (first, second)]
    matrix = np.column_stack([*columns, np.cross(*columns)])
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def paper_translation(rotation: np.ndarray, height: float) -> tuple[float, float, float]:
    """The paper's t = (0, 0, H / |r33|): the world origin is where the optical axis meets the road."""
    return (0.0, 0.0, float(height / max(abs(rotation[2, 2]), 1e-9)))


def ground_points(camera: Camera, normal: np.ndarray, height: float, pixels: np.ndarray) -> np.ndarray:
    """Where pixels (n, 2) meet the road: ahead of the camera's foot and to the left of it, shape (n, 2).

    Ahead is where the optical axis points; the lengths are in the unit of `height`.
    """
    bearings, _ = camera.unproject(pixels)
    ahead = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    ahead /= np.linalg.norm(ahead)
    reach = height / np.maximum(-(bearings @ normal), 1e-6)
    return reach[:, None] * np.column_stack([bearings @ ahead, bearings @ np.cross(normal, ahead)])


def pixels_ahead(camera: Camera, normal: np.ndarray, height: float, distances: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of road points straight ahead at distances (n,) from the camera's foot; nan outside the image."""
    ahead = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    ahead /= np.linalg.norm(ahead)
    pixels, valid = camera.project(distances[:, None] * ahead - height * normal)
    inside = valid & (pixels >= 0).all(axis=1) & (pixels <= [camera.width - 1, camera.height - 1]).all(axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def angles_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles in degrees between vectors (..., 3)."""
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.degrees(np.arctan2(across, (first * second).sum(axis=-1)))


def unsigned_angle_deg(one: np.ndarray, other: np.ndarray) -> float:
    """Angle between two unit vectors (3,), whichever way they point, degrees."""
    return float(np.degrees(np.arccos(min(abs(float(one @ other)), 1.0))))


@dataclass(frozen=True)
class Transform:
    """Takes coordinates in the frame `child` to coordinates in the frame `parent`; metres, unit quaternion (4,)."""

    parent: str
    child: str
    translation_m: np.ndarray
    rotation_xyzw: np.ndarray


@dataclass(frozen=True)
class GroundPlane:
    """The pose of the camera over the road: a point in the camera optical frame goes to the ground frame.

    Ground frame: origin at the camera's foot point on the road, z up, x along the dominant traffic
    direction, y left. `rotation` is ground_from_camera, shape (3, 3); `height_m` is in metres, or 1 when
    `metric` is false: then all lengths are in units of the camera's height.
    """

    rotation: np.ndarray
    height_m: float
    metric: bool = True

    @property
    def translation_m(self) -> np.ndarray:
        """The camera in the ground frame, shape (3,)."""
        return np.array([0.0, 0.0, self.height_m])

    @property
    def rotation_xyzw(self) -> np.ndarray:
        """The rotation as a unit quaternion x, y, z, w with w >= 0, shape (4,)."""
        return quaternion_xyzw(self.rotation)

    @property
    def normal_in_camera(self) -> np.ndarray:
        """Unit vector up from the road in the camera optical frame, shape (3,)."""
        return self.rotation[2]

    def transform(self, ground_frame: str, camera_frame: str, tf_parent: str) -> Transform:
        """Return the pose with the 'ground' or the 'camera' as the parent: the same pose, told from either end."""
        if tf_parent == 'ground':
            return Transform(ground_frame, camera_frame, self.translation_m, self.rotation_xyzw)
        back = self.rotation.T
        return Transform(camera_frame, ground_frame, -back @ self.translation_m, quaternion_xyzw(back))


def quaternion_xyzw(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion x, y, z, w (w >= 0) of a rotation matrix (3, 3)."""
    quaternion = Rotation.from_matrix(rotation).as_quat()
    return quaternion if quaternion[3] >= 0 else -quaternion
