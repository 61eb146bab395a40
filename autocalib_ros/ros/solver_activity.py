"""What the solver is doing, and how it ended last, for /diagnostics. Needs no ROS."""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

REMEMBERED = 9
"""Durations whose median is the usual one."""


class SolverState(str, Enum):
    """State of the solver."""

    IDLE = 'IDLE'
    SOLVING = 'SOLVING'
    TIMED_OUT = 'TIMED_OUT'
    """The last solution took too long and was given up."""
    CRASHED = 'CRASHED'
    """The last solution ended with an error, or the process with it."""


@dataclass(frozen=True)
class SolverSummary:
    """What the solver is doing at one moment; real seconds."""

    state: SolverState = SolverState.IDLE
    solving_s: float | None = None
    """For how long the present solution has been running."""
    usual_s: float | None = None
    """Median of the last durations."""
    fault: str = ''
    """Why the last solution failed; '' if it did not."""
    result_age_s: float | None = None
    """Since when there has been the newest result, accepted or refused."""

    def __str__(self) -> str:
        if self.solving_s is None:
            return self.fault
        usual = '' if self.usual_s is None else f', usually {self.usual_s:.0f} s'
        return f'solving for {self.solving_s:.0f} s{usual}'


class SolverActivity:
    """Notes what the solver does; thread-safe."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._durations_s: deque[float] = deque(maxlen=REMEMBERED)
        self._began: float | None = None
        self._ended: float | None = None
        self._failed = SolverState.IDLE
        self._fault = ''

    def begin(self) -> None:
        """Note that a solution begins."""
        with self._lock:
            self._began = self._clock()

    def end(self) -> None:
        """Note that it gave a result."""
        with self._lock:
            self._ended = self._clock()
            self._durations_s.append(self._ended - (self._ended if self._began is None else self._began))
            self._began, self._failed, self._fault = None, SolverState.IDLE, ''

    def fail(self, error: Exception, *, timed_out: bool) -> None:
        """Note that it failed."""
        with self._lock:
            self._began, self._fault = None, str(error) or type(error).__name__
            self._failed = SolverState.TIMED_OUT if timed_out else SolverState.CRASHED

    def summary(self) -> SolverSummary:
        """Return what the solver is doing now."""
        with self._lock:
            now = self._clock()
            return SolverSummary(
                state=self._failed if self._began is None else SolverState.SOLVING,
                solving_s=None if self._began is None else now - self._began,
                usual_s=statistics.median(self._durations_s) if self._durations_s else None,
                fault=self._fault,
                result_age_s=None if self._ended is None else now - self._ended,
            )
