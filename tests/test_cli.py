"""The `autocalib` command: messages and exit statuses."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import autocalib_ros
from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.cli import main
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info_yaml import write_camera_info_yaml


@pytest.fixture
def still_video(tmp_path) -> Path:
    """Return a short video in which nothing moves."""
    path = tmp_path / 'still.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 10.0, (160, 96))
    picture = np.random.default_rng(0).integers(0, 255, (96, 160, 3)).astype(np.uint8)
    for _ in range(20):
        writer.write(picture)
    writer.release()
    return path


def python(*arguments: object, folder: Path, **more: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, 'PYTHONPATH': str(Path(autocalib_ros.__file__).parents[1]), **more}
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=folder,
        env=environment,
        check=False,
    )


def autocalib(*arguments: object, folder: Path, **more: str) -> subprocess.CompletedProcess:
    return python('-m', 'autocalib_ros', *arguments, folder=folder, **more)


def one_line(text: str) -> str:
    assert text.startswith('autocalib: error: '), text
    assert text.count('\n') == 1, text
    return text


def test_help_and_version_end_well(capsys):
    assert main(['--version']) == 0
    assert capsys.readouterr().out == f'autocalib {autocalib_ros.__version__}\n'
    assert main(['--help']) == 0
    assert main(['replay', '--help']) == 0
    assert main(['evidence', '--help']) == 0
    assert main(['simulate', '--help']) == 0
    assert main(['demo', '--help']) == 0


def test_alone_it_lists_the_commands(capsys):
    assert main([]) == 2
    listed = capsys.readouterr().out
    assert 'calibrate from a recording' in listed and 'write a calibration in the format of another' in listed


def test_the_options_in_force_are_printed_as_a_parameter_file(tmp_path, capsys):
    given = ['--camera-height', '7.5', '--distance', '1', '2', '300', '4', '12', '-p', 'joint.noise_px=0.7']
    assert main(['replay', '--print-params', *given]) == 0
    (tmp_path / 'p.yaml').write_text(capsys.readouterr().out)
    assert main(['evidence', '--print-params', '--params-file', str(tmp_path / 'p.yaml')]) == 0
    assert capsys.readouterr().out == (tmp_path / 'p.yaml').read_text()
    values = yaml.safe_load((tmp_path / 'p.yaml').read_text())['/**']['ros__parameters']
    assert (values['camera_height'], values['joint']['noise_px']) == (7.5, 0.7)
    assert values['scale']['distances'] == '1 2 300 4 12'


def test_shells_complete_commands_and_options(tmp_path):
    pytest.importorskip('argcomplete', reason='argcomplete completes lines: pip install argcomplete')
    code = 'from autocalib_ros.cli import main; main([])'
    for line, expected in (('autocalib rep', 'replay'), ('autocalib replay --camera-he', '--camera-height')):
        answer = tmp_path / 'answer'
        python(
            '-c',
            code,
            folder=tmp_path,
            COMP_LINE=line,
            COMP_POINT=str(len(line)),
            _ARGCOMPLETE='1',
            PYTHONPATH=os.pathsep.join([str(Path(autocalib_ros.__file__).parents[1]), *sys.path]),
            _ARGCOMPLETE_STDOUT_FILENAME=str(answer),
        )
        assert expected in answer.read_text()


@pytest.mark.dds
def test_a_reader_that_goes_away_is_no_error(tmp_path):
    command = [sys.executable, '-m', 'autocalib_ros', 'replay', '--print-params']
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path, text=True) as done:
        done.stdout.close()
        assert done.stderr.read() == ''
    assert done.returncode == 141


@pytest.mark.dds
def test_help_imports_nothing_heavy(tmp_path):
    code = (
        "import sys; from autocalib_ros.cli import main; main(['--help']);"
        "print(sorted({'cv2', 'numpy', 'rosbags', 'matplotlib', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, '-c', code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, 'PYTHONPATH': str(Path(autocalib_ros.__file__).parents[1])},
    )
    assert done.stdout.endswith('[]\n')


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['replay'], 'the following arguments are required: SOURCE'),
        (['jump'], "there is no command 'jump' (see autocalib --help)"),
        (['reply', 'x'], "there is no command 'reply'; did you mean 'replay'?"),
        (['--verson'], 'COMMAND'),
        (
            ['replay', 'x', '--camera-hight=8'],
            "--camera-hight=8; did you mean '--camera-height'? (see autocalib replay",
        ),
        (['replay', 'x', '--camera-height', 'high'], "invalid float value: 'high'"),
        (['replay', 'x', '--method', 'magic'], "invalid choice: 'magic'"),
        (['replay', 'x', '--unheard-of'], 'unrecognized arguments: --unheard-of'),
        (['replay', 'x', '--camera-height', '-3'], "'camera_height' lies between 0 and 500; got -3.0"),
        (['replay', 'x', '--camera-height', 'nan'], "'camera_height' lies between 0 and 500; got nan"),
        (['replay', 'x', '--camera-height', 'inf'], "'camera_height' lies between 0 and 500; got inf"),
        (['replay', 'x', '--focal-px', '800', '--hfov-deg', '50'], 'not allowed with argument --focal-px'),
        (['evidence', 'x', '--scale-speed', '5', '-p', 'scale_from=height'], "'scale.speed_km_h' is given too"),
        (['replay', 'x', '--scale-distance', '1', '2', '3', '4'], 'expected 5 arguments'),
        (['replay', 'x', '--scale-distance', '1', '2', '3', '4', '5'], 'px apart'),
        (['replay', 'x', '--distance', '1', '2', '300', '4', '0'], 'up to 1000 metres'),
        (['evidence', 'x', '-p', 'scale_from=speed'], "needs 'scale.speed_km_h'"),
        (['evidence', 'x', '-p', 'scale_from=distance'], "needs 'scale.distance_px'"),
        (['demo', '--scale-from', 'guess'], "invalid choice: 'guess'"),
        (['replay', 'x', '-p', 'camera_hight=3'], "did you mean 'camera_height'?"),
        (['replay', 'x', '-p', 'camera_height'], 'does not have the form name=value'),
        (['replay', 'x', '-p', 'tracking.max_points=many'], "'max_points' takes a int, got 'many'"),
        (['replay', 'x', '--params-file', 'nowhere.yaml'], 'cannot read nowhere.yaml'),
        (['replay', 'nowhere.mp4'], 'nowhere.mp4 does not exist'),
        (['replay', 'x', '--camera-info', 'nowhere.yaml'], 'cannot read nowhere.yaml'),
        (['replay', 'x', '-p', 'detector.model=nowhere.onnx'], "'detector.model' is nowhere.onnx, which is not a file"),
        (['replay', 'x', '-p', 'detector.layout=yolo'], "'layout' is one of auto, yolox"),
        (['evidence'], 'the following arguments are required: FILE'),
        (['evidence', 'nowhere.npz'], 'nowhere.npz'),
        (['evidence', 'nowhere.npz', '-p', 'camera_hight=3'], "did you mean 'camera_height'?"),
        (['demo', '--seed', 'x'], "invalid int value: 'x'"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert message in one_line(capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


@pytest.mark.dds
def test_unreadable_input_is_one_line_and_status_2(tmp_path):
    names = ['text.mp4', 'text.mcap', 'text.db3', 'text.bag', 'folder']
    for name in names[:-1]:
        (tmp_path / name).write_text('only words\n' * 100)
    (tmp_path / 'folder').mkdir()
    # in one process of its own: what libraries write to stderr counts, and a start takes a second
    program = 'import sys; from autocalib_ros.cli import main; print([main(["replay", name]) for name in sys.argv[1:]])'
    done = python('-c', program, *names, folder=tmp_path)
    told = done.stderr.splitlines(keepends=True)
    assert (done.stdout, len(told)) == (f'{len(names) * [2]}\n', len(names)), done.stderr
    assert all(name in one_line(line) for name, line in zip(names, told, strict=True))
    assert not (tmp_path / 'autocalib_out').exists()


@pytest.mark.dds
def test_a_truncated_video_is_one_line_from_the_libraries_too(tmp_path):
    path = tmp_path / 'clip.mp4'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'mp4v'), 10.0, (160, 96))
    for index in range(20):
        writer.write(np.full((96, 160, 3), 10 * index, np.uint8))
    writer.release()
    path.write_bytes(path.read_bytes()[:-300])
    done = autocalib('replay', path, folder=tmp_path)
    assert done.returncode == 2
    one_line(done.stderr)


def test_nothing_that_moves_is_refused_with_the_reason(still_video, tmp_path):
    # output that the terminal cannot encode must not raise
    done = autocalib(
        'replay', still_video, '--camera-height', 8, '--out', 'out', folder=tmp_path, PYTHONIOENCODING='ascii'
    )
    assert done.returncode == 3, done.stderr
    assert 'Not calibrated: ' in done.stderr
    assert 'Traceback' not in done.stderr
    document = json.loads((tmp_path / 'out' / 'calibration.json').read_text())
    assert document['state'] == 'refused'
    assert document['refusal']['message'].rstrip('.')[1:] in done.stderr  # a sentence of its own there
    assert sorted(path.name for path in (tmp_path / 'out').iterdir()) == [
        'calibration.json',
        'evidence.npz',
        'figures',
        'report.html',
    ]
    assert 'Written to out: calibration.json, report.html, evidence.npz' in done.stdout


def test_a_lens_of_another_shape_is_noticed_at_the_first_image(still_video, tmp_path, capsys):
    write_camera_info_yaml(tmp_path / 'lens.yaml', Camera.equidistant(640, 480, 300.0), 'north')
    command = ['replay', str(still_video), '--quiet', '--out', str(tmp_path / 'out')]
    assert main([*command, '--camera-info', str(tmp_path / 'lens.yaml')]) == 2
    assert 'images of 640x480, and these images have 160x96, another shape' in one_line(capsys.readouterr().err)


def test_pixels_outside_the_image_are_noticed_at_the_first_image(still_video, tmp_path, capsys):
    command = ['replay', str(still_video), '--quiet', '--out', str(tmp_path / 'out')]
    assert main([*command, '--scale-distance', '10', '80', '400', '80', '12.5']) == 2
    assert '(400, 80) of a known distance lies outside the images, which have 160x96' in one_line(
        capsys.readouterr().err
    )


@pytest.mark.parametrize('scale', [['--scale-distance', '10', '80', '150', '80', '12.5'], ['--scale-speed', '50']])
def test_no_height_warning_with_another_metric_scale(scale, still_video, tmp_path, capsys):
    assert main(['replay', str(still_video), '--out', str(tmp_path / 'out'), *scale]) == 3
    assert 'height' not in capsys.readouterr().err


def test_a_missing_height_is_reported_in_one_line(still_video, tmp_path, capsys):
    assert main(['replay', str(still_video), '--out', str(tmp_path / 'out')]) == 3
    lines = capsys.readouterr().err.splitlines()
    assert sum('No camera height given' in line for line in lines) == 1


def test_quiet_says_only_the_reason(still_video, tmp_path, capsys):
    bag = tmp_path / 'bag'
    assert main(['replay', str(still_video), '--quiet', '--out', str(tmp_path / 'out'), '--write-bag', str(bag)]) == 3
    captured = capsys.readouterr()
    assert captured.out == ''
    assert [line.split(':')[0] for line in captured.err.splitlines()] == ['Not calibrated', f'{bag} is not written']
    assert not bag.exists()


def test_an_existing_bag_is_noticed_before_the_work(still_video, tmp_path, capsys):
    assert main(['replay', str(still_video), '--out', str(tmp_path / 'out'), '--write-bag', str(tmp_path)]) == 2
    assert 'exists already and is not overwritten' in one_line(capsys.readouterr().err)


def test_the_command_line_overrides_the_file(still_video, tmp_path):
    (tmp_path / 'p.yaml').write_text('/**: {ros__parameters: {method: paper, camera_height: 5.0}}')
    base = [
        'replay',
        str(still_video),
        '--quiet',
        '--out',
        str(tmp_path / 'out'),
        '--params-file',
        str(tmp_path / 'p.yaml'),
    ]
    for more, method in (([], 'paper'), (['--method', 'joint'], 'joint'), (['-p', 'method=joint'], 'joint')):
        assert main([*base, *more]) == 3
        assert json.loads((tmp_path / 'out' / 'calibration.json').read_text())['method'] == method


def test_two_runs_write_the_same_calibration(still_video, tmp_path):
    for name in 'ab':
        main(['replay', str(still_video), '--quiet', '--out', str(tmp_path / name)])
    first, second = ((tmp_path / name / 'calibration.json').read_bytes() for name in 'ab')
    assert first == second


def test_an_interrupt_ends_quietly(still_video, tmp_path, monkeypatch, capsys):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr('autocalib_ros.offline.recordings.open.open_source', interrupted)
    assert main(['replay', str(still_video), '--out', str(tmp_path / 'out')]) == 130
    assert 'Traceback' not in capsys.readouterr().err


def test_the_first_interrupt_solves_and_the_second_leaves(still_video, tmp_path, monkeypatch, capfd):
    add_image, images, interrupts = AutoCalibrator.add_image, [], [5]

    def interrupted(calibrator, *arguments):
        images.append(arguments)
        for _ in range(interrupts.count(len(images))):
            os.kill(os.getpid(), signal.SIGINT)
        return add_image(calibrator, *arguments)

    monkeypatch.setattr(AutoCalibrator, 'add_image', interrupted)
    out = tmp_path / 'out'
    assert main(['replay', str(still_video), '--out', str(out)]) == 3
    assert 'Ctrl-C again leaves at once' in (told := capfd.readouterr().err) and 'Stopped after 5 images' in told
    assert Evidence.load(out / 'evidence.npz').frames <= 5
    images.clear()
    interrupts.append(5)
    assert main(['replay', str(still_video), '--out', str(out)]) == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_json_is_calibration_json_and_the_rest_goes_to_stderr(still_video, tmp_path, capsys):
    out = tmp_path / 'out'
    assert main(['replay', str(still_video), '--json', '--out', str(out)]) == 3
    captured = capsys.readouterr()
    assert captured.out == (out / 'calibration.json').read_text()
    assert 'Not calibrated: ' in captured.err and 'Written to' in captured.err
    assert main(['replay', str(still_video), '--json', '--quiet', '--out', str(out)]) == 3
    quiet = capsys.readouterr()
    assert quiet.out == captured.out
    assert quiet.err.startswith('Not calibrated: ') and quiet.err.count('\n') == 1


def test_colours_are_for_terminals(still_video, tmp_path, capsys, monkeypatch):
    command = ['replay', str(still_video), '--quiet', '--out', str(tmp_path / 'out')]
    for force, start in (('', 'Not calibrated: '), ('1', '\033[31mNot calibrated: ')):
        monkeypatch.setenv('FORCE_COLOR', force)
        monkeypatch.setenv('NO_COLOR', '')
        assert main(command) == 3
        assert capsys.readouterr().err.startswith(start)
