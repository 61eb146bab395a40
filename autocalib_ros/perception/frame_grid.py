"""Regular grid of exposure times, found in and fitted through the stamps of a stream of images.

A camera exposes at a constant period; its images come late, in bursts, or not at all. An image that another follows
within half a period has waited in a queue, so its stamp says nothing about the grid: only the last one of each burst
counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.geometry.robust_kernels import MAD_TO_SIGMA

MIN_IMAGES, MIN_JITTERED_IMAGES = 8, 24
"""Images from which a grid is found: if the stamps are nearly even, and if they jitter or images are lost. With 24 the
period of stamps with a jitter of 30 % of a frame is known to 0.9 %."""
MAX_IMAGES = 64
"""Images through which the grid is fitted: two seconds at 30 Hz, in which no clock or rate drifts noticeably. A jitter
of 30 % of a frame leaves 8 % in the phase and 0.2 % in the period.
"""
QUEUED = 0.5
"""Fraction of the period: an image that another follows sooner has waited in a queue, a period cannot be that short."""
EXACT, EVEN = 0.99, 0.85
"""Concentration of the phases (mean resultant length of circular statistics) of stamps that lie on a grid to 2 %, and
to 9 % of the period."""
PRESENT, PRESENT_FEW = 0.5, 4.0
"""A grid with lost images is present if the concentration exceeds the first plus the second over the number of images:
the largest of a thousand tries with times at random is 0.54 of 24 images and 0.35 of 64."""
MAX_SIGMA = 0.35
"""Largest robust standard deviation of a jitter, fraction of the period; 0.29 is that of times at random."""
MIN_INDEPENDENCE, MIN_INDEPENDENCE_FOUND = 0.8, 1.2
"""Least Durbin-Watson statistic of the residuals of a grid in use, and of one to be taken: jitter around a regular grid
leaves 2 ± 0.4 with 24 images, intervals that are irregular themselves leave residuals that wander, below 0.8.
"""
MATTERS = 0.05
"""Robust standard deviation, fraction of the period, below which it does not matter what the residuals do."""
WITHIN_BURST, MIN_QUEUED = 0.25, 0.5
"""Fraction of the mean interval below which an image follows the one before in a burst, and share of such intervals
from which on the stream comes in bursts."""
MIN_BURSTS = 3
"""Whole bursts through which a grid is laid: two intervals between their ends, which have to agree."""
CERTAIN_SIGMA = 0.15
"""Robust standard deviation, fraction of the period, below which half a period is three standard deviations."""
SLOTS_PER_IMAGE = {'few': 1.2, 'some': 1.6, 'most': 8.0}
"""Largest ratio of grid times to images when few, some or most images are lost: one in six, one in three, and all but
one in eight, beyond which any times lie near a grid."""
SEARCH = 0.2
"""Half-width of the search for the period around each candidate, fraction."""
LAGS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Numbers of intervals over which the median time, divided by the number, is a candidate for the period."""


@dataclass(frozen=True)
class FrameGrid:
    """Regular times: `origin_ns` is that of slot 0."""

    origin_ns: int
    period_ns: float
    sigma: float = 0.0
    """Robust standard deviation of the stamps from the grid, fraction of the period, without those that waited."""
    independence: float = 2.0
    """Durbin-Watson statistic of the residuals: 2 if independent, 0 if they wander, 4 if they alternate."""

    def time_ns(self, slot: int) -> int:
        """Return the time of a slot."""
        return self.origin_ns + round(slot * self.period_ns)

    def frames_from(self, slot: int, stamp_ns: int) -> float:
        """Return how many periods a stamp lies after a slot; negative if before."""
        return (stamp_ns - self.time_ns(slot)) / self.period_ns

    def shifted(self, by_ns: int) -> FrameGrid:
        """Return the grid with all times moved."""
        return replace(self, origin_ns=self.origin_ns + by_ns)


def find_grid(stamps_ns: np.ndarray, exact: bool = False) -> FrameGrid | None:
    """Return a grid through the stamps (n,) of successive images, with slot 0 at the last; None without a period.

    With `exact`, few images are enough only if their stamps lie on it exactly.
    """
    since_ns = (stamps_ns[-MAX_IMAGES:] - stamps_ns[-1]).astype(float)
    if len(since_ns) < MIN_IMAGES or (np.diff(since_ns) <= 0).any():
        return None
    ends = _ends_of_bursts(since_ns)
    found = _by_times(since_ns, exact) if ends is None else _by_bursts(since_ns, ends)
    return None if found is None else found.shifted(int(stamps_ns[-1]))


