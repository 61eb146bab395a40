"""Progress for a person who waits: a bar on a terminal, now and then a line in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, TextIO

LINE_EVERY_S = 5.0
LINE_EVERY_SHARE = 0.1


class Progress(Protocol):
    """What `progress_bar` hands out."""

    def update_to(self, done: float, note: str = '') -> None:
        """Show that `done` of the total is done, with a short note behind it."""


@contextmanager
def progress_bar(total: float | None, unit: str, label: str, *, quiet: bool = False,
                 stream: TextIO | None = None) -> Iterator[Progress]:
    """Show progress on stderr until the block ends: tqdm's bar on a terminal, plain lines elsewhere.

    `total` is counted in `unit`s, None where it is not known beforehand; `quiet` shows nothing.
    """
    stream = stream or sys.stderr
    if quiet:
        yield _Silent()
    elif stream.isatty():
        with _Bar(total, unit, label, stream) as bar:
            yield bar
    else:
        lines = _Lines(total, unit, label, stream)
        yield lines
        lines.finish()


class _Silent:
    def update_to(self, done: float, note: str = '') -> None:
        """Show nothing."""


class _Bar:
    """tqdm with rate and time left."""

    def __init__(self, total: float | None, unit: str, label: str, stream: TextIO) -> None:
        from tqdm import tqdm  # imported late: `autocalib --help` has no use for it

        self._bar = tqdm(total=total, unit=' ' + unit, desc=label, file=stream, dynamic_ncols=True, leave=True)

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def update_to(self, done: float, note: str = '') -> None:
        """Move the bar to `done`."""
        if note:
            self._bar.set_postfix_str(note, refresh=done == self._bar.n)
        self._bar.update(done - self._bar.n)


class _Lines:
    """One line every few seconds or per cent: for logs, pipes and files."""

    def __init__(self, total: float | None, unit: str, label: str, stream: TextIO) -> None:
        self._total, self._unit, self._label, self._stream = total, unit, label, stream
        self._begun = self._said_at = time.monotonic()
        self._said = self._done = 0.0
        self._note = ''

    def update_to(self, done: float, note: str = '') -> None:
        """Remember `done` and say it when it is time."""
        self._done, self._note = done, note
        step = LINE_EVERY_SHARE * self._total if self._total else float('inf')
        now = time.monotonic()
        # a short run that goes through its tenths in a moment needs no ten lines
        late, far = now - self._said_at >= LINE_EVERY_S, done - self._said >= step
        complete = self._total is not None and self._said < self._total <= done
        if late or complete or (far and now - self._said_at >= LINE_EVERY_S / 5):
            self._say(now)

    def finish(self) -> None:
        """Say the last state once."""
        if self._done > self._said or not self._said:
            self._say(time.monotonic())

    def _say(self, now: float) -> None:
        self._said, self._said_at = self._done, now
        elapsed = max(now - self._begun, 1e-6)
        parts = [f'{self._done:g} {self._unit}']
        if self._total:
            parts = [f'{self._done:g} of {self._total:g} {self._unit} ({100 * self._done / self._total:.0f} %)']
            left_s = elapsed * (self._total - self._done) / max(self._done, 1e-9)
            parts += [f'{left_s:.0f} s left'] if 0 < self._done < self._total else []
        parts += [f'{self._done / elapsed:.1f} {self._unit}/s'] + ([self._note] if self._note else [])
        print(f'{self._label}: ' + ', '.join(parts), file=self._stream, flush=True)
