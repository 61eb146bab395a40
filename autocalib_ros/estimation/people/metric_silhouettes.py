"""Metric width and height of silhouettes that stand on the road.

Azimuths about the vertical through the camera do not depend on how high up a body is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.geometry.ground_plane import ahead_direction
from autocalib_ros.lens.camera import Camera


@dataclass(frozen=True)
class SilhouetteSizes:
    """Sizes of silhouettes in metres, each of shape (n,)."""

    azimuth: np.ndarray
    """Azimuth of the middle, from straight ahead to the left."""
    distance: np.ndarray
    """Distance from the camera's foot to the lowest point, on the road."""
    width: np.ndarray
    """Width across the line of sight, at that distance."""
    height: np.ndarray
    """Height of a vertical object there that reaches as far up in the image; depth adds to it."""


def measure_silhouettes(
    silhouettes_px: np.ndarray, camera: Camera, normal: np.ndarray, height_m: float
) -> SilhouetteSizes:
    """Measure silhouettes (n, OUTLINE_COLUMNS), as in `Outlines.ends_px`, of objects that stand on the road."""
    bearings = camera.unproject(silhouettes_px[:, :-1].astype(float).reshape(-1, 2))[0].reshape(-1, 8, 3)
    ahead = ahead_direction(normal)
    x, y, z = bearings @ ahead, bearings @ np.cross(normal, ahead), bearings @ normal
    middle = np.arctan2(y.sum(axis=1), x.sum(axis=1))
    turned = np.arctan2(y, x) - middle[:, None]
    azimuths = np.arctan2(np.sin(turned), np.cos(turned))
    slope = z / np.maximum(np.hypot(x, y), 1e-9)
    distance = height_m / np.maximum(-slope.min(axis=1), 1e-6)
    return SilhouetteSizes(
        middle, distance, np.ptp(azimuths, axis=1) * distance, height_m + distance * slope.max(axis=1)
    )
