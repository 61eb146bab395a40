"""Derivatives of distances by the lens against differences of the distances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.geometry.great_circles import unproject_rays
from autocalib_ros.geometry.lens_slopes import CENTRE_X, CENTRE_Y, K1, K2, LOG_ASPECT, LOG_FOCAL, PolarRays
from autocalib_ros.lens.camera import Camera

STEP = 1e-6
EQUIDISTANT = Camera(1280, 720, 560.0, (630.0, 355.0))
BARREL = replace(EQUIDISTANT, k=(0.05, -0.01, 0.002, 0.0))
SQUEEZED = replace(BARREL, pixel_aspect=1.3, skew=0.05)
NARROW = replace(EQUIDISTANT, k=(-0.3, 0.01, 0.0, 0.0))
"""The corners of the image lie beyond its range."""


def moved(camera: Camera, parameter: int, step: float) -> Camera:
    (cx, cy), (k1, k2, *rest) = camera.principal_point_px, camera.k
    if parameter in (CENTRE_X, CENTRE_Y):
        point = (cx + step, cy) if parameter == CENTRE_X else (cx, cy + step)
        return replace(camera, principal_point_px=point)
    if parameter in (K1, K2):
        return replace(camera, k=(k1 + step, k2, *rest) if parameter == K1 else (k1, k2 + step, *rest))
    if parameter == LOG_FOCAL:
        return replace(camera, focal_px=camera.focal_px * np.exp(step))
    return replace(camera, pixel_aspect=camera.pixel_aspect * np.exp(step))


@pytest.mark.parametrize('parameter', [LOG_FOCAL, CENTRE_X, CENTRE_Y, K1, K2, LOG_ASPECT])
@pytest.mark.parametrize(
    'camera', [EQUIDISTANT, BARREL, SQUEEZED, NARROW], ids=['square', 'barrel', 'squeezed', 'narrow']
)
def test_slopes_by_the_lens_are_those_of_small_steps(camera: Camera, parameter: int) -> None:
    generator = np.random.default_rng(0)
    pixels = generator.uniform(0.0, 1.0, (40, 10, 2)) * (camera.width, camera.height)
    normals = generator.normal(size=(40, 1, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    ahead, behind = (
        unproject_rays(moved(camera, parameter, step), pixels).distance_px(normals) for step in (STEP, -STEP)
    )
    (slope,) = PolarRays(camera, pixels, unproject_rays(camera, pixels).bearings).distance_slopes(
        normals, np.array([parameter])
    )
    expected = (ahead - behind) / (2 * STEP)
    np.testing.assert_allclose(slope, expected, atol=1e-7 * np.abs(expected).max())
