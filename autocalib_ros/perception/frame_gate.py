"""Pictures that show no new view: repeated, frozen or hidden by a shutter; and what has changed behind it.

A thermal core closes a shutter every few minutes to correct its pixels. Meanwhile it repeats the last picture or
sends that of the shutter, for 0.3 to 1 s; afterwards offset and pattern of its grey levels are others.
"""

from __future__ import annotations

from enum import Enum

import cv2
import numpy as np

COMPARISON_WIDTH_PX = 64
"""Width at which two pictures are compared as views: finer than lorries, coarser than noise."""
MIN_VIEW_CORRELATION = 0.3
"""Least correlation between two pictures of one view: what drives through leaves much more, another view none."""
VIEW_CHANGE_RATIO = 0.5
"""Another view changes most pixels by as much as they differ among themselves, at least by this share of it. What
drives changes few, however bright it is: the rest of a dark or foggy road stays, though its correlation is lost."""
MAX_SHUTTER_S = 2.0
"""A shutter is open again after this; what is seen then is the view."""
MIN_SPREAD_LEVELS = 1.0
"""Spread, in grey levels, below which a picture shows nothing that could be found again."""
LEVEL_SHIFT_THRESHOLD = 6.0
"""Half of the picture changed by more than this at once: the light, the gain or the offset leapt, for the motion mask
calls moving what changes by ten levels, and nothing that drives covers half of the picture from one image to the next.
"""
OFFSET_MEDIAN_PX = 15
"""Side of the median, in pixels of the reduced picture, that tells the camera's own change from that of traffic."""


class FrameStatus(Enum):
    """What a picture is beside the last one used."""

    NEW = 'the same view, later'
    REPEATED = 'the same picture again'
    HIDDEN = 'another view, for a moment'
    LEVEL_SHIFT = 'a view whose grey levels have nothing to do with those before'


class FrameGate:
    """Compares the pictures of one stream; what is `REPEATED` or `HIDDEN` is not to be used."""

    def __init__(
        self,
        max_repeat_difference: float,
        level_shift_threshold: float = np.inf,
        min_spread_levels: float = MIN_SPREAD_LEVELS,
    ) -> None:
        self._max_repeat_difference, self._level_shift_threshold, self._min_spread_levels = (
            max_repeat_difference,
            level_shift_threshold,
            min_spread_levels,
        )
        self._last: np.ndarray | None = None
        self._before = np.zeros((0, 0), np.float32)
        self._last_s = 0.0

    def classify(self, picture: np.ndarray, time_s: float) -> FrameStatus:
        """Compare a reduced grey picture (h, w), of any type, with the last one used."""
        now = _downsampled(picture)
        seen = FrameStatus.NEW if self._last is None else self._compare(picture, now, time_s)
        if seen is not FrameStatus.HIDDEN:
            self._last_s = time_s
        if seen in (FrameStatus.NEW, FrameStatus.LEVEL_SHIFT):
            self._last, self._before = picture, now
        return seen

    def _compare(self, picture: np.ndarray, now: np.ndarray, time_s: float) -> FrameStatus:
        if cv2.absdiff(self._last, picture).max() <= self._max_repeat_difference:
            return FrameStatus.REPEATED
        before, change = self._before, now - self._before
        spread = _robust_spread(before)
        gone = VIEW_CHANGE_RATIO * spread if spread >= self._min_spread_levels else np.inf
        # a spread is at most three times the median change: where that is small, as mostly, nothing else need be known
        if 2 * np.count_nonzero(np.abs(change) > min(self._level_shift_threshold, gone / 3)) < change.size:
            return FrameStatus.NEW
        if _robust_spread(change) > gone and _correlation(before, now) < MIN_VIEW_CORRELATION:
            return FrameStatus.HIDDEN if time_s - self._last_s <= MAX_SHUTTER_S else FrameStatus.LEVEL_SHIFT
        return FrameStatus.LEVEL_SHIFT if np.median(np.abs(change)) > self._level_shift_threshold else FrameStatus.NEW


def match_grey_levels(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Give a grey uint8 image (H, W) the offset, slowly varying over the image, of a later one of the same view."""
    change = np.clip(_downsampled(after) - _downsampled(before) + 128.0, 0, 255).astype(np.uint8)
    field = cv2.medianBlur(change, OFFSET_MEDIAN_PX).astype(np.float32) - 128.0
    return np.clip(before + cv2.resize(field, before.shape[::-1]) + 0.5, 0, 255).astype(np.uint8)


def _downsampled(picture: np.ndarray) -> np.ndarray:
    """Reduce a picture (h, w) to `COMPARISON_WIDTH_PX`, float32."""
    height, width = picture.shape
    columns = min(COMPARISON_WIDTH_PX, width)
    size = (columns, max(1, height * columns // width))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _robust_spread(picture: np.ndarray) -> float:
    """Standard deviation of most of a picture, by the median of the deviations from its median."""
    return 1.4826 * float(np.median(np.abs(picture - np.median(picture))))


def _correlation(before: np.ndarray, now: np.ndarray) -> float:
    """Correlation coefficient of two pictures; 0 where one is flat."""
    before, now = before - before.mean(), now - now.mean()
    return float((before * now).sum() / max(np.sqrt((before**2).sum() * (now**2).sum()), 1e-9))
