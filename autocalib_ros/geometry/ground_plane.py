"""Pose of the camera over the ground plane: ray-ground intersection, tilt and roll, the ground frame.

A normal points up, away from the road, in the camera optical frame (x right, y down, z forward).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.lens.camera import Camera

MIN_FRACTION_BELOW_HORIZON = 0.95
"""Smallest fraction of tracked points below the horizon of a plausible ground plane: vehicles drive on the road.
Judgement; leaves 5 % for outliers."""
CLAMP_DEPRESSION_SINE = 1e-6
"""Clamp of the sine of the depression angle for public coordinates: rays at or above the horizon meet the ground a
million camera heights away."""


def orient_upward(normal: np.ndarray, bearings: np.ndarray) -> tuple[np.ndarray, float]:
    """Orient a plane normal (3,) away from the majority of the bearings (n, 3).

    Returns the upward normal and the fraction of the bearings below the horizon.
    """
    below = bearings @ normal < 0
    return (normal, float(below.mean())) if below.mean() >= 0.5 else (-normal, float(1 - below.mean()))


def ground_plane(normal: np.ndarray, direction: np.ndarray, height: float, *, metric: bool) -> GroundPlane:
    """Build the ground plane from the upward `normal` (3,) and the road `direction` (3,), both in the camera frame.

    z is the normal; x is the road direction projected on the plane, with the sign that points away from the camera.
    """
    z = normal / np.linalg.norm(normal)
    x = direction - (direction @ z) * z
    x /= np.linalg.norm(x)
    forward = np.array([0.0, 0.0, 1.0])
    if x @ forward < 0:
        x = -x
    return GroundPlane(np.stack([x, np.cross(z, x), z]), float(height), metric)


def tilt_and_roll_deg(normal: np.ndarray) -> np.ndarray:
    """Return tilt and roll in degrees (2,) of the upward normal (3,).

    Tilt is the depression of the optical axis below the horizontal, roll the rotation about the axis.
    """
    return np.degrees([np.arcsin(np.clip(-normal[2], -1, 1)), np.arctan2(-normal[0] + 0.0, -normal[1])])


def focal_from_vanishing_points(first: np.ndarray, second: np.ndarray) -> float | None:
    """Return the focal length in pixels that makes two vanishing points (2,) perpendicular, None where none does.

    Points are relative to the principal point: `(ux-cx)(vx-cx) + (uy-cy)(vy-cy) + f^2 = 0`, f_new of Jain & Saunier
    (arXiv 2001.07243).
    """
    squared = -float(first @ second)
    return squared**0.5 if squared > 0 else None


def rotation_from_vanishing_points(first: np.ndarray, second: np.ndarray, focal_px: float) -> np.ndarray:
    """Return the rotation (3, 3) whose columns are two roads and their normal in the camera frame.

    From vanishing points (2,) relative to the principal point; the nearest rotation by SVD, R of Jain & Saunier
    (arXiv 2001.07243).
    """
    columns = [np.append(point, focal_px) / np.hypot(np.linalg.norm(point), focal_px) for point in (first, second)]
    matrix = np.column_stack([*columns, np.cross(*columns)])
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def paper_translation(rotation: np.ndarray, height: float) -> tuple[float, float, float]:
    """Return t = (0, 0, H / |r33|) of Jain & Saunier: the world origin is where the optical axis meets the road."""
    return (0.0, 0.0, float(height / max(abs(rotation[2, 2]), 1e-9)))


def ahead_direction(normal: np.ndarray) -> np.ndarray:
    """Return the optical axis projected on the ground plane of an upward normal (3,), unit length, camera frame."""
    ahead = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    return ahead / np.linalg.norm(ahead)


def depression_sine(bearings: np.ndarray, normal: np.ndarray, min_sine: float = CLAMP_DEPRESSION_SINE) -> np.ndarray:
    """Return the sine of the angle below the horizon of unit bearings (..., 3), clamped to `min_sine`, shape (...).

    The one denominator of every ray-ground intersection; the clamp limits the distance to height / `min_sine`.
    """
    return np.maximum(-(bearings @ normal), min_sine)


def intersect_ground(
    bearings: np.ndarray, normal: np.ndarray, height: float, min_sine: float = CLAMP_DEPRESSION_SINE
) -> np.ndarray:
    """Return the range (...) along unit bearings (..., 3) to the ground plane, in the unit of `height`.

    The range times the bearing is the ground point in the camera frame. Rays less than `min_sine` below the horizon
    are clamped, see `depression_sine`.
    """
    return height / depression_sine(bearings, normal, min_sine)


def ground_points(camera: Camera, normal: np.ndarray, height: float, pixels: np.ndarray) -> np.ndarray:
    """Return the ground coordinates (n, 2) of pixels (n, 2): ahead of and left of the camera's foot point.

    Ahead is the optical axis projected on the plane; lengths are in the unit of `height`.
    """
    bearings, _ = camera.unproject(pixels)
    ahead = ahead_direction(normal)
    distance = intersect_ground(bearings, normal, height)
    return distance[:, None] * np.column_stack([bearings @ ahead, bearings @ np.cross(normal, ahead)])


def pixels_ahead(camera: Camera, normal: np.ndarray, height: float, distances: np.ndarray) -> np.ndarray:
    """Return the pixels (n, 2) of ground points straight ahead at distances (n,) from the foot point.

    NaN outside the image.
    """
    pixels, valid = camera.project(distances[:, None] * ahead_direction(normal) - height * normal)
    inside = valid & (pixels >= 0).all(axis=1) & (pixels <= [camera.width - 1, camera.height - 1]).all(axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def angles_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles in degrees, 0 to 180, between vectors (..., 3), shape (...)."""
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.degrees(np.arctan2(across, (first * second).sum(axis=-1)))


