"""The lens in every distortion model of ROS, against OpenCV's own projection."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from autocalib_ros.errors import InputError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import (
    RECTIFIED_LIMIT_DEG,
    ModelMisfit,
    Readout,
    camera_info,
    rectified_matrix,
    to_full_resolution,
)
from autocalib_ros.lens.camera_info_yaml import read_camera_info, write_camera_info_yaml
from autocalib_ros.lens.opencv_lens import MAX_MODEL_ERROR_PX, fit_opencv_coefficients, max_visible_angle_rad

WIDTH, HEIGHT = 1280, 720
EQUIDISTANT, BARREL, NARROWING, TANGENT = (
    (0.0,) * 4,
    (0.02, -0.005, 0.0, 0.0),
    (-0.03, 0.002, 0.0, 0.0),
    (1 / 3, 2 / 15, 17 / 315, 62 / 2835),
)
LENSES = (EQUIDISTANT, BARREL, NARROWING, TANGENT)
EXACT_PX = 1e-5
"""The two ways of projecting agree to this, and a coefficient of 1e-9 that keeps D from being zero moves no more."""


def lens(field_deg: float, k: tuple[float, ...] = EQUIDISTANT, offset_px: tuple[float, float] = (0.0, 0.0)) -> Camera:
    """Return a lens with this diagonal field of view in degrees."""
    middle = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    x, y = (middle + offset_px).tolist()
    in_focal_lengths = Camera(WIDTH, HEIGHT, 1.0, (x, y), k).radius(np.radians(field_deg / 2))
    return Camera(WIDTH, HEIGHT, float(np.hypot(*(middle + np.abs(offset_px))) / in_focal_lengths), (x, y), k)


def seen(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels all over the image, its borders and corners among them, and their bearings."""
    across, down = np.linspace(0, WIDTH - 1, 257), np.linspace(0, HEIGHT - 1, 145)
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    bearings, valid = camera.unproject(pixels)
    return pixels[valid], bearings[valid]


def by_opencv(info, bearings: np.ndarray) -> np.ndarray:
    """Project bearings (n, 3) as a consumer of the message does."""
    matrix, still = np.array(info.k).reshape(3, 3), np.zeros(3)
    project = cv2.fisheye.projectPoints if info.distortion_model == 'equidistant' else None
    if project is not None:
        return project(bearings[:, None], still, still, matrix, np.array(info.d))[0][:, 0]
    return cv2.projectPoints(bearings, still, still, matrix, np.array(info.d))[0][:, 0]


def worst_px(info, camera: Camera) -> float:
    pixels, bearings = seen(camera)
    return float(np.hypot(*(by_opencv(info, bearings) - pixels).T).max())


@pytest.mark.parametrize('offset_px', [(0.0, 0.0), (37.0, -21.0)])
@pytest.mark.parametrize('k', LENSES)
@pytest.mark.parametrize(
    ('model', 'field_deg'),
    [
        ('equidistant', 60),
        ('equidistant', 170),
        ('rational_polynomial', 60),
        ('rational_polynomial', 110),
        ('rational_polynomial', 150),
        ('rational_polynomial', 162),
        ('plumb_bob', 60),
        ('plumb_bob', 90),
    ],
)
def test_the_error_that_is_reported_is_that_of_opencv_over_the_whole_image(model, field_deg, k, offset_px):
    camera = lens(field_deg, k, offset_px)
    info = camera_info(camera, model)
    assert info.distortion_model == model
    assert info.k == camera_info(camera).k  # consumers that read K alone need not know the model
    worst = worst_px(info, camera)
    # neither grid nor fit samples the point of the largest error, but both sample near it
    assert worst <= 1.001 * info.error_px + EXACT_PX
    assert worst >= 0.8 * info.error_px - EXACT_PX
    assert info.error_px <= MAX_MODEL_ERROR_PX


@pytest.mark.parametrize('k', LENSES)
@pytest.mark.parametrize('field_deg', [60, 90, 130])
def test_no_plumb_bob_comes_nearer_than_the_fitted_one(field_deg, k):
    camera = lens(field_deg, k)
    theta = np.linspace(0, max_visible_angle_rad(camera), 801)[1:]
    slope, radius = np.tan(theta), camera.radius(theta)
    powers = camera.focal_px * slope[:, None] * (slope[:, None] / slope[-1]) ** [2, 4, 6]
    rest, one = radius - camera.focal_px * slope, np.ones((800, 1))
    least = linprog(
        [0, 0, 0, 1],
        np.block([[powers, -one], [-powers, -one]]),
        np.concatenate([rest, -rest]),
        bounds=[(None, None)] * 3 + [(0, None)],
        method='highs',
    )
    error_px = fit_opencv_coefficients(camera, rational=False)[1]
    assert error_px <= 1.1 * least.fun + 1e-4


