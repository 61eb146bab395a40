"""Smaller versions of one grey image, each made once: view, frame gate and motion mask use the same ones."""

from __future__ import annotations

import cv2
import numpy as np


class Reductions:
    """Reductions of a grey image (H, W), uint8, by averages over the pixels; nobody may change them.

    Halves are made of halves: averages of four pixels take a tenth of the time of those over larger areas, and differ
    from them by one grey level at most.
    """

    def __init__(self, image: np.ndarray) -> None:
        self._halves = [image]
        self._of_size: dict[tuple[int, int], np.ndarray] = {}

    def at(self, size: tuple[int, int]) -> np.ndarray:
        """Return the image reduced to a size (width, height), not larger than its own."""
        if size not in self._of_size:
            index = 0
            while _has_half(self._half(index), size):
                index += 1
            image = self._half(index)
            is_there = image.shape == size[::-1]
            self._of_size[size] = image if is_there else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return self._of_size[size]

    def _half(self, index: int) -> np.ndarray:
        """Return the image halved so many times."""
        while len(self._halves) <= index:
            height, width = self._halves[-1].shape
            half = (width // 2, height // 2)
            self._halves.append(cv2.resize(self._halves[-1], half, interpolation=cv2.INTER_AREA))
        return self._halves[index]


def _has_half(image: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether each pixel of a reduction to a size is made of whole pixels of half the image."""
    height, width = image.shape
    return width % (2 * size[0]) == 0 and height % (2 * size[1]) == 0
