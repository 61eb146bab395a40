"""Views of the road through a known lens and pose."""

import numpy as np
import pytest

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import rectified_matrix
from autocalib_ros.pictures.views import (
    EMPTY_GREY,
    TopView,
    grid_lines,
    grid_step,
    ground_to_image,
    image_to_ground,
    project_great_circle,
    project_road_lines,
    rectification_map,
    resample,
)

CAMERA = Camera(640, 480, 300.0, (322.0, 236.0), (0.01, 0.0, 0.0, 0.0))


def looking_down(dip_deg: float) -> GroundPlane:
    """A camera 8 m up that looks down along x."""
    dip = np.radians(dip_deg)
    ahead = np.array([np.cos(dip), 0.0, -np.sin(dip)])
    right = np.array([0.0, -1.0, 0.0])
    return GroundPlane(np.column_stack([right, np.cross(ahead, right), ahead]), 8.0)


@pytest.fixture
def ground() -> GroundPlane:
    return looking_down(30.0)


def checks(ground: GroundPlane) -> np.ndarray:
    """The image of a chequered road, squares of 2 m, 0 and 255."""
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1)
    points = image_to_ground(CAMERA, ground, pixels)
    return np.where(np.nan_to_num(np.floor(points / 2.0).sum(axis=-1)) % 2 == 0, 0, 255).astype(np.uint8)


def test_from_above_the_squares_of_the_road_are_square(ground):
    view = TopView.between(np.array([6.0, -4.0]), np.array([14.0, 4.0]), 400)
    seen = resample(checks(ground), view.sources(CAMERA, ground))
    centres = np.array([[x, y] for x in (7.0, 9.0, 11.0, 13.0) for y in (-3.0, -1.0, 1.0, 3.0)])
    columns, rows = np.round(view.pixels(centres)).astype(int).T
    expected = np.where(np.floor(centres / 2.0).sum(axis=1) % 2 == 0, 0, 255)
    assert (seen[rows, columns] == expected).all()


def test_a_point_of_the_road_lies_where_the_view_looks_it_up(ground):
    view = TopView.of_image(CAMERA, ground, 500)
    points = np.array([[12.0, 1.5, 0.0], [20.0, -3.0, 0.0]])
    columns, rows = np.round(view.pixels(points)).astype(int).T
    # half a pixel of the view is 0.1 m at the most, which 12 m away is a few pixels of the image
    assert view.sources(CAMERA, ground)[rows, columns] == pytest.approx(ground_to_image(CAMERA, ground, points), abs=4)
    assert max(view.columns, view.rows) == 500


def test_a_view_of_no_road_is_none(ground):
    assert TopView.of_image(CAMERA, looking_down(-80.0), 500) is None
    assert TopView.around(np.zeros((1, 2)), ground, 500) is None


def test_pixels_outside_the_field_of_view_are_empty(ground):
    behind = TopView.between(np.array([-60.0, -4.0]), np.array([-50.0, 4.0]), 50)
    assert (resample(checks(ground), behind.sources(CAMERA, ground)) == EMPTY_GREY).all()


def test_undistorted_the_lines_of_the_road_are_straight(ground):
    matrix = rectified_matrix(CAMERA)
    line = np.column_stack([np.full(30, 9.0), np.linspace(-4, 4, 30), np.zeros(30)])
    sources = rectification_map(CAMERA, matrix)
    found = [
        np.unravel_index(np.argmin(np.hypot(*(sources - pixel).T).T), sources.shape[:2])
        for pixel in ground_to_image(CAMERA, ground, line)
    ]
    columns, rows = np.array(found, float)[:, ::-1].T
    misfit = rows - np.polyval(np.polyfit(columns, rows, 1), columns)
    assert np.abs(misfit).max() < 1.0  # a whole pixel is the grain of this look-up


def test_the_horizon_is_where_the_road_ends(ground):
    horizon = np.concatenate(project_great_circle(CAMERA, ground.normal_in_camera))
    inside = horizon[(horizon >= 0).all(axis=1) & (horizon[:, 0] < 640)]
    assert len(inside) > 10
    assert np.isfinite(image_to_ground(CAMERA, ground, inside + [0.0, 2.0])).all()
    assert np.isnan(image_to_ground(CAMERA, ground, inside - [0.0, 2.0])).all()


def test_lines_of_the_grid_lie_a_step_apart_on_the_road(ground):
    step = grid_step(ground)
    parts = project_road_lines(CAMERA, ground, grid_lines(np.array([15.0, 0.0]), step))
    points = np.concatenate([image_to_ground(CAMERA, ground, part) for part in parts])
    off = np.abs(points / step - np.round(points / step)).min(axis=1)
    assert step == 5.0
    assert off.max() < 1e-6
