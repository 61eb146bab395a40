"""Lenses of which one parameter is moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.geometry.lens_slopes import CENTRE_X, CENTRE_Y, K1, K2, LOG_FOCAL
from autocalib_ros.lens.camera import Camera


def moved_lens(camera: Camera, parameter: int, step: float) -> Camera:
    """Return the lens after a step of a parameter, see `geometry.lens_slopes`."""
    (cx, cy), (k1, k2, *rest) = camera.principal_point_px, camera.k
    if parameter in (CENTRE_X, CENTRE_Y):
        point = (cx + step, cy) if parameter == CENTRE_X else (cx, cy + step)
        return replace(camera, principal_point_px=point)
    if parameter in (K1, K2):
        return replace(camera, k=(k1 + step, k2, *rest) if parameter == K1 else (k1, k2 + step, *rest))
    if parameter == LOG_FOCAL:
        return replace(camera, focal_px=camera.focal_px * np.exp(step))
    return replace(camera, pixel_aspect=camera.pixel_aspect * np.exp(step))