def _by_times(since_ns: np.ndarray, exact: bool) -> FrameGrid | None:
    """Return the grid of images that come one by one, some late and some not at all, if there is one."""
    candidates = _candidates(since_ns)
    if len(since_ns) < MIN_JITTERED_IMAGES:
        return _by_phase(since_ns, candidates, EXACT if exact else EVEN, SLOTS_PER_IMAGE['few'])
    present = PRESENT + PRESENT_FEW / len(since_ns)
    return (
        _by_phase(since_ns, candidates, EXACT, SLOTS_PER_IMAGE['some'])
        or _by_count(since_ns, candidates)
        or _by_phase(since_ns, candidates, present, SLOTS_PER_IMAGE['most'])
    )


def fit_grid(grid: FrameGrid, slots: np.ndarray, stamps_ns: np.ndarray, counts: np.ndarray) -> FrameGrid:
    """Fit period and phase through stamps (n,) of known slots (n,), where `counts` (n,) is true, robustly.

    Cauchy weights with the robust standard deviation of the residuals. The period is kept with fewer than
    `MIN_IMAGES` stamps.
    """
    chosen = np.flatnonzero(counts)
    if not len(chosen):
        return grid
    last = int(slots[chosen[-1]])
    x = (slots[chosen] - last).astype(float)
    y = (stamps_ns[chosen] - grid.time_ns(last)).astype(float) - x * grid.period_ns
    shift, slope = _robust_line(x, y, 1e-3 * grid.period_ns, fixed_slope=len(chosen) < MIN_IMAGES)
    period_ns = grid.period_ns + slope
    left = (y - shift - slope * x) / grid.period_ns
    time_ns = grid.time_ns(last) + round(shift)
    return FrameGrid(time_ns - round(last * period_ns), period_ns, _spread(left), _independence(left))


def wanders(grid: FrameGrid, images: int, least: float = MIN_INDEPENDENCE) -> bool:
    """Return whether the residuals of a grid through this many images wander, and so much that it matters."""
    return images >= MIN_JITTERED_IMAGES and grid.sigma > MATTERS and grid.independence < least


