"""`autocalib rectify`, `topview` and `picture`: known geometry in, pictures out."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from autocalib_ros.cli import main
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import rectified_matrix
from autocalib_ros.lens.camera_info_yaml import write_camera_info_yaml
from autocalib_ros.offline import view_files
from autocalib_ros.pictures.views import EMPTY_GREY, ground_to_image, image_to_ground
from autocalib_ros.results.calibration_json import write_calibration_json
from stored_results import LOOKS_ALONG, calibration, lens_only

pytestmark = pytest.mark.render

DIP = np.radians(28.0)
DOWN = np.array([[1.0, 0, 0], [0, np.cos(DIP), np.sin(DIP)], [0, -np.sin(DIP), np.cos(DIP)]])
LENS = Camera(640, 360, 300.0, (322.0, 178.0), (0.01, 0.0, 0.0, 0.0))
POSE = GroundPlane(LOOKS_ALONG @ DOWN, 8.0)
"""Camera that looks along the ground x axis, 28 degrees down."""
SQUARE_M = 2.0


def chequered(camera: Camera) -> np.ndarray:
    """Return the image of a chequered road with grey levels 40 and 220, and a sky of 130."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(float)
    points = image_to_ground(camera, POSE, pixels)
    odd = np.nan_to_num(np.floor(points / SQUARE_M).sum(axis=-1)) % 2 == 1
    grey = np.where(np.isnan(points[..., 0]), 130, np.where(odd, 220, 40)).astype(np.uint8)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)


@pytest.fixture
def saved(tmp_path) -> Path:
    """Return a folder with calibration.json, image.png and half.png, the image at half size."""
    write_calibration_json(tmp_path / 'calibration.json', replace(calibration(), camera=LENS, ground=POSE))
    cv2.imwrite(str(tmp_path / 'image.png'), chequered(LENS))
    cv2.imwrite(str(tmp_path / 'half.png'), chequered(LENS.scaled_to(320, 180)))
    return tmp_path


@pytest.fixture
def video(saved) -> Path:
    """Return a video of 20 images at 10 Hz with increasing brightness."""
    path = saved / 'clip.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 10.0, (640, 360))
    for index in range(20):
        writer.write(np.full((360, 640, 3), 10 + 10 * index, np.uint8))
    writer.release()
    return path


@pytest.fixture
def command(saved, capsys):
    """Return a function that runs a command in the folder: status, stdout, stderr."""

    def run(name: str, *arguments: object):
        status = main([name, str(saved / 'calibration.json'), *map(str, arguments)])
        return status, *capsys.readouterr()

    return run


def squares_are_square(picture: np.ndarray, low_m: tuple[float, float], px_per_m: float) -> bool:
    """Return whether the centres of the squares are at their true places in a top-down view."""
    rows, columns = picture.shape[:2]
    high_y = low_m[1] + rows / px_per_m
    for x in np.arange(low_m[0] + 1, low_m[0] + columns / px_per_m, SQUARE_M):
        for y in np.arange(low_m[1] + 1, high_y, SQUARE_M):
            shade = picture[int((high_y - y) * px_per_m), int((x - low_m[0]) * px_per_m)].mean()
            if (shade > 130) != (np.floor(np.array([x, y]) / SQUARE_M).sum() % 2 == 1):
                return False
    return True


@pytest.mark.parametrize('image', ['image.png', 'half.png'])
def test_the_road_from_above_is_to_scale_in_images_of_any_size(image, command, saved):
    status, stdout, _ = command(
        'topview', saved / image, saved / 'top.png', '--px-per-m', 20, '--x', 6, 16, '--y', -4, 4, '--no-scale-bar'
    )
    assert (status, stdout) == (0, f'Written to {saved / "top.png"}: 200x160\n')
    assert squares_are_square(cv2.imread(str(saved / 'top.png')), (6.0, -4.0), 20.0)


