"""Derivatives of distances and headings by the lens against differences of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moved_lenses import moved_lens

from autocalib_ros.estimation.markings.road_segments import ProjectedSegments
from autocalib_ros.geometry.great_circles import unproject_rays
from autocalib_ros.geometry.lens_slopes import CENTRE_X, CENTRE_Y, K1, K2, LOG_ASPECT, LOG_FOCAL, PolarRays
from autocalib_ros.geometry.robust_kernels import wrap_undirected
from autocalib_ros.lens.camera import Camera

STEP = 1e-6
EQUIDISTANT = Camera(1280, 720, 560.0, (630.0, 355.0))
BARREL = replace(EQUIDISTANT, k=(0.05, -0.01, 0.002, 0.0))
SQUEEZED = replace(BARREL, pixel_aspect=1.3, skew=0.05)
NARROW = replace(EQUIDISTANT, k=(-0.3, 0.01, 0.0, 0.0))
"""The corners of the image lie beyond its range."""


each_lens = pytest.mark.parametrize(
    'camera', [EQUIDISTANT, BARREL, SQUEEZED, NARROW], ids=['square', 'barrel', 'squeezed', 'narrow']
)
each_parameter = pytest.mark.parametrize('parameter', [LOG_FOCAL, CENTRE_X, CENTRE_Y, K1, K2, LOG_ASPECT])


@each_parameter
@each_lens
def test_slopes_of_distances_are_those_of_small_steps(camera: Camera, parameter: int) -> None:
    generator = np.random.default_rng(0)
    pixels = generator.uniform(0.0, 1.0, (40, 10, 2)) * (camera.width, camera.height)
    normals = generator.normal(size=(40, 1, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    ahead, behind = (
        unproject_rays(moved_lens(camera, parameter, step), pixels).distance_px(normals) for step in (STEP, -STEP)
    )
    (slope,) = PolarRays(camera, pixels, unproject_rays(camera, pixels).bearings).distance_slopes(
        normals, np.array([parameter])
    )
    expected = (ahead - behind) / (2 * STEP)
    np.testing.assert_allclose(slope, expected, atol=1e-7 * np.abs(expected).max())


@each_parameter
@each_lens
def test_slopes_of_headings_are_those_of_small_steps(camera: Camera, parameter: int) -> None:
    generator = np.random.default_rng(1)
    middles = generator.uniform(0.0, 1.0, (60, 2)) * (camera.width, camera.height)
    ways = generator.normal(0.0, 20.0, (60, 2))
    ends = np.concatenate([middles - ways / 2, middles + ways / 2], axis=1)
    directions = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    ahead, behind = (
        ProjectedSegments.from_camera(moved_lens(camera, parameter, step), ends).residuals(directions)
        for step in (STEP, -STEP)
    )
    rays = PolarRays(camera, middles, unproject_rays(camera, middles).bearings)
    (slope,) = rays.heading_slopes(ways, directions, np.array([parameter]))
    expected = wrap_undirected(ahead - behind) / (2 * STEP)
    np.testing.assert_allclose(slope, expected, atol=1e-7 * np.abs(expected).max() + 1e-8)
