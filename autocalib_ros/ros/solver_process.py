"""Solutions in a process of their own: a solver in a thread would hold Python's lock and cost images.

The child takes a pickled problem from its pipe, and sends the result or the exception back. It steps back behind
everything else on the machine, and ends when its parent does.
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
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration, Refusal

Result = Calibration | Refusal
NICENESS = 10
"""A solution has minutes, an image has milliseconds."""
PROCESS_EXIT_S = 1.0


class SolverDied(AutocalibError):
    """The process that solves ended before it gave a result."""


class _ChildTraceback(Exception):
    """The traceback of the child, to stand above that of the parent."""


class SolverProcess:
    """Solves like `calibrator.solve`; one problem at a time, from one thread; `close` may come from any.

    The process is started by the first problem.
    """

    def __init__(self) -> None:
        self._process: BaseProcess | None = None

    def _start(self) -> BaseProcess:
        # Not forked: a fork would share the locks of the parent's threads and its middleware.
        context = multiprocessing.get_context('spawn')
        self._pipe, child_pipe = context.Pipe()
        process = context.Process(target=_run_child, args=(child_pipe,), name='autocalib solver', daemon=True)
        process.start()
        child_pipe.close()
        return process

    def __call__(self, evidence: Evidence, options: Options, /, *, lens: Camera | None) -> Result:
        """Return the result; raise what the solver raised, or SolverEnded, after which the next call starts anew."""
        self._process = process = self._process or self._start()
        try:
            self._pipe.send((evidence, options, lens))
            result, error, told = self._pipe.recv()
        except (EOFError, OSError) as lost:
            process.join(PROCESS_EXIT_S)
            self._process = None
            raise SolverDied(
                f'the process that solves ended with status {process.exitcode} before it gave a result; '
                'the next solution starts another: is there enough memory?'
            ) from lost
        if error is not None:
            raise error from _ChildTraceback(told)
        return result

    def close(self) -> None:
        """End the process, even in the middle of a solution."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.join(PROCESS_EXIT_S)


def _run_child(pipe: Connection) -> None:
    """Solve what comes until the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt from the keyboard is the parent's to answer
    os.nice(NICENESS)
    while True:
        try:
            evidence, options, lens = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send((solve(evidence, options, lens=lens), None, ''))
        except Exception as error:  # the parent raises it where the problem came from
            pipe.send((None, error, traceback.format_exc()))
