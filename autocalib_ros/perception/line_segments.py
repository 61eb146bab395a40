"""Straight lines of the scene that stands still: markings on the road, kerbs, slabs, and whatever else is there."""

from __future__ import annotations

import cv2
import numpy as np

MIN_LINE_LENGTH = 0.02
"""Shortest line, share of the image width: a dash or a stripe of a crosswalk fills more, far away or not."""
MIN_LINE_LENGTH_PX = 10.0
MAX_LINES = 800
"""The longest are kept: 26 kB."""
SAMPLES_PER_LINE = 7
"""Points along a line at which it is looked whether it is to be left out."""


class LineSegmentDetector:
    """Finds straight lines in the background, anew only where that has changed."""

    def __init__(self, ignored: np.ndarray | None) -> None:
        """Lines are taken where the image (H, W) `ignored` is 0."""
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_ADV)
        self._ignored = ignored
        self._source_times_s: tuple[float, ...] | None = None
        self._lines = np.zeros((0, 4))

    def is_current(self, times_s: tuple[float, ...]) -> bool:
        """Tell whether the lines are those of the background that is made of images of these times."""
        return times_s == self._source_times_s

    def find(self, grey: np.ndarray | None, times_s: tuple[float, ...]) -> None:
        """Look into a background (H, W) made of images of these times; None is no background yet."""
        self._source_times_s, found = times_s, None if grey is None else self._detector.detect(grey)[0]
        if found is None:
            self._lines = np.zeros((0, 4))
            return
        lines = found.reshape(-1, 4).astype(float)
        length = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
        longest = np.argsort(-length, kind='stable')
        longest = longest[length[longest] >= max(MIN_LINE_LENGTH_PX, MIN_LINE_LENGTH * grey.shape[1])]
        lines = lines[longest]
        self._lines = lines[~self._touches_ignored(lines)][:MAX_LINES]

    def _touches_ignored(self, lines: np.ndarray) -> np.ndarray:
        """Tell which lines (n, 4) touch what is ignored, shape (n,)."""
        if self._ignored is None:
            return np.zeros(len(lines), bool)
        share = np.linspace(0.0, 1.0, SAMPLES_PER_LINE)[:, None]
        points = lines[:, None, :2] + share * (lines[:, 2:] - lines[:, :2])[:, None]
        height, width = self._ignored.shape
        columns, rows = np.round(points).astype(int).T
        return (self._ignored[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)] > 0).any(axis=0)

    @property
    def lines_px(self) -> np.ndarray:
        """What was found: x0, y0, x1, y1 in pixels of the image as given, the longest first, shape (n, 4)."""
        return self._lines
