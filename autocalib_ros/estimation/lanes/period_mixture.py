"""The period of spacings: a mixture of one period, its multiples where dashes are hidden, and any other spacings."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

MAX_GAP_HEIGHTS = 6.0
"""Farthest next dash, camera heights: 18 m from a camera 3 m high."""
HIDDEN_SHARES = (0.75, 0.19, 0.06)
"""Shares of spacings that are one, two and three periods: every fourth dash is hidden or worn. A period whose single
spacing is never seen is less probable by the logarithm of 0.75 / 0.19 for each spacing. Judgement."""
TRIAL_PERIODS = np.geomspace(0.15, MAX_GAP_HEIGHTS, 180)
"""Periods that are tried, camera heights: 2 % apart."""
DASH_SHARES = np.array([0.2, 0.4, 0.6, 0.8])
"""Shares of the spacings that are one period."""
MIN_PERIOD_NATS, MIN_OTHER_NATS, SAME_PERIOD = 8.0, 3.0, 0.15
"""Least log likelihood of a period over none, which is more than the logarithm of the planes and periods that are
tried; and over any other period, which differs by more than this in its logarithm."""
MIN_RIVAL_NATS = 5.2
"""Least gain in log likelihood by a second period: the logarithm of the number of periods that are tried."""
MIN_PERIODIC_SPACINGS = 6
"""Fewest spacings that are one period. Judgement."""
PERIOD_PAINT_SIGMA = 0.03
"""Standard deviation of the logarithm of a period that no spread shows: crews lay out dashes by the machine's wheel.
Judgement; two rendered highways were 1 % off, four real recordings 2 to 6 % at camera heights by hand."""


def one_period(logs: np.ndarray, noise: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, float, float] | None:
    """Return the probability of each spacing to be one period (m,), the sigma of the log period, and the rival.

    `logs` (p, m) are the log spacings in each of the planes, of log prior (p,); `noise` (m,) are their standard
    deviations. None if there is no one period.
    """
    centre = len(logs) // 2
    spread = max(float(logs[centre].std()), 0.4)
    any_other = np.exp(-0.5 * ((logs - logs[centre].mean()) / spread) ** 2) / spread
    trial = np.log(TRIAL_PERIODS)[:, None, None]
    several = [  # (periods, planes, spacings) each
        hidden * np.exp(-0.5 * ((logs - trial - np.log(times)) / noise) ** 2) / noise
        for times, hidden in enumerate(HIDDEN_SHARES, start=1)
    ]
    explained = np.sum(several, axis=0)
    mixed = np.array([np.log(each * explained + (1.0 - each) * any_other).sum(axis=-1) for each in DASH_SHARES])
    mixed += prior  # (shares, periods, planes)
    best = np.unravel_index(np.argmax(mixed), mixed.shape)
    none = float(logsumexp(np.log(any_other).sum(axis=-1) + prior))
    others = np.abs(np.log(TRIAL_PERIODS / TRIAL_PERIODS[best[1]])) > SAME_PERIOD + _drift(logs, int(best[2]))
    if mixed[best] < none + MIN_PERIOD_NATS or mixed[best] < mixed[:, others].max(initial=-np.inf) + MIN_OTHER_NATS:
        return None
    share, density, rest = DASH_SHARES[best[0]], several[0][best[1], best[2]], any_other[best[2]]
    unexplained = (1.0 - share) * rest
    probable = share * density / (share * explained[best[1], best[2]] + unexplained)
    if np.count_nonzero(probable > 0.5) < MIN_PERIODIC_SPACINGS:
        return None
    sigma = float(np.hypot((probable / noise**2).sum() ** -0.5, PERIOD_PAINT_SIGMA))
    return probable, sigma, _rival(explained[:, best[2]], rest, float(share), int(best[1]))


def _rival(explained: np.ndarray, rest: np.ndarray, share: float, best: int) -> float:
    """Return the ratio to the best period of another one that explains spacings which the best one does not; or 0.

    `explained` (periods, m) and `rest` (m,) are densities of the spacings in one plane.
    """
    alone = share * explained[best] + (1.0 - share) * rest
    second = 0.5 * (1.0 - share) * (explained + rest)  # half of the rest
    gained = np.log((share * explained[best] + second) / alone).sum(axis=1)
    gained[np.abs(np.log(TRIAL_PERIODS / TRIAL_PERIODS[best])) < SAME_PERIOD] = -np.inf
    found = int(np.argmax(gained))
    return float(TRIAL_PERIODS[found] / TRIAL_PERIODS[best]) if gained[found] > MIN_RIVAL_NATS else 0.0


def _drift(logs: np.ndarray, plane: int) -> float:
    """Return how much the same spacings differ from plane to plane: a period in another plane is no other period."""
    return float(np.abs(np.median(logs - logs[plane], axis=1)).max())
