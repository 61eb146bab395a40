"""Client of the driver's set_camera_info service: uploads the calibration, as camera_calibration does."""

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
"""Real seconds between two checks of a running or pending call."""
DRIVER_TIMEOUT_S = 10.0
"""Real seconds to wait for the answer: a driver that writes to the camera's memory takes seconds."""
UPLOAD_PERIOD_S = 60.0
"""Minimum real seconds between two calls: a driver may write each to flash memory."""
NO_DRIVER_REMINDER_S = 60.0
"""Real seconds before the warning of a missing driver is repeated."""


class DriverUpload:
    """Calls `set_camera_info` with the newest message offered, one call at a time.

    `log(text, good=)` is called with the outcome.
    """

    def __init__(self, node: Node, log: Callable[..., None]) -> None:
        self._client = node.create_client(SetCameraInfo, 'set_camera_info')
        self._name = node.resolve_service_name('set_camera_info')
        self._log = log
        self._lock = threading.Lock()
        self._pending: CameraInfo | None = None
        self._call: Future | None = None
        self._called_at = -UPLOAD_PERIOD_S
        self._warned_at = -NO_DRIVER_REMINDER_S
        node.create_timer(UPLOAD_POLL_S, self._poll, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def offer(self, message: CameraInfo) -> None:
        """Upload this, unless a newer one replaces it; thread-safe."""
        with self._lock:
            self._pending = message

    def withdraw(self) -> None:
        """Drop the pending upload; thread-safe."""
        with self._lock:
            self._pending = None

    def _poll(self) -> None:
        """Check the running call, or start the next; in the executor's thread."""
        now = time.monotonic()
        if self._call is not None:
            if now - self._called_at > DRIVER_TIMEOUT_S:
                self._client.remove_pending_request(self._call)
                self._call = None
                self._log(f'{self._name}: no answer from the driver within {DRIVER_TIMEOUT_S:.0f} s', good=False)
            return
        if self._pending is None or now - self._called_at < UPLOAD_PERIOD_S:
            return
        if not self._client.service_is_ready():
            if now - self._warned_at > NO_DRIVER_REMINDER_S:
                self._warned_at = now
                self._log(
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
        if self._call is None or call is not self._call:
            return  # timed out before
        self._call = None
        answer = call.result()
        if answer is not None and answer.success:
            self._log(f'{self._name}: the driver accepted the calibration', good=True)
        else:
            why = getattr(answer, 'status_message', '') or 'no reason given'
            self._log(f'{self._name}: the driver rejected the calibration: {why}', good=False)
