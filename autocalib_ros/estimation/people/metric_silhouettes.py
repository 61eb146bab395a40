"""What moves has a size: outlines in the image become lengths across the line of sight and heights, in metres.

Azimuths about the upright through the camera do not depend on how high up a body is seen, nor on its height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.lens.camera import Camera


@dataclass(frozen=True)
class SilhouetteSizes:
    """Of outlines, in metres, each of shape (n,)."""

    azimuth: np.ndarray
    """Of the middle, from straight ahead to the left."""
    distance: np.ndarray
    """From the camera's foot to where the lowest part stands on the road."""
    width: np.ndarray
    """Across the line of sight, at that distance."""
    height: np.ndarray
    """Of what is upright there and reaches as far up in the image; deeper bodies seem higher."""


def measure_silhouettes(
    outlines_px: np.ndarray, camera: Camera, normal: np.ndarray, height_m: float
) -> SilhouetteSizes:
    """Measure outlines (n, OUTLINE_COLUMNS), as `Outlines.ends_px`, of what stands on the road."""
    bearings = camera.unproject(outlines_px[:, :-1].astype(float).reshape(-1, 2))[0].reshape(-1, 8, 3)
    ahead = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    ahead /= np.linalg.norm(ahead)
    x, y, z = bearings @ ahead, bearings @ np.cross(normal, ahead), bearings @ normal
    middle = np.arctan2(y.sum(axis=1), x.sum(axis=1))
    turned = np.arctan2(y, x) - middle[:, None]
    azimuths = np.arctan2(np.sin(turned), np.cos(turned))
    slope = z / np.maximum(np.hypot(x, y), 1e-9)
    distance = height_m / np.maximum(-slope.min(axis=1), 1e-6)
    return SilhouetteSizes(
        middle, distance, np.ptp(azimuths, axis=1) * distance, height_m + distance * slope.max(axis=1)
    )
