"""What lies beside the stored calibration: views and history; written again when a disk was full or a folder missing.

Needs no ROS.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any

from autocalib_ros.perception.view_file import write_views
from autocalib_ros.perception.view_watch import KnownView
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.history import MAX_VERSIONS, append_version
from autocalib_ros.results.store import Store, calibration_checksum
from autocalib_ros.ros.store_writer import SAVE_PERIOD_S, StoreWriter


class SideFiles:
    """Writes through the thread of `writer`, one thing at a time; `clock` returns real seconds.

    To be called from one thread, but for `remember`.
    """

    def __init__(self, writer: StoreWriter, clock: Callable[[], float] = time.monotonic) -> None:
        self._writer, self._clock = writer, clock
        self._versions: deque[tuple[Store, dict[str, Any]]] = deque(maxlen=MAX_VERSIONS)
        self._views_stored: tuple[int, ...] = ()
        self._failed_at = -SAVE_PERIOD_S
        self._running: Future = Future()
        self._running.set_result(None)

    def remember(self, store: Store, entry: dict[str, Any]) -> None:
        """Append a version to the history, at once if nothing is in the way."""
        self._versions.append((store, entry))
        self._writer.run(self._write_versions)

    def catch_up(self) -> None:
        """Write versions that could not be written; to be called now and then."""
        if self._versions and self._is_free():
            self._start(self._write_versions, lambda: None)

    def keep_views(self, store: Store, calibration: Calibration, views: Sequence[KnownView]) -> None:
        """Write the views of the stored calibration if they are others than those written last."""
        shown = tuple(map(id, (calibration, *views)))
        if views and shown != self._views_stored and self._is_free():
            self._start(
                partial(write_views, store.views, calibration_checksum(calibration), views),
                lambda: setattr(self, '_views_stored', shown),
            )

    def _is_free(self) -> bool:
        """Whether nothing is being written, and the last fault was a while ago."""
        return self._running.done() and self._clock() - self._failed_at >= SAVE_PERIOD_S

    def _start(self, step: Callable[[], Any], succeeded: Callable[[], None]) -> None:
        def note(done: Future) -> None:
            if isinstance(done.result(), Exception):
                self._failed_at = self._clock()  # the writer tells the fault of the calibration itself
            else:
                succeeded()

        self._running = self._writer.run(step)
        self._running.add_done_callback(note)

    def _write_versions(self) -> None:
        while self._versions:
            store, entry = self._versions[0]
            append_version(store.history, entry)
            self._versions.popleft()
