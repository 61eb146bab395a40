"""Progress reports: a bar on a terminal, a line now and then in a log."""

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
"""Shortest time between two lines, seconds: a short run does not need a line for every tenth of it."""
KNOWN_FRACTION = 0.05
"""Fraction of the work after which the time left is told: before, the start of libraries and the first images count."""
MIN_MEASURED_S = 2.0
"""Shortest time since the first item from which a rate is told, seconds."""
BAR = '{desc} {percentage:3.0f} %|{bar:8}| {remaining} left{postfix}'
BEGINNING_BAR = '{desc} {percentage:3.0f} %|{bar:8}|{postfix}'
OPEN_BAR = '{desc} {n_fmt}{unit}, {elapsed}{postfix}'


class ProgressReporter(Protocol):
    """Receives progress; see `progress_bar`."""

    def update_to(self, done: float, note: str = '') -> None:
        """Show that `done` of the total is done, followed by a short note whose first word is the state."""


@contextmanager
def progress_bar(
    total: float | None, unit: str, label: str, *, quiet: bool = False, stream: TextIO | None = None
) -> Iterator[ProgressReporter]:
    """Show progress on stderr until the block ends: a tqdm bar on a terminal, plain lines elsewhere.

    `total` is counted in `unit`s, None if unknown; `quiet` shows nothing.
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
    """A tqdm bar followed by the note, truncated to the width of the terminal."""

    def __init__(self, total: float | None, unit: str, label: str, stream: TextIO) -> None:
        from tqdm import tqdm  # lazy import: `autocalib --help` does not need it

        self._stream = stream
        # nrows=2: on a terminal of unknown size tqdm would show nothing
        self._bar = tqdm(
            total=total,
            unit=' ' + unit,
            desc=label,
            file=stream,
            leave=True,
            nrows=2,
            ncols=terminal_width(stream) - 1,
            bar_format=BEGINNING_BAR if total else OPEN_BAR,
        )
        self._total = total
        self._note = ''

    def __enter__(self) -> _ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.refresh()
        self._bar.close()

    def update_to(self, done: float, note: str = '') -> None:
        """Move the bar to `done`; show a new state immediately, because it may last."""
        changed, self._note = _state(note) != _state(self._note), note
        self._bar.ncols = terminal_width(self._stream) - 1  # the window may have been resized
        if self._total and done >= KNOWN_FRACTION * self._total:
            self._bar.bar_format = BAR
        fixed = {**self._bar.format_dict, 'n': done, 'postfix': '', 'ncols': None}
        room = self._bar.ncols - len(self._bar.format_meter(**fixed)) - len(', ')
        self._bar.set_postfix_str(truncate(note, room), refresh=False)
        self._bar.update(done - self._bar.n)
        if changed:
            self._bar.refresh()


class _ProgressLines:
    """A line every few seconds or per cent and for each new state: for logs, pipes and files."""

    def __init__(self, total: float | None, unit: str, label: str, stream: TextIO) -> None:
        self._total, self._unit, self._label, self._stream = total, unit, label, stream
        self._started_at = self._reported_at = time.monotonic()
        self._first: tuple[float, float] | None = None
        self._reported = self._done = 0.0
        self._note = self._reported_note = ''

    def update_to(self, done: float, note: str = '') -> None:
        """Store `done` and print a line if one is due."""
        self._done, self._note = done, note
        step = LINE_EVERY_FRACTION * self._total if self._total else float('inf')
        now = time.monotonic()
        if self._first is None and done > 0:
            self._first = now, done
        late = now - self._reported_at >= LINE_EVERY_S
        far = done - self._reported >= step or _state(note) != _state(self._reported_note)
        complete = self._total is not None and self._reported < self._total <= done
        if late or complete or (far and now - self._reported_at >= MIN_INTERVAL_S):
            self._report(now)

    def finish(self) -> None:
        """Print the last state unless it was printed already."""
        if self._done > self._reported or not self._reported:
            self._report(time.monotonic())

    def _report(self, now: float) -> None:
        self._reported, self._reported_at, self._reported_note = self._done, now, self._note
        elapsed = max(now - self._started_at, 1e-6)
        parts = [f'{self._done:g} {self._unit}']
        if self._total:
            parts = [f'{self._done:g} of {self._total:g} {self._unit} ({100 * self._done / self._total:.0f} %)']
            left_s = self._left_s(now)
            parts += [] if left_s is None else [f'{left_s:.0f} s left']
        parts += [f'{self._done / elapsed:.1f} {self._unit}/s'] + ([self._note] if self._note else [])
        print(f'{self._label}: ' + ', '.join(parts), file=self._stream, flush=True)

    def _left_s(self, now: float) -> float | None:
        """Return how long the rest takes at the rate since the first item; None while too little is done to tell."""
        if self._first is None or not self._total or not KNOWN_FRACTION * self._total <= self._done < self._total:
            return None
        first_at, first = self._first
        if self._done <= first or now - first_at < MIN_MEASURED_S:
            return None
        return (now - first_at) * (self._total - self._done) / (self._done - first)


def _state(note: str) -> str:
    """Return the state: the first word of a note."""
    return note.partition(' ')[0]
