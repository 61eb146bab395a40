"""What a terminal can show: colours where they are wanted, and lines that do not wrap."""

from __future__ import annotations

import os
from typing import TextIO

from autocalib_ros.results.calibration import Calibration, Refusal

ESCAPES = {'green': '\033[32m', 'yellow': '\033[33m', 'red': '\033[31m'}
RESET = '\033[0m'
ELLIPSIS = '…'
DEFAULT_COLUMNS = 80


def wants_colour(stream: TextIO) -> bool:
    """Whether colours are wanted: on a terminal that is not dumb, unless NO_COLOR says no or FORCE_COLOR yes.

    Both count when they are not empty (no-color.org), and no goes before yes.
    """
    if os.environ.get('NO_COLOR'):
        return False
    return bool(os.environ.get('FORCE_COLOR')) or is_terminal(stream)


def is_terminal(stream: TextIO) -> bool:
    """Whether a line on the stream can be painted and written over."""
    return stream.isatty() and os.environ.get('TERM') != 'dumb'


def terminal_width(stream: TextIO) -> int:
    """Return the columns of the terminal; `DEFAULT_COLUMNS` where it has no size, as in a container."""
    try:
        size = os.get_terminal_size(stream.fileno())
    except (OSError, ValueError):
        return DEFAULT_COLUMNS
    return size.columns if size.columns and size.lines else DEFAULT_COLUMNS


def coloured(text: str, colour: str, stream: TextIO) -> str:
    """Return the text in one of `ESCAPES` where the stream shows colours."""
    return f'{ESCAPES[colour]}{text}{RESET}' if wants_colour(stream) else text


def state_colour(result: Calibration | Refusal) -> str:
    """Return green for all that was asked, yellow for a part of it or where it is assumed, red for nothing."""
    if isinstance(result, Refusal):
        return 'red'
    return 'green' if result.grade == 'full' else 'yellow'


def truncate(text: str, columns: int) -> str:
    """Return the text on one line of so many columns at the most, with an ellipsis where it was cut."""
    text = ' '.join(text.split())
    if len(text) <= columns:
        return text
    return text[: max(columns - 1, 0)].rstrip(' ,;:') + ELLIPSIS if columns > 0 else ''


def align_columns(rows: list[tuple[str, ...]], gap: str = '  ') -> list[str]:
    """Return rows of equally many cells as lines, cells of a column below each other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [gap.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
