"""Does the camera stand still: how far the background has moved since the reference image."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

WIDTH_PX = 640
POINTS = 80
INTERVAL_S = 0.5
MIN_POINTS = 8
"""Fewer background points say nothing: rain, darkness, a covered lens."""
ROUND_TRIP_PX = 0.5
QUANTILES = (0.05, 0.95)
"""Drift is the span between these quantiles of the offsets: one passing lorry is not a moving camera."""


class Stillness:
    """Follows strong corners of the background from a reference image into later ones."""

    def __init__(self, memory_s: float) -> None:
        self._memory_s = memory_s
        self._reference: np.ndarray | None = None
        self._corners = np.zeros((0, 1, 2), np.float32)
        self._base = np.zeros(2)
        self._offsets: deque[tuple[float, float, float]] = deque(maxlen=4096)
        self._next_s = 0.0
        self._factor = 1.0

    def update(self, grey: np.ndarray, time_s: float) -> None:
        """Look at a grey image (H, W), at most every `INTERVAL_S`."""
        if time_s < self._next_s:
            return
        self._next_s = time_s + INTERVAL_S
        self._factor = max(1.0, grey.shape[1] / WIDTH_PX)
        size = (round(grey.shape[1] / self._factor), round(grey.shape[0] / self._factor))
        reduced = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if self._factor > 1 else grey
        offset = self._offset(reduced)
        if offset is None:
            self._begin(reduced)
        else:
            self._offsets.append((time_s, *(self._base + offset)))
            while self._offsets[0][0] < time_s - self._memory_s:
                self._offsets.popleft()

    def _begin(self, reduced: np.ndarray) -> None:
        """Take a new reference image where the last one is of no more use, and go on from the newest offset."""
        if self._offsets:
            self._base = np.array(self._offsets[-1][1:])
        corners = cv2.goodFeaturesToTrack(reduced, POINTS, 0.02, max(8, reduced.shape[1] // 20))
        self._corners = np.zeros((0, 1, 2), np.float32) if corners is None else corners
        self._reference = reduced.copy()

    def _offset(self, reduced: np.ndarray) -> np.ndarray | None:
        """Return the median motion of the background (2,) since the reference; None when it is lost."""
        if self._reference is None or len(self._corners) < MIN_POINTS or self._reference.shape != reduced.shape:
            return None
        found, forward, _ = cv2.calcOpticalFlowPyrLK(self._reference, reduced, self._corners, None)
        back, backward, _ = cv2.calcOpticalFlowPyrLK(reduced, self._reference, found, None)
        miss = np.hypot(*(back - self._corners)[:, 0].T)
        good = (forward.ravel() == 1) & (backward.ravel() == 1) & (miss < ROUND_TRIP_PX)
        if good.sum() < max(MIN_POINTS, len(self._corners) // 3):
            return None
        return np.median((found - self._corners)[good, 0], axis=0).astype(float)

    @property
    def drift_px(self) -> float:
        """Largest span of the background's position within memory, pixels of the image as given."""
        if len(self._offsets) < 2:
            return 0.0
        span = np.diff(np.quantile(np.array(self._offsets)[:, 1:], QUANTILES, axis=0), axis=0)
        return float(np.hypot(*span[0]) * self._factor)