@pytest.mark.parametrize('field_deg', [110, 130, 150])
def test_a_wide_lens_is_refused_in_plumb_bob_with_the_way_out(field_deg):
    with pytest.raises(ModelMisfit) as raised:
        camera_info(lens(field_deg), 'plumb_bob')
    error_px = fit_opencv_coefficients(lens(field_deg), rational=False)[1]
    assert f'up to {error_px:.3g} px' in raised.value.message
    assert f'sees {field_deg / 2:.0f} degrees from its axis; 0.5 px is the most' in raised.value.message
    assert 'Set distortion_model to rational_polynomial, which is off by' in raised.value.remedy
    assert camera_info(lens(field_deg), 'rational_polynomial').error_px < 0.1


@pytest.mark.parametrize(('field_deg', 'expected'), [(176, 'would be off by up to'), (185, 'ends before 89')])
@pytest.mark.parametrize('model', ['plumb_bob', 'rational_polynomial'])
def test_a_lens_that_sees_half_the_world_is_equidistant_or_nothing(model, field_deg, expected):
    with pytest.raises(ModelMisfit) as raised:
        camera_info(lens(field_deg), model)
    assert expected in raised.value.message
    assert raised.value.remedy == 'Set distortion_model to equidistant, which is exact.'
    assert camera_info(lens(field_deg), 'auto').distortion_model == 'equidistant'


def test_a_disc_in_the_image_is_fitted_up_to_its_edge():
    # r(theta) falls from 62 degrees on, which is 235 px from the centre: the corners show nothing
    camera = Camera(WIDTH, HEIGHT, 300.0, (639.5, 359.5), (-0.25, -0.01, 0.0, 0.0))
    assert np.degrees(camera.max_angle_rad) == pytest.approx(np.degrees(max_visible_angle_rad(camera)))
    info = camera_info(camera, 'rational_polynomial')
    assert worst_px(info, camera) <= info.error_px + EXACT_PX


@settings(deadline=None)
@given(st.tuples(*[st.floats(-1e-9, 1e-9)] * 4))
def test_equidistant_coefficients_are_never_all_zero(k):
    # image_proc takes an all-zero D as "no distortion"
    assert any(abs(value) >= 1e-9 for value in camera_info(Camera(WIDTH, HEIGHT, 500.0, (639.5, 359.5), k)).d)


@pytest.mark.parametrize('model', ['rational_polynomial', 'plumb_bob'])
def test_what_is_written_in_another_model_is_read_as_the_lens(tmp_path: Path, model):
    camera = lens(90, BARREL)
    write_camera_info_yaml(tmp_path / 'c.yaml', camera, 'north', model)
    assert f'distortion_model: {model}\n' in (tmp_path / 'c.yaml').read_text()
    again = read_camera_info(tmp_path / 'c.yaml')
    pixels, bearings = seen(camera)
    assert np.hypot(*(again.project(bearings)[0] - pixels).T).max() < MAX_MODEL_ERROR_PX


@settings(deadline=None)
@given(st.floats(20, 200), st.sampled_from(LENSES), st.floats(0, 1), st.floats(-60, 60), st.floats(-60, 60))
def test_the_rectified_camera_is_finite_and_positive_for_any_field(field_deg, k, balance, dx, dy):
    if k != EQUIDISTANT:
        field_deg = min(field_deg, 170)
    matrix = np.array(camera_info(lens(field_deg, k, (dx, dy)), 'auto', balance).p).reshape(3, 4)
    assert np.isfinite(matrix).all() and (matrix[:, 3] == 0).all() and matrix[2].tolist() == [0, 0, 1, 0]
    assert matrix[0, 0] == matrix[1, 1] > 1.0
    # the axis is in the picture, so the road is
    assert 0 <= matrix[0, 2] <= WIDTH - 1 and 0 <= matrix[1, 2] <= HEIGHT - 1


def rectified_rays(camera: Camera, balance: float) -> np.ndarray:
    """Return the bearings of the pixels of the rectified image, shape (n, 3)."""
    pixels = np.stack(np.meshgrid(np.linspace(0, WIDTH - 1, 161), np.linspace(0, HEIGHT - 1, 91)), axis=-1)
    return (
        np.column_stack([pixels.reshape(-1, 2), np.ones(161 * 91)]) @ np.linalg.inv(rectified_matrix(camera, balance)).T
    )


