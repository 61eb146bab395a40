"""Progress for a person who waits: a bar on a terminal, now and then a line in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, TextIO

from autocalib_ros.offline.terminal.style import is_terminal, terminal_width, truncate

LINE_EVERY_S = 5.0
LINE_EVERY_FRACTION = 0.1
MIN_INTERVAL_S = 1.0
"""A short run that goes through its tenths or its states in a moment needs no ten lines."""
BAR = '{desc} {percentage:3.0f} %|{bar:8}| {remaining} left{postfix}'
OPEN_BAR = '{desc} {n_fmt}{unit}, {elapsed}{postfix}'


class ProgressReporter(Protocol):
    """What `progress_bar` hands out."""

    def update_to(self, done: float, note: str = '') -> None:
        """Show that `done` of the total is done, with a short note behind it whose first word is the state."""


@contextmanager
def progress_bar(
    total: float | None, unit: str, label: str, *, quiet: bool = False, stream: TextIO | None = None
) -> Iterator[ProgressReporter]:
    """Show progress on stderr until the block ends: tqdm's bar on a terminal, plain lines elsewhere.

    `total` is counted in `unit`s, None where it is not known beforehand; `quiet` shows nothing.
    """
    stream = stream or sys.stderr
    if quiet:
        yield _NoProgress()
    elif is_terminal(stream):
        with _ProgressBar(total, unit, label, stream) as bar:
            yield bar
    else:
        lines = _ProgressLines(total, unit, label, stream)
        yield lines
        lines.finish()


class _NoProgress:
    def update_to(self, done: float, note: str = '') -> None:
        """Show nothing."""


class _ProgressBar:
    """tqdm's bar, with as much of the note behind it as the terminal has columns for."""

    def __init__(self, total: float | None, unit: str, label: str, stream: TextIO) -> None:
        from tqdm import tqdm  # imported late: `autocalib --help` has no use for it

        self._stream = stream
        # a terminal of unknown size has no line for tqdm, which then shows nothing
        self._bar = tqdm(
            total=total,
            unit=' ' + unit,
            desc=label,
            file=stream,
            leave=True,
            nrows=2,
            ncols=terminal_width(stream) - 1,
            bar_format=BAR if total else OPEN_BAR,
        )
        self._note = ''

    def __enter__(self) -> _ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.refresh()
        self._bar.close()

    def update_to(self, done: float, note: str = '') -> None:
        """Move the bar to `done`; show another state at once, because it may take a while."""
        changed, self._note = _state(note) != _state(self._note), note
        self._bar.ncols = terminal_width(self._stream) - 1  # the window may have been resized
        fixed = {**self._bar.format_dict, 'n': done, 'postfix': '', 'ncols': None}
        room = self._bar.ncols - len(self._bar.format_meter(**fixed)) - len(', ')
        self._bar.set_postfix_str(truncate(note, room), refresh=False)
        self._bar.update(done - self._bar.n)
        if changed:
            self._bar.refresh()


class _ProgressLines:
    """One line every few seconds or per cent, and for another state: for logs, pipes and files."""

    def __init__(self, total: float | None, unit: str, label: str, stream: TextIO) -> None:
        self._total, self._unit, self._label, self._stream = total, unit, label, stream
        self._started_at = self._reported_at = time.monotonic()
        self._reported = self._done = 0.0
        self._note = self._reported_note = ''

    def update_to(self, done: float, note: str = '') -> None:
        """Remember `done` and say it when it is time."""
        self._done, self._note = done, note
        step = LINE_EVERY_FRACTION * self._total if self._total else float('inf')
        now = time.monotonic()
        late = now - self._reported_at >= LINE_EVERY_S
        far = done - self._reported >= step or _state(note) != _state(self._reported_note)
        complete = self._total is not None and self._reported < self._total <= done
        if late or complete or (far and now - self._reported_at >= MIN_INTERVAL_S):
            self._report(now)

    def finish(self) -> None:
        """Say the last state once."""
        if self._done > self._reported or not self._reported:
            self._report(time.monotonic())

    def _report(self, now: float) -> None:
        self._reported, self._reported_at, self._reported_note = self._done, now, self._note
        elapsed = max(now - self._started_at, 1e-6)
        parts = [f'{self._done:g} {self._unit}']
        if self._total:
            parts = [f'{self._done:g} of {self._total:g} {self._unit} ({100 * self._done / self._total:.0f} %)']
            left_s = elapsed * (self._total - self._done) / max(self._done, 1e-9)
            parts += [f'{left_s:.0f} s left'] if 0 < self._done < self._total else []
        parts += [f'{self._done / elapsed:.1f} {self._unit}/s'] + ([self._note] if self._note else [])
        print(f'{self._label}: ' + ', '.join(parts), file=self._stream, flush=True)


def _state(note: str) -> str:
    """Return the first word of a note."""
    return note.partition(' ')[0]
