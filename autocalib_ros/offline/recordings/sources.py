"""Interface of recordings: frames, stored images, and the time window of a recording."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from autocalib_ros.errors import InputError, UsageError

BAG_SUFFIXES = ('.bag', '.mcap', '.db3')
"""File name endings of ROS recordings: ROS 1, and the two storage formats of rosbag2."""


@dataclass(frozen=True)
class Frame:
    """An image with its time stamp: grey (H, W) or BGR (H, W, 3), uint8, possibly read-only."""

    stamp_ns: int
    image: np.ndarray


@dataclass(frozen=True)
class StoredImage:
    """An image as stored in a recording: receive time, header, and serialised message (None in a video)."""

    recorded_ns: int
    stamp_ns: int
    frame_id: str
    cdr: bytes | memoryview | None = None


@dataclass(frozen=True)
class TimeWindow:
    """A time window of a recording, in seconds from its first image. Raises UsageError for invalid values."""

    start_s: float = 0.0
    duration_s: float | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start_s) and self.start_s >= 0):
            raise UsageError(f'the start must be at least 0 seconds, got {self.start_s}')
        if self.duration_s is not None and not (math.isfinite(self.duration_s) and self.duration_s > 0):
            raise UsageError(f'the duration must be a positive number of seconds, got {self.duration_s}')

    @property
    def is_whole_recording(self) -> bool:
        """Whether the window covers the whole recording."""
        return self.start_s == 0 and self.duration_s is None

    @property
    def bounds_ns(self) -> tuple[int, int | None]:
        """First nanosecond and end (exclusive) of the window; the end is None without a duration."""
        start = round(self.start_s * 1e9)
        return start, None if self.duration_s is None else start + round(self.duration_s * 1e9)

    def overlap_s(self, recording_s: float) -> float:
        """Return the seconds of a recording of length `recording_s` that fall into the window."""
        rest = max(recording_s - self.start_s, 0.0)
        return rest if self.duration_s is None else min(rest, self.duration_s)


class Source(Protocol):
    """A recording of one camera; it can be iterated more than once."""

    name: str
    """File or folder name for messages."""
    window: TimeWindow
    """The part of it that is read."""
    topic: str
    """Image topic; '' in a video."""
    image_type: str
    """Message type of the images; '' in a video."""
    camera_frame: str
    """The frame_id of the images, '' if unknown."""
    total: int | None
    """Approximate number of frames in the window; None if unknown."""
    duration_s: float | None
    """Approximate duration of the window in seconds; None if unknown."""
    pixel_aspect: float
    """Width of a pixel over its height, as the recording says; 0 if it says nothing."""
    is_live: bool
    """Whether images come as they are taken: they wait for nobody, are read once, and have no known end."""

    def frames(self) -> Iterator[Frame]:
        """Yield the decoded images of the window in order of time; InputError without an image."""

    def stored(self) -> Iterator[StoredImage]:
        """Yield the stored images of the window without decoding them."""


def no_image_error(name: str, window: TimeWindow, recording_s: float | None) -> InputError:
    """Return the error for a recording without an image, or without one in the window."""
    if window.start_s > 0:
        length = '' if recording_s is None else f', which lasts {recording_s:.1f} s'
        return InputError(f'no image {window.start_s:g} s after the start of {name}{length}')
    return InputError(f'{name} has no images')


def camera_name(source: Source) -> str:
    """Return the namespace of the image topic; without one the frame of the images, else 'camera'."""
    namespace = '_'.join(image_topic(source).strip('/').split('/')[:-1])
    return namespace or source.camera_frame or 'camera'


def image_topic(source: Source) -> str:
    """Return the image topic without the image_transport suffix of compressed images."""
    compressed = source.image_type.endswith('/CompressedImage')
    return source.topic.removesuffix('/compressed') if compressed else source.topic
