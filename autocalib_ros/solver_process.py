"""Solver in a child process: in a thread it would hold the GIL and cost images.

The child receives a pickled problem through a pipe and sends back the result or the exception. It runs at low
priority and ends with its parent.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import ctypes
import math
import multiprocessing
import os
import signal
import traceback
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

from autocalib_ros.config import Options
from autocalib_ros.errors import AutocalibError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration, Refusal

Result = Calibration | Refusal
PR_SET_PDEATHSIG = 1
"""Option of prctl(2): the signal that a process gets when its parent ends."""
NICENESS = 10
"""Nice value of the child: a solution has minutes, an image milliseconds."""
PROCESS_EXIT_S = 1.0
"""Real seconds to wait for the end of a killed process."""


class SolverDied(AutocalibError):
    """The solver process ended before it returned a result."""


class SolverTimedOut(AutocalibError):
    """The solver process did not return a result in time, and was ended."""


class _ChildTraceback(Exception):
    """Traceback of the child process, printed above that of the parent."""


class SolverProcess:
    """Callable like `calibrator.solve`, for one thread and one problem at a time; `close` is thread-safe.

    The first call starts the process. A solution that takes longer than `limit_s` (real seconds) is given up.
    """

    def __init__(self, limit_s: float = float('inf')) -> None:
        self.limit_s = limit_s
        self._process: BaseProcess | None = None

    def _start(self) -> BaseProcess:
        # spawn, not fork: a fork would copy locks held by the parent's threads and its middleware
        context = multiprocessing.get_context('spawn')
        self._pipe, child_pipe = context.Pipe()
        process = context.Process(target=_run_child, args=(child_pipe,), name='autocalib solver', daemon=True)
        process.start()
        child_pipe.close()
        return process

    def __call__(self, evidence: Evidence, options: Options, /, *, lens: Camera | None) -> Result:
        """Return the result. Raise what the solver raised, SolverDied, or SolverTimedOut.

        After the latter two the next call starts a new process.
        """
        self._process = process = self._process or self._start()
        try:
            self._pipe.send((evidence, options, lens))
            if not self._pipe.poll(None if math.isinf(self.limit_s) else self.limit_s):
                self.close()
                raise SolverTimedOut(
                    f'a solution took longer than {self.limit_s:g} s and was given up, and the solver starts anew: '
                    'the machine is too busy, or raise solve_limit_s'
                )
            result, error, child_traceback = self._pipe.recv()
        except (EOFError, OSError) as lost:
            process.join(PROCESS_EXIT_S)
            self._process = None
            raise SolverDied(
                f'the solver process ended with status {process.exitcode} before it returned a result, possibly out '
                'of memory; the next solution starts a new process'
            ) from lost
        if error is not None:
            raise error from _ChildTraceback(child_traceback)
        return result

    def close(self) -> None:
        """Kill the process, also during a solution."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.join(PROCESS_EXIT_S)


class BackgroundSolver:
    """Solves one problem after the other in a child process, while the caller goes on."""

    def __init__(self) -> None:
        self._process = SolverProcess()
        self._waiting = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix='background solver')

    def __call__(self, evidence: Evidence, options: Options, lens: Camera | None) -> concurrent.futures.Future[Result]:
        """Start a solution; the future raises what `SolverProcess` does."""
        return self._waiting.submit(self._process, evidence, options, lens=lens)

    def close(self) -> None:
        """Give up what is under way, and end the process."""
        self._waiting.shutdown(wait=False, cancel_futures=True)
        self._process.close()


def _end_with_parent() -> None:
    """Let the kernel end this process with its parent, also where that is killed in the middle of a solution."""
    with contextlib.suppress(OSError, AttributeError):  # Linux has it; elsewhere the closed pipe ends the process later
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL))


def _run_child(pipe: Connection) -> None:
    """Solve the problems that arrive until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent
    _end_with_parent()
    os.nice(NICENESS)
    from autocalib_ros.estimation.estimate import solve  # here alone: the parent starts faster and smaller without it

    while True:
        try:
            evidence, options, lens = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send((solve(evidence, options, lens=lens), None, ''))
        except Exception as error:  # raised again in the parent, at the call
            pipe.send((None, error, traceback.format_exc()))
