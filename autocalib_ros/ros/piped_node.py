"""A live node whose images come through a pipe, as fast as it takes them: for `autocalib benchmark soak`.

    python -m autocalib_ros.ros.piped_node FD --ros-args -p camera_height:=8.0

FD is the descriptor of a `multiprocessing` pipe. Everything but the subscription is that of the live node. A request is
an image: its stamp in nanoseconds, grey levels (H, W), and what was seen in it besides (FrameObservations, in seconds
since the first image) or None; it has no answer. None asks for `PipedNode.numbers` once all images before are done.
"""

from __future__ import annotations

import sys
import threading
import time
from array import array
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image

from autocalib_ros.calibrator import AutoCalibrator, ImageIntake
from autocalib_ros.config import Options
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.perception.detector.detector import VehicleDetector
from autocalib_ros.perception.observer import FrameObservations
from autocalib_ros.ros.autocalib_node import AutocalibNode
from autocalib_ros.ros.messages import time_message
from autocalib_ros.ros.solver_activity import SolverState
from autocalib_ros.ros.spinning import spin_until, stop_on_signals
from autocalib_ros.util.threads import limit_blas_threads

MOST_WAITING = 4
"""Images that may wait for the perception thread: half of its queue, so that none is dropped."""
SOLVING_PAUSE_S = 0.5
"""Longest pause between two images during a solution, real seconds: the node tells a stream that stops for longer."""
POLL_S = 0.0005
"""Real seconds between two looks whether the node can take another image: a fraction of the time of one."""


class PipedCalibrator(AutoCalibrator):
    """Gathers also the observations that come with the images; `added` holds them by stamp."""

    def __init__(self, options: Options, detector: VehicleDetector | None, added: dict[int, FrameObservations]) -> None:
        super().__init__(options, detector)
        self._added = added

    def add_image(self, stamp_ns: int, image: np.ndarray) -> ImageIntake:
        """Take one image as `AutoCalibrator` does, and what came with it."""
        intake = super().add_image(stamp_ns, image)
        observed, stream = self._added.pop(stamp_ns, None), self._stream
        if observed is not None and stream is not None:
            stream.take(replace(observed, view=stream.observer.view), stream.time_s)
        return intake


class PipedNode(AutocalibNode):
    """The live node, fed by `show`."""

    def __init__(self) -> None:
        self._added: dict[int, FrameObservations] = {}
        super().__init__(calibrator=lambda options, detector: PipedCalibrator(options, detector, self._added))

    def serve(self, pipe: Connection, stop: threading.Event) -> None:
        """Answer requests until the end of the pipe, then stop."""
        try:
            while not stop.is_set():
                request = pipe.recv()
                if request is None:
                    self._wait_for_room(0)
                    pipe.send(self.numbers())
                else:
                    self.show(*request)
        except EOFError:
            pass
        finally:
            stop.set()

    def show(self, stamp_ns: int, image: np.ndarray, observed: FrameObservations | None) -> None:
        """Take an image as from the topic, once there is room for it and no solution runs."""
        self._wait_for_room(MOST_WAITING)
        height, width = image.shape
        message = Image(width=width, height=height, step=width, encoding='mono8', data=array('B', image.tobytes()))
        message.header.stamp, message.header.frame_id = time_message(stamp_ns), 'camera'
        if observed is not None:
            self._added[stamp_ns] = observed
        self._input.take(message)

    def _wait_for_room(self, most: int) -> None:
        """Wait until at most so many images wait for the perception thread; during a solution at the pace of a camera.

        A solution takes seconds of real time, in which simulated hours would pass.
        """
        until = time.monotonic() + SOLVING_PAUSE_S
        while self._waiting > most or (
            self._worker.solver.summary().state is SolverState.SOLVING and time.monotonic() < until
        ):
            time.sleep(POLL_S)

    @property
    def _waiting(self) -> int:
        counters = self._worker.counters
        done = counters.used + counters.dropped + counters.unreadable + counters.late + counters.odd_size
        return counters.received - done

    def numbers(self) -> dict[str, Any]:
        """Return what the node has come to."""
        published, view = self.publication.published, self._worker.view
        result = None if published is None else published.result
        ground = None if result is None else result.ground
        return {
            'used': self._worker.counters.used,
            'lost': self._worker.counters.received - self._worker.counters.used,
            'state': self.publication.state.value,
            'view': str(view),
            'withheld': bool(self.publication.withheld),
            'focal_px': None if result is None else result.camera.focal_px,
            'focal_sigma_px': None if result is None else result.stddev.focal_px,
            'tilt_deg': None if ground is None else float(tilt_and_roll_deg(ground.normal_in_camera)[0]),
            'tilt_sigma_deg': None if result is None else result.stddev.tilt_deg,
            'tracks': 0 if result is None else result.evidence.tracks,
        }


def main(arguments: list[str]) -> int:
    """Run the node on the pipe whose descriptor is the first argument; return the exit status."""
    pipe = Connection(int(arguments.pop(1)))
    stop = stop_on_signals()
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = PipedNode()
        threading.Thread(target=node.serve, args=(pipe, stop), name='pipe', daemon=True).start()
        try:
            spin_until(node, stop)
        finally:
            node.close()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    limit_blas_threads()
    sys.exit(main(sys.argv))