def test_a_view_from_above_has_a_scale_bar_by_default(command, saved):
    for name, more in (('plain', ['--no-scale-bar']), ('bar', []), ('grid', ['--grid'])):
        assert command('topview', saved / 'image.png', saved / f'{name}.png', *more)[0] == 0
    plain, bar, grid = (cv2.imread(str(saved / f'{name}.png')).astype(int) for name in ('plain', 'bar', 'grid'))
    assert max(plain.shape) == 1000
    assert (plain != EMPTY_GREY).mean() > 0.3
    changed = np.argwhere((bar != plain).any(axis=2))
    assert len(changed) and (changed > [plain.shape[0] * 0.7, -1]).all() and changed[:, 1].max() < 600
    assert (grid != bar).any(axis=2).mean() > 0.01


@pytest.mark.parametrize('form', ['calibration.json', 'equidistant.yaml', 'rational_polynomial.yaml'])
def test_undistorted_the_road_is_that_of_a_camera_without_distortion(form, saved):
    if form.endswith('.yaml'):
        write_camera_info_yaml(saved / form, LENS, 'north', form.removesuffix('.yaml'))
    assert main(['rectify', str(saved / form), str(saved / 'image.png'), str(saved / 'r.png'), '--quiet']) == 0
    picture = cv2.imread(str(saved / 'r.png'), cv2.IMREAD_GRAYSCALE)
    pixels = np.stack(np.meshgrid(np.arange(640), np.arange(360)), axis=-1)
    rays = np.concatenate([pixels, np.ones((360, 640, 1))], axis=2) @ np.linalg.inv(rectified_matrix(LENS)).T
    rays = rays @ POSE.rotation.T
    near = rays[..., 2] < -0.25 * np.linalg.norm(rays, axis=-1)  # farther squares are not much larger than a pixel
    points = rays[..., :2] * (-POSE.height_m / np.where(near, rays[..., 2], np.nan))[..., None]
    inside = near & (np.abs(points / SQUARE_M - np.round(points / SQUARE_M)) > 0.1).all(axis=-1)
    odd = np.floor(np.nan_to_num(points) / SQUARE_M).sum(axis=-1) % 2 == 1
    assert inside.mean() > 0.3
    assert ((picture > 130) == odd)[inside].mean() > 0.999


def test_more_balance_shows_more(command, saved):
    shares = []
    for balance in (0, 0.5, 1):
        assert command('rectify', saved / 'image.png', saved / 'r.png', '--balance', balance)[0] == 0
        shares.append((cv2.imread(str(saved / 'r.png')) == EMPTY_GREY).all(axis=2).mean())
    assert shares[0] < 0.001
    assert shares[0] < shares[1] < shares[2]


@pytest.mark.parametrize('name', ['out.mp4', 'out.avi'])
def test_a_video_becomes_a_video_of_even_size(name, command, saved, video):
    status, stdout, stderr = command('topview', video, saved / name, '--px-per-m', 10, '--x', 6, 16.1, '--y', -4, 4.1)
    assert (status, stdout) == (0, f'Written to {saved / name}: 100x80\n')
    assert 'topview: 20 of 20 images (100 %)' in stderr
    capture = cv2.VideoCapture(str(saved / name))
    assert (capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_WIDTH)) == (10.0, 100.0)
    count = 0
    while capture.grab():
        count += 1
    capture.release()
    assert count == 20
    assert not list(saved.glob('.*'))


def test_a_picture_of_a_video_shows_the_image_that_is_asked_for(command, saved, video):
    for at, grey in ((0.0, 10), (1.5, 160)):
        assert command('rectify', video, saved / 'r.png', '--at', at)[0] == 0
        assert cv2.imread(str(saved / 'r.png')).mean() == pytest.approx(grey, abs=3)  # JPEG


def test_a_part_of_a_video_is_written(command, saved, video):
    assert command('rectify', video, saved / 'r.avi', '--at', 0.5, '--duration', 1, '--quiet') == (0, '', '')
    capture = cv2.VideoCapture(str(saved / 'r.avi'))
    shades = []
    while True:
        there, image = capture.read()
        if not there:
            break
        shades.append(image.mean())
    capture.release()
    assert len(shades) == 10
    assert shades[0] == pytest.approx(60, abs=3)


