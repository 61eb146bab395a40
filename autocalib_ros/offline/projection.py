"""Between the image and the road, for drawing and for comparing with the truth."""

from __future__ import annotations

import numpy as np

from autocalib_ros.calibration import GroundPlane
from autocalib_ros.camera import Camera

LEAST_DISTANCE_M = 2.0
"""Shorter distances on the road are not compared: their relative error says little."""


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


def distances_error(true_m: np.ndarray, found_m: np.ndarray) -> float:
    """Median relative error of the distances between points (n, 2) on the road; nan where all are too short."""
    first, second = np.triu_indices(len(true_m), 1)
    true_lengths = np.hypot(*(true_m[first] - true_m[second]).T)
    lengths = np.hypot(*(found_m[first] - found_m[second]).T)
    far_apart = true_lengths > LEAST_DISTANCE_M
    if not far_apart.any():
        return float('nan')
    # a point that ends up above the horizon is as wrong as can be, and must not drop out of the median
    errors = np.where(np.isfinite(lengths), np.abs(lengths / np.maximum(true_lengths, 1e-9) - 1), np.inf)
    return float(np.median(errors[far_apart]))


def angles_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles in degrees between vectors (..., 3)."""
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.degrees(np.arctan2(across, (first * second).sum(axis=-1)))
