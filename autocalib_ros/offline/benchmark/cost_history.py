"""History of cost and accuracy: one row of a CSV file for each measured recording."""

from __future__ import annotations

import csv
import os
import platform
import subprocess
from datetime import datetime, timezone
from pathlib import Path

from autocalib_ros import __version__
from autocalib_ros.errors import InputError
from autocalib_ros.offline.benchmark.runtime import LiveCost

COST_COLUMNS = (
    'commit',
    'date',
    'machine',
    'recording',
    'size',
    'frames',
    'image_ms',
    'image_ratio',
    'p95_ratio',
    'solution_s',
    'solution_ratio',
    'peak_mb',
    'grade',
    'focal_error_percent',
    'focal_error_sigmas',
    'normal_error_deg',
)
"""Columns of the file. Ratios are to bare optical flow on the same frames, and of the 95th percentile to the mean."""
GIT_TIMEOUT_S = 10.0
"""Longest time to ask git for the commit, seconds."""


def add_to_history(path: Path, cost: LiveCost, recording: Path) -> None:
    """Append a row to a file, or create it with a header; InputError if it has other columns."""
    is_new = not path.exists()
    if not is_new:
        with path.open(encoding='utf-8', newline='') as stream:
            header = next(csv.reader(stream), [])
        if header != list(COST_COLUMNS):
            raise InputError(f'{path}: it has other columns than a history of cost; give another file')
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open('a', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream, lineterminator='\n')
        if is_new:
            writer.writerow(COST_COLUMNS)
        writer.writerow(history_row(cost, recording))


def history_row(cost: LiveCost, recording: Path) -> tuple[str, ...]:
    """Return the values of `COST_COLUMNS`; '' for what is not known."""
    percent, sigmas = cost.focal_error or (None, None)
    numbers = (
        (1e3 * float(cost.images_s.mean()), 2),
        (cost.ratio, 2),
        (cost.spread, 2),
        (cost.last_solution_s, 2),
        (cost.solution_ratio, 0),
        (cost.peak_mb[1], 0),
    )
    errors = ((percent, 2), (sigmas, 2), (cost.normal_error_deg, 2))
    return (
        _commit(),
        datetime.now(timezone.utc).date().isoformat(),
        _machine(),
        '/'.join(recording.absolute().parts[-2:]),
        f'{cost.size[0]}x{cost.size[1]}',
        str(len(cost.images_s)),
        *(f'{value:.{digits}f}' for value, digits in numbers),
        getattr(cost.result, 'grade', getattr(cost.result, 'code', '')),
        *('' if value is None else f'{value:.{digits}f}' for value, digits in errors),
    )


def _commit() -> str:
    """Return the commit of this checkout, with + where files changed since; the version where there is none."""
    here = Path(__file__).parent
    try:
        found = subprocess.run(
            ('git', 'describe', '--always', '--dirty=+', '--exclude=*'),
            cwd=here,
            capture_output=True,
            text=True,
            timeout=GIT_TIMEOUT_S,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return __version__
    return found.stdout.strip()


def _machine() -> str:
    """Return processor and number of its cores."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8', errors='replace').splitlines()
        name = next((line.split(':', 1)[1].strip() for line in lines if line.startswith('model name')), name)
    except OSError:
        pass
    return f'{name}, {os.cpu_count()} cores'
