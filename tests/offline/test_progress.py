"""Progress reports on a terminal and in a log."""

from __future__ import annotations

import io
import re
import time

import pytest

from autocalib_ros.offline.terminal.progress import progress_bar


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def run(stream: io.StringIO, total: float | None = 10, quiet: bool = False) -> str:
    with progress_bar(total, 'images', 'replay', quiet=quiet, stream=stream) as progress:
        for done in range(1, 11):
            progress.update_to(done, '3 tracks')
    return stream.getvalue()


def test_a_log_gets_plain_lines():
    text = run(io.StringIO())
    assert '\r' not in text
    assert text.startswith('replay: 10 of 10 images (100 %), ')
    assert text.endswith('3 tracks\n')


def test_a_short_run_says_only_its_end():
    assert run(io.StringIO()).count('\n') == 1


def test_an_unknown_total_is_no_obstacle():
    assert run(io.StringIO(), total=None).startswith('replay: 10 images, ')


def test_a_terminal_gets_a_bar_with_percentage_and_note():
    text = run(Terminal())
    assert '\r' in text
    assert '100 %|' in text
    assert '3 tracks' in text


@pytest.mark.parametrize('total', [10, None])
def test_a_long_note_does_not_wrap_on_a_terminal(total):
    stream, note = Terminal(), 'collecting 42 %: ' + 'traffic crossed 20 % of the image, 25 % is needed, ' * 3
    with progress_bar(total, 'images', 'replay', stream=stream) as progress:
        for done in range(1, 11):
            progress.update_to(done, note)
    shown = [line for line in re.split('[\r\n]', stream.getvalue()) if 'collecting' in line]
    assert shown
    assert all(len(line) < 80 and line.rstrip().endswith('…') for line in shown)  # 80 where nobody tells


def test_another_state_is_shown_at_once_as_it_may_take_long():
    stream = Terminal()
    with progress_bar(1000, 'images', 'replay', stream=stream) as progress:
        progress.update_to(1, 'collecting 0 %')
        progress.update_to(2, 'solving')
        assert 'solving' in stream.getvalue()


def test_a_dumb_terminal_gets_plain_lines(monkeypatch):
    monkeypatch.setenv('TERM', 'dumb')
    assert '\r' not in run(Terminal())


def test_quiet_is_quiet():
    assert run(Terminal(), quiet=True) == ''


def test_no_time_is_told_before_it_is_known():
    stream = Terminal()
    with progress_bar(1000, 'images', 'replay', stream=stream) as progress:
        progress.update_to(1, 'collecting')
        progress.update_to(2, 'solving')
        assert 'left' not in stream.getvalue()
        progress.update_to(500, 'collecting again')
        progress.update_to(501, 'solving')
    assert ' left, ' in stream.getvalue()


def test_no_time_is_foretold_before_the_rate_is_known(monkeypatch):
    clock = iter([0.0, 30.0, 35.2, 40.4, 46.0, 46.0])
    monkeypatch.setattr(time, 'monotonic', lambda: next(clock))
    stream = io.StringIO()
    with progress_bar(100, 'images', 'replay', stream=stream) as progress:
        for done in (1, 4, 21, 100):  # the first image took 30 s: libraries, and the backdrop of a simulation
            progress.update_to(done)
    lines = stream.getvalue().splitlines()
    assert ['left' in line for line in lines] == [False, False, True, False]
    assert '41 s left' in lines[2]  # 79 images at 20 in 10.4 s
