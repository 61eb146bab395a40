"""Client of the driver's set_camera_info: the calibration goes where a checkerboard's would have gone."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo

UPLOAD_POLL_S = 0.5
DRIVER_TIMEOUT_S = 10.0
"""A driver that writes to its camera's own memory takes seconds."""
UPLOAD_PERIOD_S = 60.0
"""Real seconds between two calls: a driver may write each to flash memory."""
NO_DRIVER_REMINDER_S = 60.0
"""Real seconds before a driver that is missing, or does not answer, is told again."""


class DriverUpload:
    """Calls `set_camera_info` with the newest message offered, never twice at once.

    `say(text, good=)` hears what came of it.
    """

    def __init__(self, node: Node, say: Callable[..., None]) -> None:
        self._client = node.create_client(SetCameraInfo, 'set_camera_info')
        self._name = node.resolve_service_name('set_camera_info')
        self._say = say
        self._lock = threading.Lock()
        self._pending: CameraInfo | None = None
        self._call: Future | None = None
        self._called_at = -UPLOAD_PERIOD_S
        self._warned_at = -NO_DRIVER_REMINDER_S
        node.create_timer(UPLOAD_POLL_S, self._poll, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def offer(self, message: CameraInfo) -> None:
        """Send this soon, unless a newer one comes before; from any thread."""
        with self._lock:
            self._pending = message

    def withdraw(self) -> None:
        """Send nothing that has not been sent; from any thread."""
        with self._lock:
            self._pending = None

    def _poll(self) -> None:
        """Look after the call that runs, or start the next; in the executor's thread."""
        now = time.monotonic()
        if self._call is not None:
            if now - self._called_at > DRIVER_TIMEOUT_S:
                self._client.remove_pending_request(self._call)
                self._call = None
                self._say(f'{self._name}: the driver did not answer within {DRIVER_TIMEOUT_S:.0f} s', good=False)
            return
        if self._pending is None or now - self._called_at < UPLOAD_PERIOD_S:
            return
        if not self._client.service_is_ready():
            if now - self._warned_at > NO_DRIVER_REMINDER_S:
                self._warned_at = now
                self._say(
                    f'no driver serves {self._name}: remap it with -r set_camera_info:=/your/driver/set_camera_info',
                    good=False,
                )
            return
        with self._lock:
            message, self._pending = self._pending, None
        if message is None:
            return
        self._called_at = now
        self._call = self._client.call_async(SetCameraInfo.Request(camera_info=message))
        self._call.add_done_callback(self._answered)

    def _answered(self, call: Future) -> None:
        if call is not self._call:
            return  # given up already
        self._call = None
        answer = call.result()
        if answer is not None and answer.success:
            self._say(f'{self._name}: the driver took the calibration', good=True)
        else:
            why = getattr(answer, 'status_message', '') or 'no reason given'
            self._say(f'{self._name}: the driver refused the calibration: {why}', good=False)
