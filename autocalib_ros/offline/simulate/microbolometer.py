"""Thermal sensor: 14-bit counts with fixed-pattern noise, offset drift and flat-field corrections by a shutter."""

from __future__ import annotations

import math

import cv2
import numpy as np

from autocalib_ros.offline.simulate.options import SimulationOptions

COUNTS_PER_LEVEL = 8.0
"""Counts per grey level of the palette: at the usual 25 counts/K, engines are 19 K warmer than the road."""
NOISE_COUNTS_PER_LEVEL = 1.5
"""Counts per grey level of `noise_sigma`: by default 3 counts of noise, or 120 mK."""
BASE_COUNTS = 6400.0
OFFSET_DRIFT_PER_S = 0.8
"""Offset drift in counts per second while the housing warms, reset by the shutter."""
PIXEL_FPN_COUNTS, COLUMN_FPN_COUNTS = 2.0, 1.5
"""Standard deviations of the pixel and column fixed-pattern noise that the correction leaves."""
SHADING_COUNTS, SHADING_PER_S = 12.0, 0.4
"""Excess counts of the corners over the centre (shading): standard deviation after a correction, and growth."""
FFC_OFFSET_COUNTS = 60.0
"""Standard deviation of the offset after a flat-field correction."""
SHUTTER_CLOSED_S = 0.5
"""Duration of a shutter closure."""


class Microbolometer:
    """Converts rendered thermal images to counts; depends only on the options and the time."""

    def __init__(self, options: SimulationOptions) -> None:
        self._options = options
        self._event = -1
        self._pattern = np.zeros(0)
        self._offset = self._shading_gain = 0.0
        height, width = options.height_px, options.width_px
        y, x = np.mgrid[:height, :width]
        square = ((x - width / 2) / (width / 2)) ** 2 + ((y - height / 2) / (height / 2)) ** 2
        self._shading = (square / 2).astype(np.float32)

    def counts(
        self, image: np.ndarray, time_s: float, noise: np.ndarray, *, shutter_closed: bool = False
    ) -> np.ndarray:
        """Return mono16 counts (h, w) of a heat picture (h, w, 3), or of the closed shutter, and noise (h, w, 1)."""
        event, since_s = self._shutter_state(time_s)
        self._redraw_pattern(event)
        heat = cv2.GaussianBlur(np.ascontiguousarray(image[..., 0]).astype(np.float32), (0, 0), 0.6)
        if shutter_closed:
            heat[:] = heat.mean()
        gain = COUNTS_PER_LEVEL * (1 + 0.03 * math.sin(2 * math.pi * time_s / 47.0))
        offset = BASE_COUNTS + 30.0 * math.sin(2 * math.pi * time_s / 31.0 + 1.0) + OFFSET_DRIFT_PER_S * since_s
        bowl = (self._shading_gain + SHADING_PER_S * since_s) * self._shading
        counts = heat * gain + (offset + self._offset) + self._pattern + bowl + noise[..., 0]
        return np.clip(np.round(counts), 0, 16383).astype(np.uint16)

    def _shutter_state(self, time_s: float) -> tuple[int, float]:
        """Return the number of completed corrections and the time since the last one."""
        every_s = self._options.shutter_every_s
        if every_s is None or time_s < every_s + SHUTTER_CLOSED_S:
            return 0, time_s
        event = math.floor((time_s - SHUTTER_CLOSED_S) / every_s)
        return event, time_s - SHUTTER_CLOSED_S - event * every_s

    def _redraw_pattern(self, event: int) -> None:
        """Draw offset, shading and fixed-pattern noise of the `event`-th correction."""
        if event == self._event:
            return
        rng = np.random.default_rng([self._options.seed, 9, event])
        height, width = self._shading.shape
        self._offset = float(rng.normal(0.0, FFC_OFFSET_COUNTS)) if event else 0.0
        self._shading_gain = float(rng.normal(0.0, SHADING_COUNTS))
        pixels = rng.standard_normal((height, width), np.float32) * PIXEL_FPN_COUNTS
        self._pattern = pixels + rng.standard_normal(width, np.float32) * COLUMN_FPN_COUNTS
        self._event = event


def shutter_closed_since(options: SimulationOptions, time_s: float) -> float | None:
    """Return the time at which the shutter closed if it is closed at a time, else None."""
    every_s = options.shutter_every_s
    if every_s is None or time_s < every_s:
        return None
    closed_s = math.floor(time_s / every_s) * every_s
    return closed_s if time_s - closed_s < SHUTTER_CLOSED_S else None
