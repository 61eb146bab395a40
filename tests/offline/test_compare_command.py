"""`autocalib compare`: messages, exit statuses and JSON output."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from autocalib_ros.cli import main
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.lens.camera_info_yaml import write_camera_info_yaml
from autocalib_ros.pictures.views import ground_to_image
from autocalib_ros.results.calibration_json import calibration_json, write_calibration_json
from stored_results import calibration

OURS = calibration()
STATED = np.diag([1.0, 2.1, 1.9, 0.004, 0.001, 0, 0, 0.2, 0.21, 0.05]) ** 2


@pytest.fixture
def files(tmp_path):
    """Return a function that writes a calibration under a name and returns its path."""

    def write(name: str, result=OURS):
        path = tmp_path / name
        write_calibration_json(path, replace(result, covariance=STATED))
        return str(path)

    return write


@pytest.fixture
def compare(capsys):
    """Return a function that runs the command: status, stdout, stderr."""

    def run(*arguments: object):
        status = main(['compare', *map(str, arguments)])
        return status, *capsys.readouterr()

    return run


def test_equal_calibrations_agree(files, compare):
    status, stdout, stderr = compare(files('a.json'), files('b.json'))
    assert (status, stderr) == (0, '')
    assert stdout.startswith('The calibrations agree within 3 combined sigmas')
    assert 'road 10 m ahead' in stdout


def test_a_camera_that_was_turned_is_status_3_and_named(files, compare):
    turned = calibration(tilt_deg=13.8)
    status, stdout, _ = compare(files('a.json'), files('b.json', turned))
    assert status == 3
    assert stdout.startswith('The calibrations differ in tilt (5.3 sigmas)')


def test_json_is_a_document_with_the_verdict(files, compare):
    status, stdout, stderr = compare(files('a.json'), files('b.json', calibration(303.0)), '--json')
    found = json.loads(stdout)
    assert (status, found['agrees'], stderr) == (0, True, '')
    assert found['focal_percent'] == pytest.approx(1.0)
    assert found['lens'][0]['sigmas'] == pytest.approx(3 / np.sqrt(2))
    assert found['road'][0]['distance_m'] == 10.0
    assert found['rays']['largest_deg'] >= found['rays_turned']['largest_deg'] > 0


def test_a_camera_info_of_a_topic_and_of_a_file_are_read(files, compare, tmp_path):
    write_camera_info_yaml(tmp_path / 'lens.yaml', OURS.camera, 'north')
    assert compare(files('a.json'), tmp_path / 'lens.yaml')[0] == 0
    info = camera_info(OURS.camera)
    echoed = {
        'header': {'frame_id': 'x'},
        'height': info.height,
        'width': info.width,
        'distortion_model': info.distortion_model,
        'd': info.d,
        'k': info.k,
        'r': info.r,
        'p': info.p,
        'binning_x': 0,
        'binning_y': 0,
        'roi': {'x_offset': 0, 'y_offset': 0, 'height': 0, 'width': 0},
    }
    (tmp_path / 'echo.yaml').write_text(yaml.safe_dump(echoed) + '---\n')
    status, stdout, _ = compare(tmp_path / 'echo.yaml', files('a.json'))
    assert status == 0
    assert 'A states no standard deviations and is taken as exact' in stdout


@pytest.fixture
def truth(tmp_path):
    """Return a truth.json equal to OURS but with a 1 % longer focal length and 0.3 m more height."""
    camera = replace(OURS.camera, focal_px=303.0)
    ground = GroundPlane(OURS.ground.rotation, 8.4)
    x, y = np.meshgrid(np.linspace(8, 30, 6), np.linspace(-6, 6, 6))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(36)], axis=1)
    rows = np.concatenate([points[:, :2], ground_to_image(camera, ground, points)], axis=1)
    path = tmp_path / 'truth.json'
    path.write_text(
        json.dumps(
            {
                'width': camera.width,
                'height': camera.height,
                'lens': {
                    'model': 'kannala_brandt',
                    'f': 303.0,
                    'k': list(camera.k),
                    'cx': camera.principal_point_px[0],
                    'cy': camera.principal_point_px[1],
                },
                'camera': {'R_world_from_camera': ground.rotation.tolist(), 'height': 8.4, 'position': [0, 0, 8.4]},
                'ground_points': {'rows': rows.tolist()},
            }
        )
    )
    return path


def test_both_are_compared_with_the_truth(files, compare, truth):
    better = replace(calibration(303.0), ground=GroundPlane(OURS.ground.rotation, 8.4))
    status, stdout, _ = compare(files('a.json'), files('b.json', better), '--truth', truth, '--json')
    first, second = json.loads(stdout)['against_truth']
    assert first['focal length, %'] == pytest.approx(100 * (300 / 303 - 1))
    assert first['height, m'] == pytest.approx(-0.3)
    assert second['focal length, %'] == pytest.approx(0, abs=1e-9)
    assert second['rays, largest, deg'] == pytest.approx(0, abs=1e-6)
    assert second['distances within 40 m, median, %'] == pytest.approx(0, abs=1e-6)
    assert status == 3  # 0.3 m of height are more than three times 0.07
    assert 'against the truth' in compare(files('a.json'), files('b.json'), '--truth', truth)[1]


@pytest.mark.parametrize(
    ('name', 'text', 'message'),
    [
        ('cut.json', calibration_json(OURS)[:500], 'it is not JSON'),
        ('nowhere.json', None, 'cannot read'),
        ('list.yaml', '[1, 2]', 'holds no names with values'),
    ],
)
def test_a_wrong_file_is_one_line_and_status_2(name, text, message, files, compare, tmp_path):
    if text is not None:
        (tmp_path / name).write_text(text)
    status, stdout, stderr = compare(files('a.json'), tmp_path / name)
    assert (status, stdout, stderr.count('\n')) == (2, '', 1)
    assert stderr.startswith('autocalib: error: ') and message in stderr and name in stderr


def test_images_of_another_shape_are_wrong_input(files, compare, tmp_path):
    write_camera_info_yaml(tmp_path / 'square.yaml', replace(OURS.camera, height=500), 'north')
    status, _, stderr = compare(files('a.json'), tmp_path / 'square.yaml')
    assert status == 2 and 'another shape' in stderr


def test_a_truth_of_something_else_is_wrong_input(files, compare, tmp_path):
    (tmp_path / 'truth.json').write_text('{"lens": {"model": "pinhole"}, "camera": {}}')
    status, _, stderr = compare(files('a.json'), files('b.json'), '--truth', tmp_path / 'truth.json')
    assert status == 2 and "unsupported lens model 'pinhole' in the truth" in stderr
