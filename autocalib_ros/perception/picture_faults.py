"""Pictures that say nothing about the scene: black, over-exposed, covered, blurred, frozen."""

from __future__ import annotations

from enum import Enum

import cv2
import numpy as np


class PictureFault(str, Enum):
    """Why a picture says nothing."""

    BLACK = 'black'
    OVEREXPOSED = 'over-exposed'
    COVERED = 'covered, fogged or out of focus: nothing with an outline is seen'
    BLURRED = 'blurred'
    FROZEN = 'frozen: the same image again and again'
    UNRECOGNISED = 'changing, and nothing of the calibrated view is seen'


DARK_LEVEL, BRIGHT_LEVEL = 20.0, 250.0
"""Grey levels below and above which a sensor resolves nothing: video black is 16, white is 235 to 255."""
DARK_QUANTILE, BRIGHT_QUANTILE = 0.98, 0.2
"""Quantile of the picture below or above them: 2 % for burnt-in text, and the dark parts of a glaring picture."""
FROZEN_S = 7.0
"""Time for which images are the same before they count as frozen, seconds: sensor noise differs from image to image,
and encoders send whole images every few seconds; consumers are told within 10 s."""
MIN_REPEATS = 5
"""Least number of such images: two that are far apart say nothing about what came between."""
FINE_SIGMAS_PX, COARSE_SIGMAS_PX = (0.7, 1.4), (2.5, 6.0)
"""Scales of the detail that a blur takes away, and of that which it leaves, pixels of the registered image."""
BLURRED_RATIO = 0.45
"""What is left of fine detail, compared with what is left of coarse detail, below which a picture is blurred. A blur of
two pixels (sigma) leaves 0.35, compression by night 0.7."""

LEAST_DETAIL = 0.02
"""Part of the coarse detail below which nothing is left: thick fog leaves 0.04."""


def exposure_fault(image: np.ndarray) -> PictureFault | None:
    """Return whether a grey image (H, W) is black or over-exposed."""
    sampled = image[::4, ::4]
    if np.quantile(sampled, DARK_QUANTILE) <= DARK_LEVEL:
        return PictureFault.BLACK
    return PictureFault.OVEREXPOSED if np.quantile(sampled, BRIGHT_QUANTILE) >= BRIGHT_LEVEL else None


class Detail:
    """Fine and coarse detail of a grey reference (H, W), to see what is left of them in later images."""

    def __init__(self, reference: np.ndarray) -> None:
        self._bands = _bands(reference)
        self._energies = [float(np.vdot(band, band)) for band in self._bands]

    def sharpness(self, image: np.ndarray) -> float:
        """Return what an image (H, W) of the same pose leaves of the fine detail over what it leaves of the coarse.

        Noise does not count, since it is not that of the reference; neither do contrast and traffic, which lower both.
        """
        fine, coarse = (
            float(np.vdot(own, other)) / max(energy, 1e-6)
            for own, other, energy in zip(self._bands, _bands(image), self._energies, strict=True)
        )
        return fine / coarse if coarse > LEAST_DETAIL else 0.0


def _bands(image: np.ndarray) -> list[np.ndarray]:
    """Return the fine detail of a grey image (H, W), and the coarse one in half size."""
    levels = image.astype(np.float32)
    half = cv2.resize(levels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return [
        cv2.GaussianBlur(shown, (0, 0), near / scale) - cv2.GaussianBlur(shown, (0, 0), far / scale)
        for shown, (near, far), scale in ((levels, FINE_SIGMAS_PX, 1.0), (half, COARSE_SIGMAS_PX, 2.0))
    ]


class FreezeDetector:
    """For how long images have been the same."""

    def __init__(self) -> None:
        self._image: np.ndarray | None = None
        self._since_s = 0.0
        self._repeats = 0

    def is_frozen(self, image: np.ndarray, time_s: float) -> bool:
        """Take an image; return whether `MIN_REPEATS` images or more, over `FROZEN_S` or longer, are equal to it."""
        if self._image is None or self._image.shape != image.shape or not np.array_equal(self._image, image):
            self._image, self._since_s, self._repeats = image, time_s, 0
            return False
        self._repeats += 1
        return self._repeats >= MIN_REPEATS and time_s - self._since_s >= FROZEN_S
