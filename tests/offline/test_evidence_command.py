"""`autocalib evidence`: solving saved evidence again, and known lenses."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from autocalib_ros.cli import main
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info_yaml import read_camera_info, write_camera_info_yaml
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence

pytestmark = pytest.mark.solve

JUNCTION = Junction(noise_px=0.2, turning_fraction=0.0, vehicles=40, points_per_vehicle=2)
"""Little evidence is solved quickly; the command is what is tested here."""
ONE_FAMILY = ('-p', 'joint.lens_prior=equidistant')
"""Of lenses: the others take as long again."""
SMALL_LENS = Camera(640, 360, 280.0, (319.5, 179.5))
"""The junction's lens, in images of half the size."""
REFUSE = ('-p', 'gate.min_tracks=100000')


@pytest.fixture(scope='module')
def saved(tmp_path_factory) -> Path:
    """Return the saved evidence of a junction."""
    path = tmp_path_factory.mktemp('evidence') / 'evidence.npz'
    synthetic_evidence(JUNCTION, np.random.default_rng(0)).save(path)
    return path


@pytest.fixture
def lens_file(tmp_path) -> Path:
    write_camera_info_yaml(tmp_path / 'lens.yaml', SMALL_LENS, 'north')
    return tmp_path / 'lens.yaml'


@pytest.fixture
def without_height(saved, capsys):
    """Return a function that runs the command: status, stdout and stderr."""

    def run(*arguments: object) -> tuple[int, str, str]:
        status = main(['evidence', str(saved), *ONE_FAMILY, *map(str, arguments)])
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def evidence(without_height):
    """Return the same function with the camera height given."""
    return lambda *arguments: without_height('--camera-height', '8', *arguments)


def document(stdout: str) -> dict:
    return json.loads(stdout)


def test_a_calibration_is_summed_up_and_written(evidence, tmp_path):
    status, stdout, stderr = evidence('--out', tmp_path / 'out')
    assert (status, stderr) == (0, '')
    assert stdout.startswith('Calibrated: focal length ')
    assert stdout.endswith(f'Written to {tmp_path / "out"}: camera_info.yaml, calibration.json, report.html\n')
    assert 'accepted after' not in stdout
    assert {path.name for path in (tmp_path / 'out').iterdir()} == {
        'camera_info.yaml',
        'calibration.json',
        'report.html',
        'figures',
    }
    figures = {path.stem for path in (tmp_path / 'out' / 'figures').iterdir()}
    assert {'all_tracks', 'kept_tracks', 'ground_grid', 'top_view', 'undistorted'} <= figures  # without a picture
    assert 'settling' not in figures  # saved evidence does not say what was known when
    assert 'evidence.npz' in (tmp_path / 'out' / 'report.html').read_text()
    written = document((tmp_path / 'out' / 'calibration.json').read_text())
    assert written['evidence']['accepted_at_s'] is None
    assert read_camera_info(tmp_path / 'out' / 'camera_info.yaml').focal_px == written['camera']['focal_px']


def test_json_is_the_file_and_nothing_is_written_unless_asked(evidence, tmp_path, monkeypatch):
    (tmp_path / 'here').mkdir()
    monkeypatch.chdir(tmp_path / 'here')
    status, stdout, _ = evidence('--json', '--method', 'paper')
    assert (status, document(stdout)['method']) == (0, 'paper')
    assert not list((tmp_path / 'here').iterdir())
    evidence('--quiet', '--method', 'paper', '--out', 'out')
    assert stdout == (tmp_path / 'here' / 'out' / 'calibration.json').read_text()


def test_runs_on_one_evidence_give_the_same_bytes(evidence):
    assert len({evidence('--json')[1] for _ in range(3)}) == 1


def test_a_refusal_is_status_3_with_the_reason_on_stderr(evidence, tmp_path):
    status, stdout, stderr = evidence(*REFUSE, '--out', tmp_path / 'out')
    assert status == 3
    assert stderr.startswith('Not calibrated: ') and stderr.count('\n') == 1
    assert 'Not calibrated' not in stdout and 'tracks of' in stdout
    assert not (tmp_path / 'out' / 'camera_info.yaml').exists()


