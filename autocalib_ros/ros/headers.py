"""Time stamps and frames of image headers; corrects faults of drivers, with one warning for each."""

from __future__ import annotations

from collections.abc import Callable

from builtin_interfaces.msg import Time

from autocalib_ros.config import NodeOptions
from autocalib_ros.lens.camera_info_yaml import sanitised_name
from autocalib_ros.ros.messages import stamp_ns

DEFAULT_FRAME = 'camera_optical_frame'
MAX_REPEATED_STAMPS = 30
"""Images in a row with one time stamp after which the clock counts as stopped, or as one of whole seconds."""


class Headers:
    """Time stamps and frames of one camera; `warn` and `now_ns` come from the node."""

    def __init__(
        self, options: NodeOptions, namespace: str, warn: Callable[[str], None], now_ns: Callable[[], int]
    ) -> None:
        self._options, self._namespace, self._warn, self._now_ns = options, namespace.strip('/'), warn, now_ns
        self._warned: set[str] = set()
        self._given_ns, self._repeats = -1, 0

    def stamp_ns(self, stamp: Time) -> int:
        """Return the time of an image in nanoseconds.

        It is the time of receipt if the driver sets none, and from then on once `MAX_REPEATED_STAMPS` images in a row
        had the same stamp.
        """
        given_ns = stamp_ns(stamp)
        if not given_ns:
            self._warn_once('images have no time stamp: using the time of receipt')
            return self._now_ns()
        if self._repeats < MAX_REPEATED_STAMPS:
            self._repeats = self._repeats + 1 if given_ns == self._given_ns else 1
            self._given_ns = given_ns
        if self._repeats < MAX_REPEATED_STAMPS:
            return given_ns
        self._warn_once(
            f'{MAX_REPEATED_STAMPS} images in a row have the same time stamp: using the time of receipt from now on'
        )
        return self._now_ns()

    def frame_id(self, given: str) -> str:
        """Return the frame of an image in tf2: as given without a leading '/', never empty."""
        if not given:
            frame = self._options.camera_frame.lstrip('/') or DEFAULT_FRAME
            self._warn_once(f"images have no frame_id: using '{frame}'")
            return frame
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
        if text not in self._warned:
            self._warned.add(text)
            self._warn(text)
