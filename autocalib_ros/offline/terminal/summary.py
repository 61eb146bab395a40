"""Summary of a result for the terminal; the report has all numbers."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import replace

from autocalib_ros.offline.terminal.style import align_columns
from autocalib_ros.report.text import number_rows, remedy
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.camera_move import CameraMove
from autocalib_ros.results.verification_table import summarise_verification

INDENT = '  '


def summary_lines(
    result: Calibration | Refusal,
    accepted_at_s: float | None = None,
    columns: int | None = None,
    moves: Sequence[CameraMove] = (),
) -> list[str]:
    """Return values with one sigma, then assumptions, checks and remedy, wrapped to `columns` columns."""
    found = result.candidate
    if found is None:
        rows = [(row.name, row.value) for row in number_rows(result)]
        pairs = [*_move_pairs(moves), ('what helps', remedy(result))]
        return [INDENT + line for line in align_columns(rows)] + _wrap_pairs(pairs, columns)
    numbers = number_rows(replace(found, paper=None), accepted_at_s)
    # column widths from rows with a sigma only: other rows can be long
    cells = [('', 'value', '1 sigma'), *((row.name, row.value, f'± {row.sigma}') for row in numbers if row.sigma)]
    name_width, value_width = (max(len(cell[column]) for cell in cells) for column in (0, 1))
    table = [cells[0], *((row.name, row.value, f'± {row.sigma}' if row.sigma else '') for row in numbers)]
    title = [] if result else ['not accepted, but found:']
    lines = [f'{name:<{name_width}}  {value:<{value_width}}  {sigma}'.rstrip() for name, value, sigma in table]
    remarks = [
        *(('assumed', statement.text) for statement in found.assumptions),
        *(('checked', statement.text) for statement in found.checks),
        *_move_pairs(moves),
        ('verified', summarise_verification(found.verification)),
        ('what helps', remedy(result) or (found.helpful.text if found.helpful else '')),
    ]
    return [INDENT + line for line in title + lines] + _wrap_pairs(remarks, columns)


def _move_pairs(moves: Sequence[CameraMove]) -> list[tuple[str, str]]:
    """Return a line for each move of the camera."""
    return [('moved', f'after {move.time_s:.1f} s, {move}') for move in moves]


def _wrap_pairs(pairs: list[tuple[str, str]], columns: int | None) -> list[str]:
    lines = []
    for name, text in pairs:
        start = f'{INDENT}{name + ":":<12}'
        lines += (
            (
                textwrap.wrap(start + text, columns, subsequent_indent=' ' * len(start), break_long_words=False)
                if columns
                else [start + text]
            )
            if text
            else []
        )
    return lines
