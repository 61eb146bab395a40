"""CameraInfo of a lens: written and read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from autocalib_ros.errors import InputError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import camera_info, rectified_matrix
from autocalib_ros.lens.camera_info_lens import CameraInfoLens
from autocalib_ros.lens.camera_info_yaml import read_camera_info, read_exact_lens, write_camera_info_yaml

CAMERA = Camera(1280, 720, 560.0, (639.5, 359.5))
WIDTH, HEIGHT = 1280, 720
SQUARE = [900.0, 0.0, 632.0, 0.0, 900.0, 365.0, 0.0, 0.0, 1.0]
WIDE = [500.0, 0.0, 645.0, 0.0, 500.0, 352.0, 0.0, 0.0, 1.0]
ALLOWED_PX = 0.5
"""Maximum error of a converted lens anywhere in the image: the accuracy of a tracked point."""
READ_PX = 1e-6
"""An equidistant lens is read, not converted: only double precision rounds."""


def test_distortion_is_never_all_zero() -> None:
    # all-zero D reads as "no distortion" to image_proc, whatever the model is called
    assert any(abs(value) >= 1e-9 for value in camera_info(CAMERA).d)


def test_foxglove_s_name_stands_for_the_same_numbers_and_is_read_again(tmp_path: Path) -> None:
    lens = Camera(1280, 720, 560.0, (639.5, 359.5), (0.02, -0.003, 0.0, 0.0))
    named, usual = camera_info(lens, 'kannala_brandt'), camera_info(lens)
    assert (named.distortion_model, usual.distortion_model) == ('kannala_brandt', 'equidistant')
    assert (named.d, named.k, named.p, named.error_px) == (usual.d, usual.k, usual.p, 0.0)
    write_camera_info_yaml(tmp_path / 'camera_info.yaml', lens, 'camera', 'kannala_brandt')
    assert 'distortion_model: kannala_brandt' in (tmp_path / 'camera_info.yaml').read_text()
    assert read_camera_info(tmp_path / 'camera_info.yaml') == lens


def test_camera_info_has_the_lengths_of_the_message() -> None:
    info = camera_info(CAMERA)
    assert [len(info.k), len(info.d), len(info.r), len(info.p)] == [9, 4, 9, 12]
    assert all(isinstance(value, float) for value in (*info.k, *info.d, *info.r, *info.p))


@pytest.mark.parametrize('focal', [300.0, 560.0, 2000.0])
def test_the_rectified_image_shows_no_empty_border(focal: float) -> None:
    camera = Camera(1280, 720, focal, (632.0, 364.0))
    border = np.array(
        [(x, y) for x in np.linspace(0, 1279, 30) for y in (0, 719)]
        + [(x, y) for x in (0, 1279) for y in np.linspace(0, 719, 30)]
    )
    rays = np.column_stack([border, np.ones(len(border))]) @ np.linalg.inv(rectified_matrix(camera)).T
    pixels, _ = camera.project(rays)
    assert (pixels >= -0.5).all() and (pixels <= (1279.5, 719.5)).all()


def test_the_yaml_is_that_of_camera_info_manager(tmp_path: Path) -> None:
    write_camera_info_yaml(tmp_path / 'c.yaml', CAMERA, 'cam/1 é')
    document = yaml.safe_load((tmp_path / 'c.yaml').read_text())
    assert list(document) == [
        'image_width',
        'image_height',
        'camera_name',
        'camera_matrix',
        'distortion_model',
        'distortion_coefficients',
        'rectification_matrix',
        'projection_matrix',
    ]
    assert document['camera_name'] == 'cam_1__'
    assert document['camera_matrix'] == {'rows': 3, 'cols': 3, 'data': camera_info(CAMERA).k}
    assert document['distortion_coefficients']['data'] == camera_info(CAMERA).d


def test_a_file_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError, match='cannot write'):
        write_camera_info_yaml(tmp_path / 'file' / 'c.yaml', CAMERA, 'camera')


def document(**changes: Any) -> dict[str, Any]:
    """Return the content of a file of camera_info_manager."""
    content = {
        'image_width': WIDTH,
        'image_height': HEIGHT,
        'camera_name': 'north',
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': SQUARE},
        'distortion_model': 'plumb_bob',
        'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': [-0.3, 0.1, 0.0, 0.0, 0.0]},
    }
    return {name: value for name, value in {**content, **changes}.items() if value is not None}


def written(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / 'lens.yaml'
    path.write_bytes(content if isinstance(content, bytes) else yaml.safe_dump(content).encode())
    return path


def lens(tmp_path: Path, model: str, matrix: list[float], coefficients: list[float]) -> Camera:
    return read_camera_info(
        written(
            tmp_path,
            document(
                distortion_model=model, camera_matrix={'data': matrix}, distortion_coefficients={'data': coefficients}
            ),
        )
    )


def seen(model: str, matrix: list[float], coefficients: list[float], field_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return random bearings and their OpenCV pixels; the model stops being monotonic at `field_deg`."""
    generator = np.random.default_rng(0)
    theta, around = np.radians(field_deg) * np.sqrt(generator.random(20000)), 2 * np.pi * generator.random(20000)
    bearings = np.stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], axis=1)
    still, square = np.zeros(3), np.array(matrix).reshape(3, 3)
    if model == 'equidistant':
        filled = np.array([*coefficients, 0.0, 0.0, 0.0, 0.0][:4])
        pixels, _ = cv2.fisheye.projectPoints(bearings[:, None], still, still, square, filled)
    else:
        pixels, _ = cv2.projectPoints(bearings, still, still, square, np.array(coefficients))
    pixels = pixels[:, 0]
    inside = (pixels >= 0).all(axis=1) & (pixels <= [WIDTH - 1, HEIGHT - 1]).all(axis=1)
    assert np.ptp(pixels[inside], axis=0) == pytest.approx([WIDTH, HEIGHT], abs=20)  # the whole image is compared
    return bearings[inside], pixels[inside]