def unsigned_angle_deg(one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle in degrees, 0 to 90, between the lines along two unit vectors (3,)."""
    return float(np.degrees(np.arccos(min(abs(float(one @ other)), 1.0))))


@dataclass(frozen=True)
class Transform:
    """Rigid transform of coordinates from the frame `child` to the frame `parent`."""

    parent: str
    child: str
    translation_m: np.ndarray
    """Shape (3,)."""
    rotation_xyzw: np.ndarray
    """Unit quaternion, shape (4,)."""


@dataclass(frozen=True)
class GroundPlane:
    """Pose of the camera over the road: maps the camera optical frame to the ground frame.

    Ground frame: origin at the camera's foot point on the road, z up, x along the dominant traffic direction, y left.
    """

    rotation: np.ndarray
    """ground_from_camera, shape (3, 3)."""
    height_m: float
    """Camera height in metres; 1 where `metric` is false, and all lengths are then in camera heights."""
    metric: bool = True

    @property
    def translation_m(self) -> np.ndarray:
        """Camera position in the ground frame, shape (3,)."""
        return np.array([0.0, 0.0, self.height_m])

    @property
    def rotation_xyzw(self) -> np.ndarray:
        """Rotation as a unit quaternion x, y, z, w with w >= 0, shape (4,)."""
        return quaternion_xyzw(self.rotation)

    @property
    def normal_in_camera(self) -> np.ndarray:
        """Upward unit normal of the road in the camera optical frame, shape (3,)."""
        return self.rotation[2]

    def transform(self, ground_frame: str, camera_frame: str, tf_parent: str) -> Transform:
        """Return the pose as a transform with `tf_parent`, 'ground' or 'camera', as the parent frame."""
        if tf_parent == 'ground':
            return Transform(ground_frame, camera_frame, self.translation_m, self.rotation_xyzw)
        back = self.rotation.T
        return Transform(camera_frame, ground_frame, -back @ self.translation_m, quaternion_xyzw(back))


def quaternion_xyzw(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion x, y, z, w (w >= 0) of a rotation matrix (3, 3)."""
    quaternion = Rotation.from_matrix(rotation).as_quat()
    return quaternion if quaternion[3] >= 0 else -quaternion
