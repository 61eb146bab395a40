"""Map a function over tasks in parallel processes, results in the order of the tasks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

from autocalib_ros.util.threads import limit_blas_threads

Task = TypeVar('Task')
Result = TypeVar('Result')


def map_in_order(work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int) -> Iterator[Result]:
    """Yield `work(task)` for each task, in the order of the tasks, computed by `jobs` processes."""
    if jobs == 1:
        yield from map(work, tasks)
        return
    # spawned, not forked: a worker must limit its BLAS threads before it imports numpy
    with ProcessPoolExecutor(jobs, get_context('spawn'), limit_blas_threads) as pool:
        try:
            yield from pool.map(work, tasks)
        finally:
            pool.shutdown(cancel_futures=True)
