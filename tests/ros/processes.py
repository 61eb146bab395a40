"""Nodes and cameras in processes of their own, for tests over DDS."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
NODE = [sys.executable, '-m', 'autocalib_ros.ros.node', '--ros-args', '-r', '__ns:=/site', '-r', 'image:=/camera/image']
CAMERA = [sys.executable, str(HERE / 'camera.py')]
PROCESS_PATIENCE_S = 90.0
"""Processes take seconds to start, and much longer on a busy machine."""


class DiagnosticsLog(list):
    """Messages of /diagnostics, newest last."""

    def newest(self) -> dict[str, str]:
        return {} if not self else {item.key: item.value for item in self[-1].status[0].values}

    def used(self) -> int:
        return int(self.newest().get('used', 0))


def environment(**more: str) -> dict[str, str]:
    """Return the variables of a process that finds this package, which may not be installed."""
    return {**os.environ, 'PYTHONPATH': str(ROOT), **more}


@contextmanager
def running_node(log: Path, *arguments: str) -> Iterator[subprocess.Popen]:
    """Run a node of /site with its own solver; it is interrupted at the end, unless a test ended it."""
    with log.open('w') as stream, subprocess.Popen([*NODE, *arguments], stderr=stream, env=environment()) as process:
        try:
            yield process
            if process.poll() is None:
                interrupt(process, log)
        finally:
            process.kill()
    assert 'Traceback' not in log.read_text()


@contextmanager
def running_fake_node(
    log: Path,
    focal_px: float,
    seconds: float = 0.0,
    *,
    variables: dict[str, str] | None = None,
    under: Sequence[str] = (),
    **parameters: Any,
) -> Iterator[subprocess.Popen]:
    """Run a node of camera /cam1 whose solver finds a focal length after some seconds; killed at the end.

    `variables` are put into its environment; `under` is the start of its command.
    """
    more = [text for name, value in {'camera_height': 8.0, **parameters}.items() for text in ('-p', f'{name}:={value}')]
    remapped = ['--ros-args', '-r', '__ns:=/cam1', '-r', 'image:=/image', *more]
    command = [sys.executable, str(HERE / 'fake_node.py'), str(focal_px), str(seconds), *remapped]
    with (
        log.open('w') as stream,
        subprocess.Popen([*under, *command], stderr=stream, env=environment(**(variables or {}))) as process,
    ):
        try:
            yield process
        finally:
            process.kill()


def interrupt(process: subprocess.Popen, log: Path) -> None:
    """End a node as a launch file does; it has to end well."""
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=PROCESS_PATIENCE_S) == 0, log.read_text()


@contextmanager
def running_camera(topic: str, *phases: dict) -> Iterator[Callable[[], None]]:
    """Yield a function that sends the camera into its next phase."""
    with subprocess.Popen([*CAMERA, topic, json.dumps(phases)], stdin=subprocess.PIPE, text=True) as process:

        def go_on() -> None:
            process.stdin.write('\n')
            process.stdin.flush()

        try:
            yield go_on
        finally:
            process.kill()
