"""Tests run as the programs do: with one thread for linear algebra; those that cost nothing are marked `unit`."""

import os

import pytest

from autocalib_ros.util.threads import limit_blas_threads
from stored_results import quick_folder

limit_blas_threads()
os.environ.pop('FORCE_COLOR', None)  # some test machines set it, and messages are compared as they are

COSTLY = ('solve', 'dds', 'render', 'slow')
"""Markers of tests that take seconds, see pytest.ini; a test with none of them is a `unit` test."""
FIXTURE_COSTS = {'bench': 'dds', 'written': 'render', 'still_video': 'render', 'video': 'render'}
"""Markers of all tests that ask for a fixture: a workbench of nodes, a report, videos."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark tests by what they cost, and those that cost little `unit`."""
    for item in items:
        for fixture in FIXTURE_COSTS.keys() & set(item.fixturenames):
            item.add_marker(FIXTURE_COSTS[fixture])
        if not any(item.get_closest_marker(name) for name in COSTLY):
            item.add_marker('unit')


def pytest_configure(config):
    """Keep the tests of a module in one process, where several run: they share solutions, pages and recordings."""
    if getattr(config.option, 'dist', 'no') == 'load':
        config.option.dist = 'loadfile'


@pytest.fixture
def quick_path():
    """Yield a folder for files that are written again and again."""
    with quick_folder() as folder:
        yield folder
