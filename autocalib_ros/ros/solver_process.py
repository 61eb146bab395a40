"""Solver in a child process: in a thread it would hold the GIL and cost images.

The child receives a pickled problem through a pipe and sends back the result or the exception. It runs at low
priority and ends with its parent.
"""

from __future__ import annotations

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
NICENESS = 10
"""Nice value of the child: a solution has minutes, an image milliseconds."""
PROCESS_EXIT_S = 1.0
"""Real seconds to wait for the end of a killed process."""


class SolverDied(AutocalibError):
    """The solver process ended before it returned a result."""


class _ChildTraceback(Exception):
    """Traceback of the child process, printed above that of the parent."""


class SolverProcess:
    """Callable like `calibrator.solve`, for one thread and one problem at a time; `close` is thread-safe.

    The first call starts the process.
    """

    def __init__(self) -> None:
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
        """Return the result. Raise what the solver raised, or SolverDied; the next call then starts a new process."""
        self._process = process = self._process or self._start()
        try:
            self._pipe.send((evidence, options, lens))
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


def _run_child(pipe: Connection) -> None:
    """Solve the problems that arrive until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent
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
