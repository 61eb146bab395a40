"""Ignored image regions, `ignore_regions`: never tracked, never shown.

Code that draws on, sends or stores a camera image must black it out first:

    image = black_out(image, options.ignored_polygons)
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from autocalib_ros.config import Polygons
from autocalib_ros.errors import UsageError

SUBPIXEL_BITS = 4
"""Fractional bits of the polygon coordinates passed to OpenCV."""


def black_out(image: np.ndarray, polygons: Polygons) -> np.ndarray:
    """Return an image (H, W) or (H, W, 3) of full size with the polygons black; the image itself if there are none."""
    if not polygons:
        return image
    return cv2.bitwise_and(image, image, mask=_visible_mask(polygons, image.shape[1::-1]))


@lru_cache(maxsize=8)
def _visible_mask(polygons: Polygons, size: tuple[int, int]) -> np.ndarray:
    """Return the mask uint8 (H, W) of an image of `size` (width, height): 255 outside the polygons, 0 inside."""
    return np.where(ignored_mask(polygons, size), 0, 255).astype(np.uint8)


@lru_cache(maxsize=8)
def ignored_mask(polygons: Polygons, size: tuple[int, int]) -> np.ndarray:
    """Return the mask bool (H, W) of an image of `size` (width, height): true inside a polygon or on its border."""
    mask = np.zeros(size[::-1], np.uint8)
    for polygon in polygons:
        points = np.round(np.array(polygon) * 2**SUBPIXEL_BITS).astype(np.int32)
        cv2.fillPoly(mask, [points], 1, shift=SUBPIXEL_BITS)
    inside = mask > 0
    inside.flags.writeable = False  # cached and shared
    return inside


def require_polygons_inside(polygons: Polygons, size: tuple[int, int]) -> None:
    """Raise UsageError if a polygon lies entirely outside images of `size` (width, height)."""
    for number, polygon in enumerate(polygons, start=1):
        if not ignored_mask((polygon,), size).any():
            raise UsageError(
                f"polygon {number} of 'ignore_regions' lies entirely outside the images of "
                f'{size[0]}x{size[1]}: give pixels of the full image as the camera sends it'
            )


def union(one: np.ndarray | None, other: np.ndarray | None) -> np.ndarray | None:
    """Return the union of two masks uint8 (h, w), each of which may be None: nothing."""
    if one is None or other is None:
        return one if other is None else other
    return cv2.bitwise_or(one, other)


class IgnoreMask:
    """The ignored regions in pixels of the tracked image, for feature detection."""

    def __init__(self, polygons: Polygons, full_size: tuple[int, int], tracked_size: tuple[int, int]) -> None:
        self._black: np.ndarray | None = None
        if polygons:
            black: np.ndarray = ignored_mask(polygons, full_size).astype(np.uint8)
            # a tracked pixel is ignored if any part of it is
            black = cv2.resize(black * 255, tracked_size, interpolation=cv2.INTER_AREA)
            self._black = (black > 0).astype(np.uint8)

    def near(self, margin_px: int) -> np.ndarray | None:
        """Return the regions dilated by a margin, uint8 0 or 1 (h, w): windows around these pixels overlap a region.

        None if there are no regions.
        """
        if self._black is None:
            return None
        return cv2.dilate(self._black, np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8))
