"""Thread limits of the numerical libraries, to be set before numpy is imported."""

from __future__ import annotations

import os


def limit_blas_threads() -> None:
    """Limit BLAS to one thread, unless the environment sets another number.

    The matrices here are small: waiting threads doubled the CPU time of a solution and slowed down other cameras on
    the machine. Takes effect only before the first import of numpy.
    """
    for variable in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ.setdefault(variable, '1')
