"""Image sensor: noise, darkness, glow of lamps."""

from __future__ import annotations

import math

import cv2
import numpy as np

from autocalib_ros.offline.simulate.microbolometer import NOISE_COUNTS_PER_LEVEL
from autocalib_ros.offline.simulate.options import SimulationOptions

_NOISE_MARGIN_PX = 64  # range of the random offset of a crop
NIGHT_GAIN = 0.28  # brightness at night relative to day
_NIGHT_NOISE = 1.8  # noise at night relative to day: higher sensor gain


class SensorNoise:
    """Sensor noise: random crops, randomly flipped, of one large noise image."""

    def __init__(self, options: SimulationOptions) -> None:
        self._seed = options.seed
        self._size = (options.height_px, options.width_px)
        sigma = options.noise_sigma * (_NIGHT_NOISE if options.night else 1.0)
        channels = 1 if options.thermal else 3
        if options.thermal:
            sigma *= NOISE_COUNTS_PER_LEVEL
        rng = np.random.default_rng([options.seed, 6])
        shape = (*(n + _NOISE_MARGIN_PX for n in self._size), channels)
        self._bank = np.round(rng.standard_normal(shape, np.float32) * sigma).astype(np.int16)

    def of(self, index: int) -> np.ndarray:
        """Return the noise (h, w, channels) int16 of a frame."""
        rng = np.random.default_rng([self._seed, 7, index])
        y, x = (int(n) for n in rng.integers(0, _NOISE_MARGIN_PX, 2))
        crop = self._bank[y : y + self._size[0], x : x + self._size[1]]
        return cv2.flip(crop, int(rng.integers(-1, 2))).reshape(*self._size, -1)


def darken(image: np.ndarray) -> np.ndarray:
    """Return a BGR image (h, w, 3) darkened to a night without lamps."""
    levels = np.arange(256) * NIGHT_GAIN
    table = np.stack([levels * 1.15, levels, levels * 0.9], -1).round().astype(np.uint8)
    return cv2.LUT(image, table[None])


def add_glow(image: np.ndarray, pixel: np.ndarray, radius_px: float, colour: tuple[int, int, int]) -> None:
    """Add a glow around a pixel (2,) to a BGR image, in place."""
    radius = max(2.0, 3.0 * radius_px)
    x0, y0 = (max(0, math.floor(c - radius)) for c in pixel)
    x1 = min(image.shape[1], math.ceil(pixel[0] + radius) + 1)
    y1 = min(image.shape[0], math.ceil(pixel[1] + radius) + 1)
    if x1 <= x0 or y1 <= y0:
        return
    dx, dy = np.arange(x0, x1) - pixel[0], np.arange(y0, y1) - pixel[1]
    square = (dx[None] ** 2 + dy[:, None] ** 2) / radius_px**2
    core = np.exp(-square / 0.35) + 0.30 * np.exp(-square / 2.2)
    light = np.clip(core, 0, 1)[..., None] * np.array(colour, float)
    patch = image[y0:y1, x0:x1]
    patch[:] = np.clip(patch + light, 0, 255).astype(np.uint8)
