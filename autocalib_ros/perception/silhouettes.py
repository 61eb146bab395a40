"""Outlines of what moves, eight points of each: small enough to keep, and their size tells a rider from a car."""

from __future__ import annotations

import cv2
import numpy as np

from autocalib_ros.evidence.snapshot import OUTLINE_COLUMNS
from autocalib_ros.perception.motion_mask import Region

EXTREME_DIRECTIONS = np.array([(-1, -1), (1, 1), (-1, 1), (1, -1), (-1, 0), (1, 0), (0, -1), (0, 1)])
"""In which an outline's points are its farthest, as `Outlines.ends_px` has them."""


def outlines_of(
    regions: list[Region],
    dilation_px: tuple[float, float],
    shape: tuple[int, int],
    reduction: float,
    excluded: np.ndarray | None = None,
) -> np.ndarray:
    """Outline each region of an image (H, W), without what it was `dilation_px` by; rows as `Outlines.ends_px`.

    The full image is `reduction` times as large. What is beside a place that is `excluded`, not 0 in an image (H, W),
    has no gap.
    """
    ends = np.zeros((len(regions), OUTLINE_COLUMNS))
    if not regions:
        return ends
    for row, region in zip(ends, regions, strict=True):
        row[:-1] = (_extreme_points(region) - EXTREME_DIRECTIONS * dilation_px).ravel()
    ends[:, -1] = _gaps_to_nearest(ends[:, :-1].reshape(-1, len(EXTREME_DIRECTIONS), 2), shape)
    ends[:, -1] *= [not _touches_excluded(region, excluded) for region in regions]
    ends *= reduction
    ends[:, :-1] -= 0.5  # from the corner of the image to the centre of its first pixel
    return ends


def _touches_excluded(region: Region, excluded: np.ndarray | None) -> bool:
    height, width = region.mask.shape
    return excluded is not None and bool(excluded[region.y : region.y + height, region.x : region.x + width].any())


def _extreme_points(region: Region) -> np.ndarray:
    """Points (8, 2) where a region reaches farthest in each direction; (0, 0) is the corner of the image."""
    contours, _ = cv2.findContours(region.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    points = np.concatenate(contours).reshape(-1, 2)
    reach = points @ EXTREME_DIRECTIONS.T
    farthest = reach == reach.max(axis=0)
    # the middle of a side, where a whole one is as far
    places = farthest.T @ points / farthest.sum(axis=0)[:, None]
    return places + [region.x + 0.5, region.y + 0.5] + 0.5 * EXTREME_DIRECTIONS


def _gaps_to_nearest(points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Gap (n,) between the box of each outline (n, 8, 2) and the nearest other or the border of the image (H, W)."""
    height, width = shape
    least, most = points.min(axis=1), points.max(axis=1)
    apart = np.maximum(least[:, None] - most, least - most[:, None]).max(axis=2)
    np.fill_diagonal(apart, np.inf)
    border = np.minimum(least, [width, height] - most).min(axis=1)
    return np.maximum(np.minimum(apart.min(axis=1), border), 0.0)