def test_the_picture_shows_image_and_view_from_above_with_the_same_squares(command, saved):
    assert command('picture', saved / 'image.png', saved / 'p.png')[0] == 0
    picture = cv2.imread(str(saved / 'p.png')).astype(int)
    assert picture.shape == (700, 1600, 3)
    left = picture[:607, :1080]
    # squares of 5 m from 8 m up: crossings of the grid are teal
    crossings = np.array([[x, y, 0.0] for x in (15.0, 20.0, 25.0) for y in (-5.0, 0.0, 5.0)])
    pixels = (ground_to_image(LENS, POSE, crossings) + 0.5) * 1080 / 640 - 0.5
    blue, _, red = left[tuple(np.round(pixels[:, ::-1]).astype(int).T)].T
    assert (blue - red > 60).all()
    assert (picture[:607, 1100:, 0] - picture[:607, 1100:, 2] > 60).mean() > 0.002
    # the horizon, orange, is as far above the axis as the camera looks down
    horizon = np.argwhere(left[..., 2] - left[..., 0] > 120)
    middle = horizon[np.abs(horizon[:, 1] - 322 / 640 * 1080) < 3]
    assert np.median(middle[:, 0]) == pytest.approx((178 - LENS.radius(DIP)) / 640 * 1080, abs=2)


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['image.png', 'out.gif'], 'is neither a picture nor a video'),
        (['image.png', 'image.png'], 'is the source itself'),
        (['image.png', 'out.mp4'], 'is one image'),
        (['image.png', 'out.png', '--at', '3'], 'is one image'),
        (['image.png', '.'], 'is neither a picture'),
        (['clip.avi', 'out.png', '--duration', '3'], '--duration is for videos'),
        (['clip.avi', 'out.png', '--at', '99'], 'no image 99 s after the start'),
        (['clip.avi', 'out.png', '--at', '-1'], 'the start must be at least 0 seconds'),
        (['nowhere.mp4', 'out.png'], 'does not exist'),
        (['nowhere.png', 'out.png'], 'cannot read'),
        (['words.png', 'out.png'], 'is not a readable image'),
        (['words.mp4', 'out.png'], 'is not a readable video'),
        (['empty.png', 'out.png'], 'is not a readable image'),
        (['square.png', 'out.png'], 'these images have 300x300, another shape'),
        (['image.png', 'words.png/out.png'], 'cannot write'),
    ],
)
def test_what_does_not_fit_is_one_line_and_status_2(arguments, message, command, saved, video, monkeypatch):
    monkeypatch.chdir(saved)
    Path('words.png').write_text('only words\n' * 50)
    Path('words.mp4').write_text('only words\n' * 50)
    Path('empty.png').touch()
    cv2.imwrite('square.png', np.zeros((300, 300, 3), np.uint8))
    before = sorted(saved.iterdir())
    status, stdout, stderr = command('topview', *arguments)
    assert (status, stdout, stderr.count('\n')) == (2, '', 1)
    assert stderr.startswith('autocalib: error: ') and message in stderr
    assert sorted(saved.iterdir()) == before


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['topview', '--x', '5', '5'], '--x takes the lower and then the higher end'),
        (['topview', '--px-per-m', '0'], '--px-per-m is more than 0'),
        (['topview', '--px-per-m', '100000'], 'choose another --px-per-m'),
        (['rectify', '--balance', '2'], 'the balance lies between 0'),
    ],
)
def test_wrong_numbers_are_reported(arguments, message, command, saved):
    status, _, stderr = command(arguments[0], saved / 'image.png', saved / 'out.png', *arguments[1:])
    assert status == 2 and message in stderr


@pytest.mark.parametrize('name', ['topview', 'picture'])
def test_a_lens_without_a_plane_makes_no_view_from_above(name, command, saved):
    write_calibration_json(saved / 'calibration.json', lens_only(calibration()))
    status, _, stderr = command(name, saved / 'image.png', saved / 'out.png')
    assert status == 2 and 'holds no ground plane: calibrate with --camera-height' in stderr


