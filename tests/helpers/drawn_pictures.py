"""Pictures that tests draw by the hundred: bodies pasted between pixels, and the noise of a camera."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np

GRAINS = 29
"""Pictures of noise that are drawn for each image size: to draw one costs more than most of what is tested with it."""


@cache
def _grains(shape: tuple[int, ...]) -> np.ndarray:
    """Normal noise of standard deviation 1, shape (GRAINS, *shape)."""
    return np.random.default_rng(9).standard_normal((GRAINS, *shape), np.float32)


def noisy(image: np.ndarray, sigma: float, index: int) -> np.ndarray:
    """Return an image, rounded down to uint8, with noise of `sigma` levels: another for each of `GRAINS` indices."""
    grain = _grains(image.shape)[index % GRAINS]
    return cv2.addWeighted(image.astype(np.float32), 1.0, grain, sigma, -0.5, dtype=cv2.CV_8U)


def paste(image: np.ndarray, body: np.ndarray, x: float, y: float) -> None:
    """Draw a body (h, w) into an image (H, W) with its upper left pixel at (x, y), which may lie between pixels."""
    left, top = math.floor(x), math.floor(y)
    size = (body.shape[1] + 1, body.shape[0] + 1)
    shift = np.array([[1.0, 0.0, x - left], [0.0, 1.0, y - top]])
    cover, look = (cv2.warpAffine(what, shift, size) for what in (np.ones_like(body), body))
    (first_row, end_row), (first_column, end_column) = (
        (min(max(-start, 0), length), max(min(length, extent - start), 0))
        for start, length, extent in ((top, size[1], image.shape[0]), (left, size[0], image.shape[1]))
    )
    if first_row >= end_row or first_column >= end_column:
        return
    inside = (slice(first_row, end_row), slice(first_column, end_column))
    place = image[top + first_row : top + end_row, left + first_column : left + end_column]
    place *= 1 - cover[inside]
    place += look[inside] * cover[inside]
