"""Damaged files of every kind are read or refused in one line; `tests/tools/fuzz_readers.py` tries thousands."""

import logging

import pytest
from fuzzed_readers import TARGETS, fuzz, seeds_of

COUNT = 60
"""Damaged files of each kind; the program has an argument for more."""
FEWEST_REFUSED = 3
"""Of them: fewer would say that the damage does not reach what is read."""


@pytest.fixture(autouse=True)
def silence(caplog):
    """Libraries and readers warn of each of the damaged files."""
    caplog.set_level(logging.CRITICAL)


@pytest.mark.parametrize('target', TARGETS)
def test_whole_files_are_read(target, quick_path):
    for seed in seeds_of(target):
        path = quick_path / TARGETS[target].name
        path.write_bytes(seed)
        TARGETS[target].read(path)


@pytest.mark.parametrize('target', TARGETS)
def test_damaged_files_are_read_or_refused_in_one_line(target, quick_path, capfd):
    refused = fuzz(target, range(COUNT), quick_path)
    assert target in ('history', 'stored', 'model', 'avi', 'mp4') or refused >= FEWEST_REFUSED
