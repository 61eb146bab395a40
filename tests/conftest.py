"""Tests run as the programs do: with one thread for linear algebra."""

import os

import pytest

from autocalib_ros.util.threads import use_one_thread_for_linear_algebra
from stored_results import quick_folder

use_one_thread_for_linear_algebra()
os.environ.pop('FORCE_COLOR', None)  # some test machines set it, and messages are compared as they are


@pytest.fixture
def quick_path():
    """Yield a folder for files that are written again and again."""
    with quick_folder() as folder:
        yield folder
