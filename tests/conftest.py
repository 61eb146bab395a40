"""Tests run as the programs do: with one thread for linear algebra."""

import os

import pytest

from autocalib_ros.util.threads import limit_blas_threads
from stored_results import quick_folder

limit_blas_threads()
os.environ.pop('FORCE_COLOR', None)  # some test machines set it, and messages are compared as they are


@pytest.fixture
def quick_path():
    """Yield a folder for files that are written again and again."""
    with quick_folder() as folder:
        yield folder
