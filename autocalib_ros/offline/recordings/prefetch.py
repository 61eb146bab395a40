"""Decode images ahead in a thread, while earlier ones are processed: OpenCV decodes without Python's lock."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Iterator

from autocalib_ros.offline.recordings.sources import Frame

AHEAD_FRAMES = 8
"""Images that wait at the most: as many as one dear image, with detection and edges, takes longer than the others."""


class _End:
    """What the thread puts after the last image: the exception that ended it, or None."""

    def __init__(self, error: BaseException | None) -> None:
        self.error = error


class _Decoder:
    """Reads an iterator in a thread into a bounded queue."""

    def __init__(self, frames: Iterator[Frame]) -> None:
        self._frames = frames
        self._waiting: queue.Queue[Frame | _End] = queue.Queue(AHEAD_FRAMES)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name='decoder', daemon=True)
        self._thread.start()

    def _read(self) -> None:
        error: BaseException | None = None
        try:
            for frame in self._frames:
                if not self._put(frame):
                    break
        except BaseException as problem:  # is raised in the other thread
            error = problem
        finally:
            if hasattr(self._frames, 'close'):
                self._frames.close()
        self._put(_End(error))

    def _put(self, item: Frame | _End) -> bool:
        """Wait for room; return whether the item was taken, and not the reading stopped."""
        while not self._stop.is_set():
            with contextlib.suppress(queue.Full):
                self._waiting.put(item, timeout=0.1)
                return True
        return False

    def next(self) -> Frame | _End:
        """Wait for the next image, or the end."""
        return self._waiting.get()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()


def prefetched(frames: Iterator[Frame]) -> Iterator[Frame]:
    """Yield images from another iterator, which a thread reads ahead; its exceptions are raised here.

    When this iterator is closed, that one is closed too, in its thread.
    """
    decoder = _Decoder(frames)
    try:
        while not isinstance(item := decoder.next(), _End):
            yield item
        if item.error is not None:
            raise item.error
    finally:
        decoder.stop()
