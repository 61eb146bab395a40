"""Image streams as real cameras send them: a node and a camera in processes of their own, seen by /diagnostics."""

import json
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray

from bench import Bench, wait_for

pytestmark = pytest.mark.dds

NODE = [sys.executable, '-m', 'autocalib_ros.ros.node', '--ros-args', '-r', '__ns:=/site', '-r', 'image:=/camera/image']
CAMERA = [sys.executable, str(Path(__file__).with_name('camera.py'))]
PATIENCE_S = 90.0
"""Processes take seconds to start, and much longer on a busy machine."""
RAW, COMPRESSED, LOSSY = {}, {'compressed': True}, {'reliable': False}


class DiagnosticsLog(list):
    """Messages of /diagnostics, newest last."""

    def newest(self) -> dict[str, str]:
        return {} if not self else {item.key: item.value for item in self[-1].status[0].values}

    def used(self) -> int:
        return int(self.newest().get('used', 0))


@contextmanager
def running_node(log: Path, *arguments: str):
    with log.open('w') as stream, subprocess.Popen([*NODE, *arguments], stderr=stream) as process:
        try:
            yield process
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=PATIENCE_S) == 0, log.read_text()
        finally:
            process.kill()
    assert 'Traceback' not in log.read_text()


@contextmanager
def running_camera(topic: str, *phases: dict):
    """Yield a function that sends the camera into its next phase."""
    with subprocess.Popen([*CAMERA, topic, json.dumps(phases)], stdin=subprocess.PIPE, text=True) as process:

        def go_on():
            process.stdin.write('\n')
            process.stdin.flush()

        try:
            yield go_on
        finally:
            process.kill()


@pytest.fixture
def diagnostics(bench: Bench) -> DiagnosticsLog:
    seen = DiagnosticsLog()
    bench.client.create_subscription(DiagnosticArray, '/diagnostics', seen.append, 10)
    return seen


def test_camera_that_starts_late_and_changes_its_reliability_twice_is_heard(diagnostics, tmp_path):
    with running_node(tmp_path / 'log'):
        wait_for(lambda: diagnostics.newest().get('state') == 'WAITING_FOR_IMAGES', 'the node', PATIENCE_S)
        with running_camera('/camera/image', RAW, LOSSY, RAW, {'width': 160, 'height': 120}) as go_on:
            wait_for(lambda: diagnostics.used() > 3, 'images', PATIENCE_S)
            go_on()
            reliably = diagnostics.used()
            wait_for(lambda: diagnostics.used() > reliably + 10, 'images of best effort', PATIENCE_S)
            go_on()
            lossily = diagnostics.used()
            wait_for(lambda: diagnostics.used() > lossily + 10, 'reliable images', PATIENCE_S)
            newest, status = diagnostics.newest(), diagnostics[-1].status[0]
            go_on()
            wait_for(
                lambda: 'the image size changed: collecting new evidence' in (tmp_path / 'log').read_text(),
                'the news',
                PATIENCE_S,
            )
            before = diagnostics.used()
            wait_for(lambda: diagnostics.used() > before + 3, 'images of the other size', PATIENCE_S)
    subscriptions = [line for line in (tmp_path / 'log').read_text().splitlines() if 'subscribed to' in line]
    assert [line.rpartition(' ')[2] for line in subscriptions] == ['reliable)', 'best_effort)', 'reliable)']
    assert (newest['state'], newest['encoding'], newest['image_topic']) == ('COLLECTING', 'mono8', '/camera/image')
    assert float(newest['received_hz']) > 0
    assert (status.level, status.name, status.hardware_id) == (b'\x01', 'site/autocalib: calibration', 'site')


def test_compressed_images_are_heard(diagnostics, tmp_path):
    with (
        running_node(tmp_path / 'log', '-p', 'image_transport:=compressed'),
        running_camera('/camera/image/compressed', COMPRESSED),
    ):
        wait_for(lambda: diagnostics.used() > 3, 'images', PATIENCE_S)
    assert diagnostics.newest()['encoding'] == 'jpeg'
