"""What is drawn in the ground frame."""

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.lens.camera import Camera
from autocalib_ros.pictures.road import GroundGrid, enlargement, error_ellipses, view_frustum
from autocalib_ros.results.calibration import COVARIANCE_PARAMETERS, GROUND_DISTANCES_M

HEIGHT_SIGMA_M = 0.1


@pytest.fixture
def with_height_unsure(calibration):
    covariance = np.zeros((len(COVARIANCE_PARAMETERS),) * 2)
    covariance[-1, -1] = HEIGHT_SIGMA_M**2
    return lambda camera, ground: calibration(camera, ground, covariance=covariance)


def test_an_unsure_height_makes_ellipses_along_the_ray_that_grow_with_distance(camera, ground, with_height_unsure):
    found = error_ellipses(with_height_unsure(camera, ground))
    assert [ellipse.distance_m for ellipse in found] == [10.0, 20.0, 40.0] == list(GROUND_DISTANCES_M)
    for ellipse in found:
        expected = ellipse.distance_m * HEIGHT_SIGMA_M / 8.0  # similar triangles
        assert ellipse.centre_m == pytest.approx([ellipse.distance_m, 0.0], abs=1e-9)
        assert ellipse.sigma_m == pytest.approx(expected, rel=1e-3)
        assert np.abs(ellipse.axes_m[-1]) == pytest.approx([expected, 0.0], rel=1e-3, abs=1e-6)
        reach = np.abs(ellipse.outline(5.0) - ellipse.centre_m).max(axis=0)
        assert reach == pytest.approx([5 * expected, 0.0], rel=1e-2, abs=1e-4)


def test_distances_that_are_not_in_the_image_have_no_ellipse(camera, with_height_unsure, looking_down):
    assert [ellipse.distance_m for ellipse in error_ellipses(with_height_unsure(camera, looking_down(70.0)))] == [10.0]


def test_without_covariance_or_metres_there_are_no_ellipses(camera, ground, calibrated, lens_only, with_height_unsure):
    length_unit = replace(with_height_unsure(camera, ground), ground=replace(ground, metric=False))
    assert error_ellipses(calibrated) == error_ellipses(lens_only) == error_ellipses(length_unit) == []


def test_ellipses_are_enlarged_until_they_are_seen_and_no_more(camera, ground, with_height_unsure):
    shown = error_ellipses(with_height_unsure(camera, ground))
    assert enlargement(shown) == 5  # 1.25 % of the distance: 10 times would be more than a tenth
    assert enlargement([]) == 1


@pytest.mark.parametrize('focal_px', [300.0, 140.0])
def test_the_field_of_view_goes_through_the_corners_of_the_image(ground, focal_px):
    """At 140 px the corners are more than 90 degrees from the axis."""
    camera = Camera(640, 480, focal_px, (322.0, 236.0))
    lines = view_frustum(camera, ground)
    rays, around = lines[:4], lines[-1]
    ends = np.array([ray[1] - ray[0] for ray in rays])
    pixels, valid = camera.project(ends @ ground.rotation)
    assert valid.all()
    assert pixels == pytest.approx(np.array([[-0.5, -0.5], [639.5, -0.5], [639.5, 479.5], [-0.5, 479.5]]), abs=1e-3)
    assert np.allclose(np.linalg.norm(around - ground.translation_m, axis=1), np.linalg.norm(ends[0]))
    assert (around[0] == around[-1]).all()


def test_no_grid_where_no_road_is_seen(camera, looking_down):
    assert GroundGrid.of(camera, looking_down(-80.0)) is None
