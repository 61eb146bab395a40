"""Normalise images of 16 bits or of temperatures to 8 bits, with limits that adapt too slowly to disturb tracking."""

from __future__ import annotations

import numpy as np

from autocalib_ros.perception.frame_gate import FrameGate, FrameStatus

PERCENTILES = (1.0, 99.0)
"""Percentiles of the samples that become black and white."""
TIME_CONSTANT_S = 20.0
"""Time constant, seconds, of the two low-pass filters in series through which the limits follow the percentiles. A hot
bus nearby passes in 5 s and shifts them by a fifth of a grey level per image; after a change of weather they converge
within a minute.
"""
MIN_SPAN, MIN_FLOAT_SPAN = 16.0, 0.1
"""Least range, counts or kelvins: a flatter image (lens cap, dark start) sets no limits."""
MAX_ABSOLUTE_VALUE = 1e9
"""Clip limit of floating-point images: above any temperature or count, and its square is finite."""
CLIPPED_FRACTION, CLIPPED_S = 0.25, 2.0
"""Fraction of clipped pixels, and seconds after which the limits are then reset. Judgement."""
HISTOGRAM_SAMPLES = 128
"""Samples along each side of the image for the percentiles."""
MAX_STEP_S = 2.0
"""Longest interval between two images that counts, seconds: one odd stamp must not move the limits, and after a real
pause `CLIPPED_S` resets them if need be."""
DEFAULT_INTERVAL_S = 0.1
"""Frame interval assumed if the stamps are unusable, seconds."""


class IntensityNormaliser:
    """Percentile stretch of one stream; a plain shift by 8 bits would leave the images of a 12-bit camera black.

    A change common to all pixels, such as the drift of a thermal core or its NUC, moves the limits at once, so that the
    grey levels stay the same. Frames of a closed shutter move nothing.
    """

    def __init__(self) -> None:
        self._encoding = ''
        self._stamp_s: float | None = None
        self._reset()

    def _reset(self) -> None:
        self._limits: np.ndarray = np.zeros(2)
        self._target_limits = self._limits
        self._last_samples: np.ndarray | None = None
        self._time_s = self._last_within_limits_s = 0.0
        self._frame_gate: FrameGate | None = None

    def to_8_bit(self, image: np.ndarray, encoding: str, stamp_s: float | None = None) -> np.ndarray:
        """Return an image of any shape and numeric type as uint8, with NaN as black.

        `stamp_s` is its time in seconds; None if unknown.
        """
        self._min_span, self._quantum = MIN_SPAN, 1.0
        if image.dtype.kind == 'f':
            self._min_span, self._quantum = MIN_FLOAT_SPAN, 0.0
            image = np.clip(image.astype(np.float32), -MAX_ABSOLUTE_VALUE, MAX_ABSOLUTE_VALUE)
        self._update_limits(image, encoding, stamp_s)
        low, high = self._limits
        scale = 255.0 / max(high - low, self._min_span)
        if image.dtype.kind == 'f':
            image = np.where(np.isnan(image), np.float32(low), image)
        return np.clip((image - np.float32(low)) * np.float32(scale) + np.float32(0.5), 0, 255).astype(np.uint8)

    def _update_limits(self, image: np.ndarray, encoding: str, stamp_s: float | None) -> None:
        every_y, every_x = (max(1, side // HISTOGRAM_SAMPLES) for side in image.shape[:2])
        samples: np.ndarray = image[::every_y, ::every_x].reshape(-(-image.shape[0] // every_y), -1).astype(np.float32)
        if np.isnan(samples).any():
            known = samples[~np.isnan(samples)]
            samples = np.where(np.isnan(samples), np.median(known) if len(known) else np.float32(0), samples)
        if encoding != self._encoding or (self._last_samples is not None and self._last_samples.shape != samples.shape):
            self._reset()
        step_s = self._step_s(stamp_s)
        self._encoding, self._stamp_s, self._time_s = encoding, stamp_s, self._time_s + step_s
        self._frame_gate = self._frame_gate or FrameGate(min_spread_levels=self._min_span / 4)
        status = self._frame_gate.classify(samples, self._time_s)
        if status in (FrameStatus.REPEATED, FrameStatus.HIDDEN):
            self._last_within_limits_s += step_s
            return
        now: np.ndarray = np.percentile(samples, PERCENTILES)
        unset = self._limits[1] - self._limits[0] < self._min_span
        if unset or status is FrameStatus.LEVEL_SHIFT or self._last_samples is None or self._clipped_too_long(samples):
            self._limits = self._target_limits = now
        else:
            common = _common_change(self._last_samples, samples, self._quantum)
            gain = 1 - np.exp(-step_s / TIME_CONSTANT_S)
            self._target_limits = self._target_limits + common + gain * (now - self._target_limits - common)
            self._limits = self._limits + common + gain * (self._target_limits - self._limits - common)
        self._last_samples = samples

    def _step_s(self, stamp_s: float | None) -> float:
        step_s = 0.0 if stamp_s is None or self._stamp_s is None else stamp_s - self._stamp_s
        return min(step_s, MAX_STEP_S) if step_s > 0 else DEFAULT_INTERVAL_S

    def _clipped_too_long(self, samples: np.ndarray) -> bool:
        """Whether more than `CLIPPED_FRACTION` of the samples has been outside the limits for `CLIPPED_S`."""
        outside = (samples < self._limits[0]) | (samples > self._limits[1])
        if outside.mean() < CLIPPED_FRACTION:
            self._last_within_limits_s = self._time_s
        return self._time_s - self._last_within_limits_s > CLIPPED_S


def _common_change(before: np.ndarray, now: np.ndarray, quantum: float) -> float:
    """Return the mean change of the samples near the median change; robust to traffic and to rounding."""
    change = now - before
    middle = np.median(change)
    deviation = np.abs(change - middle)
    return float(change[deviation <= 2 * np.median(deviation) + quantum].mean())
