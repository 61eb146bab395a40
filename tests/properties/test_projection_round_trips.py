"""Projecting and unprojecting undo each other, whatever the lens and the pose."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.ground import Ground
from autocalib_ros.lens.camera import Camera
from random_geometry import ground_planes, image_pixels, lenses, reproducible

EXACT_PX = 1.5e-3
"""`unproject` accepts an error of 1e-6 focal lengths, which is 0.0015 px of the longest lens."""
SEEDS = st.integers(0, 2**32 - 1)


def ground_of(camera: Camera, plane: GroundPlane) -> Ground:
    return Ground(lens=camera, rotation=plane.rotation, camera_m=plane.translation_m)


@reproducible(60)
@given(lenses(), SEEDS)
def test_pixels_return_through_their_bearings(camera: Camera, seed: int) -> None:
    pixels = image_pixels(seed)
    bearings, reached = camera.unproject(pixels)
    back, valid = camera.project(bearings[reached])
    assert reached.mean() > 0.5 and valid.all()
    np.testing.assert_allclose(back, pixels[reached], atol=EXACT_PX)


@reproducible(60)
@given(lenses(), SEEDS, st.floats(1e-3, 1e3))
def test_bearings_return_through_their_pixels_whatever_their_length(camera: Camera, seed: int, length: float) -> None:
    generator = np.random.default_rng(seed)
    # to where r(theta) nearly stops growing, and at most to 80 degrees, beyond the corners of any of these images
    largest = min(0.95 * camera.max_angle_rad, np.radians(80.0))
    theta, around = largest * np.sqrt(generator.uniform(0.0, 1.0, 200)), generator.uniform(-np.pi, np.pi, 200)
    bearings = np.column_stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)])
    pixels, valid = camera.project(length * bearings)
    back, reached = camera.unproject(pixels)
    assert valid.all() and reached.all()
    # 1e-6 focal lengths over the least slope of r(theta), which 5 % below its maximum is not zero
    np.testing.assert_allclose(back, bearings, atol=1e-4)


@reproducible(60)
@given(lenses(), ground_planes(), SEEDS)
def test_pixels_return_through_their_points_of_the_road(camera: Camera, plane: GroundPlane, seed: int) -> None:
    pixels, ground = image_pixels(seed), ground_of(camera, plane)
    found = ground.points(pixels)
    back, seen = ground.pixels(found.points_m)
    np.testing.assert_array_equal(seen, found.valid)
    assert found.valid.any()
    np.testing.assert_allclose(back[seen], pixels[seen], atol=EXACT_PX)


@reproducible(60)
@given(lenses(), ground_planes(), SEEDS)
def test_points_of_the_road_return_through_their_pixels(camera: Camera, plane: GroundPlane, seed: int) -> None:
    ground, generator = ground_of(camera, plane), np.random.default_rng(seed)
    ahead = np.arctan2(plane.rotation[1, 2], plane.rotation[0, 2])
    reach = plane.height_m * generator.uniform(1.0, 8.0, 100)  # from the camera's foot, to 7 degrees below the horizon
    around = ahead + generator.uniform(-0.5, 0.5, 100)
    points = np.column_stack([reach * np.cos(around), reach * np.sin(around), np.zeros(100)])
    pixels, seen = ground.pixels(points)
    found = ground.points(pixels[seen])
    assert seen.any() and found.valid.all()
    # EXACT_PX at 7 degrees below the horizon is a hundred-thousandth of the distance
    np.testing.assert_allclose(found.points_m, points[seen], rtol=1e-4, atol=1e-4 * plane.height_m)