@pytest.mark.parametrize('k', LENSES)
@pytest.mark.parametrize('field_deg', [60, 100, 150, 170])
def test_at_balance_0_every_rectified_pixel_was_seen(field_deg, k):
    camera = lens(field_deg, k, (12.0, -7.0))
    pixels, _ = camera.project(rectified_rays(camera, 0.0))
    assert (pixels >= -0.5).all() and (pixels <= (WIDTH - 0.5, HEIGHT - 0.5)).all()


@pytest.mark.parametrize('k', LENSES)
@pytest.mark.parametrize('field_deg', [60, 100, 150, 170])
def test_at_balance_1_every_pixel_up_to_the_limit_is_in_the_rectified_image(field_deg, k):
    camera = lens(field_deg, k, (12.0, -7.0))
    _, bearings = seen(camera)
    near = bearings[bearings[:, 2] > np.cos(np.radians(RECTIFIED_LIMIT_DEG))]
    pixels = (near / near[:, 2:]) @ rectified_matrix(camera, 1.0)[:2].T
    assert (pixels >= -0.5).all() and (pixels <= (WIDTH - 0.5, HEIGHT - 0.5)).all()


def test_the_balance_zooms_out_steadily():
    focal = [rectified_matrix(lens(130), balance)[0, 0] for balance in np.linspace(0, 1, 11)]
    assert np.all(np.diff(focal) < 0)


@pytest.mark.parametrize('k', LENSES)
@pytest.mark.parametrize(
    ('model', 'field_deg'),
    [('plumb_bob', 90), ('rational_polynomial', 90), ('rational_polynomial', 130), ('rational_polynomial', 150)],
)
def test_what_the_lens_does_not_see_is_not_mirrored_into_the_rectified_image(model, field_deg, k):
    # a polynomial that bends back beyond the field would show the road twice
    camera = lens(field_deg, k)
    rays = rectified_rays(camera, 1.0)
    truth, found = camera.project(rays)[0], by_opencv(camera_info(camera, model), rays)

    def inside(pixels: np.ndarray) -> np.ndarray:
        return ((pixels >= 0) & (pixels <= (WIDTH - 1, HEIGHT - 1))).all(axis=1)

    assert np.hypot(*(found - truth)[inside(found)].T).max() <= MAX_MODEL_ERROR_PX


def as_image_geometry(matrix: list[float], columns: int, readout: Readout) -> np.ndarray:
    """Return K or P of an image as image_geometry's PinholeCameraModel takes it from a message (REP-104)."""
    rows = np.array(matrix).reshape(3, columns)
    rows[:2, 2] -= readout.offset
    rows[0] /= max(readout.binning[0], 1)
    rows[1] /= max(readout.binning[1], 1)
    return rows


@pytest.mark.parametrize(
    'readout',
    [
        Readout(1280, 720),
        Readout(2560, 1440, (2, 2)),
        Readout(2561, 1441, (2, 2)),
        Readout(2560, 720, (2, 0)),
        Readout(1920, 1080, (1, 1), (300, 200), (1280, 720)),
        Readout(4000, 3000, (2, 2), (301, 200), (2560, 1440)),
    ],
)
def test_a_message_in_full_resolution_is_the_calibration_in_the_image(readout):
    camera = lens(110, BARREL, (12.0, -7.0))
    info = camera_info(camera, 'rational_polynomial')
    full = to_full_resolution(info, readout)
    assert (full.width, full.height) == (readout.width, readout.height)
    assert (full.d, full.r, full.distortion_model) == (info.d, info.r, info.distortion_model)
    np.testing.assert_allclose(as_image_geometry(full.k, 3, readout), np.reshape(info.k, (3, 3)), rtol=1e-14)
    np.testing.assert_allclose(as_image_geometry(full.p, 4, readout), np.reshape(info.p, (3, 4)), rtol=1e-14)


@pytest.mark.parametrize(
    ('readout', 'expected'),
    [
        (Readout(1280, 720, (2, 2)), 'for images of 640x360, these have 1280x720'),  # both scalings at once
        (Readout(1920, 1080), 'for images of 1920x1080'),
        (Readout(0, 0), 'for images of 0x0'),
        (Readout(1920, 1080, (1, 1), (0, 0), (640, 480)), 'for images of 640x480'),
        (Readout(1920, 1080, (1, 1), (641, 0), (1280, 720)), 'exceeds its 1920x1080 pixels'),
        (Readout(0, 0, (1, 1), (0, 0), (1280, 720)), 'exceeds its 0x0 pixels'),
    ],
)
def test_a_readout_of_other_images_is_reported(readout, expected):
    with pytest.raises(InputError, match=expected):
        to_full_resolution(camera_info(lens(100)), readout)


def test_without_binning_nothing_changes():
    info = camera_info(replace(lens(100), width=640, height=360))
    assert to_full_resolution(info, Readout(640, 360)) == info