def worst_px(camera: Camera, bearings: np.ndarray, pixels: np.ndarray) -> float:
    found, valid = camera.project(bearings)
    assert valid.all()
    return float(np.hypot(*(found - pixels).T).max())


@pytest.mark.parametrize('coefficients', [[0.01, -0.004, 0.002, -0.0005], [0.02, -0.01], [0.03], []])
@pytest.mark.parametrize('name', ['equidistant', 'fisheye'])
def test_an_equidistant_lens_is_read_as_it_stands(tmp_path, name, coefficients):
    camera = lens(tmp_path, name, WIDE, coefficients)
    assert (camera.width, camera.height, camera.focal_px, camera.principal_point_px) == (
        WIDTH,
        HEIGHT,
        500.0,
        (645.0, 352.0),
    )
    assert worst_px(camera, *seen('equidistant', WIDE, coefficients, 85.0)) < READ_PX


@pytest.mark.parametrize(
    ('model', 'matrix', 'coefficients', 'field_deg'),
    [
        ('plumb_bob', SQUARE, [-0.3, 0.1, 0.0, 0.0, 0.0], 50.0),
        ('plumb_bob', SQUARE, [-0.3, 0.1, 0.0, 0.0], 50.0),
        ('plumb_bob', SQUARE, [0.15, 0.05, 0.0, 0.0, 0.01], 50.0),
        ('plumb_bob', SQUARE, [-0.28, 0.1, 0.0001, -0.0001, -0.02], 48.0),
        ('plumb_bob', SQUARE, [0.0] * 5, 50.0),
        ('plumb_bob', WIDE, [0.0] * 5, 65.0),
        ('plumb_bob', [5000.0, *SQUARE[1:4], 5000.0, *SQUARE[5:]], [0.0] * 5, 12.0),
        ('plumb_bob', [*SQUARE[:4], 900.8, *SQUARE[5:]], [-0.1, 0.01, 0.0, 0.0, 0.0], 50.0),
        ('rational_polynomial', WIDE, [1.2, 0.3, 0.0, 0.0, 0.01, 1.5, 0.5, 0.03], 75.0),
        ('rational_polynomial', SQUARE, [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 50.0),
        ('equidistant', [*WIDE[:4], 500.3, *WIDE[5:]], [0.01, -0.004, 0.002, -0.0005], 85.0),
    ],
)
def test_another_lens_is_converted_within_half_a_pixel(tmp_path, model, matrix, coefficients, field_deg):
    camera = lens(tmp_path, model, matrix, coefficients)
    assert worst_px(camera, *seen(model, matrix, coefficients, field_deg)) < ALLOWED_PX


def test_a_lens_without_distortion_has_the_series_of_the_tangent(tmp_path):
    # at 40 degrees from corner to corner the fit stays this close to the series of tan
    narrow = [2000.0, *SQUARE[1:4], 2000.0, *SQUARE[5:]]
    camera = lens(tmp_path, 'plumb_bob', narrow, [0.0] * 5)
    assert camera.k[:2] == pytest.approx((1 / 3, 2 / 15), abs=1e-3)
    assert camera.focal_px == pytest.approx(2000.0, rel=1e-6)


def test_a_radial_lens_keeps_its_principal_point(tmp_path):
    camera = lens(tmp_path, 'plumb_bob', SQUARE, [-0.3, 0.1, 0.0, 0.0, 0.0])
    assert camera.principal_point_px == pytest.approx((632.0, 365.0), abs=0.01)


def test_a_slight_skew_is_shared_out(tmp_path):
    skew = 0.4
    camera = lens(tmp_path, 'plumb_bob', [900.0, skew, *SQUARE[2:]], [0.0] * 5)
    bearings, pixels = seen('plumb_bob', SQUARE, [0.0] * 5, 50.0)
    pixels[:, 0] += skew * bearings[:, 1] / bearings[:, 2]
    assert worst_px(camera, bearings, pixels) < ALLOWED_PX


@pytest.mark.parametrize(
    'camera',
    [
        CAMERA,
        Camera(640, 480, 333.3333333333333, (320.1, 239.9), (0.1, -0.02, 3e-05, -1e-07)),
        Camera(1920, 1080, 700.0, (900.0, 600.0), (1 / 3, 2 / 15, 17 / 315, 62 / 2835)),
    ],
)
def test_what_is_written_is_read_to_the_last_bit(tmp_path, camera):
    write_camera_info_yaml(tmp_path / 'c.yaml', camera, 'north')
    assert read_camera_info(tmp_path / 'c.yaml') == camera


def test_what_ros2_topic_echo_prints_is_read(tmp_path):
    text = (
        b'header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: cam\nheight: 720\nwidth: 1280\n'
        b'distortion_model: equidistant\nd:\n- 0.01\n- 0.0\n- 0.0\n- 1.0e-05\nk:\n- 500.0\n- 0.0\n- 645.0\n'
        b'- 0.0\n- 500.0\n- 352.0\n- 0.0\n- 0.0\n- 1.0\nr: []\np: []\nbinning_x: 0\nbinning_y: 0\n'
        b'roi:\n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n  do_rectify: false\n---\n'
    )
    assert read_camera_info(written(tmp_path, text)) == Camera(1280, 720, 500.0, (645.0, 352.0), (0.01, 0.0, 0.0, 1e-5))


def test_what_ros1_prints_is_read(tmp_path):
    text = (
        b'height: 720\nwidth: 1280\ndistortion_model: "equidistant"\nD: [0.01, 0.0, 0.0, 1e-05]\n'
        b'K: [500.0, 0.0, 645.0, 0.0, 500.0, 352.0, 0.0, 0.0, 1.0]\n---\n'
    )
    assert read_camera_info(written(tmp_path, text)) == Camera(1280, 720, 500.0, (645.0, 352.0), (0.01, 0.0, 0.0, 1e-5))


def test_a_path_in_the_home_folder_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    write_camera_info_yaml(tmp_path / 'c.yaml', CAMERA, 'north')
    assert read_camera_info(Path('~/c.yaml')) == CAMERA


def complaint(path: Path) -> str:
    with pytest.raises(InputError) as raised:
        read_camera_info(path)
    text = str(raised.value)
    assert str(path) in text and '\n' not in text and len(text) < 600, text
    return text


NAN, INF = float('nan'), float('inf')
ODD = 'give the file of camera_info_manager'


@pytest.mark.parametrize(
    ('changes', 'expected', 'remedy'),
    [
        (
            {'camera_matrix': {'data': [0.0] * 9}},
            'not calibrated, the focal length is 0',
            'calibrate the camera, or leave',
        ),
        ({'camera_matrix': {'data': [1.0] * 8}}, "'camera_matrix' has 8 numbers, expected 9", ODD),
        ({'camera_matrix': {'data': [NAN, *SQUARE[1:]]}}, "'camera_matrix' contains nan, not a finite number", ODD),
        (
            {'camera_matrix': {'data': ['wide', *SQUARE[1:]]}},
            "'camera_matrix' contains 'wide', not a finite number",
            ODD,
        ),
        ({'camera_matrix': {'data': [-900.0, *SQUARE[1:]]}}, 'not of the form fx s cx', ODD),
        ({'camera_matrix': {'data': [*SQUARE[:8], 2.0]}}, 'not of the form fx s cx', ODD),
        ({'camera_matrix': {'rows': 3}}, "'camera_matrix' is not a list of numbers", ODD),
        ({'camera_matrix': 'none'}, "'camera_matrix' is not a list of numbers", ODD),
        ({'camera_matrix': None}, "has no 'camera_matrix' (nor 'k')", ODD),
        ({'image_width': None}, "has no 'image_width' (nor 'width')", ODD),
        ({'image_width': 0}, "'image_width' is 0, not a number of pixels", ODD),
        ({'image_height': 719.5}, "'image_height' is 719.5, not a number of pixels", ODD),
        ({'image_height': True}, "'image_height' contains True, not a finite number", ODD),
        ({'distortion_model': None}, "has no 'distortion_model'", ODD),
        (
            {'distortion_model': 'thin_prism'},
            "distortion model is 'thin_prism', supported are plumb_bob",
            'recalibrate the',
        ),
        ({'distortion_model': ''}, "distortion model is ''", 'or leave the file out'),
        ({'distortion_model': 'rational_polynomial'}, 'has 5 numbers, expected 8', ODD),
        ({'distortion_model': 'equidistant'}, 'has 5 numbers, expected at most 4', ODD),
        ({'distortion_coefficients': {'data': [0.0] * 3}}, 'has 3 numbers, expected 4 or 5', ODD),
        ({'distortion_coefficients': {'data': [0.0, INF, 0.0, 0.0]}}, 'contains inf, not a finite number', ODD),
        ({'distortion_coefficients': None}, "has no 'distortion_coefficients' (nor 'd')", ODD),
        (
            {'distortion_coefficients': {'data': [-0.5, 0.0, 0.0, 0.0]}},
            'not invertible for 33 % of the image',
            'near the borders',
        ),
        (
            {'distortion_model': 'equidistant', 'distortion_coefficients': {'data': [-9.0]}},
            'its distortion is not invertible',
            'recalibrate the camera',
        ),
        (
            {'distortion_model': 'equidistant', 'distortion_coefficients': {'data': [1e9]}},
            'degrees from corner to corner',
            'recalibrate the camera',
        ),
        (
            {'distortion_coefficients': {'data': [-0.3, 0.1, 0.002, 0.0]}},
            'tangential distortion',
            '--zero-tangent-dist',
        ),
        (
            {'camera_matrix': {'data': [250.0, *WIDE[1:4], 250.0, *WIDE[5:]]}, 'distortion_coefficients': [0.0] * 5},
            'its field of view is too wide',
            'with a fisheye model',
        ),
        ({'roi': {'x_offset': 10, 'width': 640, 'height': 360}}, 'region of interest', 'without roi'),
    ],
)
def test_an_unusable_file_is_reported_with_a_remedy(tmp_path, changes, expected, remedy):
    text = complaint(written(tmp_path, document(**changes)))
    assert expected in text
    assert remedy in text


def test_the_error_of_a_conversion_is_reported_in_pixels(tmp_path):
    # p1 = 0.005 moves a corner at (x, y) = (0.72, 0.41) by 900 p1 (2 x y, r^2 + 2 y^2) px, of which a shift of the
    # principal point and the radial terms take up a part
    text = complaint(written(tmp_path, document(distortion_coefficients=[0.0, 0.0, 0.005, 0.0, 0.0])))
    error_px = float(text.split('differs from this one by up to ')[1].split(' px')[0])
    assert 0.5 < error_px < 0.005 * 900 * np.hypot(2 * 0.72 * 0.41, 0.83**2 + 2 * 0.41**2)
    assert 'more than the 0.5 px that the pose allows' in text


CALIBRATOR_FISHEYE = {
    'camera_matrix': {'data': [500.0, 1.5, 640.0, 0.0, 502.5, 365.0, 0.0, 0.0, 1.0]},
    'distortion_model': 'equidistant',
    'distortion_coefficients': {'data': [0.01, -0.004, 0.002, -0.0005]},
}
"""As the fisheye calibrator of camera_calibration writes it: fx != fy by 0.5 %, and skew."""


@pytest.mark.parametrize(
    'matrix',
    [CALIBRATOR_FISHEYE['camera_matrix']['data'], [450.0, 0.0, 640.0, 0.0, 640.0, 365.0, 0.0, 0.0, 1.0]],
    ids=['calibrator', 'squeezed'],
)
def test_a_fisheye_file_is_read_and_published_as_it_is(tmp_path, matrix):
    given = document(**{**CALIBRATOR_FISHEYE, 'camera_matrix': {'data': matrix}})
    lens = read_camera_info(written(tmp_path, given))
    published = camera_info(lens)
    assert published.k == pytest.approx(matrix, rel=1e-15)
    assert published.d == given['distortion_coefficients']['data']
    exact, _ = read_exact_lens(written(tmp_path, given))
    pixels = exact.grid()
    there, reached = CameraInfoLens(exact).unproject(pixels)
    np.testing.assert_allclose(lens.unproject(pixels)[0][reached], there[reached], atol=1e-9)


def test_a_pinhole_file_with_two_focal_lengths_is_converted_with_its_pixels(tmp_path):
    given = document(camera_matrix={'data': [*SQUARE[:4], 910.0, *SQUARE[5:]]}, distortion_coefficients=[0.0] * 5)
    lens = read_camera_info(written(tmp_path, given))
    assert lens.pixel_aspect == pytest.approx(910 / 900)
    pixels, _ = lens.project(np.array([[0.3, -0.2, 1.0]]))
    assert np.hypot(*(pixels[0] - (SQUARE[2] + 270.0, SQUARE[5] - 182.0))) < 0.5  # the error that a conversion may have


BOMB = b'a: &a [x, x, x, x, x, x, x, x, x]\n' + b''.join(
    b'%c: &%c [%s]\n' % (code, code, b', '.join([b'*%c' % (code - 1)] * 9)) for code in range(ord('b'), ord('j'))
)


@pytest.mark.parametrize(
    'content',
    [
        b'',
        b'words only',
        b'[1, 2]',
        b'{',
        b'\x00\x01',
        b'\xff\xfe\x00',
        b'[' * 20000,
        b'&a [*a]',
        b'{[1]: 2}',
        b'&a {image_width: *a}',
        BOMB + b'image_width: *i',
        b'!!python/object/apply:os.system [ls]',
        b'image_width: !!int ""',
        b'image_width: ' + b'9' * 5000,
        b'image_width: ' + b'9' * 400,
        b'image_width: 2020-13-45',
        b'!!timestamp x',
        b'!!bool x',
        b'<<: 3',
        b'a' * 2_000_000,
    ],
    ids=range(20),
)
def test_hostile_yaml_is_one_clear_line(tmp_path, content):
    assert 'give the file of camera_info_manager' in complaint(written(tmp_path, content))


@pytest.mark.parametrize(('name', 'expected'), [('none.yaml', 'No such file'), ('', 'Is a directory')])
def test_a_file_that_does_not_exist_is_reported(tmp_path, name, expected):
    assert expected in complaint(tmp_path / name)
