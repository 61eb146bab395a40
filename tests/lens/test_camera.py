"""The lens model against itself and against OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autocalib_ros.errors import UsageError
from autocalib_ros.lens.camera import Camera

LENSES = {
    'equidistant': Camera(1280, 720, 560.0, (639.5, 359.5)),
    'kannala_brandt': Camera(1280, 720, 560.0, (630.0, 371.0), (0.015, -0.003, 0.001, -0.0002)),
    'narrow': Camera(640, 480, 900.0, (320.0, 240.0), (0.05, 0.0, 0.0, 0.0)),
    'squeezed': Camera(720, 576, 448.0, (359.5, 287.5), (0.015, -0.003, 0.0, 0.0), pixel_aspect=64 / 45),
    'nearly distortion-free': Camera(1280, 720, 700.0, (640.0, 360.0), (1 / 3, 2 / 15, 17 / 315, 62 / 2835)),
}


@pytest.fixture(params=LENSES.values(), ids=LENSES.keys())
def camera(request: pytest.FixtureRequest) -> Camera:
    return request.param


@pytest.fixture
def pixels(camera: Camera) -> np.ndarray:
    generator = np.random.default_rng(0)
    return generator.uniform((0, 0), (camera.width, camera.height), (500, 2))


def test_unproject_inverts_project(camera: Camera, pixels: np.ndarray) -> None:
    bearings, reached = camera.unproject(pixels)
    back, valid = camera.project(bearings)
    assert reached.all() and valid.all()
    np.testing.assert_allclose(back, pixels, atol=1e-7)  # a ten-millionth of a pixel: the inversion's tolerance


def test_bearings_are_unit_vectors(camera: Camera, pixels: np.ndarray) -> None:
    bearings, _ = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=1), 1.0, atol=1e-12)


def test_projection_agrees_with_opencv(camera: Camera) -> None:
    points = np.random.default_rng(1).uniform((-2, -1, 1), (2, 1, 3), (100, 3))
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.k)
    )
    np.testing.assert_allclose(camera.project(points)[0], expected[:, 0], atol=1e-8)


def test_skewed_axes_agree_with_opencv() -> None:
    camera = Camera(1280, 720, 502.5, (640.0, 365.0), (0.01, -0.004, 0.002, 0.0), pixel_aspect=1.005, skew=0.003)
    points = np.random.default_rng(1).uniform((-2, -1, 1), (2, 1, 3), (100, 3))
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.k), alpha=camera.skew
    )
    pixels, _ = camera.project(points)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-8)
    seen, _ = camera.unproject(pixels)
    np.testing.assert_allclose(seen, points / np.linalg.norm(points, axis=1)[:, None], atol=1e-7)


def test_a_squeezed_image_of_a_lens_has_its_pixel_aspect() -> None:
    wide = Camera(1024, 576, 448.0, (511.5, 287.5), (0.015, -0.003, 0.0, 0.0))
    squeezed, bearings = LENSES['squeezed'], wide.unproject(np.random.default_rng(2).uniform(0, 576, (50, 2)))[0]
    pixels = wide.project(bearings)[0]
    columns = (pixels[:, 0] + 0.5) * 720 / 1024 - 0.5  # the border lies half a pixel outside the first column
    np.testing.assert_allclose(squeezed.project(bearings)[0], np.column_stack([columns, pixels[:, 1]]), atol=1e-9)
    assert squeezed.matrix[0, 0] == pytest.approx(315.0)
    assert squeezed.scaled_to(360, 288).matrix[:2, :2] == pytest.approx(np.diag([157.5, 224.0]))


def test_undistorted_paths_of_a_squeezed_lens_are_straight() -> None:
    line = np.array([-1.0, 0.4, 1.0]) + np.linspace(0, 1, 20)[:, None] * [2.0, -0.3, 0.5]
    flat = LENSES['squeezed'].undistort(LENSES['squeezed'].project(line)[0])
    steps = flat - flat[0]
    assert np.abs(steps[:, 0] * steps[-1, 1] - steps[:, 1] * steps[-1, 0]).max() < 1e-5 * np.hypot(*steps[-1]) ** 2


@pytest.mark.parametrize('aspect', [0.0, -1.0, np.nan])
def test_an_impossible_pixel_aspect_is_refused(aspect: float) -> None:
    with pytest.raises(UsageError, match='pixel aspect'):
        Camera(1280, 720, 560.0, (639.5, 359.5), pixel_aspect=aspect)


def test_projection_is_valid_behind_the_image_plane() -> None:
    camera = LENSES['equidistant']
    pixels, valid = camera.project(np.array([np.sin(2.0), 0.0, np.cos(2.0)]))  # 115 degrees off the axis
    assert valid
    np.testing.assert_allclose(pixels, (639.5 + 2.0 * 560.0, 359.5))


def test_the_principal_point_looks_along_the_axis(camera: Camera) -> None:
    bearing, _ = camera.unproject(np.array(camera.principal_point_px))
    np.testing.assert_allclose(bearing, (0, 0, 1))


def test_a_lens_that_folds_back_says_where_it_is_invalid() -> None:
    camera = Camera(1280, 720, 560.0, (639.5, 359.5), (-0.2, 0.0, 0.0, 0.0))
    assert np.radians(70) < camera.max_angle_rad < np.radians(75)  # 1 = 3 * 0.2 theta^2 at 74 degrees
    _, valid = camera.project(np.array([1.0, 0.0, -0.2]))
    assert not valid


def test_a_pixel_beyond_the_model_is_marked_unreached() -> None:
    camera = Camera(4000, 2000, 300.0, (2000.0, 1000.0), (-0.2, 0.0, 0.0, 0.0))
    _, reached = camera.unproject(np.array([0.0, 0.0]))
    assert not reached


def test_undistortion_follows_the_published_equation() -> None:
    camera = LENSES['equidistant']
    distorted = np.array([200.0, -100.0])
    radius = np.hypot(*distorted)
    expected = distorted * np.tan(radius / 560.0) / (radius / 560.0)
    undistorted = camera.undistort(distorted + camera.principal_point_px) - camera.principal_point_px
    np.testing.assert_allclose(undistorted, expected)


def test_undistortion_past_ninety_degrees_has_no_image() -> None:
    camera = Camera(1280, 720, 300.0, (639.5, 359.5))  # the corner is 140 degrees from the axis
    assert np.isnan(camera.undistort(np.array([0.0, 0.0]))).all()


@pytest.mark.parametrize('focal', [0.0, -5.0, float('nan'), float('inf')])
def test_an_impossible_focal_length_is_refused(focal: float) -> None:
    with pytest.raises(UsageError, match='positive focal length'):
        Camera(1280, 720, focal, (640.0, 360.0))


@pytest.mark.parametrize('size', [(640, 360), (2560, 1440), (1920, 1080)])
def test_a_scaled_lens_sees_the_same_through_the_same_part_of_the_image(camera, pixels, size):
    width, height = size if camera.height == 720 else (size[0], size[0] * camera.height // camera.width)
    scale = width / camera.width
    before, _ = camera.unproject(pixels)
    # the border of the first pixel, at -0.5, is the border in every size
    after, valid = camera.scaled_to(width, height).unproject((pixels + 0.5) * scale - 0.5)
    assert valid.all()
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_a_lens_of_the_same_size_is_not_touched(camera):
    assert camera.scaled_to(camera.width, camera.height) is camera


def test_half_a_pixel_of_rounding_is_the_same_shape():
    scaled = Camera(1920, 1080, 800.0, (959.5, 539.5)).scaled_to(854, 480)
    assert scaled.principal_point_px == pytest.approx((426.5, 239.5))
    assert scaled.focal_px == pytest.approx(800 * 854 / 1920, rel=1e-3)  # half a pixel of 480


@pytest.mark.parametrize('size', [(640, 480), (1280, 719), (720, 1280), (640, 359)])
def test_another_shape_is_wrong_usage_and_reports_both_sizes(size):
    with pytest.raises(UsageError, match=f'images of 1280x720, and these images have {size[0]}x{size[1]}'):
        LENSES['equidistant'].scaled_to(*size)