def test_json_of_a_refusal_is_on_stdout_alone(evidence):
    status, stdout, stderr = evidence(*REFUSE, '--json')
    assert (status, document(stdout)['state']) == (3, 'refused')
    assert document(stdout)['refusal']['message'].rstrip('.') in stderr


def test_quiet_leaves_only_the_reason(evidence):
    status, stdout, stderr = evidence(*REFUSE, '--quiet')
    assert (status, stdout) == (3, '')
    assert stderr.startswith('Not calibrated: ') and stderr.count('\n') == 1


@pytest.mark.parametrize(
    ('more', 'message'),
    [
        ([], 'the size of the vehicles gives the scale, to 14 % at best'),
        (['--allow-unit-scale'], 'the ground plane is given in units of that height'),
    ],
)
def test_no_height_is_said(saved, capsys, more, message):
    assert main(['evidence', str(saved), *REFUSE, *more]) == 3
    assert f'No camera height given: {message}' in capsys.readouterr().err


def test_a_known_lens_is_kept_and_the_pose_is_found(evidence, lens_file):
    status, stdout, _ = evidence('--json', '--camera-info', lens_file)
    assert status == 0
    found = document(stdout)
    assert found['camera'] == {
        'model': 'kannala_brandt',
        'focal_px': 560.0,
        'principal_point_px': [639.5, 359.5],
        'k': [0.0, 0.0, 0.0, 0.0],
        'pixel_aspect': 1.0,
        'skew': 0.0,
    }
    x, y, z, w = found['ground_from_camera']['rotation_xyzw']
    up_in_camera = np.array([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)])
    # with the true lens the normal is as good as 0.2 px at the ends of tracks of hundreds of pixels
    assert np.degrees(np.arccos(up_in_camera @ JUNCTION.normal_in_camera)) < 0.5


def test_the_lens_of_the_live_node_is_used_and_the_command_line_wins(evidence, lens_file, tmp_path):
    params = tmp_path / 'params.yaml'
    params.write_text(yaml.safe_dump({'/**': {'ros__parameters': {'camera_info_file': str(lens_file)}}}))
    _, stdout, _ = evidence('--json', '--params-file', params)
    assert document(stdout)['camera']['focal_px'] == 560.0
    write_camera_info_yaml(tmp_path / 'other.yaml', replace(SMALL_LENS, focal_px=282.0), 'north')
    _, stdout, _ = evidence('--json', '--params-file', params, '--camera-info', tmp_path / 'other.yaml')
    assert document(stdout)['camera']['focal_px'] == 564.0


def test_a_distance_on_the_road_gives_the_height(without_height):
    ends_m = np.array([[10.0, -8.0, -JUNCTION.height_m], [18.0, -2.0, -JUNCTION.height_m]])
    pixels, _ = JUNCTION.camera.project(ends_m @ JUNCTION.camera_from_ground.T)
    status, stdout, stderr = without_height('--json', '--scale-distance', *np.round(pixels, 2).ravel(), 10.0)
    found = document(stdout)
    assert (status, stderr, found['grade']) == (0, '', 'full')
    sigma = found['stddev']['height_m']
    assert 0 < sigma < 0.02 * JUNCTION.height_m
    assert found['ground_from_camera']['translation_m'][2] == pytest.approx(JUNCTION.height_m, abs=3 * sigma)
    assert (
        found['assumptions'][-1]['kind'] == 'scale_distance'
        and found['assumptions'][-1]['values']['distance_m'] == 10.0
    )
    assert found['stddev']['ground_point_m']['20'] > 20 * 0.005  # the share of the tape


def test_the_speed_of_the_traffic_gives_the_height(without_height):
    status, stdout, _ = without_height('--json', '--scale-speed', '34.2', '-p', 'scale.speed_sigma_km_h=2.0')
    found = document(stdout)
    assert (status, found['grade']) == (0, 'fair')  # the height is as uncertain as the speed and the tracked height
    height, sigma = found['ground_from_camera']['translation_m'][2], found['stddev']['height_m']
    assert height == pytest.approx(JUNCTION.height_m, abs=3 * sigma) and sigma < 0.15 * JUNCTION.height_m
    assert found['assumptions'][-1]['text'].startswith('scale from a mean speed of 34.2 ± 2 km/h')


