"""Figures of a report drawn in a process beside the one that writes it: two processors halve the wait."""

from __future__ import annotations

import contextlib
import pickle
import signal
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


class FigureProcess:
    """A second process that draws; without `start`, or on one processor, there is none, and it draws nothing."""

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._futures: dict[int, Future[Any]] = {}

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
            self._futures = {index: self._pool.submit(_draw, draw, index) for index in reversed(range(count))}
        except BrokenProcessPool:
            self._futures = {}

    def leaves(self, index: int) -> bool:
        """Return whether the caller is to draw a figure, which this process has not begun."""
        future = self._futures.get(index)
        return future is None or future.cancel()

    def result(self, index: int) -> Any:
        """Wait for what was drawn. BrokenProcessPool if the process has died."""
        return self._futures[index].result()

    def close(self) -> None:
        """End the process."""
        if self._pool is not None:
            # waits, since Python may fail to end what ends at the same time as itself
            self._pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent
    end_with_parent()


def _load() -> None:
    import autocalib_ros.report.canvas  # noqa: F401  # Matplotlib, before the scene is there


def _hold(scene: bytes) -> None:
    _HELD[:] = [pickle.loads(scene)]


def _draw(draw: Callable[[int, ReportScene], Any], index: int) -> Any:
    return draw(index, _HELD[0])