def _candidates(since_ns: np.ndarray) -> list[float]:
    """Return possible periods, longest first."""
    count = len(since_ns)
    periods = [_median(since_ns[lag:] - since_ns[:-lag]) / lag for lag in LAGS if lag <= count // 2]
    periods.append(float(np.quantile(np.diff(since_ns), 0.2)))  # with many images lost the shorter intervals are single
    return sorted({round(period) for period in periods if period >= 1.0}, reverse=True)


def _fresh(since_ns: np.ndarray, period: float) -> np.ndarray:
    """Return the mask (n,) of the images that did not wait in a queue."""
    return np.append(np.diff(since_ns) >= QUEUED * period, True)


def _ends_of_bursts(since_ns: np.ndarray) -> np.ndarray | None:
    """Return the indices of the last image of each whole burst; None unless most images follow the one before at once.

    The last burst may go on.
    """
    steps = np.diff(since_ns)
    within = steps < WITHIN_BURST * steps.mean()
    return np.flatnonzero(~within) if within.mean() > MIN_QUEUED else None


def _by_bursts(since_ns: np.ndarray, ends: np.ndarray) -> FrameGrid | None:
    """Return the grid with one slot for each image through the ends of bursts, if these are `MIN_BURSTS` and agree.

    Bursts at equal intervals lie on many grids with lost images as well: the phases of their ends tell nothing.
    """
    if len(ends) < MIN_BURSTS:
        return None
    slots, times = (ends - ends[-1]).astype(float), since_ns[ends] - since_ns[ends[-1]]
    period = float(times[0] / slots[0])
    shift, slope = _robust_line(slots, times - slots * period, 1e-3 * period)
    left = (times - shift - slots * (period + slope)) / (period + slope)
    sigma = _spread(left)
    if np.abs(left).max() > QUEUED or sigma > CERTAIN_SIGMA:
        return None
    return FrameGrid(round(since_ns[ends[-1]] + shift), period + slope, sigma, _independence(left))


def _by_phase(since_ns: np.ndarray, candidates: list[float], least: float, slots_per_image: float) -> FrameGrid | None:
    """Return the grid of the longest period at which the phases of the stamps concentrate by `least`, if any.

    The periodogram of the stamps: lost images do not matter to it.
    """
    count, span = len(since_ns), -since_ns[0]
    for candidate in candidates:
        chosen = since_ns[_fresh(since_ns, candidate)]
        if len(chosen) < MIN_IMAGES // 2 or span > (1 + SEARCH) * slots_per_image * count * candidate:
            continue
        tries = int(40 * SEARCH * span / candidate) + 3  # the phase over the whole span changes by a twentieth
        periods = candidate * (1.0 + np.linspace(-SEARCH, SEARCH, tries))
        means = np.exp(2j * np.pi * chosen / periods[:, None]).mean(axis=1)
        best = int(np.abs(means).argmax())
        slots = span / periods[best] + 1.0
        if abs(means[best]) < least or not count - 0.5 <= slots <= slots_per_image * count + 1.0:
            continue
        period = float(periods[best])
        phase = float(np.angle(means[best])) / (2 * np.pi) * period
        rounded = np.round((chosen - phase) / period).astype(int)
        stamps = chosen.astype(np.int64)
        return fit_grid(FrameGrid(round(phase), period), rounded, stamps, np.ones(len(chosen), bool))
    return None


def _by_count(since_ns: np.ndarray, candidates: list[float]) -> FrameGrid | None:
    """Return the grid with one slot for each image, if the stamps jitter around one."""
    for candidate in candidates:
        fresh = _fresh(since_ns, candidate)
        if fresh.sum() < MIN_IMAGES // 2:
            continue
        slots = np.arange(len(since_ns)) - len(since_ns) + 1
        start = FrameGrid(0, candidate)
        x, y = slots[fresh].astype(float), since_ns[fresh] - slots[fresh] * candidate
        shift, slope = _robust_line(x, y, 1e-3 * candidate, shift=float(np.quantile(y, [0.25, 0.75]).mean()))
        period = candidate + slope
        if period <= 0 or abs(slope) > SEARCH * candidate:
            continue
        left = (y - shift - slope * x) / period
        found = replace(
            start, origin_ns=round(shift), period_ns=period, sigma=_spread(left), independence=_independence(left)
        )
        far = np.quantile(np.abs(left), 0.9) > 4 * MAX_SIGMA
        if found.sigma <= MAX_SIGMA and not far and not wanders(found, len(left), MIN_INDEPENDENCE_FOUND):
            return found
    return None


def _independence(left: np.ndarray) -> float:
    """Return the Durbin-Watson statistic of residuals (n,), with outliers cut at three standard deviations."""
    limit = 3.0 * _spread(left)
    cut = np.clip(left, -limit, limit)
    return float((np.diff(cut) ** 2).sum() / max((cut**2).sum(), 1e-12))


def _robust_line(
    x: np.ndarray, y: np.ndarray, least: float, shift: float = 0.0, fixed_slope: bool = False
) -> tuple[float, float]:
    """Return shift and slope of a line through y (n,) over x (n,) by Cauchy weights; `least` is the least scale.

    It starts at a level line: of stamps that alternate around the grid the median would choose one half.
    """
    slope = 0.0
    for _ in range(4):
        left = y - shift - slope * x
        weight = 1.0 / (1.0 + (left / max(2.0 * _spread(left), least)) ** 2)
        total = weight.sum()
        mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
        square = (weight * (x - mean_x) ** 2).sum()
        if not fixed_slope and square > 0:
            slope = float((weight * (x - mean_x) * (y - mean_y)).sum() / square)
        shift = float(mean_y - slope * mean_x)
    return shift, slope


def _spread(values: np.ndarray) -> float:
    """Return the robust standard deviation around 0, 1.4826 times the median absolute value."""
    return MAD_TO_SIGMA * _median(np.abs(values))


def _median(values: np.ndarray) -> float:
    """Return the median of values (n,), n at least 1: `np.median` takes five times as long for so few."""
    lower, upper = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (lower, upper))
    return float(0.5 * (ordered[lower] + ordered[upper]))
