"""Motion mask by background subtraction (MOG2, Zivkovic 2004) and its connected regions.

Without a detector the regions are the vehicles; with one they separate moving boxes from stationary ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from autocalib_ros.config import MotionOptions
from autocalib_ros.perception.reductions import Reductions

MOG2_VARIANCE_THRESHOLD = 25.0
"""Squared Mahalanobis distance from the background above which a pixel is foreground: five sigmas."""


@dataclass(frozen=True)
class Region:
    """One moving region: a rectangle in pixels of the tracked image and the mask inside it."""

    x: int
    y: int
    mask: np.ndarray
    """255 in the foreground, uint8, shape (height, width)."""


class MotionMask:
    """Adaptive background model at reduced size."""

    def __init__(self, options: MotionOptions) -> None:
        self._options = options
        self._subtractor = cv2.createBackgroundSubtractorMOG2(varThreshold=MOG2_VARIANCE_THRESHOLD, detectShadows=False)
        self._mask: np.ndarray | None = None
        self._size = (0, 0)
        self._newest_s = 0.0

    def update(self, grey: np.ndarray, time_s: float, reductions: Reductions | None = None) -> None:
        """Update the model with a grey image (H, W) taken at `time_s` seconds, of which there may be `reductions`."""
        height, width = grey.shape
        reduced_width = min(self._options.width_px, width)
        size = (reduced_width, max(1, round(height * reduced_width / width)))
        reduced = (reductions or Reductions(grey)).at(size)
        first = self._mask is None
        rate = 1.0 if first else min(max((time_s - self._newest_s) / self._options.history_s, 1e-4), 0.2)
        foreground = self._subtractor.apply(reduced, learningRate=rate)
        self._mask = np.zeros_like(foreground) if first else foreground
        self._size, self._newest_s = (width, height), time_s

    def regions(self) -> list[Region]:
        """Return the moving regions of the newest image, largest first."""
        if self._mask is None:
            return []
        closed = cv2.morphologyEx(cv2.medianBlur(self._mask, 3), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        count, labels, stats, _ = cv2.connectedComponentsWithStats(closed)
        least = max(6.0, self._options.min_area * closed.size)
        large = [label for label in range(1, count) if stats[label, cv2.CC_STAT_AREA] >= least]
        large.sort(key=lambda label: -stats[label, cv2.CC_STAT_AREA])
        return [self._region(labels == label, stats[label]) for label in large]

    @property
    def dilation_px(self) -> tuple[float, float]:
        """Dilation of the regions on each side, x and y in pixels of the tracked image."""
        if self._mask is None:
            return 0.0, 0.0
        height, width = self._mask.shape
        return self._size[0] / width, self._size[1] / height

    def _region(self, inside: np.ndarray, stats: np.ndarray) -> Region:
        """Scale one region to the tracked image, dilated by one reduced pixel to include the silhouette."""
        width, height = self._size
        factor_x, factor_y = width / inside.shape[1], height / inside.shape[0]
        x0, y0 = max(stats[0] - 1, 0), max(stats[1] - 1, 0)
        x1 = min(stats[0] + stats[2] + 1, inside.shape[1])
        y1 = min(stats[1] + stats[3] + 1, inside.shape[0])
        part = cv2.dilate(inside[y0:y1, x0:x1].astype(np.uint8) * 255, np.ones((3, 3), np.uint8))
        left, top = round(x0 * factor_x), round(y0 * factor_y)
        right, bottom = round(x1 * factor_x), round(y1 * factor_y)
        return Region(left, top, cv2.resize(part, (right - left, bottom - top), interpolation=cv2.INTER_NEAREST))


def exclude_pixels(regions: list[Region], excluded: np.ndarray | None) -> list[Region]:
    """Return the regions without the pixels where the mask `excluded` (H, W) is not 0; empty regions are dropped."""
    if excluded is None:
        return regions
    left = []
    for region in regions:
        height, width = region.mask.shape
        part = excluded[region.y : region.y + height, region.x : region.x + width]
        mask = np.where(part > 0, np.uint8(0), region.mask)
        left += [Region(region.x, region.y, mask)] if mask.any() else []
    return left
