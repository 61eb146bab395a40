"""The examples run, on tiny synthetic input."""

import csv
import importlib.util
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest

from autocalib_ros.ground import Ground
from autocalib_ros.offline.replay_recording import ReplayResult
from autocalib_ros.results.calibration_json import write_calibration_json
from synthetic_results import full_result, grey_road, junction_evidence, lens_result

EXAMPLES = Path(__file__).parent.parent / 'examples'


def loaded(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name.partition('.')[0], EXAMPLES / name)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look for their module there
    spec.loader.exec_module(module)
    return module


def test_every_example_is_tested():
    source = Path(__file__).read_text(encoding='utf-8')
    assert {path.name for path in EXAMPLES.iterdir() if path.suffix == '.py' and path.name not in source} == set()


def test_track_on_ground_follows_vehicles_at_their_speed(tmp_path, capsys):
    calibration = tmp_path / 'calibration.json'
    result = full_result(junction_evidence())
    write_calibration_json(calibration, result)
    ground = Ground.of(result)
    times_s = np.arange(0.0, 3.0, 0.1)
    generator = np.random.default_rng(0)
    with (tmp_path / 'detections.csv').open('w', newline='', encoding='utf-8') as stream:
        for time_s in times_s:
            # two vehicles side by side, 36 and 18 km/h
            places_m = np.array([[3.0 + 10.0 * time_s, 4.0], [6.0, 3.0 + 5.0 * time_s]])
            pixels, seen = ground.pixels(places_m)
            for u, v in pixels[seen] + generator.normal(0.0, 0.1, (seen.sum(), 2)):
                csv.writer(stream).writerow([f'{time_s:.1f}', u, v])
    assert loaded('track_on_ground.py').main(str(calibration), str(tmp_path / 'detections.csv')) == 0
    rows = np.array([line.split(',') for line in capsys.readouterr().out.splitlines()], float)
    last = rows[rows[:, 0] == rows[-1, 0]]
    assert len(last) == 2
    assert len(np.unique(rows[:, 1])) == 2, 'a vehicle keeps its track'
    # 2 px of assumed noise at a 320 px wide image leave about 1 m/s after three seconds
    np.testing.assert_allclose(last[:, 4], [36.0, 18.0], atol=4.0)


def test_track_on_ground_forgets_vehicles_that_left():
    module = loaded('track_on_ground.py')
    tracker = module.Tracker(Ground.of(full_result(junction_evidence())))
    pixels, _ = tracker.ground.pixels(np.array([[6.0, 3.0]]))
    assert [track.number for track in tracker.measure(0.0, pixels)] == [1]
    assert [track.number for track in tracker.measure(0.1, pixels)] == [1]
    assert [track.number for track in tracker.measure(10.0, pixels)] == [2]
    assert tracker.measure(10.1, np.array([[160.0, -1000.0]])) == [], 'above the horizon there is no road'


def run_replay_and_plot(monkeypatch, recording: Path, out: Path) -> None:
    monkeypatch.setattr(sys, 'argv', ['replay_and_plot.py', str(recording), '8.0', str(out)])
    runpy.run_path(str(EXAMPLES / 'replay_and_plot.py'), run_name='__main__')
    assert cv2.imread(str(out)).shape == (450, 1200, 3)


def test_replay_and_plot_shows_why_a_recording_is_refused(tmp_path, monkeypatch, capsys):
    video = tmp_path / 'empty_road.avi'
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*'MJPG'), 10.0, (64, 48))
    for _ in range(5):
        writer.write(np.full((48, 64, 3), 90, np.uint8))
    writer.release()
    run_replay_and_plot(monkeypatch, video, tmp_path / 'plot.png')
    assert 'no_motion: ' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('of', 'says'),
    [
        (lambda full: full, 'grade full'),
        (lens_result, 'one_direction: '),
        (lambda full: replace(full, ground=replace(full.ground, metric=False)), 'no metric scale'),
    ],
)
def test_replay_and_plot_shows_a_result(of, says, tmp_path, monkeypatch, capsys):
    # a recording that calibrates takes minutes to render: the result is made by hand
    evidence = junction_evidence()
    found = ReplayResult(
        result=of(full_result(evidence)), evidence=evidence, accepted_at_s=30.0, background=grey_road(), frames=600
    )
    monkeypatch.setattr(sys.modules['autocalib_ros.offline.replay_recording'], 'replay', lambda *_: found)
    run_replay_and_plot(monkeypatch, tmp_path / 'recording', tmp_path / 'plot.png')
    assert says in capsys.readouterr().out


class Kept:
    """Stands in for a class of launch, which plain pip does not bring: keeps what it is given."""

    def __init__(self, *given, **named):
        self.given, self.named = given, named

    def perform(self, context):
        return context[self.given[0]]


def test_ground_points_launch_file_joins_both_nodes(monkeypatch):
    for name in ('launch', 'launch.actions', 'launch.substitutions', 'launch_ros', 'launch_ros.actions'):
        monkeypatch.setitem(
            sys.modules,
            name,
            SimpleNamespace(
                LaunchContext=Kept,
                LaunchDescription=Kept,
                DeclareLaunchArgument=Kept,
                OpaqueFunction=Kept,
                LaunchConfiguration=Kept,
                Node=Kept,
            ),
        )
    module = loaded('ground_points.launch.py')
    assert len(module.generate_launch_description().given[0]) == len(module.ARGUMENTS) + 1
    given = {name: default for name, default, _ in module.ARGUMENTS}
    calibration, points = module.start_nodes({**given, 'camera_height': '6.5'})
    assert calibration.named['parameters'] == [{'camera_height': 6.5}]
    node_name = '{namespace}/{name}'.format(**calibration.named)
    assert points.named['namespace'] == node_name, 'its camera_info and ground_transform are those of the node'
    assert points.named['remappings'] == [('pixels', '/cam1/wheels')]
    _, absolute = module.start_nodes({**given, 'pixels': '/detector/wheels'})
    assert absolute.named['remappings'] == [('pixels', '/detector/wheels')]
