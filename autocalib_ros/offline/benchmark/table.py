"""Tables of the accuracy benchmark, 120 columns wide: one line per family and method."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from autocalib_ros.offline.benchmark.broken_families import BROKEN
from autocalib_ros.offline.benchmark.families import UNDERDETERMINED
from autocalib_ros.offline.benchmark.monte_carlo import Run

COVERAGE_SIGMAS = 1.96
"""Half-width of the 95 % interval of a normal distribution, in standard deviations."""
FALSE_ACCEPT_SIGMAS = 3.0
"""Errors beyond this many stated standard deviations count as false."""
FALSE_ACCEPT_FOCAL = 0.05
"""Relative focal length error that counts as false whatever the stated sigma; judgement."""
FALSE_ACCEPT_DEG = 1.0
"""Tilt and roll errors below this never count as false, degrees; judgement."""
NAME_FORMAT = '{:<21}{:<6}{:>5}{:>6}'
ERRORS_FORMAT = NAME_FORMAT + '  {:<21}{:>7}{:>7}{:>7}{:>7}{:>8}{:>7}{:>7}{:>7}'
SIGMAS_FORMAT = NAME_FORMAT + '{:>7}{:>8}{:>7}{:>8}{:>7}{:>7}{:>8}{:>7}{:>8}'


def format_tables(runs: Sequence[Run]) -> str:
    """Return tables of errors, of stated standard deviations against errors, and the list of crashes."""
    determined = [run for run in runs if run.family not in UNDERDETERMINED and run.family not in BROKEN]
    doubtful = [run for run in runs if run.family in UNDERDETERMINED]
    broken = [run for run in runs if run.family in BROKEN]
    blocks = [
        *_blocks('Evidence that determines the calibration', determined),
        *_blocks('Evidence that does not, or that is misleading', doubtful),
        *_blocks('Evidence that breaks an assumption', broken),
        *_crashes(runs),
    ]
    return '\n\n'.join(blocks)


def falsely_accepted(run: Run) -> bool:
    """Return whether a wrong result was accepted.

    Wrong means: focal length beyond 3 stated standard deviations or 5 %, or tilt or roll beyond 3 stated standard
    deviations and 1 degree.
    """
    if not run.accepted:
        return False
    focal = abs(run.focal_error)
    tilted = _beyond(run.tilt_error_deg, run.tilt_sigma_deg) or _beyond(run.roll_error_deg, run.roll_sigma_deg)
    return focal > FALSE_ACCEPT_FOCAL or focal > FALSE_ACCEPT_SIGMAS * run.focal_sigma or tilted


def is_overconfident(run: Run) -> bool:
    """Return whether focal length, tilt or roll of an accepted result is beyond 3 of its stated standard deviations."""
    pairs = (
        (run.focal_error, run.focal_sigma),
        (run.tilt_error_deg, run.tilt_sigma_deg),
        (run.roll_error_deg, run.roll_sigma_deg),
    )
    return run.accepted and any(abs(error) > FALSE_ACCEPT_SIGMAS * sigma for error, sigma in pairs)


def _beyond(error_deg: float, sigma_deg: float) -> bool:
    return abs(error_deg) > FALSE_ACCEPT_SIGMAS * sigma_deg and abs(error_deg) > FALSE_ACCEPT_DEG


def _blocks(title: str, runs: Sequence[Run]) -> list[str]:
    if not runs:
        return []
    groups = list(dict.fromkeys((run.family, run.method) for run in runs))
    grouped = [[run for run in runs if (run.family, run.method) == group] for group in groups]
    return [
        _block(f'{title}: errors', ERROR_HEADERS, map(_errors, grouped)),
        _block(f'{title}: stated standard deviations against errors', SIGMA_HEADERS, map(_sigmas, grouped)),
    ]


def _block(title: str, heads: Sequence[str], lines: Iterable[str]) -> str:
    return '\n'.join([title, '-' * max(map(len, heads)), *heads, *lines])


ERROR_HEADERS = (
    ERRORS_FORMAT.format(
        '', '', '', 'acc.', 'most common', 'focal', 'length', '%', '', 'normal', 'deg', 'rays', 'dist.'
    ),
    ERRORS_FORMAT.format(
        'family', '', 'runs', '%', 'refusal', 'bias', 'spread', 'mean', 'worst', 'mean', 'worst', 'deg', '%'
    ),
)
SIGMA_HEADERS = (
    SIGMAS_FORMAT.format(
        '', '', '', 'acc.', 'false', 'beyond', 'plane', 'in 95 %', 'inter-', 'val, %', 'rms', 'z', 'solve'
    ),
    SIGMAS_FORMAT.format(
        'family', '', 'runs', '%', 'acc.', '3 sig', '%', 'focal', 'tilt', 'roll', 'focal', 'tilt', 'cpu s'
    ),
)


def _errors(runs: Sequence[Run]) -> str:
    accepted = [run for run in runs if run.accepted]
    focal, normal = 100 * _column(accepted, 'focal_error'), _column(accepted, 'normal_deg')
    return ERRORS_FORMAT.format(
        *_label_cells(runs),
        _common_refusal(runs),
        _format_statistic(focal, np.mean, '+.2f'),
        _format_statistic(focal, _spread, '.2f'),
        _format_statistic(np.abs(focal), np.mean, '.2f'),
        _format_statistic(np.abs(focal), np.max, '.2f'),
        _format_statistic(normal, np.mean, '.2f'),
        _format_statistic(normal, np.max, '.2f'),
        _format_statistic(_column(accepted, 'rays_deg'), np.mean, '.3f'),
        _format_statistic(100 * _column(accepted, 'distance_error'), np.median, '.2f'),
    ).rstrip()


def _sigmas(runs: Sequence[Run]) -> str:
    accepted = [run for run in runs if run.accepted]
    planes = np.isfinite([run.normal_deg for run in accepted]).astype(float)
    focal, tilt, roll = (
        _z_scores(accepted, 'focal_error', 'focal_sigma'),
        _z_scores(accepted, 'tilt_error_deg', 'tilt_sigma_deg'),
        _z_scores(accepted, 'roll_error_deg', 'roll_sigma_deg'),
    )
    return SIGMAS_FORMAT.format(
        *_label_cells(runs),
        sum(map(falsely_accepted, runs)),
        sum(map(is_overconfident, runs)),
        _format_statistic(100 * planes, np.mean, '.0f'),
        *(_format_statistic(z, _coverage, '.0f') for z in (focal, tilt, roll)),
        *(_format_statistic(z, _rms, '.2f') for z in (focal, tilt)),
        _format_statistic(_column(runs, 'cpu_s'), np.mean, '.2f'),
    ).rstrip()


def _label_cells(runs: Sequence[Run]) -> tuple[str, str, int, str]:
    percent = 100 * sum(run.accepted for run in runs) / len(runs)
    return runs[0].family, runs[0].method, len(runs), f'{percent:.0f}'


def _common_refusal(runs: Sequence[Run]) -> str:
    codes = Counter(run.code for run in runs if run.code)
    return codes.most_common(1)[0][0] if codes else '-'


def _crashes(runs: Sequence[Run]) -> list[str]:
    crashed = [
        f'{run.family} {run.run} ({run.method}, {run.code.partition(":")[2]})'
        for run in runs
        if run.code.startswith('crash:')
    ]
    return ['\n'.join([f'{len(crashed)} solutions crashed:', *(f'  {text}' for text in crashed)])] if crashed else []


def _column(runs: Sequence[Run], name: str) -> np.ndarray:
    """Return the values (n,) of a field, without nan."""
    values = np.array([getattr(run, name) for run in runs], float)
    return values[~np.isnan(values)]


def _z_scores(runs: Sequence[Run], error: str, sigma: str) -> np.ndarray:
    """Return the errors (n,) in units of their stated standard deviations, for runs that state one."""
    pairs = np.array([(getattr(run, error), getattr(run, sigma)) for run in runs], float).reshape(-1, 2)
    errors, sigmas = pairs[(pairs[:, 1] > 0) & np.isfinite(pairs[:, 0])].T
    return errors / sigmas


def _format_statistic(values: np.ndarray, statistic: Callable[[np.ndarray], float], form: str) -> str:
    return format(float(statistic(values)), form) if len(values) else '-'


def _spread(values: np.ndarray) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def _coverage(z: np.ndarray) -> float:
    return 100 * float(np.mean(np.abs(z) <= COVERAGE_SIGMAS))


def _rms(z: np.ndarray) -> float:
    return float(np.sqrt(np.mean(z * z)))
