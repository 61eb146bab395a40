"""Solutions on the way through a recording: when they are tried, and what they gave."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from autocalib_ros.config import Options
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.report.scene import SolutionSnapshot, append_snapshot
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.solver_process import SolverDied

LOG = logging.getLogger(__name__)

StartSolving = Callable[[Callable[[], Evidence], Options, Camera | None], Future[Calibration | Refusal]]
"""Starts a solution of the evidence that a function returns, see `solver_process.BackgroundSolver`."""

SOLVE_AGAIN_GROWTH = 2.0
"""Growth of the recording after which a refused solution is tried again: with twice the evidence a standard deviation
falls by a third. A solution is as dear as a minute of images."""
ACCEPTED_GROWTH = 4.0
"""The same for an accepted one, which is solved again for the convergence plot of the report alone: the standard
deviation halves."""
LAST_SHARE = 0.5
"""Share of a recording of known length behind which no solution is tried: that of the end tells nearly the same."""


@dataclass(frozen=True)
class _Trial:
    """Evidence that is solved if the solution before does not make it superfluous."""

    seconds: float
    evidence: Callable[[], Evidence]
    lens: Camera | None


class SolutionTrials:
    """Solutions while a recording is read, as a live node tries them.

    A solution may take its time while images are read: evidence that may be due waits until the solution before tells
    whether it is. So the same recording is always solved at the same times, and the reading never waits.
    """

    def __init__(self, options: Options, start_solving: StartSolving) -> None:
        self._options, self._start_solving = options, start_solving
        self._running: tuple[float, Future[Calibration | Refusal]] | None = None
        self._waiting: list[_Trial] = []
        self._part_start_s = self._next_solve_s = self._next_trial_s = 0.0
        self.latest: Calibration | Refusal | None = None
        self.moments: tuple[SolutionSnapshot, ...] = ()
        self.accepted_at_s: float | None = None

    def begin_part(self, start_s: float) -> None:
        """Forget the solutions if the evidence is of another still part of the recording than before."""
        if start_s != self._part_start_s:
            self._running, self._waiting = None, []
            self._part_start_s, self._next_solve_s, self._next_trial_s = start_s, 0.0, 0.0
            self.latest, self.moments, self.accepted_at_s = None, (), None

    def is_due(self, seconds: float, duration_s: float | None) -> bool:
        """Whether evidence of this length of a recording of that length, None if unknown, may be worth a solution."""
        if seconds < self._next_trial_s or (duration_s is not None and seconds > LAST_SHARE * duration_s):
            return False
        # whatever the solutions before give, so that they need not be known yet
        self._next_trial_s = seconds * SOLVE_AGAIN_GROWTH
        return self._running is not None or seconds >= self._next_solve_s

    def start(self, seconds: float, evidence: Callable[[], Evidence], lens: Camera | None) -> None:
        """Solve what a function returns, evidence of this length that is due, once the solution before has ended."""
        self._waiting.append(_Trial(seconds, evidence, lens))
        self._start_next()

    def _start_next(self) -> None:
        """Begin the next solution that is due, unless one is running."""
        while self._waiting and self._running is None:
            trial = self._waiting.pop(0)
            if trial.seconds >= self._next_solve_s:
                self._running = trial.seconds, self._start_solving(trial.evidence, self._options, trial.lens)

    def take_finished(self) -> None:
        """Take the result of the running solution if it is there, and begin the next one."""
        if self._running is not None and self._running[1].done():
            self._take()

    def finish(self) -> None:
        """Wait for all solutions that are due."""
        while self._running is not None:
            self._take()

    def _take(self) -> None:
        """Wait for the running solution, decide when to solve again, and begin the next one."""
        if self._running is None:
            return
        (seconds, future), self._running = self._running, None
        self._next_solve_s = seconds * SOLVE_AGAIN_GROWTH
        try:
            self._judge(seconds, future)
        finally:
            self._start_next()

    def _judge(self, seconds: float, future: Future[Calibration | Refusal]) -> None:
        """Take a result, and decide when to solve again."""
        try:
            tried = future.result()
        except SolverDied as error:
            LOG.warning('%s', error)
            return
        self.moments = append_snapshot(self.moments, tried)
        if tried and self.accepted_at_s is None:  # a live node would have accepted it at this time
            self.accepted_at_s = seconds
        self.latest = tried if tried or self.accepted_at_s is None else self.latest
        self._next_solve_s = seconds * (SOLVE_AGAIN_GROWTH if self.accepted_at_s is None else ACCEPTED_GROWTH)


def solved_in_between(
    evidence: Callable[[], Evidence], options: Options, lens: Camera | None
) -> Future[Calibration | Refusal]:
    """Solve at once."""
    future: Future[Calibration | Refusal] = Future()
    future.set_result(solve(evidence(), options, lens=lens))
    return future
