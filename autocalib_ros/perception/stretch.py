"""16-bit images as 8 bits, with limits that follow the scene so slowly that tracking does not notice."""

from __future__ import annotations

import numpy as np

PERCENTILES = (1.0, 99.0)
EASE = 0.005
"""Share of the way to the present limits that is gone per image."""
LEAST_SPAN = 16.0
"""Grey levels: an image flatter than this (a lens cap, a dark start) fixes no limits."""
SAMPLES_PER_SIDE = 256


class Stretch:
    """Percentile stretch of one stream; shifting right by 8 alone would leave a 12-bit camera black."""

    def __init__(self) -> None:
        self._limits = np.zeros(2)
        self._encoding = ''

    def to_8_bit(self, image: np.ndarray, encoding: str) -> np.ndarray:
        """Return a uint16 image, of any shape and byte order, as uint8."""
        self._follow(image, encoding)
        low, high = self._limits
        scale = 255.0 / max(high - low, LEAST_SPAN)
        return np.clip((image - np.float32(low)) * np.float32(scale) + np.float32(0.5), 0, 255).astype(np.uint8)

    def _follow(self, image: np.ndarray, encoding: str) -> None:
        every_y, every_x = (max(1, side // SAMPLES_PER_SIDE) for side in image.shape[:2])
        now = np.percentile(image[::every_y, ::every_x], PERCENTILES)
        unset = self._limits[1] - self._limits[0] < LEAST_SPAN
        if unset or encoding != self._encoding:
            self._limits = now
        else:
            self._limits = self._limits + EASE * (now - self._limits)
        self._encoding = encoding
