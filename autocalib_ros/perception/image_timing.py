"""Intake of the images of one stream: gives each its time of exposure, in order, and holds those in doubt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from autocalib_ros.perception.frame_clock import ClockSummary, FrameClock


@dataclass(frozen=True)
class ReadyImage:
    """An image with its time of exposure, nanoseconds on a clock that is never set."""

    time_ns: int
    image: np.ndarray
    lost: int = 0
    """Images that were lost between the one before and this one."""


@dataclass(frozen=True)
class Taken:
    """What became of the images with a new one."""

    ready: tuple[ReadyImage, ...]
    """Images to use now, in order of time."""
    restarted: bool
    """The stamps began anew: `ready` are the first images of a new time."""
    is_late: bool
    """The new image is left out, unless later ones show that the clock was set back."""


class ImageTiming:
    """A frame clock with the images that wait for it; it keeps copies of these few only.

    `follows` tells whether an image shows the traffic one step after the last one that was ready; False if unknown.
    """

    def __init__(self, follows: Callable[[np.ndarray], bool] = lambda image: False) -> None:
        self._clock = FrameClock(lambda number: follows(self._waiting[number]))
        self._waiting: dict[int, np.ndarray] = {}
        self._arrived = 0

    @property
    def offset_ns(self) -> int:
        """Nanoseconds to add to a time for that by the present clock of the camera."""
        return self._clock.offset_ns

    def summary(self) -> ClockSummary:
        """Return what the clock saw so far."""
        return self._clock.summary()

    def add(self, stamp_ns: int, image: np.ndarray) -> Taken:
        """Take the next image; return the images that have their time now."""
        self._waiting[self._arrived] = image
        reading = self._clock.add(stamp_ns)
        ready = tuple(ReadyImage(timed.time_ns, self._waiting[timed.image], timed.lost) for timed in reading.timed)
        held = self._clock.held
        self._waiting = {number: kept for number, kept in self._waiting.items() if number in held}
        if self._arrived in held:
            self._waiting[self._arrived] = image.copy()
        self._arrived += 1
        return Taken(ready, reading.restarted, reading.is_late)
