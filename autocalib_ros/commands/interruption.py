"""Ctrl-C while a recording is read: the first one ends the reading, the second one the program."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Ctrl-C, and what service managers and containers send."""
TOLD = b'\nStopping: what was seen so far is solved and written. Ctrl-C again leaves at once.\n'


class StopRequest:
    """Whether the user wants to stop; true once a signal came while `listening`."""

    def __init__(self) -> None:
        self._is_requested = False

    def __call__(self) -> bool:
        """Return whether to stop."""
        return self._is_requested

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take signals in this block: the first one is a request, a second one raises KeyboardInterrupt.

        Outside of the main thread Python takes no signals, and nothing changes.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = [signal.signal(number, self._on_signal) for number in SIGNALS]
        try:
            yield
        finally:
            for number, handler in zip(SIGNALS, before, strict=True):
                signal.signal(number, handler)

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if self._is_requested:
            raise KeyboardInterrupt
        self._is_requested = True
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, TOLD)  # print may be interrupted by itself
