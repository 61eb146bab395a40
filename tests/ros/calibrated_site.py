"""A node in a process of its own that has calibrated, for tests of what may happen to it."""

import array
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CameraInfo

from autocalib_ros.ros.messages import stamp_ns
from bench import PATIENCE_S, Bench, image, wait_for
from processes import DiagnosticsLog, interrupt, running_fake_node

FRAME_NS = 10**8
FOCAL_PX = 311.0
ANSWER_S = 0.3
"""Within this a node answers an image, unless the image was lost; it takes 10 ms on an idle machine."""
NODE = '/cam1/autocalib'
INFO = f'{NODE}/camera_info'


class Site:
    """A node that has calibrated, its log, and the camera that sends it images."""

    def __init__(self, bench: Bench, process: subprocess.Popen, log: Path) -> None:
        self.bench, self.process, self._log = bench, process, log
        self.diagnostics = DiagnosticsLog()
        bench.client.create_subscription(DiagnosticArray, '/diagnostics', self.diagnostics.append, 10)
        self.infos: list[CameraInfo] = bench.collect(CameraInfo, INFO)
        self.publisher = bench.connected(bench.publisher())
        self.time_ns = time.time_ns()

    def send(self, count: int = 1, **more) -> None:
        """Send images; no two are the same, as those of a sensor."""
        for _ in range(count):
            self.time_ns += FRAME_NS
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
            return bool(self.bench.client.count_publishers(INFO) and self.diagnostics)

        wait_for(is_heard, 'the node', 2 * PATIENCE_S)
        wait_for(lambda: self.bench.ask('calibrate', NODE).success, 'a calibration')
        self.require_calibrated('after the start')

    def require_calibrated(self, when: str) -> None:
        """Send good images until one of them has got the CameraInfo of the calibration."""
        sent_after, due = self.time_ns, 0.0

        def is_answered() -> bool:
            nonlocal due
            if time.monotonic() >= due:  # not more than a slow machine can follow
                due = time.monotonic() + ANSWER_S
                self.send()
            return any(
                stamp_ns(info.header.stamp) > sent_after and info.k[0] == FOCAL_PX for info in list(self.infos[-20:])
            )

        wait_for(is_answered, f'camera_info of an image {when}')

    def told(self, text: str) -> int:
        """Return how many lines of the log hold a text."""
        return sum(text in line for line in self._log.read_text().splitlines())

    def longest_line(self) -> int:
        """Return the length of the longest line of the log."""
        return max(map(len, self._log.read_text().splitlines()))

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
