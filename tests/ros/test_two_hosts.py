"""Two hosts with a cable between them: network namespaces, each with an address of its own, joined by a veth pair.

It takes root and iproute2, and is skipped where the machine does not allow it.
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from bench import wait_for

pytestmark = pytest.mark.dds

HERE = Path(__file__).parent
CABLE = 'cable'
CUT_S = 30.0
"""Longer than the 20 s after which DDS gives a participant up."""
NEEDED = {'focal_px', 'height_m'} | ({'tf_static_m'} if importlib.util.find_spec('tf2_msgs') else set())
"""What a consumer has to get; /tf_static only where its message type is there."""


def ip(*words: str) -> None:
    """Run ip; an error includes its output."""
    done = subprocess.run(['ip', *words], capture_output=True, text=True, timeout=20, check=False)
    if done.returncode:
        raise OSError(f'ip {" ".join(words)}: {done.stderr.strip()}')


def set_up(host: str) -> None:
    """Switch the network of a host on; multicast goes through the cable, by which nodes find each other."""
    for link in ('lo', CABLE):
        ip('-n', host, 'link', 'set', link, 'up')
    ip('-n', host, 'route', 'add', '224.0.0.0/4', 'dev', CABLE)


def connect(hosts: tuple[str, str]) -> None:
    """Make both hosts and the cable between them."""
    for host in hosts:
        ip('netns', 'add', host)
    ip('link', 'add', CABLE, 'netns', hosts[0], 'type', 'veth', 'peer', 'name', CABLE, 'netns', hosts[1])
    for number, host in enumerate(hosts, 1):
        ip('-n', host, 'address', 'add', f'10.213.84.{number}/24', 'dev', CABLE)
        set_up(host)


@pytest.fixture
def hosts() -> Iterator[tuple[str, str]]:
    """Yield the names of two hosts; they are removed afterwards in any case."""
    if os.geteuid() != 0 or shutil.which('ip') is None:
        pytest.skip('two hosts take root and iproute2: run as root with `ip` installed')
    names = (f'autocalib{os.getpid()}a', f'autocalib{os.getpid()}b')
    try:
        try:
            connect(names)
        except OSError as error:
            pytest.skip(f'network namespaces are not allowed here: {error}')
        yield names
    finally:
        for name in names:
            with suppress(OSError):
                ip('netns', 'delete', name)


class Process:
    """A program on one of the hosts, and the lines that it prints."""

    def __init__(self, host: str, script: str, *arguments: str, log: Path | None = None) -> None:
        # Both hosts are this machine: without UDP alone, Fast DDS would go by shared memory and not by the cable.
        environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET', 'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4'}
        with open(os.devnull if log is None else log, 'w') as errors:
            self._process = subprocess.Popen(
                ['ip', 'netns', 'exec', host, sys.executable, str(HERE / script), *arguments],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=None if log is None else errors,
                text=True,
            )
        self.received: list[list] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        for line in self._process.stdout:
            self.received.append(json.loads(line))

    @property
    def newest(self) -> dict[str, float]:
        """The newest value of each kind."""
        return dict(tuple(item) for item in self.received)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()
        self._process.stdin.close()
        self._process.stdout.close()


@contextmanager
def running(host: str, script: str, *arguments: str, log: Path | None = None) -> Iterator[Process]:
    process = Process(host, script, *arguments, log=log)
    try:
        yield process
    finally:
        process.kill()


def test_a_consumer_on_another_host_gets_the_calibration_late_and_again_after_a_restart(hosts):
    with running(hosts[1], 'far_consumer.py') as consumer:
        with running(hosts[0], 'camera_host.py', '300.0'):
            wait_for(lambda: consumer.newest.keys() >= NEEDED, 'the calibration on the other host')
            with running(hosts[1], 'far_consumer.py') as late:
                wait_for(lambda: late.newest.keys() >= NEEDED, 'the calibration, latched')
                assert late.newest == consumer.newest == dict.fromkeys(NEEDED, 8.0) | {'focal_px': 300.0}
        before = len(consumer.received)
        with running(hosts[0], 'camera_host.py', '310.0'):
            wait_for(lambda: {what for what, _ in consumer.received[before:]} >= NEEDED, 'what the new node restores')
            wait_for(lambda: consumer.newest == dict.fromkeys(NEEDED, 8.0) | {'focal_px': 310.0}, 'what it solves')


@pytest.mark.slow
@pytest.mark.skipif(os.environ.get('AUTOCALIB_FAULT_TEST') != '1', reason='a minute: set AUTOCALIB_FAULT_TEST=1')
def test_cable_that_is_cut_for_half_a_minute_costs_the_images_of_that_time_alone(hosts, tmp_path):
    """The camera and a consumer are on one host, the node on the other."""
    log, topic = tmp_path / 'log', '/camera/image'
    node = ('300.0', '0', '--ros-args', '-r', f'image:={topic}', '-p', 'camera_height:=8.0', '-p', 'idle_solve_s:=0.1')
    with (
        running(hosts[0], 'fake_node.py', *node, log=log),
        running(hosts[1], 'far_consumer.py') as consumer,
        running(hosts[1], 'camera.py', topic, '[{"width": 160, "height": 120, "interval_s": 0.2}]'),
    ):
        wait_for(lambda: consumer.newest.keys() >= NEEDED and len(consumer.received) > 20, 'the calibration')
        ip('-n', hosts[1], 'link', 'set', CABLE, 'down')
        time.sleep(CUT_S)
        before = len(consumer.received)
        time.sleep(1.0)
        assert len(consumer.received) == before, 'the cable is not cut'
        set_up(hosts[1])
        wait_for(lambda: len(consumer.received) > before + 20, 'the calibration again')
        with running(hosts[1], 'far_consumer.py') as late:
            wait_for(lambda: late.newest.keys() >= NEEDED, 'the calibration, latched')
            assert late.newest == consumer.newest == dict.fromkeys(NEEDED, 8.0) | {'focal_px': 300.0}
    text = log.read_text()
    assert 'but no image arrives' in text and f'no publisher on {topic}' in text  # once DDS gives it up
    assert text.count('no image for') == 2 and text.count(f'images on {topic} again') == 1
    assert 'withdrawn' not in text and 'Traceback' not in text
