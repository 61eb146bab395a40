"""Tests run as the programs do: with one thread for linear algebra; those that cost nothing are marked `unit`."""

import gc
import os
from collections import defaultdict

import pytest

from autocalib_ros.util.threads import limit_blas_threads

limit_blas_threads()  # before the first import of numpy

from stored_results import quick_folder  # noqa: E402

gc.disable()  # while tests are collected: what they import stays until the end
os.environ.pop('FORCE_COLOR', None)  # some test machines set it, and messages are compared as they are

COSTS_S = {'exhaustive': 2.0, 'slow': 60.0, 'solve': 2.0, 'dds': 4.0, 'render': 1.5, 'unit': 0.02}
"""Markers and about how many seconds one of their tests takes, see pytest.ini; without another it is a `unit` test."""
FIXTURE_COSTS = {'bench': 'dds', 'written': 'render', 'still_video': 'render', 'video': 'render'}
"""Markers of all tests that ask for a fixture: a workbench of nodes, a report, videos."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark tests by what they cost, and those that cost little `unit`; the dearest modules come first.

    With several processes, the last module then keeps one of them busy for seconds and not for minutes.
    """
    module_s: dict[str, float] = defaultdict(float)
    for item in items:
        for fixture in FIXTURE_COSTS.keys() & set(item.fixturenames):
            item.add_marker(FIXTURE_COSTS[fixture])
        costs_s = [cost_s for name, cost_s in COSTS_S.items() if item.get_closest_marker(name)]
        if not costs_s:
            item.add_marker('unit')
        module_s[item.nodeid.partition('::')[0]] += max(costs_s, default=COSTS_S['unit'])
    items.sort(key=lambda item: -module_s[item.nodeid.partition('::')[0]])


def pytest_configure(config):
    """Keep the tests of a module in one process, where several run: they share solutions, pages and recordings."""
    if getattr(config.option, 'dist', 'no') == 'load':
        config.option.dist = 'loadfile'
        config.option.loadscopereorder = False  # the order above: the number of tests says little of their cost


def pytest_collection_finish():
    """Look for garbage from here on, and not among what was imported."""
    gc.freeze()
    gc.enable()


@pytest.fixture
def quick_path():
    """Yield a folder for files that are written again and again."""
    with quick_folder() as folder:
        yield folder
