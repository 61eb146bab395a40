"""Lucas-Kanade optical flow of a few hundred points, forwards and back, on the parts of the images around them.

OpenCV prepares pyramids and derivatives of whole images, which costs more than the points themselves. Points on
vehicles lie close together: the parts of the images around groups of them are a third of a busy picture.
"""

from __future__ import annotations

import cv2
import numpy as np

GROUP_CELL_PX = 64
"""Side of the cells whose neighbours form a group of points, pixels: vehicles nearer to each other share the
surroundings that the coarsest level of the pyramid needs."""
ALIGNMENT_PX = 8
"""Borders of the parts are multiples of this, so that levels of their pyramids have the pixels of those of the images:
the step of the third level, the coarsest one by default."""
CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
"""Most iterations of a level, and the step in pixels at which they end."""


def follow_points(
    before: np.ndarray, after: np.ndarray, start: np.ndarray, guess: np.ndarray, *, window_px: int, levels: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Follow points (n, 2) of a grey image (H, W) into another one from a guess (n, 2), and back at full resolution.

    Return their positions (n, 2), the distance (n,) of the way back from the start, and the mask (n,) of the points
    that were found both ways.
    """
    origin, found = start.astype(np.float32), guess.astype(np.float32)
    round_trip_px, tracked = np.zeros(len(origin), np.float32), np.zeros(len(origin), bool)
    for group in _groups(origin, before.shape):
        first, aim = origin[group], found[group]
        ends, forward = _flow(before, after, first, aim, window_px, levels)
        back, backward = _flow(after, before, ends, first, window_px, 0)
        found[group], tracked[group] = ends, forward & backward
        round_trip_px[group] = np.hypot(*(back - first).T)
    return found, round_trip_px, tracked


def _groups(points: np.ndarray, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Return the indices of the points (n, 2) of each group of neighbouring cells in an image of `shape`."""
    rows, columns = -(-shape[0] // GROUP_CELL_PX), -(-shape[1] // GROUP_CELL_PX)
    x, y = np.clip(points / GROUP_CELL_PX, 0, [columns - 1, rows - 1]).astype(int).T
    occupied = np.zeros((rows, columns), np.uint8)
    occupied[y, x] = 1
    count, labels = cv2.connectedComponents(occupied, connectivity=8)
    of_point = labels[y, x]
    return [np.flatnonzero(of_point == label) for label in range(1, count)]


def _flow(
    before: np.ndarray,
    after: np.ndarray,
    start: np.ndarray,
    guess: np.ndarray,
    window_px: int,
    levels: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Follow points (n, 2) float32 within the parts of the images around both ends.

    Return their positions (n, 2) float32 and the mask (n,) of those that were found.
    """
    part, corner = _part(np.concatenate([start, guess]), before.shape, (window_px + 1) << levels)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        before[part],
        after[part],
        np.ascontiguousarray(start - corner).reshape(-1, 1, 2),
        np.ascontiguousarray(guess - corner).reshape(-1, 1, 2),
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return found[:, 0] + corner, status.ravel() == 1


def _part(ends: np.ndarray, shape: tuple[int, ...], window_px: int) -> tuple[tuple[slice, slice], np.ndarray]:
    """Return rows and columns around points (n, 2) of an image, whole blocks, and the first corner (2,) float32.

    Windows of the coarsest level, `window_px` of the image wide, fit about the points, and into the part also at the
    border of the image: OpenCV leaves out levels that are smaller than a window.
    """
    size = np.array([shape[1], shape[0]])
    inside = np.clip(ends, 0, size - 1)
    reach, block = window_px // 2 + 1, ALIGNMENT_PX
    low = np.floor((inside.min(axis=0) - reach) / block).astype(int) * block
    high = np.ceil((inside.max(axis=0) + reach) / block).astype(int) * block
    low = np.maximum(np.minimum(low, (size - window_px - block) // block * block), 0)
    high = np.minimum(np.maximum(high, low + window_px + block), size)
    return (slice(low[1], high[1]), slice(low[0], high[0])), low.astype(np.float32)
