"""Lens and camera pose of the simulator, independent of the estimator's.

Kannala and Brandt (2006): r = f (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9), theta the angle
from the optical axis.  Camera optical frame: x right, y down, z forward.  Pixel (0, 0) is the
centre of the top-left pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class KannalaBrandtLens:
    """Kannala-Brandt lens with square pixels.

    focal_px: f in pixels; k: k1..k4; centre_px: the principal point (x, y) in pixels.
    """

    focal_px: float
    k: tuple[float, ...]
    centre_px: tuple[float, float]

    @cached_property
    def theta_limit(self) -> float:
        """Angle in radians up to which the radius increases, at most pi."""
        slope = np.zeros(2 * len(self.k) + 1)  # dr/dtheta / f = 1 + 3 k1 theta^2 + 5 k2 theta^4 ..
        slope[0] = 1.0
        slope[2::2] = [(2 * i + 3) * k for i, k in enumerate(self.k)]
        roots = np.polynomial.Polynomial(slope).trim().roots()
        real = roots[np.abs(roots.imag) < 1e-9].real
        return float(min([math.pi, *real[real > 0]]))

    @property
    def radius_limit_px(self) -> float:
        """Largest valid image radius in pixels."""
        return float(self._radius(np.float64(self.theta_limit)))

    def project(self, points_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (..., 3) in the optical frame.

        Returns pixels (..., 2) and a validity mask (...).  A point outside the valid range of the
        lens is projected to the rim in its direction and marked invalid.
        """
        x, y, z = np.moveaxis(np.asarray(points_camera, float), -1, 0)
        across = np.hypot(x, y)
        theta = np.arctan2(across, z)
        valid = theta < self.theta_limit
        radius = self._radius(np.minimum(theta, self.theta_limit))
        scale = radius / np.maximum(across, 1e-12)
        return np.stack([x * scale + self.centre_px[0], y * scale + self.centre_px[1]], -1), valid

    def bearings(self, pixels: np.ndarray) -> np.ndarray:
        """Return the unit bearings (..., 3) in the optical frame of pixels (..., 2)."""
        offset = np.asarray(pixels, float) - np.array(self.centre_px)
        radius = np.hypot(offset[..., 0], offset[..., 1])
        theta = np.interp(radius, *self._table)
        across = np.sin(theta) / np.maximum(radius, 1e-12)
        return np.concatenate([offset * across[..., None], np.cos(theta)[..., None]], -1)

    def _radius(self, theta: np.ndarray | np.float64) -> np.ndarray:
        square = theta * theta
        factor: np.ndarray = np.ones_like(theta)
        power = square
        for coefficient in self.k:
            factor = factor + coefficient * power
            power = power * square
        return np.asarray(self.focal_px * theta * factor)

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray]:
        """Radii and angles of a lookup table; linear interpolation errs by < 1e-9 rad."""
        theta = np.linspace(0.0, self.theta_limit, 1 << 16)
        return self._radius(theta), theta


@dataclass(frozen=True)
class CameraPose:
    """Camera pose: rotation (3, 3) and position (3,) in metres; world frame z up."""

    world_from_camera: np.ndarray
    position_m: np.ndarray

    def to_camera(self, points_world: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) from the world to the optical frame."""
        return (np.asarray(points_world, float) - self.position_m) @ self.world_from_camera

    def rotated(self, camera_rotation: np.ndarray) -> CameraPose:
        """Return the pose after a rotation (3, 3) in the camera frame."""
        return CameraPose(self.world_from_camera @ camera_rotation, self.position_m)


def look_rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """Return world_from_camera (3, 3) from yaw, downward pitch and roll.

    Positive roll turns the camera clockwise as seen from behind it.
    """
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    level = np.stack([right, down, forward], 1)
    return level @ rotation_from_vector(np.array([0.0, 0.0, roll]))


def rotation_from_vector(vector_rad: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector_rad))
    if angle < 1e-15:
        return np.eye(3)
    x, y, z = np.asarray(vector_rad, float) / angle
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