def test_the_height_and_its_source_are_summed_up(without_height):
    _, stdout, _ = without_height('--camera-height', '8', '-p', 'camera_height_sigma=0.1')
    assert re.search(r'camera height +8.00 m +± 0.10\n', stdout)
    assert 'assumed:    scale from the camera height of 8 ± 0.1 m (given)' in stdout


def test_a_distance_above_the_horizon_leaves_the_lens(without_height):
    status, stdout, _ = without_height('--scale-distance', 600, 20, 600, 500, 10.0)
    assert status == 0
    assert 'there is no ground plane. Pixel (600, 20)' in stdout


def test_pixels_outside_the_image_are_wrong_usage(without_height):
    status, stdout, stderr = without_height('--scale-distance', 600, 720, 600, 500, 10.0)
    assert (status, stdout, stderr.count('\n')) == (2, '', 1)
    assert '(600, 720) of a known distance lies outside the images, which have 1280x720' in stderr


def test_a_lens_of_another_shape_is_wrong_usage(evidence, tmp_path):
    write_camera_info_yaml(tmp_path / 'square.yaml', Camera.equidistant(500, 500, 200.0), 'north')
    status, stdout, stderr = evidence('--camera-info', tmp_path / 'square.yaml')
    assert (status, stdout) == (2, '')
    assert stderr.startswith('autocalib: error: the lens was calibrated in images of 500x500') and '1280x720' in stderr


@pytest.mark.parametrize(
    ('name', 'message'), [('nowhere.yaml', 'cannot read'), ('evidence.npz', 'it is not YAML'), ('.', 'Is a directory')]
)
def test_an_unreadable_lens_is_one_line_and_status_2(evidence, saved, name, message):
    status, stdout, stderr = evidence('--camera-info', saved.parent / name)
    assert (status, stdout, stderr.count('\n')) == (2, '', 1)
    assert message in stderr and str(saved.parent) in stderr


@pytest.mark.parametrize(
    ('content', 'message'),
    [(None, 'No such file'), (b'', 'is not a file of saved evidence'), (b'words', 'is not a file of saved evidence')],
)
def test_unreadable_evidence_is_one_line_and_status_2(content, message, tmp_path, capsys):
    if content is not None:
        (tmp_path / 'e.npz').write_bytes(content)
    assert main(['evidence', str(tmp_path / 'e.npz'), '--out', str(tmp_path / 'out')]) == 2
    error = capsys.readouterr().err
    assert error.startswith('autocalib: error: ') and message in error and error.count('\n') == 1
    assert not (tmp_path / 'out').exists()


def test_camera_info_is_in_the_distortion_model_that_is_asked_for(evidence):
    _, plain, _ = evidence('--method', 'paper', '--json')
    status, stdout, _ = evidence(
        '--method', 'paper', '--json', '-p', 'distortion_model=rational_polynomial', '-p', 'rectified_balance=1.0'
    )
    assert status == 0
    before, found = document(plain), document(stdout)
    assert found['camera'] == before['camera']
    info = found['camera_info']
    assert (info['distortion_model'], len(info['d'])) == ('rational_polynomial', 8)
    assert info['k'] == before['camera_info']['k'] and info['p'][0] < before['camera_info']['p'][0]
    assert found['checks'][-1]['kind'] == 'distortion_model' and found['checks'][-1]['values']['error_px'] < 0.1


def test_a_model_that_cannot_say_the_lens_is_a_refusal_that_names_another(evidence):
    status, stdout, stderr = evidence('--method', 'paper', '--json', '-p', 'distortion_model=plumb_bob')
    assert (status, document(stdout)['refusal']['code']) == (3, 'distortion_model')
    assert stderr.startswith(
        'Not calibrated: the distortion model that was asked for does not fit the lens. plumb_bob would be'
    )
    assert 'Set distortion_model to rational_polynomial, which is off by' in stderr


def test_a_known_lens_in_a_model_that_cannot_say_it_is_wrong_usage(without_height, lens_file):
    status, _, stderr = without_height('--camera-info', lens_file, '-p', 'distortion_model=plumb_bob')
    assert status == 2
    assert 'plumb_bob would be off' in stderr and 'Set distortion_model' in stderr
