"""Pictures that say nothing about the scene: black, over-exposed, covered, blurred, frozen."""

from __future__ import annotations

from enum import Enum
from functools import cache

import cv2
import numpy as np

from autocalib_ros.perception.background_motion import noise_sigma


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
BLURRED_RATIO = 0.3
"""What is left of fine detail over what is left of coarse detail, below which a picture is blurred. Sharp pictures
leave 0.7 or more, compressed, by night and in sway too; a blur of two pixels (sigma) leaves 0.22."""

BLOCKS = (20, 12)
"""Columns and rows of blocks in which the detail is compared."""
MIN_RICH_BLOCKS = 12
"""Least blocks with fine detail from which sharpness is judged. Judgement: a twentieth of the picture."""
MIN_DETAIL_OVER_NOISE = 10.0
"""Least energy of the fine detail of a block over that of the noise of the reference, which is known to a tenth."""
UNHIDDEN_QUANTILE = 0.75
"""Quantile of the blocks that stands for those that nothing hides; blocks with half of their coarse detail count."""
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
        noise = noise_sigma(reference)
        # the energy of a band has that of its noise in it, which later images do not show
        fine, coarse = (
            _over_blocks(band * band) - noise**2 * of_noise
            for band, of_noise in zip(self._bands, _bands_of_noise(), strict=True)
        )
        self._energies = (fine, coarse)
        least = MIN_DETAIL_OVER_NOISE * noise**2 * _bands_of_noise()[0]
        self._rich = (fine >= np.median(fine)) & (fine > least) & (coarse >= np.median(coarse)) & (coarse > 0)

    def sharpness(self, image: np.ndarray) -> float:
        """Return what an image (H, W) of the same pose leaves of the fine detail over what it leaves of the coarse.

        The median of the blocks of the picture that show the reference. Noise does not count, since it is not that of
        the reference, and neither does contrast, which lowers both; blocks with traffic show something else. 1 if the
        reference has too little fine detail, as by night.
        """
        if self._rich.sum() < MIN_RICH_BLOCKS:
            return 1.0
        fine, coarse = (
            _over_blocks(own * other)[self._rich] / energy[self._rich]
            for own, other, energy in zip(self._bands, _bands(image), self._energies, strict=True)
        )
        if np.quantile(coarse, UNHIDDEN_QUANTILE) < LEAST_DETAIL:
            return 0.0
        shown = coarse >= 0.5 * np.quantile(coarse, UNHIDDEN_QUANTILE)
        return float(np.median(fine[shown] / coarse[shown]))


@cache
def _bands_of_noise() -> tuple[float, float]:
    """Return the energy per pixel of both bands of white noise of one grey level."""
    impulse = np.zeros((64, 64), np.float32)
    impulse[32, 32] = 1.0
    fine, coarse = (float((band**2).sum()) for band in _bands(impulse))
    return fine, 4.0 * coarse  # its mean over four places in the half size


def _over_blocks(values: np.ndarray) -> np.ndarray:
    """Return the means of an image (H, W) over `BLOCKS`, flat."""
    return cv2.resize(values, BLOCKS, interpolation=cv2.INTER_AREA).ravel()


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
