"""Line segments of the static scene by LSD on the background image: lane markings, kerbs, joints of slabs."""

from __future__ import annotations

import cv2
import numpy as np

MIN_LINE_LENGTH = 0.02
"""Shortest segment, fraction of the image width: dashes and crosswalk stripes are longer. Judgement."""
MIN_LINE_LENGTH_PX = 10.0
"""Shortest segment, pixels of the tracked image."""
MAX_LINES = 800
"""Most segments, the longest first: 26 kB."""
SAMPLES_PER_LINE = 7
"""Points along a segment at which the ignore mask is sampled."""


class LineSegmentDetector:
    """Detects line segments in the background; the result is cached until the background changes."""

    def __init__(self, ignored: np.ndarray | None) -> None:
        """Segments are kept where the mask `ignored` (H, W) is 0."""
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_ADV)
        self._ignored = ignored
        self._source_times_s: tuple[float, ...] | None = None
        self._lines = np.zeros((0, 4))

    def is_current(self, times_s: tuple[float, ...]) -> bool:
        """Whether the cached segments belong to the background computed from images of these times."""
        return times_s == self._source_times_s

    def find(self, grey: np.ndarray | None, times_s: tuple[float, ...]) -> None:
        """Detect segments in a background (H, W) computed from images of these times; None if there is none yet."""
        self._source_times_s, self._lines = times_s, np.zeros((0, 4))
        found = None if grey is None else self._detector.detect(grey)[0]
        if grey is None or found is None:
            return
        lines = found.reshape(-1, 4).astype(float)
        length = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
        longest = np.argsort(-length, kind='stable')
        longest = longest[length[longest] >= max(MIN_LINE_LENGTH_PX, MIN_LINE_LENGTH * grey.shape[1])]
        lines = lines[longest]
        self._lines = lines[~self._touches_ignored(lines)][:MAX_LINES]

    def _touches_ignored(self, lines: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of segments (n, 4) that touch the ignored regions."""
        if self._ignored is None:
            return np.zeros(len(lines), bool)
        share = np.linspace(0.0, 1.0, SAMPLES_PER_LINE)[:, None]
        points = lines[:, None, :2] + share * (lines[:, 2:] - lines[:, :2])[:, None]
        height, width = self._ignored.shape
        columns, rows = np.round(points).astype(int).T
        return (self._ignored[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)] > 0).any(axis=0)

    @property
    def lines_px(self) -> np.ndarray:
        """Segments x0, y0, x1, y1 in pixels of the background passed to `find`, longest first, shape (n, 4)."""
        return self._lines
