"""Derivatives of projected pixels against differences of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moved_lenses import moved_lens

from autocalib_ros.geometry.lens_slopes import CENTRE_X, CENTRE_Y, K1, K2, LOG_ASPECT, LOG_FOCAL
from autocalib_ros.geometry.projection_slopes import ProjectedPoints
from autocalib_ros.lens.camera import Camera

STEP = 1e-6
BARREL = Camera(1280, 720, 560.0, (630.0, 355.0), (0.05, -0.01, 0.002, 0.0))
each_lens = pytest.mark.parametrize(
    'camera', [BARREL, replace(BARREL, pixel_aspect=1.3, skew=0.05)], ids=['square', 'squeezed']
)


def points() -> np.ndarray:
    """Points (50, 3) ahead of the camera and beside it, at any distance."""
    generator = np.random.default_rng(0)
    ahead = generator.normal(size=(50, 3)) + (0.0, 0.0, 1.0)
    return generator.uniform(0.5, 3.0, (50, 1)) * ahead / np.linalg.norm(ahead, axis=1, keepdims=True)


@each_lens
def test_points_are_projected_as_by_the_camera(camera: Camera) -> None:
    np.testing.assert_allclose(ProjectedPoints(camera, points()).pixels, camera.project(points())[0], atol=1e-9)


@each_lens
def test_slopes_by_the_position_are_those_of_small_steps(camera: Camera) -> None:
    differences = [
        (camera.project(points() + STEP * axis)[0] - camera.project(points() - STEP * axis)[0]) / (2 * STEP)
        for axis in np.eye(3)
    ]
    slopes = ProjectedPoints(camera, points()).place_slopes()
    np.testing.assert_allclose(slopes, np.stack(differences, axis=-1), rtol=1e-6, atol=1e-3)


@each_lens
@pytest.mark.parametrize('parameter', [LOG_FOCAL, CENTRE_X, CENTRE_Y, K1, K2, LOG_ASPECT])
def test_slopes_by_the_lens_are_those_of_small_steps(camera: Camera, parameter: int) -> None:
    ahead, behind = (moved_lens(camera, parameter, step).project(points())[0] for step in (STEP, -STEP))
    (slope,) = ProjectedPoints(camera, points()).lens_slopes(np.array([parameter]))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * STEP), rtol=1e-6, atol=1e-3)
