"""Figures of a report drawn in a second process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest

from autocalib_ros.report.figure_process import FigureProcess
from autocalib_ros.report.page import ENTRIES, draw_entry, write_report

pytestmark = pytest.mark.render
DEATH_S = 30.0


@pytest.fixture
def process(monkeypatch) -> Iterator[FigureProcess]:
    """Yield a process that was started, as on a machine with two processors."""
    monkeypatch.setattr('autocalib_ros.report.figure_process.usable_processors', lambda: 2)
    with closing(FigureProcess()) as one:
        one.start()
        one._pool.submit(int).result()  # it has loaded what it needs
        yield one


def test_figures_of_two_processes_are_those_of_one(process, refused, written, tmp_path):
    assert process.leaves(len(ENTRIES) - 1)
    write_report(tmp_path / 'report.html', refused, process=process)
    assert not process.leaves(len(ENTRIES) - 1)
    alone = written('refused').parent / 'figures'
    assert {path.name: path.read_bytes() for path in (tmp_path / 'figures').iterdir()} == {
        path.name: path.read_bytes() for path in alone.iterdir()
    }
    assert (tmp_path / 'report.html').read_text() == written('refused').read_text()


def test_a_process_that_dies_leaves_all_figures_to_the_other_one(process, refused, written, tmp_path):
    process.begin(draw_entry, refused, len(ENTRIES))
    (child,) = process._pool._processes.values()
    child.kill()
    child.join(DEATH_S)
    write_report(tmp_path / 'report.html', refused, process=process)
    assert (tmp_path / 'report.html').read_text() == written('refused').read_text()


def test_one_processor_draws_alone(monkeypatch, refused):
    monkeypatch.setattr('autocalib_ros.report.figure_process.usable_processors', lambda: 1)
    process = FigureProcess()
    process.start()
    process.begin(draw_entry, refused, 1)
    assert process.leaves(0)
