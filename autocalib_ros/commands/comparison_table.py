"""Format a comparison of calibrations as a terminal table and as a JSON document."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from autocalib_ros.comparison import Comparison, Difference
from autocalib_ros.offline.terminal.style import align_columns

DIGITS = {'px': 2, 'deg': 2, 'm': 3, '': 5}
SIGNED = ('focal length', 'tilt', 'roll', 'height')
"""Errors against the ground truth that are signed."""


def comparison_lines(result: Comparison) -> list[str]:
    """Return the differences as table lines: lens, pose, road, and notes on quantities that were not compared."""
    rows: list[tuple[str, ...]] = [('', 'A', 'B', 'B - A', 'sigmas')]
    rows += [_row(item) for item in (*result.lens, *result.pose)]
    if result.normal_deg is not None:
        rows.append(('ground normal', '', '', f'{result.normal_deg:.2f} deg apart', ''))
    for name, rays in (('rays, lens alone', result.rays), ('rays, aligned', result.rays_aligned)):
        rows.append(
            (name, '', '', f'up to {rays.largest_deg:.2f} deg, mean {rays.mean_deg:.2f}', _format_sigmas(rays.sigmas))
        )
    rows += [
        (f'road {item.distance_m:g} m ahead', '', '', f'{item.separation_m:.2f} m apart', _format_sigmas(item.sigmas))
        for item in result.road
    ]
    alignment = (
        f'rays, aligned: B is rotated by {result.alignment_deg:.2f} degrees for the best fit, because rotation and'
        ' principal point compensate each other'
    )
    road = ['road: where one pixel meets the road plane; both planes share the point below the camera and the heading']
    return [*align_columns(rows), alignment, *(road if result.road else []), *result.notes]


def _row(item: Difference) -> tuple[str, ...]:
    digits, unit = DIGITS[item.unit], f' {item.unit}' if item.unit else ''
    percent = f' ({100 * item.difference / item.first:+.2f} %)' if item.name in ('focal length', 'height') else ''
    return (
        item.name,
        f'{item.first:.{digits}f}{unit}',
        f'{item.second:.{digits}f}{unit}',
        f'{item.difference:+.{digits}f}{unit}{percent}',
        _format_sigmas(item.sigmas),
    )


def _format_sigmas(sigmas: float | None) -> str:
    if sigmas is None:
        return '-'
    return f'{sigmas:.1f}' if math.isfinite(sigmas) else 'both exact'


def comparison_document(result: Comparison) -> dict[str, Any]:
    """Return the comparison and its verdict as a JSON document; infinite and unknown values are null."""

    def with_sigmas(item: Any) -> dict[str, Any]:
        more = {'difference': item.difference} if isinstance(item, Difference) else {}
        return _finite({**asdict(item), **more, 'sigmas': item.sigmas})

    return {
        'agrees': result.agrees,
        'verdict': result.verdict(),
        'lens': [with_sigmas(item) for item in result.lens],
        'lens_px': _finite(result.lens_px),
        'focal_percent': 100 * result.lens[0].difference / result.lens[0].first,
        'rays': with_sigmas(result.rays),
        'rays_turned': with_sigmas(result.rays_aligned),
        'turned_deg': result.alignment_deg,
        'pose': [with_sigmas(item) for item in result.pose],
        'normal_deg': result.normal_deg,
        'road': [with_sigmas(item) for item in result.road],
        'stated': list(result.stated),
        'notes': list(result.notes),
    }


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def truth_lines(errors: list[dict[str, float | None]]) -> list[str]:
    """Return the errors of A and B against the ground truth as table lines."""
    rows: list[tuple[str, ...]] = [('against the truth', 'A', 'B')]
    rows += [
        (
            name,
            *(
                '-'
                if one[name] is None
                else f'{one[name]:+.2f}'
                if name.split(',')[0] in SIGNED
                else f'{one[name]:.2f}'
                for one in errors
            ),
        )
        for name in errors[0]
    ]
    return align_columns(rows)
