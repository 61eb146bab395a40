"""Ctrl-C while a recording is read: the first one ends the reading, the second one the program."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Ctrl-C, and what service managers and containers send."""
TOLD = b'\nStopping: what was seen so far is solved and written. Ctrl-C again leaves at once.\n'


@contextmanager
def first_interrupt_stops() -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether the user wants to stop; a second signal raises KeyboardInterrupt.

    Outside of the main thread, where Python takes no signals, it never does.
    """
    stopped = False

    def on_signal(number: int, _: FrameType | None) -> None:
        nonlocal stopped
        if stopped:
            raise KeyboardInterrupt
        stopped = True
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, TOLD)  # print may be interrupted by itself

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = [signal.signal(number, on_signal) for number in SIGNALS]
    try:
        yield lambda: stopped
    finally:
        for number, handler in zip(SIGNALS, before, strict=True):
            signal.signal(number, handler)
