"""Recordings as streams of frames: which kind of file it is, and what all kinds have in common."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from autocalib_ros.errors import InputError, UsageError

BAG_SUFFIXES = ('.bag', '.mcap', '.db3')


@dataclass(frozen=True)
class Frame:
    """One image, grey (H, W) or BGR (H, W, 3) uint8, perhaps read-only, and when it was taken."""

    stamp_ns: int
    image: np.ndarray


@dataclass(frozen=True)
class StoredImage:
    """An image as a new bag will hold it: when it was recorded, its header, and its message where there is one."""

    recorded_ns: int
    stamp_ns: int
    frame_id: str
    cdr: bytes | memoryview | None = None


@dataclass(frozen=True)
class TimeWindow:
    """The part of a recording that is asked for, in seconds from its first image."""

    start_s: float = 0.0
    duration_s: float | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start_s) and self.start_s >= 0):
            raise UsageError(f'the start lies at zero seconds or later, got {self.start_s}')
        if self.duration_s is not None and not (math.isfinite(self.duration_s) and self.duration_s > 0):
            raise UsageError(f'the duration is a positive number of seconds, got {self.duration_s}')

    @property
    def is_whole_recording(self) -> bool:
        """Whether it is all of the recording."""
        return self.start_s == 0 and self.duration_s is None

    @property
    def bounds_ns(self) -> tuple[int, int | None]:
        """First and one past the last nanosecond, the latter None at the recording's end."""
        start = round(self.start_s * 1e9)
        return start, None if self.duration_s is None else start + round(self.duration_s * 1e9)

    def overlap_s(self, recording_s: float) -> float:
        """Return how much of a recording of that length falls into the window, in seconds."""
        rest = max(recording_s - self.start_s, 0.0)
        return rest if self.duration_s is None else min(rest, self.duration_s)


class Source(Protocol):
    """A recording of one camera; it can be gone through more than once."""

    name: str
    """What a person calls it: the file or folder."""
    topic: str
    """Image topic; '' in a video."""
    image_type: str
    """Message type of the images; '' in a video."""
    camera_frame: str
    """The frame_id of the images, '' where there is none."""
    total: int | None
    """About how many frames will come."""
    duration_s: float | None
    """About how long the frames last."""

    def frames(self) -> Iterator[Frame]:
        """Decode the images of the window, in order of time; InputError when there is none."""

    def stored(self) -> Iterator[StoredImage]:
        """Go through the images of the window without decoding them."""


def no_image_error(name: str, window: TimeWindow, recording_s: float | None) -> InputError:
    """Return the error of a recording that gives no image, or none in the window."""
    if window.start_s > 0:
        length = '' if recording_s is None else f', which lasts {recording_s:.1f} s'
        return InputError(f'no image {window.start_s:g} s after the start of {name}{length}')
    return InputError(f'{name} gives no image')


def camera_name(source: Source) -> str:
    """Return the namespace of the image topic, else the frame of its images, else 'camera'."""
    namespace = '_'.join(image_topic(source).strip('/').split('/')[:-1])
    return namespace or source.camera_frame or 'camera'


def image_topic(source: Source) -> str:
    """Return the image topic without the suffix that image_transport gives to compressed images."""
    compressed = source.image_type.endswith('/CompressedImage')
    return source.topic.removesuffix('/compressed') if compressed else source.topic
