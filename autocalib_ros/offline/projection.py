"""Between the image and the road, for drawing and for comparing with the truth."""

from __future__ import annotations

import numpy as np

from autocalib_ros.calibration import GroundPlane
from autocalib_ros.camera import Camera


def ground_to_image(camera: Camera, ground: GroundPlane, points_m: np.ndarray) -> np.ndarray:
    """Return pixels (..., 2) of points (..., 3) in the ground frame; nan where the lens does not see them."""
    bearings = (points_m - ground.translation_m) @ ground.rotation  # the row form of R^T (X - t)
    pixels, valid = camera.project(bearings)
    return np.where(valid[..., None], pixels, np.nan)


def image_to_ground(camera: Camera, ground: GroundPlane, pixels: np.ndarray) -> np.ndarray:
    """Return points (..., 2) on the road of pixels (..., 2); nan at and above the horizon."""
    bearings, valid = camera.unproject(pixels)
    rays = bearings @ ground.rotation.T
    down = np.where(valid & (rays[..., 2] < -1e-6), rays[..., 2], np.nan)
    return rays[..., :2] * (-ground.height_m / down)[..., None]