def test_a_plane_without_metres_is_shown_in_heights_of_the_camera(command, saved, monkeypatch):
    unit = replace(calibration(), grade='unit_scale', camera=LENS, ground=GroundPlane(POSE.rotation, 1.0, False))
    write_calibration_json(saved / 'calibration.json', unit)
    told = []
    monkeypatch.setattr('autocalib_ros.pictures.drawing.draw_text', lambda picture, text, *_: told.append(text))
    assert command('topview', saved / 'image.png', saved / 'out.png')[0] == 0
    assert command('picture', saved / 'image.png', saved / 'out.png')[0] == 0
    assert told[0].endswith(' camera height')
    assert any(words.endswith('squares of 0.5 camera heights') for words in told)
    assert not any(words.endswith(' m') for words in told)


def test_a_lens_that_folds_back_inside_the_image_cannot_be_undistorted(saved, capsys):
    (saved / 'fold.yaml').write_text(
        yaml.safe_dump(
            {
                'width': 640,
                'height': 360,
                'distortion_model': 'plumb_bob',
                'k': [300.0, 0, 320, 0, 300, 180, 0, 0, 1],
                'd': [-0.9, 0.0, 0.0, 0.0, 0.0],
            }
        )
    )
    assert main(['rectify', str(saved / 'fold.yaml'), str(saved / 'image.png'), str(saved / 'out.png')]) == 2
    assert 'the distortion folds back before the border' in capsys.readouterr().err


@pytest.mark.parametrize('image', ['image.png', 'half.png'])
def test_ignored_regions_are_black_in_images_of_any_size(image, command, saved):
    corners = ground_to_image(LENS, POSE, np.array([[9.0, -2, 0], [9, 2, 0], [13, 2, 0], [13, -2, 0]]))
    polygon = ' '.join(f'{value:.1f}' for value in corners.ravel())
    (saved / 'p.yaml').write_text(f"/**: {{ros__parameters: {{ignore_regions: '{polygon}'}}}}")
    assert (
        command(
            'topview',
            saved / image,
            saved / 'top.png',
            '--px-per-m',
            20,
            '--x',
            6,
            16,
            '--y',
            -4,
            4,
            '--no-scale-bar',
            '--params-file',
            saved / 'p.yaml',
        )[0]
        == 0
    )
    black = cv2.imread(str(saved / 'top.png')).max(axis=2) < 20
    # y 4 to -4 from top to bottom, x 6 to 16 from left to right, at 20 pixels a metre
    assert black[46:114, 66:134].all()
    assert black.sum() < 86 * 86


def test_a_missing_codec_is_an_error_and_leaves_nothing(command, saved, video, monkeypatch):
    monkeypatch.setitem(view_files.VIDEO_CODECS, '.mp4', '????')
    status, _, stderr = command('rectify', video, saved / 'out.mp4', '--quiet')
    assert status == 2 and 'cannot encode' in stderr
    assert not (saved / 'out.mp4').exists() and not list(saved.glob('.*'))


def test_an_earlier_result_stays_until_the_new_one_is_whole(command, saved, video):
    (saved / 'out.png').write_text('before')
    assert command('rectify', saved / 'image.png', saved / 'out.png')[0] == 0
    assert cv2.imread(str(saved / 'out.png')) is not None
    (saved / 'out.avi').write_text('before')
    (saved / 'calibration.json').write_text('{')
    assert command('rectify', video, saved / 'out.avi')[0] == 2
    assert (saved / 'out.avi').read_text() == 'before'


def test_a_bag_is_a_source_too(tmp_path, write_bag, images):
    write_camera_info_yaml(tmp_path / 'lens.yaml', Camera.equidistant(32, 24, 20.0), 'north')
    bag = write_bag(tmp_path / 'bag', images(8))
    assert main(['rectify', str(tmp_path / 'lens.yaml'), str(bag), str(tmp_path / 'r.png'), '--quiet']) == 0
    assert cv2.imread(str(tmp_path / 'r.png')).shape == (24, 32, 3)


def test_help_of_the_new_commands_imports_nothing_heavy():
    for name in ('compare', 'rectify', 'topview', 'picture'):
        code = (
            f'import sys; from autocalib_ros.cli import main; main(["{name}", "--help"]);'
            'print(sorted({"cv2", "numpy", "matplotlib", "scipy"} & set(sys.modules)))'
        )
        done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
        assert done.stdout.endswith('[]\n')
