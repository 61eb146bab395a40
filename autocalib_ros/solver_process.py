"""Solver in a child process: in a thread it would hold the GIL and cost images.

The child receives a pickled problem through a pipe and sends back the result or the exception. It runs at low
priority and ends with its parent.
"""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

from autocalib_ros.config import Options
from autocalib_ros.errors import AutocalibError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.util.child_process import end_with_parent

Result = Calibration | Refusal
NICENESS = 10
"""Nice value of the child: a solution has minutes, an image milliseconds."""
OUT_OF_MEMORY = 75
"""Exit status of a child that got no more memory; EX_TEMPFAIL of sysexits.h: the next solution may succeed."""
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
        expired = threading.Event()
        limit = self._limit(process, expired)
        try:
            self._pipe.send((evidence, options, lens))
            result, error, child_traceback = self._pipe.recv()
        except (EOFError, OSError) as lost:
            process.join(PROCESS_EXIT_S)
            self._process = None
            raise self._reason(process.exitcode, is_late=expired.is_set()) from lost
        finally:
            limit.cancel()
        if expired.is_set():  # the result came as the limit passed
            self._process = None
        if error is not None:
            raise error from _ChildTraceback(child_traceback)
        return result

    def _limit(self, process: BaseProcess, expired: threading.Event) -> threading.Timer:
        """Return a running timer that ends the process: one that stands still may not even take the problem."""

        def give_up() -> None:
            expired.set()
            process.kill()

        timer = threading.Timer(min(self.limit_s, threading.TIMEOUT_MAX), give_up)
        timer.daemon = True
        timer.start()
        return timer

    def _reason(self, status: int | None, *, is_late: bool) -> AutocalibError:
        """Return why there is no result."""
        if is_late:
            return SolverTimedOut(
                f'a solution took longer than {self.limit_s:g} s and was given up, and the solver starts anew: '
                'the machine is too busy, or raise solve_limit_s'
            )
        memory = 'out of memory' if status == OUT_OF_MEMORY else 'possibly out of memory'
        return SolverDied(
            f'the solver process ended with status {status} before it returned a result, {memory}; the next solution '
            'starts a new process: where that comes again, give it more memory or lower joint.max_tracks'
        )

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

    def __call__(
        self, evidence: Callable[[], Evidence], options: Options, lens: Camera | None
    ) -> concurrent.futures.Future[Result]:
        """Solve what a function returns, called in another thread; the future raises what `SolverProcess` does."""
        return self._waiting.submit(self._solve, evidence, options, lens)

    def _solve(self, evidence: Callable[[], Evidence], options: Options, lens: Camera | None) -> Result:
        return self._process(evidence(), options, lens=lens)

    def close(self) -> None:
        """Give up what is under way, and end the process."""
        self._waiting.shutdown(wait=False, cancel_futures=True)
        self._process.close()


def _run_child(pipe: Connection) -> None:
    """Solve the problems that arrive until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent
    end_with_parent()
    os.nice(NICENESS)
    from autocalib_ros.estimation.estimate import solve  # here alone: the parent starts faster and smaller without it

    try:
        while True:
            _answer(pipe, solve)
    except EOFError:
        return
    except MemoryError:
        os._exit(OUT_OF_MEMORY)  # at once: a traceback needs memory, and the parent tells the reason


def _answer(pipe: Connection, solve: Callable[..., Result]) -> None:
    """Solve one problem."""
    evidence, options, lens = pipe.recv()
    answer: tuple[Result | None, Exception | None, str]
    try:
        answer = (solve(evidence, options, lens=lens), None, '')
    except MemoryError:
        raise
    except Exception as error:  # raised again in the parent, at the call
        answer = (None, error, traceback.format_exc())
    pipe.send(answer)
