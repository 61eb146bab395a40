"""Camera motion: displacement of background corners since a reference image."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

WIDTH_PX = 640
"""Image width at which corners are tracked."""
MAX_CORNERS = 80
"""Most background corners."""
CHECK_INTERVAL_S = 0.5
"""Least interval between two measurements, seconds."""
MIN_BACKGROUND_CORNERS = 8
"""Least number of corners for a valid offset; there are fewer in rain, darkness, or with a covered lens."""
MAX_ROUND_TRIP_PX = 0.5
"""Largest forward-backward error of a tracked corner."""
DRIFT_QUANTILES = (0.05, 0.95)
"""Drift is the span between these quantiles of the offsets: one passing lorry must not count as camera motion."""
LAMP_QUANTILE = 0.97
"""Fraction of a night image that is neither lamp nor glare. Judgement."""
MAX_OCCLUSION_S = 10.0
"""Longest occlusion of the background by passing traffic, seconds. Judgement."""
MASK_MARGIN_PX = 12
"""Distance of corners from ignored regions, half an LK window: the border of a region does not move with the camera."""
COARSE_INTERVAL_S = 300.0
"""Interval between the medians kept of older offsets, seconds: shows slow drift at little memory."""
MAX_COARSE_SAMPLES = 8640
"""Medians of one month."""


class DriftMonitor:
    """Tracks strong background corners from a reference image into later images.

    Keeps all offsets of the last `memory_s` seconds, and older medians back to the time given to `compare_since`.
    Corners are detected only where the mask `ignored` (H, W) is 0.
    """

    def __init__(self, memory_s: float, ignored: np.ndarray | None = None) -> None:
        self._memory_s, self._ignored = memory_s, ignored
        self._coarse: deque[tuple[float, float, float]] = deque(maxlen=MAX_COARSE_SAMPLES)
        self._coarse_due_s = COARSE_INTERVAL_S
        self._reference: np.ndarray | None = None
        self._recent: np.ndarray | None = None
        self._found_s = 0.0
        self.lost_s = -np.inf
        """Time at which the background was last lost: the earlier camera pose is unrelated to the present one."""
        self._corners = np.zeros((0, 1, 2), np.float32)
        self._base_offset = np.zeros(2)
        self._offsets: deque[tuple[float, float, float]] = deque(maxlen=4096)
        self._next_s = 0.0
        self._factor = 1.0

    def update(self, grey: np.ndarray, time_s: float) -> None:
        """Process a grey image (H, W), at most one every `CHECK_INTERVAL_S`."""
        if time_s < self._next_s:
            return
        self._next_s = time_s + CHECK_INTERVAL_S
        self._factor = max(1.0, grey.shape[1] / WIDTH_PX)
        size = (round(grey.shape[1] / self._factor), round(grey.shape[0] / self._factor))
        reduced = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if self._factor > 1 else grey
        offset = self._offset(self._reference, self._corners, reduced)
        if offset is None:
            self._replace_reference(reduced, time_s)
            return
        self._recent, self._found_s = reduced.copy(), time_s
        self._offsets.append((time_s, *(self._base_offset + offset)))
        while self._offsets[0][0] < time_s - self._memory_s:
            self._offsets.popleft()
        if time_s >= self._coarse_due_s:
            self._coarse.append((time_s, *self._position(time_s - COARSE_INTERVAL_S)))
            self._coarse_due_s = time_s + COARSE_INTERVAL_S

    def _replace_reference(self, reduced: np.ndarray, time_s: float) -> None:
        """Replace a reference image that can no longer be matched.

        Light and shadow change slowly, so the offset is chained through the last image that matched. If that fails for
        longer than `MAX_OCCLUSION_S`, the camera may have been turned and the background counts as lost.
        """
        step = self._offset(self._recent, self._corners_of(self._recent), reduced)
        if step is None and self._reference is not None:
            if time_s - self._found_s < MAX_OCCLUSION_S:
                return
            self.lost_s = time_s
        if self._offsets:
            self._base_offset = np.array(self._offsets[-1][1:]) + (0.0 if step is None else step)
        self._reference = self._recent = reduced.copy()
        self._corners, self._found_s = self._corners_of(reduced), time_s

    def _corners_of(self, image: np.ndarray | None) -> np.ndarray:
        """Return strong corners (n, 1, 2) of a reduced image (H, W), away from ignored regions."""
        if image is None or self._ignored is None:
            return _corners(image)
        ignored = cv2.resize(self._ignored, image.shape[::-1], interpolation=cv2.INTER_NEAREST)
        near = cv2.dilate(ignored, np.ones((2 * MASK_MARGIN_PX + 1, 2 * MASK_MARGIN_PX + 1), np.uint8))
        return _corners(image, (near == 0).astype(np.uint8))

    def compare_since(self, time_s: float) -> None:
        """Drop the medians from before `time_s`: no evidence is left from then."""
        while self._coarse and self._coarse[0][0] < time_s:
            self._coarse.popleft()

    def _position(self, since_s: float) -> np.ndarray:
        """Return the median offset (2,) since `since_s`."""
        offsets = np.array(self._offsets)
        return np.median(offsets[offsets[:, 0] >= since_s, 1:], axis=0)

    @staticmethod
    def _offset(before: np.ndarray | None, corners: np.ndarray, after: np.ndarray) -> np.ndarray | None:
        """Return the median displacement (2,) of the background between two images; None if too few corners match."""
        if before is None or len(corners) < MIN_BACKGROUND_CORNERS or before.shape != after.shape:
            return None
        # the stubs of OpenCV lack None for the initial positions
        found, forward, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)  # type: ignore[call-overload]
        back, backward, _ = cv2.calcOpticalFlowPyrLK(after, before, found, None)  # type: ignore[call-overload]
        round_trip_px = np.hypot(*(back - corners)[:, 0].T)
        good = (forward.ravel() == 1) & (backward.ravel() == 1) & (round_trip_px < MAX_ROUND_TRIP_PX)
        if good.sum() < max(MIN_BACKGROUND_CORNERS, len(corners) // 3):
            return None
        return np.median((found - corners)[good, 0], axis=0).astype(float)

    @property
    def drift_px(self) -> float:
        """Largest displacement of the background in memory, pixels of the images passed to `update`."""
        if len(self._offsets) < 2:
            return 0.0
        spans = [np.diff(np.quantile(np.array(self._offsets)[:, 1:], DRIFT_QUANTILES, axis=0), axis=0)[0]]
        if len(self._coarse) > 1:
            spans.append(np.ptp(np.array(self._coarse)[:, 1:], axis=0))
        return float(max(np.hypot(*span) for span in spans) * self._factor)


def _corners(image: np.ndarray | None, where: np.ndarray | None = None) -> np.ndarray:
    """Return strong corners (n, 1, 2) of a reduced image (H, W), where the mask (H, W) is not 0.

    Corner strength is relative to the strongest one: headlamps at night, which move, would suppress all others.
    Grey levels are therefore clipped at `LAMP_QUANTILE`.
    """
    found = None
    if image is not None:
        dimmed = np.minimum(image, np.uint8(np.quantile(image[::2, ::2], LAMP_QUANTILE)))
        found = cv2.goodFeaturesToTrack(dimmed, MAX_CORNERS, 0.02, max(8, image.shape[1] // 20), mask=where)
    return np.zeros((0, 1, 2), np.float32) if found is None else found
