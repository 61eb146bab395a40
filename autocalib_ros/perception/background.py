"""The road without its traffic: the median of a few images far apart in time."""

from __future__ import annotations

import cv2
import numpy as np

MAX_SAMPLES = 9
FIRST_INTERVAL_S = 1.0
MAX_INTERVAL_S = 600.0
"""Light, dirt and new paint: what is older than `MAX_SAMPLES` of these is no longer how the road looks."""
MIN_SAMPLES = 5
"""Of fewer images the median shows what drove by as well."""


class Background:
    """Keeps a few images as JPEG; whenever it is full, every second one goes and the interval doubles.

    From `MAX_INTERVAL_S` on, the oldest goes instead.
    """

    def __init__(self) -> None:
        self._samples: list[tuple[float, np.ndarray]] = []
        self._interval_s = FIRST_INTERVAL_S
        self._next_s = 0.0

    def update(self, image: np.ndarray, time_s: float) -> None:
        """Look at a grey or BGR uint8 image; few are kept."""
        if time_s < self._next_s:
            return
        if len(self._samples) == MAX_SAMPLES:
            self._thin()
        ok, encoded = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 92])
        if ok:
            self._samples.append((time_s, encoded))
        self._next_s = time_s + self._interval_s

    def _thin(self) -> None:
        if 2 * self._interval_s > MAX_INTERVAL_S:
            self._samples = self._samples[1:]
            return
        self._samples = self._samples[::2]
        self._interval_s *= 2

    def forget_before(self, time_s: float) -> None:
        """Drop the images from before `time_s`, when the camera stood otherwise, but for the newest."""
        newer = [sample for sample in self._samples if sample[0] >= time_s]
        if len(newer) < len(self._samples):
            self._samples = newer or self._samples[-1:]
            self._interval_s, self._next_s = FIRST_INTERVAL_S, self._samples[-1][0] + FIRST_INTERVAL_S

    @property
    def times_s(self) -> tuple[float, ...]:
        """When the images were taken of which the background is made."""
        return tuple(time_s for time_s, _ in self._samples)

    def image(self) -> np.ndarray | None:
        """Return the median image, BGR uint8 (H, W, 3), or None before the first."""
        return self._median(cv2.IMREAD_COLOR) if self._samples else None

    def grey(self) -> np.ndarray | None:
        """Return the median image in grey, uint8 (H, W), or None before it is free of traffic."""
        return self._median(cv2.IMREAD_GRAYSCALE) if len(self._samples) >= MIN_SAMPLES else None

    def _median(self, flags: int) -> np.ndarray:
        return median([cv2.imdecode(encoded, flags) for _, encoded in self._samples])


def median(images: list[np.ndarray]) -> np.ndarray:
    """Return the median of images of one shape, pixel by pixel; of an even number the upper one.

    By exchanges of neighbours, which OpenCV does for a whole image at a time: odd-even transposition sort.
    """
    images = list(images)
    for turn in range(len(images)):
        for low in range(turn % 2, len(images) - 1, 2):
            one, other = images[low], images[low + 1]
            images[low], images[low + 1] = cv2.min(one, other), cv2.max(one, other)
    return images[len(images) // 2]
