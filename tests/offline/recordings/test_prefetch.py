"""Images read ahead in a thread."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from autocalib_ros.errors import InputError
from autocalib_ros.offline.recordings.prefetch import AHEAD_FRAMES, prefetched
from autocalib_ros.offline.recordings.sources import Frame


class Images:
    """Images by their number; it counts what was read, and notes that it was closed."""

    def __init__(self, count, error=None):
        self.read, self.closed, self._count, self._error = 0, threading.Event(), count, error

    def frames(self):
        try:
            for index in range(self._count):
                self.read += 1
                yield Frame(index, np.zeros((2, 2), np.uint8))
            if self._error:
                raise self._error
        finally:
            self.closed.set()


def test_all_images_come_in_order():
    images = Images(50)
    assert [frame.stamp_ns for frame in prefetched(images.frames())] == list(range(50))
    assert images.closed.is_set()


def test_an_error_comes_after_the_images_before_it():
    seen = []
    with pytest.raises(InputError, match='torn'):
        seen.extend(prefetched(Images(5, InputError('torn')).frames()))
    assert len(seen) == 5


def test_what_is_left_early_is_closed_and_not_read_on():
    images = Images(1000)
    frames = prefetched(images.frames())
    assert next(frames).stamp_ns == 0
    frames.close()
    assert images.closed.is_set() and images.read <= AHEAD_FRAMES + 3
    assert not [thread for thread in threading.enumerate() if thread.name == 'decoder']
