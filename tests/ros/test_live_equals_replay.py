"""A live run and a replay of the same images give the same calibration."""

import json
import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo

from autocalib_ros.offline.simulate import write_bag
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.ros.messages import stamp_ns
from bench import Bench, wait_for

TOPIC = '/camera/image_raw'
HEIGHT_M = 8.0
ONLY_AT_THE_END_S = 10000.0
"""No solution while images come: the one at the end is compared, and nothing else takes time or drops images."""
INTERVALS_S = (0.06, 0.2)
"""Real time between two images, faster than recorded; slower when the machine is busy and images were dropped."""
LIMIT_S = 120.0

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def bag(tmp_path_factory) -> Path:
    """Return a small simulated recording of a junction."""
    path = tmp_path_factory.mktemp('live') / 'recording'
    write_bag(
        path,
        SimulationOptions(
            width_px=320,
            height_px=180,
            focal_px=140.0,
            principal_point_offset_px=(2.0, -1.5),
            camera_height_m=HEIGHT_M,
            duration_s=18.0,
            rate_hz=6.0,
            topic=TOPIC,
        ),
    )
    return path


@pytest.fixture
def replaying(bag):
    """Yield the process of a replay, and the path of the calibration.json it writes."""
    out = bag.parent / 'replayed'
    command = [
        sys.executable,
        '-m',
        'autocalib_ros',
        'replay',
        str(bag),
        '--topic',
        TOPIC,
        '--camera-height',
        str(HEIGHT_M),
        '-p',
        f'first_solve_s={ONLY_AT_THE_END_S}',
        '--out',
        str(out),
        '--quiet',
    ]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        yield process, out / 'calibration.json'


def stamps_of(bag: Path) -> list[int]:
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([bag], default_typestore=store) as reader:
        images = [connection for connection in reader.connections if connection.topic == TOPIC]
        return [
            stamp_ns(reader.deserialize(raw, connection.msgtype).header.stamp)
            for connection, _, raw in reader.messages(images)
        ]


@contextmanager
def live_node(log: Path):
    """Run the node as a process of its own that writes its log to a file; interrupted at the end."""
    command = [
        sys.executable,
        '-m',
        'autocalib_ros.ros.node',
        '--ros-args',
        '-p',
        f'camera_height:={HEIGHT_M}',
        '-p',
        f'first_solve_s:={ONLY_AT_THE_END_S}',
        '-r',
        f'image:={TOPIC}',
    ]
    with log.open('w') as stream, subprocess.Popen(command, stderr=stream) as process:
        try:
            yield process
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=30) == 0, log.read_text()
        finally:
            process.kill()


def play(bag: Path, interval_s: float) -> int:
    """Play the recording from a process of its own; return the number of images sent."""
    command = [sys.executable, str(Path(__file__).with_name('player.py')), str(bag), TOPIC, str(interval_s)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=LIMIT_S, check=True)
    return int(done.stdout)


def received_live(bench: Bench, bag: Path, last_ns: int, interval_s: float) -> tuple[str, CameraInfo, TransformStamped]:
    """Return the node's log, and what a subscriber that joins after the last solution gets."""
    log = bag.parent / f'node_{interval_s}.log'
    with live_node(log):
        solutions = bench.collect(TransformStamped, '/autocalib/ground_transform', latched=True)
        play(bag, interval_s)
        wait_for(
            lambda: solutions and stamp_ns(solutions[-1].header.stamp) == last_ns,
            f'the solution of all images; the log so far:\n{log.read_text()}',
            LIMIT_S,
        )
        infos = bench.collect(CameraInfo, '/autocalib/camera_info', latched=True)
        transforms = bench.collect(TransformStamped, '/autocalib/ground_transform', latched=True)
        wait_for(lambda: infos and transforms, 'both latched messages')
    return log.read_text(), infos[-1], transforms[-1]


@pytest.fixture
def live(bench, bag) -> tuple[CameraInfo, TransformStamped]:
    """Return what the node published after a run in which it used every image."""
    stamps = stamps_of(bag)
    for interval_s in INTERVALS_S:
        log, info, transform = received_live(bench, bag, stamps[-1], interval_s)
        counts = re.search(r'images received (\d+), used (\d+), dropped 0, unreadable 0', log)
        if counts and counts.groups() == (str(len(stamps)), str(len(stamps))):
            return info, transform
    raise AssertionError(f'the node did not keep up with an image each {interval_s} s:\n{log}')


def test_live_node_publishes_what_a_replay_writes(live, replaying):
    info, transform = live
    replay, path = replaying
    _, said = replay.communicate(timeout=LIMIT_S)
    assert replay.returncode == 0, said
    replayed = json.loads(path.read_text(encoding='utf-8'))
    expected = replayed['camera_info']
    assert (info.distortion_model, [info.width, info.height]) == (expected['distortion_model'], replayed['image_size'])
    for name in 'kdrp':
        np.testing.assert_array_equal(getattr(info, name), expected[name])
    t, q = transform.transform.translation, transform.transform.rotation
    pose = replayed['ground_from_camera']
    assert [t.x, t.y, t.z] == pose['translation_m']
    assert [q.x, q.y, q.z, q.w] == pose['rotation_xyzw']
