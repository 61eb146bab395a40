"""The solver in a child process."""

import os
import resource
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options, ScaleOptions
from autocalib_ros.errors import UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.results.calibration import Refusal
from autocalib_ros.solver_process import BackgroundSolver, SolverDied, SolverProcess, SolverTimedOut

pytestmark = pytest.mark.dds

OPTIONS = Options(camera_height=8.0)
PATIENCE_S = 30.0
PIXELS = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)


def snapshot():
    calibrator = AutoCalibrator(OPTIONS)
    calibrator.add_image(0, PIXELS)
    return calibrator.snapshot()


def large_snapshot():
    """Return evidence that no pipe takes at once."""
    return replace(snapshot(), points_px=np.zeros((2, 2_000_000), np.float32))


@pytest.fixture(scope='module')
def solver():
    """Yield a solver; its process is started by the first problem."""
    started = SolverProcess()
    yield started
    started.close()


def test_process_gives_the_result_that_the_solver_gives(solver):
    evidence = snapshot()
    result = solver(evidence, OPTIONS, lens=None)
    assert isinstance(result, Refusal)
    assert result == solve(evidence, OPTIONS)


def test_exception_of_the_solver_is_raised_here_with_its_traceback(solver):
    outside = replace(
        OPTIONS,
        camera_height=0.0,
        scale_from='distance',
        scale=ScaleOptions(distance_px='10 10 9000 10', distance_m=5.0),
    )
    with pytest.raises(UsageError, match='lies outside the images') as raised:
        solver(snapshot(), outside, lens=None)
    assert 'require_inside' in str(raised.value.__cause__)


def test_process_that_dies_is_reported_and_the_next_solution_starts_another(solver):
    assert not solver(snapshot(), OPTIONS, lens=None)
    os.kill(solver._process.pid, signal.SIGKILL)
    with pytest.raises(SolverDied, match='ended with status -9'):
        solver(snapshot(), OPTIONS, lens=None)
    assert not solver(snapshot(), OPTIONS, lens=None)


def test_close_ends_a_solution_that_runs(solver):
    assert not solver(snapshot(), OPTIONS, lens=None)
    process = solver._process
    os.kill(process.pid, signal.SIGSTOP)  # a solution that never ends
    with ThreadPoolExecutor(max_workers=1) as pool:
        answer = pool.submit(solver, snapshot(), OPTIONS, lens=None)
        assert not threading.Event().wait(0.2)
        assert not answer.done()
        solver.close()
        assert isinstance(answer.exception(PATIENCE_S), SolverDied)
    assert not process.is_alive()


def test_process_without_memory_is_reported_in_a_line_and_the_next_solution_starts_another(solver, capfd):
    assert not solver(snapshot(), OPTIONS, lens=None)
    first = solver._process
    size = int(Path(f'/proc/{first.pid}/statm').read_text().split()[0]) * resource.getpagesize()
    resource.prlimit(first.pid, resource.RLIMIT_AS, (size, resource.RLIM_INFINITY))
    with pytest.raises(SolverDied, match=r'status 75 .* out of memory; .* joint\.max_tracks'):
        solver(large_snapshot(), OPTIONS, lens=None)
    assert 'Traceback' not in capfd.readouterr().err
    assert not solver(snapshot(), OPTIONS, lens=None)
    assert solver._process.pid != first.pid


def test_process_that_takes_no_problem_is_given_up(solver):
    assert not solver(snapshot(), OPTIONS, lens=None)
    os.kill(solver._process.pid, signal.SIGSTOP)
    solver.limit_s = 0.3
    with pytest.raises(SolverTimedOut, match=r'longer than 0\.3 s'):
        solver(large_snapshot(), OPTIONS, lens=None)
    solver.limit_s = float('inf')


def test_solution_that_hangs_is_given_up_and_the_next_one_starts_another_process(solver):
    assert not solver(snapshot(), OPTIONS, lens=None)
    stopped = solver._process
    os.kill(stopped.pid, signal.SIGSTOP)
    solver.limit_s = 0.3
    with pytest.raises(SolverTimedOut, match=r'longer than 0\.3 s'):
        solver(snapshot(), OPTIONS, lens=None)
    assert not stopped.is_alive()
    solver.limit_s = float('inf')
    assert not solver(snapshot(), OPTIONS, lens=None)


def test_a_background_solver_gives_the_same_and_ends_what_is_under_way():
    background, evidence = BackgroundSolver(), snapshot()
    assert background(lambda: evidence, OPTIONS, None).result(PATIENCE_S) == solve(evidence, OPTIONS)
    process = background._process._process
    os.kill(process.pid, signal.SIGSTOP)
    under_way = background(lambda: evidence, OPTIONS, None)
    assert not threading.Event().wait(0.2)
    background.close()
    assert isinstance(under_way.exception(PATIENCE_S), SolverDied) and not process.is_alive()
