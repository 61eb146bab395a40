"""Time stamps and frames of image headers; corrects faults of drivers, with one warning for each."""

from __future__ import annotations

from collections.abc import Callable

from builtin_interfaces.msg import Time

from autocalib_ros.config import NodeOptions
from autocalib_ros.lens.camera_info_yaml import sanitised_name
from autocalib_ros.perception.header_stamps import HeaderStamps

MAX_FRAME_LENGTH = 255
"""Longest frame in characters, as names of files and topics."""
MAX_WARNINGS = 20
"""Most warnings in all: a driver with a new frame in each image must not fill memory and log."""
DEFAULT_FRAME = 'camera_optical_frame'


class Headers:
    """Time stamps and frames of one camera; `warn` and `now_ns` come from the node."""

    def __init__(
        self, options: NodeOptions, namespace: str, warn: Callable[[str], None], now_ns: Callable[[], int]
    ) -> None:
        self._options, self._namespace, self._warn, self._now_ns = options, namespace.strip('/'), warn, now_ns
        self._warned: set[str] = set()
        self._stamps = HeaderStamps(warn)

    def stamp_ns(self, stamp: Time) -> int:
        """Return the time of the next image in nanoseconds: its stamp, or if that is no use its time of receipt."""
        return self._stamps.choose(stamp.sec, stamp.nanosec, self._now_ns())

    def frame_id(self, given: str) -> str:
        """Return the frame of an image in tf2: as given without a leading '/', never empty."""
        if not given:
            frame = self._options.camera_frame.lstrip('/') or DEFAULT_FRAME
            self._warn_once(f"images have no frame_id: using '{frame}'")
            return frame
        if not given.isprintable() or len(given) > MAX_FRAME_LENGTH:
            clean = ''.join(letter if letter.isprintable() else '_' for letter in given[:MAX_FRAME_LENGTH])
            self._warn_once(
                f"images have a frame_id that no consumer can show ({len(given)} characters): using '{clean}'"
            )
            given = clean
        if given.startswith('/'):
            self._warn_once(f"images have the frame_id '{given}': the leading '/' is removed, tf2 rejects it")
        return given.lstrip('/') or DEFAULT_FRAME

    def camera_frame(self, image_frame: str) -> str:
        """Return the frame whose pose is published."""
        return self._options.camera_frame.lstrip('/') or image_frame

    def camera_name(self, image_frame: str) -> str:
        """Return the camera's name in letters, digits and _, as camera_info_manager needs it.

        '' if it depends on the frame of the first image.
        """
        return sanitised_name(self._options.camera_name or self._namespace or image_frame)

    def ground_frame(self, image_frame: str) -> str:
        """Return the frame of the ground plane; it contains the camera's name, so that cameras do not collide."""
        return self._options.ground_frame.lstrip('/') or f'{self.camera_name(image_frame)}_ground'

    def _warn_once(self, text: str) -> None:
        if text not in self._warned and len(self._warned) < MAX_WARNINGS:
            self._warned.add(text)
            self._warn(text)
