"""How many threads the libraries below may start; for programs to call before numpy is imported."""

from __future__ import annotations

import os


def limit_blas_threads() -> None:
    """Keep BLAS to one thread, unless the environment says otherwise.

    The matrices here are small: threads that wait for each other doubled the processor time of a solution and
    took it from the cameras beside this one. Takes effect only before the first import of numpy.
    """
    for variable in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ.setdefault(variable, '1')
