"""Background thread that writes calibrations to the store."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any

from autocalib_ros.errors import AutocalibError
from autocalib_ros.results.store import Store, StoredCalibration

SAVE_PERIOD_S = 60.0
"""Minimum real seconds between two automatic writes: solutions can follow each other within seconds, for months, and
flash memory wears."""


class StoreWriter:
    """Writes calibrations one at a time, of those pending only the newest. Thread-safe.

    `warn(text)` is called from the thread when a write fails, once per reason; the write is repeated.
    """

    def __init__(self, warn: Callable[[str], None], period_s: float = SAVE_PERIOD_S) -> None:
        self._warn, self._period_s = warn, period_s
        self._changed = threading.Condition()
        self._steps: list[tuple[Callable[[], Any], Future]] = []
        self._pending: Callable[[], None] | None = None
        self._due = time.monotonic()
        self._closed = False
        self.saved: StoredCalibration | None = None
        """What this run wrote last; None before that."""
        self.fault = ''
        """Reason why the last automatic write failed; '' if it succeeded."""
        self._thread = threading.Thread(target=self._run, name='store writer', daemon=True)
        self._thread.start()

    def offer(self, store: Store, stored: StoredCalibration) -> None:
        """Write this at once, or `period_s` after the last write; a newer offer replaces it."""
        with self._changed:
            self._pending = partial(self._save, store, stored)
            self._changed.notify_all()

    def _save(self, store: Store, stored: StoredCalibration) -> None:
        store.save(stored)
        self.saved = stored

    def withdraw(self) -> None:
        """Drop the pending write."""
        with self._changed:
            self._pending = None

    def run(self, step: Callable[[], Any]) -> Future:
        """Run a step in the thread at once; the future holds its result, or its AutocalibError as a value."""
        future: Future = Future()
        with self._changed:
            if self._closed:
                future.set_result(AutocalibError('the node is shutting down'))
            else:
                self._steps.append((step, future))
                self._changed.notify_all()
        return future

    def close(self, timeout_s: float) -> bool:
        """Write what is pending and stop; return whether that finished in time."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not (self._closed or self._steps or self._seconds_until_due() == 0.0):
                    self._changed.wait(self._seconds_until_due())
                steps, self._steps = self._steps, []
                pending = self._take_pending()
                ends = self._closed
            for step, future in steps:
                future.set_result(self._guarded(step))
            if pending is not None:
                self._write(pending)
            if ends:
                return

    def _write(self, pending: Callable[[], None]) -> None:
        result = self._guarded(pending)
        fault = str(result) if isinstance(result, Exception) else ''
        if fault:
            with self._changed:  # retry: the disk may have space again
                self._pending = self._pending or pending
        if fault and fault != self.fault:
            self._warn(fault)
        self.fault = fault

    def _seconds_until_due(self) -> float | None:
        """Return the seconds until the pending write is due; None without one."""
        return None if self._pending is None else max(0.0, self._due - time.monotonic())

    def _take_pending(self) -> Callable[[], None] | None:
        """Return the pending write if it is due or the thread is closing."""
        if self._pending is None or not (self._closed or self._seconds_until_due() == 0.0):
            return None
        pending, self._pending = self._pending, None
        self._due = time.monotonic() + self._period_s
        return pending

    @staticmethod
    def _guarded(step: Callable[[], Any]) -> Any:
        """Return the result of a step, or its error as a value, so that the thread survives."""
        try:
            return step()
        except AutocalibError as error:
            return error
        except Exception as error:  # a fault of the program: reported as such, but later writes go on
            return AutocalibError(f'fault in the store: {type(error).__name__}: {error}')
