"""Painted stripes of the static scene: dashes of lane lines, and other narrow bars that are brighter than both sides.

The white top-hat (Meyer 1979) leaves what is brighter than its surroundings and narrower than the structuring element.
A bar ends where it falls to about half of its own peak, so that neither its contrast nor that of others moves its ends.
"""

from __future__ import annotations

import cv2
import numpy as np

from autocalib_ros.evidence.tables import STRIPE_COLUMNS

ENLARGED_BELOW_PX = 1000
"""Images narrower than this are enlarged twice: a dash far away is one or two pixels wide."""
MAX_STRIPE_WIDTH = 0.025
"""Width of the structuring element, fraction of the image width: three times the width of a line near the camera."""
STRIPE_LEVELS = 6.0 * 2.0 ** (np.arange(9) / 2.0)
"""Grey levels over the surroundings at which bars are cut out: from just above the noise of a median to white paint
on black asphalt, each the square root of two times the one before."""
PEAK_OVER_LEVEL = (1.7, 1.7 * 2.0**0.5)
"""Range of the peak of a bar over the level at which it is cut out: each bar is found at one level, near its half."""
MIN_STRIPE_PIXELS, MIN_STRIPE_LENGTH_PX = 8, 5.0
"""Smallest bar, pixels of the enlarged image: fewer have no direction."""
MAX_STRIPE_LENGTH = 0.25
"""Longest bar, fraction of the image width: longer ones are no dashes, and bend."""
MIN_STRIPE_ASPECT = 1.8
"""Least length over width, and least ratio of the standard deviations along and across. Judgement."""
MAX_STRIPES = 800
"""Most bars, the ones of most contrast times length first: 32 kB."""


class StripeDetector:
    """Detects bars in the background; the result is cached until the background changes."""

    def __init__(self, ignored: np.ndarray | None) -> None:
        """Bars are kept where the mask `ignored` (H, W) is 0."""
        self._ignored = ignored
        self._source_times_s: tuple[float, ...] | None = None
        self._stripes = np.zeros((0, STRIPE_COLUMNS))

    def is_current(self, times_s: tuple[float, ...]) -> bool:
        """Whether the cached bars belong to the background computed from images of these times."""
        return times_s == self._source_times_s

    def find(self, grey: np.ndarray | None, times_s: tuple[float, ...]) -> None:
        """Find the bars of a background (H, W) computed from images of these times; None if there is none yet."""
        self._stripes = np.zeros((0, STRIPE_COLUMNS)) if grey is None else find_stripes(grey, self._ignored)
        self._source_times_s = times_s

    def fresh(self) -> StripeDetector:
        """Return a detector with the same ignored regions that has not found anything."""
        return StripeDetector(self._ignored)

    @property
    def stripes_px(self) -> np.ndarray:
        """The bars of the background passed to `find`, shape (n, STRIPE_COLUMNS)."""
        return self._stripes


def find_stripes(grey: np.ndarray, ignored: np.ndarray | None = None) -> np.ndarray:
    """Return bright bars of an image (H, W): the two ends x, y of the centre line, pixels, and the contrast in levels.

    Shape (n, STRIPE_COLUMNS), those of most contrast times length first. Bars that touch the mask `ignored` (H, W) are
    left out.
    """
    factor = 2 if grey.shape[1] < ENLARGED_BELOW_PX else 1
    if factor > 1:
        smooth = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    else:
        smooth = cv2.GaussianBlur(grey, (3, 3), 0)
    side = 2 * round(0.5 * MAX_STRIPE_WIDTH * smooth.shape[1]) + 1
    element = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
    contrast = np.asarray(cv2.morphologyEx(smooth, cv2.MORPH_TOPHAT, element))
    stripes = np.concatenate([_bars_at(level, contrast) for level in STRIPE_LEVELS])
    stripes[:, :4] = (stripes[:, :4] + 0.5) / factor - 0.5
    stripes = stripes[~_touch(stripes, ignored)]
    length = np.hypot(stripes[:, 2] - stripes[:, 0], stripes[:, 3] - stripes[:, 1])
    return stripes[np.argsort(-length * stripes[:, 4], kind='stable')[:MAX_STRIPES]]


def _bars_at(level: float, contrast: np.ndarray) -> np.ndarray:
    """Return the bars (n, STRIPE_COLUMNS) of a top-hat (H, W) whose peak is about twice a level."""
    width, flat = contrast.shape[1], contrast.ravel()
    count, labels, stats, _ = cv2.connectedComponentsWithStats((contrast >= level).astype(np.uint8), connectivity=8)
    label = labels.ravel()
    spans = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    small = (stats[:, cv2.CC_STAT_AREA] >= MIN_STRIPE_PIXELS) & (spans <= MAX_STRIPE_LENGTH * width)
    small[0] = False  # the surroundings
    inside = np.flatnonzero(small[label])
    if not len(inside):
        return np.zeros((0, STRIPE_COLUMNS))
    inside = inside[np.argsort(label[inside], kind='stable')]
    peaks = np.maximum.reduceat(flat[inside], np.flatnonzero(np.diff(label[inside], prepend=-1)))
    low, high = (ratio * level for ratio in PEAK_OVER_LEVEL)
    wanted = np.zeros(count, bool)
    wanted[np.unique(label[inside])] = (peaks >= low) & (peaks < high)
    inside, peaks = inside[wanted[label[inside]]], peaks[(peaks >= low) & (peaks < high)]
    if not len(inside):
        return np.zeros((0, STRIPE_COLUMNS))
    starts = np.flatnonzero(np.diff(label[inside], prepend=-1))
    area = np.diff(np.append(starts, len(inside)))
    places = np.column_stack([inside % width, inside // width]).astype(float)
    weights = flat[inside].astype(float)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.add.reduceat(weights * values, starts) / np.add.reduceat(weights, starts))

    centre = np.column_stack([mean(places[:, 0]), mean(places[:, 1])])
    apart = places - np.repeat(centre, area, axis=0)
    pixel = 1.0 / 12.0  # variance of a place inside a pixel
    xx, yy, xy = (mean(apart[:, one] * apart[:, other]) for one, other in ((0, 0), (1, 1), (0, 1)))
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    half_sum, half_difference = 0.5 * (xx + yy) + pixel, np.hypot(0.5 * (xx - yy), xy)
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    along = (apart * np.repeat(way, area, axis=0)).sum(axis=1)
    first, last = np.minimum.reduceat(along, starts) - 0.5, np.maximum.reduceat(along, starts) + 0.5
    length = last - first
    narrow = (length >= MIN_STRIPE_LENGTH_PX) & (length * length >= MIN_STRIPE_ASPECT * area)
    narrow &= half_sum + half_difference >= MIN_STRIPE_ASPECT**2 * (half_sum - half_difference)
    bars = np.hstack([centre + first[:, None] * way, centre + last[:, None] * way, peaks[:, None]])
    return bars[narrow]


def _touch(stripes: np.ndarray, ignored: np.ndarray | None) -> np.ndarray:
    """Return the mask (n,) of bars with an end or their middle where the mask `ignored` (H, W) is not 0."""
    if ignored is None or not len(stripes):
        return np.zeros(len(stripes), bool)
    points = np.stack([stripes[:, :2], stripes[:, 2:4], 0.5 * (stripes[:, :2] + stripes[:, 2:4])])
    height, width = ignored.shape
    columns, rows = np.moveaxis(np.round(points).astype(int), -1, 0)
    return np.asarray((ignored[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)] > 0).any(axis=0))
