"""Faults of disks, rights and processes: a node in a process of its own loses nothing, and tells each once."""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from autocalib_ros.results.store import Store, StoreState
from bench import PATIENCE_S, image, wait_for
from calibrated_site import NODE, site
from processes import PROCESS_PATIENCE_S, interrupt, running_fake_node, running_node

pytestmark = [pytest.mark.dds, pytest.mark.exhaustive]


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
