"""Frame gate: detects repeated frames, frames of a closed shutter, and jumps of the grey levels.

A thermal camera closes a shutter every few minutes for non-uniformity correction (NUC). For 0.3 to 1 s it repeats the
last frame or sends images of the shutter; afterwards offset and fixed pattern of the grey levels differ.
"""

from __future__ import annotations

from enum import Enum

import cv2
import numpy as np

from autocalib_ros.geometry.robust_kernels import MAD_TO_SIGMA
from autocalib_ros.perception.repeats import RepeatDetector

COMPARISON_WIDTH_PX = 64
"""Width in pixels at which views are compared: resolves lorries, averages noise."""
MIN_VIEW_CORRELATION = 0.3
"""Least correlation of two frames of one view: traffic leaves much more, another view none. Judgement."""
VIEW_CHANGE_RATIO = 0.5
"""Least robust spread of the change to another view, fraction of the spread of the image. Traffic changes few pixels,
however bright: the rest of a dark or foggy road is unchanged, even if the correlation is lost. Judgement."""
MAX_SHUTTER_S = 2.0
"""Longest shutter closure, seconds; a view that lasts longer is accepted as the new view."""
MIN_SPREAD_LEVELS = 1.0
"""Least spread, grey levels, of an image that can be compared with others."""
LEVEL_SHIFT_THRESHOLD = 6.0
"""Median absolute change, grey levels, above which light, gain or offset have jumped. The motion mask marks changes of
ten levels as moving, and no vehicle covers half of the image from one frame to the next.
"""
OFFSET_MEDIAN_PX = 15
"""Window of the median filter, pixels of the reduced image, that separates the offset field from traffic."""


class FrameStatus(Enum):
    """A frame in relation to the last accepted one."""

    NEW = 'new frame of the same view'
    REPEATED = 'repeated frame'
    HIDDEN = 'another view, for a short time'
    LEVEL_SHIFT = 'grey levels unrelated to those of earlier frames'


class FrameGate:
    """Classifies the frames of one stream; frames that are `REPEATED` or `HIDDEN` must not be used.

    Without a detector of repeats, only identical frames are repeated.
    """

    def __init__(
        self,
        repeats: RepeatDetector | None = None,
        level_shift_threshold: float = np.inf,
        min_spread_levels: float = MIN_SPREAD_LEVELS,
    ) -> None:
        self._repeats = repeats
        self._level_shift_threshold = level_shift_threshold
        self._min_spread_levels = min_spread_levels
        self._last: np.ndarray | None = None
        self._before = np.zeros((0, 0), np.float32)
        self._last_s = 0.0

    def classify(self, image: np.ndarray, time_s: float) -> FrameStatus:
        """Compare a reduced grey image (h, w), uint8 with a detector of repeats, with the last accepted one."""
        current = _downsampled(image)
        status = FrameStatus.NEW if self._last is None else self._compare(self._last, image, current, time_s)
        if status is not FrameStatus.HIDDEN:
            self._last_s = time_s
        if status in (FrameStatus.NEW, FrameStatus.LEVEL_SHIFT):
            self._last, self._before = image, current
            self._learn_from(status, time_s)
        return status

    def revoke(self) -> None:
        """Take back that the frame accepted last is new: it is repeated."""
        if self._repeats is not None:
            self._repeats.revoke()

    def _learn_from(self, status: FrameStatus, time_s: float) -> None:
        if self._repeats is None:
            return
        if status is FrameStatus.LEVEL_SHIFT:
            self._repeats.restart()
        self._repeats.accept(time_s)

    def _is_repeated(self, last: np.ndarray, image: np.ndarray, time_s: float) -> bool:
        if self._repeats is None:
            return np.array_equal(last, image)
        return self._repeats.is_repeat(last, image, time_s)

    def _compare(self, last: np.ndarray, image: np.ndarray, current: np.ndarray, time_s: float) -> FrameStatus:
        if self._is_repeated(last, image, time_s):
            return FrameStatus.REPEATED
        before, change = self._before, current - self._before
        spread = _robust_spread(before)
        min_change = VIEW_CHANGE_RATIO * spread if spread >= self._min_spread_levels else np.inf
        # cheap early exit: a robust spread is at most three times the median absolute change
        if 2 * np.count_nonzero(np.abs(change) > min(self._level_shift_threshold, min_change / 3)) < change.size:
            return FrameStatus.NEW
        if _robust_spread(change) > min_change and _correlation(before, current) < MIN_VIEW_CORRELATION:
            return FrameStatus.HIDDEN if time_s - self._last_s <= MAX_SHUTTER_S else FrameStatus.LEVEL_SHIFT
        return FrameStatus.LEVEL_SHIFT if np.median(np.abs(change)) > self._level_shift_threshold else FrameStatus.NEW


def match_grey_levels(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return a grey uint8 image (H, W) with the smooth grey level offset to a later image of the same view applied."""
    change = np.clip(_downsampled(after) - _downsampled(before) + 128.0, 0, 255).astype(np.uint8)
    field = cv2.medianBlur(change, OFFSET_MEDIAN_PX).astype(np.float32) - 128.0
    return np.clip(before + cv2.resize(field, before.shape[::-1]) + 0.5, 0, 255).astype(np.uint8)


def _downsampled(image: np.ndarray) -> np.ndarray:
    """Return an image (h, w) reduced to `COMPARISON_WIDTH_PX`, float32."""
    height, width = image.shape
    columns = min(COMPARISON_WIDTH_PX, width)
    size = (columns, max(1, height * columns // width))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _robust_spread(image: np.ndarray) -> float:
    """Return the robust standard deviation of an image, 1.4826 times the median absolute deviation."""
    return MAD_TO_SIGMA * float(np.median(np.abs(image - np.median(image))))


def _correlation(before: np.ndarray, current: np.ndarray) -> float:
    """Return the correlation coefficient of two images; 0 if one is flat."""
    before, current = before - before.mean(), current - current.mean()
    return float((before * current).sum() / max(np.sqrt((before**2).sum() * (current**2).sum()), 1e-9))
