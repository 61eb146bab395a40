"""The road without its traffic, for people to look at: the median of a few images far apart in time."""

from __future__ import annotations

import cv2
import numpy as np

SAMPLES = 9
FIRST_INTERVAL_S = 1.0


class Background:
    """Keeps a few images as JPEG; whenever it is full, every second one goes and the interval doubles."""

    def __init__(self) -> None:
        self._samples: list[np.ndarray] = []
        self._interval_s = FIRST_INTERVAL_S
        self._next_s = 0.0

    def update(self, image: np.ndarray, time_s: float) -> None:
        """Look at a grey or BGR uint8 image; few are kept."""
        if time_s < self._next_s:
            return
        if len(self._samples) == SAMPLES:
            self._samples = self._samples[::2]
            self._interval_s *= 2
        ok, encoded = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 92])
        if ok:
            self._samples.append(encoded)
        self._next_s = time_s + self._interval_s

    def image(self) -> np.ndarray | None:
        """Return the median image, BGR uint8 (H, W, 3), or None before the first."""
        if not self._samples:
            return None
        images = [cv2.imdecode(sample, cv2.IMREAD_COLOR) for sample in self._samples]
        # in strips: a median over all images at once would hold them in floating point
        strips = np.array_split(np.arange(images[0].shape[0]), 16)
        return np.concatenate([
            np.median(np.stack([image[rows] for image in images]), axis=0).astype(np.uint8)
            for rows in strips if len(rows)])
