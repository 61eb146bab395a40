"""Faults of cameras, clocks, disks and processes: a node in a process of its own loses nothing and tells each once."""

import array
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CameraInfo

from autocalib_ros.results.store import Store, StoreState
from autocalib_ros.ros.messages import stamp_ns
from bench import PATIENCE_S, Bench, image, wait_for
from processes import (
    PROCESS_PATIENCE_S,
    DiagnosticsLog,
    interrupt,
    running_camera,
    running_fake_node,
    running_node,
)

pytestmark = pytest.mark.dds

FRAME_NS, SECOND_NS, HOUR_NS = 10**8, 10**9, 3600 * 10**9
FOCAL_PX = 311.0
NODE = '/cam1/autocalib'
MAX_GROWTH_MB = 300
"""More memory than this for one image of 8K (33 MB) would say that it was kept or copied often."""


class Site:
    """A node that has calibrated, its log, and the camera that sends it images."""

    def __init__(self, bench: Bench, process: subprocess.Popen, log: Path) -> None:
        self.bench, self.process, self._log = bench, process, log
        self.diagnostics = DiagnosticsLog()
        bench.client.create_subscription(DiagnosticArray, '/diagnostics', self.diagnostics.append, 10)
        self.infos: list[CameraInfo] = bench.collect(CameraInfo, f'{NODE}/camera_info')
        self.publisher = bench.connected(bench.publisher())
        self.time_ns = time.time_ns()

    def send(self, count: int = 1, step_ns: int = FRAME_NS, **more) -> None:
        """Send images; no two are the same, as those of a sensor."""
        for _ in range(count):
            self.time_ns += step_ns
            self.publisher.publish(self.made(**more))
            time.sleep(0.02)

    def made(self, **more):
        message = image(self.time_ns, **more)
        message.data[:8] = array.array('B', self.time_ns.to_bytes(8, 'little'))
        return message

    def calibrate(self) -> None:
        """Let the node calibrate, and wait for its first CameraInfo of an image."""

        def is_heard() -> bool:
            self.send()
            return bool(self.bench.client.count_publishers(self.infos_topic) and self.diagnostics)

        wait_for(is_heard, 'the node', 2 * PATIENCE_S)
        wait_for(lambda: self.bench.ask('calibrate', NODE).success, 'a calibration')
        self.require_calibrated('after the start')

    infos_topic = f'{NODE}/camera_info'

    def require_calibrated(self, when: str) -> None:
        """Send good images until one of them has got the CameraInfo of the calibration."""
        sent_after = self.time_ns

        def is_answered() -> bool:
            self.send()
            return any(
                stamp_ns(info.header.stamp) > sent_after and info.k[0] == FOCAL_PX for info in list(self.infos[-20:])
            )

        wait_for(is_answered, f'camera_info of an image {when}')

    def told(self, text: str) -> int:
        """Return how many lines of the log hold a text."""
        return sum(text in line for line in self._log.read_text().splitlines())

    def wait_told(self, text: str) -> None:
        wait_for(lambda: self.told(text), f'{text!r} in the log')

    def memory_mb(self) -> int:
        """Return the most memory that the node has had."""
        lines = Path(f'/proc/{self.process.pid}/status').read_text().splitlines()
        return next(int(line.split()[1]) // 1024 for line in lines if line.startswith('VmHWM'))


@contextmanager
def site(bench: Bench, log: Path, **more) -> Iterator[Site]:
    """Run a node and calibrate it; it has to end well, without a traceback."""
    with running_fake_node(log, FOCAL_PX, idle_solve_s=1000.0, **more) as process:
        running = Site(bench, process, log)
        running.calibrate()
        yield running
        if process.poll() is None:
            interrupt(process, log)
    assert 'Traceback' not in log.read_text()


WRONG_IMAGES = (
    *({'encoding': text} for text in ('banana', '', 'a\x1b[31m\n', 'rgb8', 'mono16', '32FC1', 'nv12', 'yuv422')),
    {'step': 2**31},
    *({'data': array.array('B', content)} for content in (b'', b'short')),
    {'width': 0},
    {'height': 0},
    {'width': 2**32 - 1, 'height': 2**32 - 1, 'step': 2**32 - 1},
    {'width': 2**31, 'height': 1, 'step': 2**31},
)
"""Fields that do not fit the others, by drivers with a fault."""


def test_wrong_images_cost_nothing_and_are_told_once(bench, tmp_path):
    with site(bench, tmp_path / 'log') as running:
        before_mb = running.memory_mb()
        for fields in WRONG_IMAGES:
            running.time_ns += FRAME_NS
            message = running.made()
            for name, value in fields.items():
                setattr(message, name, value)
            running.publisher.publish(message)
            running.send()
        running.send(size=(1, 1))
        running.send(size=(7680, 4320))
        running.require_calibrated('after wrong ones')
        wait_for(lambda: int(running.diagnostics.newest()['unreadable']) >= len(WRONG_IMAGES), 'the count')
        assert int(running.diagnostics.newest()['odd_size']) == 2
        assert running.told('image skipped') == 1 and running.told('withdrawn') == 0
        assert running.memory_mb() - before_mb < MAX_GROWTH_MB


def test_flood_is_counted_and_the_newest_images_are_used(bench, tmp_path):
    with site(bench, tmp_path / 'log') as running:
        before_mb, before = running.memory_mb(), int(running.diagnostics.newest()['received'])
        for _ in range(400):  # without a pause: hundreds a second
            running.time_ns += FRAME_NS
            running.publisher.publish(running.made())
        running.require_calibrated('after the flood')
        newest = running.diagnostics.newest
        wait_for(lambda: float(newest()['image_age_s'] or 0) > 1.5, 'the end of the images')
        counts = {name: int(newest()[name]) for name in ('received', 'used', 'dropped', 'late', 'unreadable')}
        assert counts['received'] > before and counts['dropped'] > 0
        assert counts['received'] == sum(counts.values()) - counts['received'], counts
        assert running.memory_mb() - before_mb < MAX_GROWTH_MB


@pytest.mark.parametrize('steps_h', [(1, -1, 30, -30, -90_000)])
def test_each_step_of_the_clock_is_told_and_the_calibration_holds(bench, tmp_path, steps_h):
    with site(bench, tmp_path / 'log') as running:
        for step_h in steps_h:
            running.time_ns += step_h * HOUR_NS
            running.send(8)
            running.require_calibrated(f'after a step of {step_h} h')
        # an hour forward may be a pause of the camera, and costs nothing
        wait_for(lambda: running.told('the time stamps jumped') >= len(steps_h) - 1, 'the steps in the log')
        assert running.told('the time stamps jumped') == len(steps_h) - 1


def test_driver_that_is_killed_and_comes_back_is_heard(bench, tmp_path):
    quick = {'reliable': True}
    with site(bench, tmp_path / 'log') as running:
        bench.client.destroy_publisher(running.publisher)
        received = lambda: int(running.diagnostics.newest()['received'])  # noqa: E731
        for _ in range(2):
            before = received()
            with running_camera('/image', quick):
                wait_for(lambda was=before: received() > was + 3, 'images of the driver', 2 * PATIENCE_S)
            # its process was killed: nobody told DDS
        wait_for(lambda: running.told('no image for') or None, 'the line of the log', 2 * PATIENCE_S)
        running.publisher = bench.connected(bench.publisher())
        running.time_ns = time.time_ns()
        running.require_calibrated('after the restarts')
        assert running.told('no image for') == 1 and running.told('withdrawn') == 0


@pytest.fixture
def small_disk(ros_home) -> Iterator[Path]:
    """Yield a folder in memory with room for 256 kB, which becomes the home of the node."""
    disk = ros_home / 'disk'
    disk.mkdir()
    mount = ['mount', '-t', 'tmpfs', '-o', 'size=256k', 'tmpfs', str(disk)]
    if os.geteuid() != 0 or shutil.which('mount') is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip('a full disk takes root and the right to mount one')
    yield disk
    subprocess.run(['umount', str(disk)], check=True)


def test_full_disk_is_told_once_and_written_to_when_there_is_room(bench, tmp_path, small_disk):
    store = Store(small_disk / 'camera_info' / 'cam1.yaml')
    filler = small_disk / 'filler'
    with suppress_full_disk(), filler.open('wb') as stream:
        while True:
            stream.write(bytes(4096))
            stream.flush()
    with site(bench, tmp_path / 'log', variables={'ROS_HOME': str(small_disk)}) as running:
        running.wait_told('No space left on device')
        answer = bench.ask('save', NODE)
        assert not answer.success and 'No space left on device' in answer.message
        wait_for(lambda: 'No space left' in running.diagnostics[-1].status[0].message, 'the diagnostics')
        running.require_calibrated('with a full disk')
        filler.unlink()
        assert bench.ask('save', NODE).success
        running.require_calibrated('with room again')
        assert running.told('No space left on device') == 1
    assert store.load().state is StoreState.INTACT
    assert not list(small_disk.rglob('.*~*'))


@contextmanager
def suppress_full_disk() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        assert error.strerror == 'No space left on device'


WITHOUT_ROOTS_RIGHTS = [
    'setpriv',
    '--bounding-set=-dac_override,-dac_read_search',
    '--inh-caps=-dac_override,-dac_read_search',
]
"""Start of a command that lets the modes of files bind root as they bind everybody else."""


def test_folder_that_may_not_be_written_is_told_once(bench, tmp_path, ros_home):
    folder = ros_home / 'camera_info'
    folder.mkdir(mode=0o555)
    under = WITHOUT_ROOTS_RIGHTS if os.geteuid() == 0 else []
    if under and shutil.which('setpriv') is None:
        pytest.skip('modes do not bind root, and setpriv is not there')
    with site(bench, tmp_path / 'log', under=under) as running:
        running.wait_told('Permission denied')
        answer = bench.ask('save', NODE)
        assert not answer.success and 'Permission denied' in answer.message
        running.require_calibrated('with nothing stored')
        assert running.told('Permission denied') == 1
    assert not list(folder.iterdir())


def test_slow_disk_holds_up_neither_images_nor_the_end(bench, tmp_path, ros_home):
    with site(bench, tmp_path / 'log', variables={'FAKE_NODE_SYNC_S': '60'}) as running:
        running.require_calibrated('while it is written')
        began = time.monotonic()
        interrupt(running.process, tmp_path / 'log')
        assert time.monotonic() - began < PROCESS_PATIENCE_S / 2
        assert running.told('a calibration was still being written and is lost') == 1
    assert not list(ros_home.rglob('*.yaml'))


def test_two_nodes_of_one_name_are_told(bench, tmp_path):
    with site(bench, tmp_path / 'log') as running, running_fake_node(tmp_path / 'other', 350.0):
        running.wait_told(f'a second node of this name also publishes {NODE}/camera_info: end one of the two')
        running.require_calibrated('beside the other')
        wait_for(lambda: 'also publishes' in (tmp_path / 'other').read_text(), 'the line of the other')


def children(pid: int) -> set[int]:
    """Return the processes that a process started."""
    found = set()
    for status in Path('/proc').glob('[0-9]*/stat'):
        with suppress(OSError):  # it ended meanwhile
            parent = int(status.read_text().rpartition(')')[2].split()[1])
            found |= {int(status.parent.name)} if parent == pid else set()
    return found


def solver_of(node: subprocess.Popen) -> int:
    """Return the solver process of a node; the other child is the resource tracker of Python."""
    (solver,) = (
        pid for pid in children(node.pid) if b'--multiprocessing-fork' in Path(f'/proc/{pid}/cmdline').read_bytes()
    )
    return solver


def is_running(pid: int) -> bool:
    with suppress(OSError):
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    return False


def test_killed_solver_is_one_line_and_a_killed_node_leaves_no_process(bench, tmp_path):
    log, publisher, node = tmp_path / 'log', bench.publisher(topic='/camera/image'), '/site/autocalib'
    with running_node(log, '-p', 'camera_height:=8.0') as process:
        bench.connected(publisher)
        answers = []

        def is_refused() -> bool:
            publisher.publish(image(time.time_ns()))
            answers.append(bench.ask('calibrate', node))
            return 'refused' in answers[-1].message

        wait_for(is_refused, 'a solution', 2 * PATIENCE_S)
        killed = solver_of(process)
        os.kill(killed, signal.SIGKILL)
        assert 'refused' not in bench.ask('calibrate', node).message
        wait_for(is_refused, 'a solution of another process', 2 * PATIENCE_S)
        assert solver_of(process) != killed
        lines = [line for line in log.read_text().splitlines() if 'ended with status -9' in line]
        assert len(lines) == 1 and 'starts a new process' in lines[0]

        left = children(process.pid)
        os.kill(solver_of(process), signal.SIGSTOP)  # in the middle of a solution, as far as the node can tell
        bench.asked('calibrate', node)
        process.kill()
        process.wait()
        wait_for(lambda: not any(map(is_running, left)), 'the end of its processes', 10.0)
