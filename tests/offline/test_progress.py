"""Progress on a terminal and elsewhere."""

from __future__ import annotations

import io

from autocalib_ros.offline.progress import progress_bar


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


def test_a_terminal_gets_a_bar_with_rate_and_note():
    text = run(Terminal())
    assert '\r' in text
    assert '10/10' in text
    assert 'images/s' in text
    assert '3 tracks' in text


def test_quiet_is_quiet():
    assert run(Terminal(), quiet=True) == ''
