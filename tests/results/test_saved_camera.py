"""Every kind of saved file becomes one value."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import rectified_matrix
from autocalib_ros.lens.camera_info_yaml import write_camera_info_yaml
from autocalib_ros.results.calibration import COVARIANCE_PARAMETERS
from autocalib_ros.results.calibration_json import calibration_json, write_calibration_json
from autocalib_ros.results.saved_camera import SavedCamera, read_saved_camera
from autocalib_ros.results.store import stored_json
from stored_results import calibration, stored

WHOLE = calibration()
PIXELS = np.stack(np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 359, 7)), axis=-1)
CHECKERBOARD = {
    'image_width': 640,
    'image_height': 480,
    'camera_name': 'x',
    'distortion_model': 'plumb_bob',
    'camera_matrix': {'rows': 3, 'cols': 3, 'data': [400.0, 0, 322.0, 0, 404.0, 238.0, 0, 0, 1]},
    'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': [-0.2, 0.04, 0.003, -0.002, 0.0]},
    'rectification_matrix': {'rows': 3, 'cols': 3, 'data': [1.0, 0, 0, 0, 1, 0, 0, 0, 1]},
    'projection_matrix': {'rows': 3, 'cols': 4, 'data': [350.0, 0, 320, 0, 0, 350, 240, 0, 0, 0, 1, 0]},
}


@pytest.fixture(params=['calibration.json', 'north.autocalib.json', 'camera_info.yaml'])
def ours(request, tmp_path):
    """Return a file that this program writes."""
    path = tmp_path / request.param
    if request.param == 'calibration.json':
        write_calibration_json(path, WHOLE)
    elif request.param == 'camera_info.yaml':
        write_camera_info_yaml(path, WHOLE.camera, 'north')
    else:
        path.write_text(stored_json(stored(WHOLE)))
    return path


def test_our_own_files_give_the_same_lens(ours):
    known = read_saved_camera(ours)
    bearings, valid = known.unproject(PIXELS)
    expected, _ = WHOLE.camera.unproject(PIXELS)
    assert valid.all()
    assert bearings == pytest.approx(expected, abs=1e-9)
    assert known.project(bearings)[0] == pytest.approx(PIXELS, abs=1e-6)
    assert (known.focal_px, known.principal_point_px) == (
        pytest.approx(300.0),
        pytest.approx(WHOLE.camera.principal_point_px),
    )
    assert known.k == pytest.approx(WHOLE.camera.k, abs=1e-12)
    assert known.rectified == pytest.approx(rectified_matrix(WHOLE.camera))
    has_pose = ours.suffix == '.json'
    assert (known.ground is not None, known.stddev.focal_px is not None, known.covariance is not None) == (
        has_pose,
    ) * 3


def test_a_checkerboards_file_keeps_what_a_kannala_brandt_lens_has_not(tmp_path):
    (tmp_path / 'c.yaml').write_text(yaml.safe_dump(CHECKERBOARD))
    known = read_saved_camera(tmp_path / 'c.yaml')
    assert known.focal_px == pytest.approx(404)
    assert known.k is None  # tangential distortion
    slopes = np.array([0.3, -0.2])
    r2 = slopes @ slopes
    radial = 1 - 0.2 * r2 + 0.04 * r2**2
    tangential = [
        2 * 0.003 * slopes[0] * slopes[1] - 0.002 * (r2 + 2 * slopes[0] ** 2),
        0.003 * (r2 + 2 * slopes[1] ** 2) - 2 * 0.002 * slopes[0] * slopes[1],
    ]
    pixel, _ = known.project(np.array([*slopes, 1.0]))
    assert pixel == pytest.approx((slopes * radial + tangential) * [400, 404] + [322, 238])


def test_scaled_the_same_place_of_the_image_has_the_same_ray(ours):
    known = read_saved_camera(ours)
    half = known.scaled_to(320, 180)
    assert half.unproject((PIXELS + 0.5) / 2 - 0.5)[0] == pytest.approx(known.unproject(PIXELS)[0], abs=1e-9)
    whole = np.array([0.1, 0.05, 1.0])
    pixel, small = ((matrix @ whole)[:2] / (matrix @ whole)[2] for matrix in (known.rectified, half.rectified))
    assert small == pytest.approx((pixel + 0.5) / 2 - 0.5)
    if known.covariance is not None:
        assert half.stddev.focal_px == pytest.approx(known.stddev.focal_px / 2)
        assert np.diag(half.covariance)[[0, 3, 9]] == pytest.approx(np.diag(known.covariance)[[0, 3, 9]] / [4, 1, 1])
        assert len(half.covariance) == len(COVARIANCE_PARAMETERS)


def test_images_of_another_shape_are_wrong_usage(ours):
    with pytest.raises(UsageError, match='640x360, and these images have 640x480, another shape'):
        read_saved_camera(ours).scaled_to(640, 480)


@pytest.mark.parametrize(
    ('name', 'text', 'expected'),
    [
        ('cut.json', calibration_json(WHOLE)[:900], 'it is not JSON'),
        ('other.json', '{"a": 1}', 'its version is None'),
        (
            'refused.json',
            json.dumps(
                {
                    'version': 1,
                    'state': 'refused',
                    'refusal': {'code': 'no_motion', 'message': 'nothing moved', 'remedy': ''},
                }
            ),
            'no_motion: nothing moved',
        ),
        ('words.yaml', 'only words', 'holds no names with values'),
        ('empty.yaml', '', 'holds no names with values'),
        (
            'ost.txt',
            '[image]\n\nwidth\n640\n\n[c]\n\ncamera matrix\n1 0 0\n',
            'it is of the INI format .ost.txt.: give',
        ),
        ('cut.yaml', yaml.safe_dump(CHECKERBOARD, sort_keys=False)[:200], 'it is not YAML'),
    ],
)
def test_a_wrong_file_is_reported_by_name(name, text, expected, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=expected) as error:
        read_saved_camera(tmp_path / name)
    assert name in str(error.value)


def test_a_file_that_does_not_exist_is_reported(tmp_path):
    for name in ('a.json', 'a.yaml'):
        with pytest.raises(InputError, match=f'cannot read .*{name}'):
            read_saved_camera(tmp_path / name)


def test_a_projection_that_images_nothing_is_left_out(tmp_path):
    broken = {**CHECKERBOARD, 'projection_matrix': {'rows': 3, 'cols': 4, 'data': [0.0] * 12}}
    (tmp_path / 'c.yaml').write_text(yaml.safe_dump(broken))
    assert read_saved_camera(tmp_path / 'c.yaml').rectified is None


def test_a_rectification_turns_the_camera(tmp_path):
    turn = Rotation.from_euler('y', 5, degrees=True).as_matrix()
    turned = {**CHECKERBOARD, 'rectification_matrix': {'rows': 3, 'cols': 3, 'data': turn.ravel().tolist()}}
    (tmp_path / 'left.yaml').write_text(yaml.safe_dump(turned))
    middle = read_saved_camera(tmp_path / 'left.yaml').rectified @ turn.T @ [0, 0, 1]
    assert middle[:2] / middle[2] == pytest.approx([320, 240])


def test_of_a_calibration_is_what_it_holds():
    lens = replace(WHOLE, camera=Camera.equidistant(640, 360, 280.0))
    assert SavedCamera.of(lens).focal_px == pytest.approx(280.0)
