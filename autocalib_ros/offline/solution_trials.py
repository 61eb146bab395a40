"""Solutions on the way through a recording: when they are tried, and what they gave."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future

from autocalib_ros.config import Options
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.report.scene import SolutionSnapshot, append_snapshot
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.solver_process import SolverDied

LOG = logging.getLogger(__name__)

StartSolving = Callable[[Evidence, Options, Camera | None], Future[Calibration | Refusal]]
"""Starts a solution, see `solver_process.BackgroundSolver`."""

SOLVE_AGAIN_GROWTH = 2.0
"""Growth of the recording after which a refused solution is tried again: with twice the evidence a standard deviation
falls by a third. A solution is as dear as a minute of images."""
ACCEPTED_GROWTH = 4.0
"""The same for an accepted one, which is solved again for the convergence plot of the report alone: the standard
deviation halves."""
LAST_SHARE = 0.5
"""Share of a recording of known length behind which no solution is tried: that of the end tells nearly the same."""


class SolutionTrials:
    """Solutions while a recording is read, as a live node tries them.

    A solution may take its time while images are read. It is waited for when the next one may be due, so that the same
    recording is always solved at the same times.
    """

    def __init__(self, options: Options, start_solving: StartSolving) -> None:
        self._options, self._start_solving = options, start_solving
        self._running: tuple[float, Future[Calibration | Refusal]] | None = None
        self._part_start_s = self._next_solve_s = 0.0
        self.latest: Calibration | Refusal | None = None
        self.moments: tuple[SolutionSnapshot, ...] = ()
        self.accepted_at_s: float | None = None

    def begin_part(self, start_s: float) -> None:
        """Forget the solutions if the evidence is of another still part of the recording than before."""
        if start_s != self._part_start_s:
            self._running = None
            self._part_start_s, self._next_solve_s = start_s, 0.0
            self.latest, self.moments, self.accepted_at_s = None, (), None

    def is_due(self, seconds: float, duration_s: float | None) -> bool:
        """Whether evidence of this length of a recording of that length, None if unknown, is worth a solution."""
        if seconds < self._next_solve_s or (duration_s is not None and seconds > LAST_SHARE * duration_s):
            return False
        self.finish()
        return seconds >= self._next_solve_s

    def start(self, evidence: Evidence, lens: Camera | None) -> None:
        """Begin a solution; the one before has ended."""
        self._next_solve_s = evidence.seconds * SOLVE_AGAIN_GROWTH
        self._running = evidence.seconds, self._start_solving(evidence, self._options, lens)

    def take_finished(self) -> None:
        """Take the result of the running solution if it is there."""
        if self._running is not None and self._running[1].done():
            self.finish()

    def finish(self) -> None:
        """Wait for the running solution, and decide when to solve again."""
        if self._running is None:
            return
        (seconds, future), self._running = self._running, None
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


def solved_in_between(evidence: Evidence, options: Options, lens: Camera | None) -> Future[Calibration | Refusal]:
    """Solve at once."""
    future: Future[Calibration | Refusal] = Future()
    future.set_result(solve(evidence, options, lens=lens))
    return future
