"""Opaque rectangles drawn into the images: logos, captions and data fields, with or without text.

Their sides follow pixel rows and columns exactly, and they stand near the upper or lower border, beside the scene.
Sides of buildings, signs and vehicles are tilted by perspective, roll or distortion, so that two long level sides of
one length, one above the other, with an upright one at their ends, are drawn.
"""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np

MAX_TILT_PX = 0.5
"""Largest tilt of a side over its length, pixels: the line segment detector places both ends to less."""
MIN_WIDTH, MIN_HEIGHT_PX = 0.05, 6.0
"""Smallest width, fraction of the image width, and height, pixels: shorter sides of the scene, as of the stripes of a
crosswalk or the rear of a bus, are level to the same tilt by chance; the lowest field with a letter has six pixels."""
MAX_CENTRE = 0.2
"""Largest distance of the centre from the upper or lower border, fraction of the image height: overlays leave the scene
free."""
CORNER_PX = 3.0
"""Largest distance of ends of sides at a corner, pixels: the detector ends segments early at corners."""
MAX_SHARE = 0.5
"""Largest width and height, fractions of the image: larger ones are bars, or pictures in the picture."""
Box = tuple[float, float, float, float]
"""Rectangle x0, y0, x1, y1 in pixels."""


def find_boxes(grey: np.ndarray) -> list[Box]:
    """Return the rectangles with exact sides in a grey background image (H, W)."""
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    if found is None:
        return []
    lines = found.reshape(-1, 4).astype(float)
    along = np.abs(lines[:, 2:] - lines[:, :2])
    level = lines[(along[:, 1] < MAX_TILT_PX) & (along[:, 0] >= MIN_WIDTH * grey.shape[1])]
    upright = lines[(along[:, 0] < MAX_TILT_PX) & (along[:, 1] >= MIN_HEIGHT_PX)]
    height, width = grey.shape
    boxes = []
    for one, other in combinations(level, 2):
        (left, right), (other_left, other_right) = np.sort(one[::2]), np.sort(other[::2])
        top, bottom = np.sort([one[1::2].mean(), other[1::2].mean()])
        if max(abs(left - other_left), abs(right - other_right)) > CORNER_PX or bottom - top < MIN_HEIGHT_PX:
            continue
        box = (min(left, other_left), top, max(right, other_right), bottom)
        small = right - left <= MAX_SHARE * width and bottom - top <= MAX_SHARE * height
        at_border = min(top + bottom, 2 * height - top - bottom) <= 2 * MAX_CENTRE * height
        if small and at_border and _has_upright_side(box, upright):
            boxes.append(box)
    return boxes


def _has_upright_side(box: Box, upright: np.ndarray) -> bool:
    """Whether one of the upright segments (n, 4) joins the level sides of a box at their ends."""
    left, top, right, bottom = box
    x, ends = upright[:, ::2].mean(axis=1), np.sort(upright[:, 1::2], axis=1)
    at_end = np.minimum(np.abs(x - left), np.abs(x - right)) <= CORNER_PX
    return bool((at_end & (np.abs(ends - [top, bottom]).max(axis=1) <= 2 * CORNER_PX)).any())
