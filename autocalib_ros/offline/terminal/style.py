"""Terminal capabilities and text layout: colours, width, truncation, columns."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TextIO

from autocalib_ros.results.calibration import Calibration, Refusal

ESCAPES = {'green': '\033[32m', 'yellow': '\033[33m', 'red': '\033[31m'}
RESET = '\033[0m'
ELLIPSIS = '…'
DEFAULT_COLUMNS = 80


def wants_colour(stream: TextIO) -> bool:
    """Return whether to print colours: on a terminal that is not dumb, subject to NO_COLOR and FORCE_COLOR.

    Either variable counts if it is not empty (no-color.org); NO_COLOR takes precedence.
    """
    if os.environ.get('NO_COLOR'):
        return False
    return bool(os.environ.get('FORCE_COLOR')) or is_terminal(stream)


def is_terminal(stream: TextIO) -> bool:
    """Return whether the stream is a terminal with colours and cursor movement."""
    return stream.isatty() and os.environ.get('TERM') != 'dumb'


def terminal_width(stream: TextIO) -> int:
    """Return the width of the terminal in columns; `DEFAULT_COLUMNS` if it is unknown, as in some containers."""
    try:
        size = os.get_terminal_size(stream.fileno())
    except (OSError, ValueError):
        return DEFAULT_COLUMNS
    return size.columns if size.columns and size.lines else DEFAULT_COLUMNS


def coloured(text: str, colour: str, stream: TextIO) -> str:
    """Return the text in a colour of `ESCAPES` if the stream shows colours."""
    return f'{ESCAPES[colour]}{text}{RESET}' if wants_colour(stream) else text


def state_colour(result: Calibration | Refusal) -> str:
    """Return green for a full calibration, yellow for a partial one or one with assumptions, red for a refusal."""
    if isinstance(result, Refusal):
        return 'red'
    return 'green' if result.grade == 'full' else 'yellow'


def truncate(text: str, columns: int) -> str:
    """Return the text on one line of at most `columns` columns, with an ellipsis if it was truncated."""
    text = ' '.join(text.split())
    if len(text) <= columns:
        return text
    return text[: max(columns - 1, 0)].rstrip(' ,;:') + ELLIPSIS if columns > 0 else ''


def align_columns(rows: Sequence[Sequence[str]], gap: str = '  ') -> list[str]:
    """Return rows with the same number of cells as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [gap.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
