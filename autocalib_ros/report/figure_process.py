"""Figures of a report drawn in a process beside the one that writes it: two processors halve the wait."""

from __future__ import annotations

import contextlib
import pickle
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

from autocalib_ros.util.child_process import end_with_parent, usable_processors

if TYPE_CHECKING:
    from autocalib_ros.report.scene import ReportScene

_HELD: list[ReportScene] = []
"""In the child process: the scene whose figures it draws."""


AHEAD = 2
"""Figures that are given to the process: the next one waits there while one is drawn. None is taken back, which Python
before 3.12 does not survive where the process dies."""


class FigureProcess:
    """A second process that draws; without `start`, or on one processor, there is none, and it draws nothing."""

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._futures: dict[int, Future[Any]] = {}
        self._draw: Callable[[int, ReportScene], Any] | None = None
        self._left: list[int] = []
        self._lock = threading.Lock()

    def start(self) -> None:
        """Start the process while there is something else to do: it takes a second to load Matplotlib."""
        if self._pool is not None or usable_processors() < 2:
            return
        with contextlib.suppress(NotImplementedError, OSError):  # without semaphores, as in some sandboxes, none starts
            # spawn, not fork: a fork would copy locks held by the other threads
            self._pool = ProcessPoolExecutor(1, mp_context=get_context('spawn'), initializer=_prepare)
            self._pool.submit(_load)

    def begin(self, draw: Callable[[int, ReportScene], Any], scene: ReportScene, count: int) -> None:
        """Begin to draw the figures 0 to `count` of a scene, the last one first."""
        if self._pool is None:
            return
        try:
            # pickled here: the thread of the pool would meet a scene that changes, by what is drawn of it meanwhile
            self._pool.submit(_hold, pickle.dumps(scene, pickle.HIGHEST_PROTOCOL))
        except BrokenProcessPool:
            return
        self._draw, self._left = draw, list(range(count))
        for _ in range(AHEAD):
            self._submit()

    def _submit(self, before: Future[Any] | None = None) -> None:
        """Begin to draw the last figure that is left, unless that before could not be drawn."""
        if before is not None and before.exception() is not None:
            return  # the pool may be ending, and holds its lock
        with self._lock:
            if not self._left or self._pool is None or self._draw is None:
                return
            index = self._left.pop()
            try:
                future = self._pool.submit(_draw, self._draw, index)
            except BrokenProcessPool:
                return
            self._futures[index] = future
        future.add_done_callback(self._submit)  # outside of the lock: it is called at once if the figure is there

    def leaves(self, index: int) -> bool:
        """Return whether the caller is to draw a figure, which this process has not begun and then leaves to it."""
        with self._lock:
            if index in self._left:
                self._left.remove(index)
            return index not in self._futures

    def result(self, index: int) -> Any:
        """Wait for what was drawn. BrokenProcessPool if the process has died."""
        return self._futures[index].result()

    def close(self) -> None:
        """End the process."""
        if self._pool is not None:
            # waits, since Python may fail to end what ends at the same time as itself
            self._pool.shutdown()


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent
    end_with_parent()


def _load() -> None:
    import autocalib_ros.report.canvas  # noqa: F401  # Matplotlib, before the scene is there


def _hold(scene: bytes) -> None:
    _HELD[:] = [pickle.loads(scene)]


def _draw(draw: Callable[[int, ReportScene], Any], index: int) -> Any:
    return draw(index, _HELD[0])
