"""Simulated bags are readable and do not depend on the number of workers."""

from __future__ import annotations

import argparse
import json
import shutil

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from autocalib_ros.errors import UsageError
from autocalib_ros.offline.simulate import add_arguments, run, write_bag
from autocalib_ros.offline.simulate.command import options_from
from autocalib_ros.offline.simulate.options import SCENES, SimulationOptions
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.truth import truth_of

pytestmark = pytest.mark.render

# One road is quickest to draw.
TINY = {'width_px': 160, 'height_px': 90, 'focal_px': 70.0, 'rate_hz': 5.0, 'duration_s': 0.6, 'one_way': True}


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Return a bag of TINY and the calls of its progress, for tests that only read."""
    calls = []
    path = tmp_path_factory.mktemp('simulated') / 'bag'
    write_bag(path, SimulationOptions(**TINY), workers=1, progress=lambda *done: calls.append(done))
    return path, calls


def _messages(path, topic):
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(connections)]


def _pixels(message) -> np.ndarray:
    kind = np.uint16 if message.encoding == 'mono16' else np.uint8
    return np.frombuffer(message.data, kind).reshape(message.height, message.width, -1)


@pytest.mark.parametrize(
    ('storage', 'zstd', 'thermal'),
    [
        ('sqlite3', False, False),
        ('sqlite3', True, True),
        ('mcap', False, True),
        ('mcap', True, False),
    ],
)
def test_raw_bag_holds_the_frames(tmp_path, storage, zstd, thermal):
    options = SimulationOptions(**TINY, storage=storage, zstd=zstd, thermal=thermal)
    messages = _messages(write_bag(tmp_path / 'bag', options, workers=1), options.topic)
    simulation = Simulation(options)
    assert len(messages) == options.frame_count
    assert messages[0].encoding == ('mono16' if thermal else 'bgr8')
    assert messages[0].step == 160 * (2 if thermal else 3)
    stamp = messages[2].header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == simulation.stamp_ns(2)
    assert messages[0].header.frame_id == options.frame_id
    assert np.array_equal(_pixels(messages[2]).squeeze(), simulation.frame(2))


@pytest.mark.parametrize(('thermal', 'prefix', 'worst'), [(False, 'bgr8; jpeg', 5.0), (True, 'mono16; png', 0.0)])
def test_compressed_bag_holds_the_frames(tmp_path, thermal, prefix, worst):
    options = SimulationOptions(**TINY, compressed=True, storage='mcap', thermal=thermal)
    path = write_bag(tmp_path / 'bag', options, workers=1)
    message = _messages(path, options.topic + '/compressed')[1]
    picture = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert message.format.startswith(prefix)
    change = np.abs(picture.astype(int) - Simulation(options).frame(1))
    assert change.mean() <= worst


def test_bag_does_not_depend_on_the_number_of_workers(tmp_path):
    options = SimulationOptions(**TINY, shake_px=1.0)
    bags = [write_bag(tmp_path / f'{n}', options, workers=n) for n in (1, 2)]
    frames = [[m.data.tobytes() for m in _messages(bag, options.topic)] for bag in bags]
    assert len(frames[0]) == options.frame_count
    assert frames[0] == frames[1]


def test_true_camera_info_comes_with_every_frame(bag):
    options = SimulationOptions(**TINY)
    infos = _messages(bag[0], options.truth_topic)
    assert len(infos) == options.frame_count
    assert infos[0].distortion_model == 'equidistant'
    assert infos[0].d == pytest.approx(options.k)
    assert infos[0].k.reshape(3, 3)[:2, 2] == pytest.approx(options.lens.centre_px)


def test_truth_is_written_beside_the_images(bag):
    options = SimulationOptions(**TINY)
    written = json.loads((bag[0] / 'truth.json').read_text())
    assert written == json.loads(json.dumps(truth_of(Simulation(options))))


def test_progress_counts_every_frame(bag):
    assert bag[1] == [(1, 3), (2, 3), (3, 3)]


def test_existing_folder_is_not_overwritten(tmp_path):
    (tmp_path / 'note.txt').write_text('mine')
    with pytest.raises(UsageError, match='already exists'):
        write_bag(tmp_path, SimulationOptions(**TINY))


def test_folder_that_is_no_bag_is_never_overwritten(tmp_path):
    (tmp_path / 'note.txt').write_text('mine')
    with pytest.raises(UsageError, match='is not a bag'):
        write_bag(tmp_path, SimulationOptions(**TINY), overwrite=True)
    assert (tmp_path / 'note.txt').read_text() == 'mine'


def test_bag_is_overwritten_on_request(tmp_path, bag):
    shutil.copytree(bag[0], tmp_path / 'bag')
    options = SimulationOptions(**{**TINY, 'duration_s': 0.2})
    path = write_bag(tmp_path / 'bag', options, workers=1, overwrite=True)
    assert len(_messages(path, options.topic)) == 1


def test_empty_folder_is_used(tmp_path):
    path = write_bag(tmp_path, SimulationOptions(**TINY), workers=1)
    assert (path / 'metadata.yaml').is_file()


def test_interrupted_recording_leaves_nothing(tmp_path):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_bag(tmp_path / 'bag', SimulationOptions(**TINY), workers=1, progress=stop)
    assert not (tmp_path / 'bag').exists()


def _parsed(*argv: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return parser.parse_args(['bag', *argv])


def test_command_line_without_options_gives_the_defaults():
    assert options_from(_parsed()) == SimulationOptions()


@pytest.mark.parametrize(
    ('argv', 'name', 'value'),
    [
        ('--focal 600', 'focal_px', 600.0),
        ('--k2 -0.01', 'k', (0.01, -0.01, 0.0, 0.0)),
        ('--principal-point-offset 3 -2', 'principal_point_offset_px', (3.0, -2.0)),
        ('--camera-height 9', 'camera_height_m', 9.0),
        ('--yaw 20', 'yaw_deg', 20.0),
        ('--position -10 -20', 'position_m', (-10.0, -20.0)),
        ('--bump-at 5', 'bump_at_s', 5.0),
        ('--one-way', 'one_way', True),
        ('--size 640x360', 'width_px', 640),
        ('--storage mcap', 'storage', 'mcap'),
        ('--shake 1.5', 'shake_px', 1.5),
        ('--road-angle 70', 'road_angle_deg', 70.0),
        *[(f'--scene {scene}', 'scene', scene) for scene in SCENES],
    ],
)
def test_command_line_sets_an_option(argv, name, value):
    argv = argv.split() + (['--focal', '280'] if 'size' in argv else [])
    assert getattr(options_from(_parsed(*argv)), name) == value


def test_command_writes_a_bag(tmp_path, capsys):
    argv = f'{tmp_path / "bag"} --size 160x90 --focal 70 --rate 5 --duration 0.2 --workers 1'
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    assert run(parser.parse_args(argv.split())) == 0
    assert (tmp_path / 'bag' / 'truth.json').is_file()
    assert 'truth.json' in capsys.readouterr().out
