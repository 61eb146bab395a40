"""A thread that writes calibrations to the store, so that nobody waits for a disk who does not want to."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from autocalib_ros.errors import AutocalibError
from autocalib_ros.results.store import Store, StoredCalibration

SAVE_PERIOD_S = 60.0
"""Real seconds between two files that nobody asked for: solutions may follow each other by seconds, for months, and
flash memory wears."""


class StoreWriter:
    """Writes one calibration after the other; of those that wait, the newest. Callable from any thread.

    `tell` hears from the thread why an offer could not be written, once until that changes; it is tried again.
    """

    def __init__(self, tell: Callable[[str], None], period_s: float = SAVE_PERIOD_S) -> None:
        self._tell, self._period_s = tell, period_s
        self._changed = threading.Condition()
        self._steps: list[tuple[Callable[[], Any], Future]] = []
        self._pending: Callable[[], None] | None = None
        self._due = time.monotonic()
        self._closed = False
        self.fault = ''
        """Why the last offer could not be written; '' when it was."""
        self._thread = threading.Thread(target=self._run, name='keeper', daemon=True)
        self._thread.start()

    def offer(self, store: Store, stored: StoredCalibration) -> None:
        """Write soon: at once when nothing was written for `period_s`; a newer offer takes this one's place."""
        with self._changed:
            self._pending = lambda: store.save(stored)
            self._changed.notify_all()

    def withdraw(self) -> None:
        """Leave out what was offered and has not been written yet."""
        with self._changed:
            self._pending = None

    def run(self, step: Callable[[], Any]) -> Future:
        """Run a step at once; the future holds what it returns, or the AutocalibError that it raised."""
        future: Future = Future()
        with self._changed:
            if self._closed:
                future.set_result(AutocalibError('the node is shutting down'))
            else:
                self._steps.append((step, future))
                self._changed.notify_all()
        return future

    def close(self, timeout_s: float) -> bool:
        """Write what waits, stop, and say whether that was done in time."""
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
            with self._changed:  # a disk may have room again
                self._pending = self._pending or pending
        if fault and fault != self.fault:
            self._tell(fault)
        self.fault = fault

    def _seconds_until_due(self) -> float | None:
        """Return the seconds until the offer is written; None while there is none."""
        return None if self._pending is None else max(0.0, self._due - time.monotonic())

    def _take_pending(self) -> Callable[[], None] | None:
        """Return the offer when its time has come, or no other will."""
        if self._pending is None or not (self._closed or self._seconds_until_due() == 0.0):
            return None
        pending, self._pending = self._pending, None
        self._due = time.monotonic() + self._period_s
        return pending

    @staticmethod
    def _guarded(step: Callable[[], Any]) -> Any:
        """Return what a step returns, or the error that it raised: the thread has to live."""
        try:
            return step()
        except AutocalibError as error:
            return error
        except Exception as error:  # a fault of the program: told as what it is, but not the end of saving
            return AutocalibError(f'fault in the store: {type(error).__name__}: {error}')
