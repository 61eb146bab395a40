"""Silhouettes of moving regions as eight extreme points: compact, and their size separates cyclists from cars."""

from __future__ import annotations

import cv2
import numpy as np

from autocalib_ros.evidence.tables import OUTLINE_COLUMNS
from autocalib_ros.perception.motion_mask import Region

EXTREME_DIRECTIONS = np.array([(-1, -1), (1, 1), (-1, 1), (1, -1), (-1, 0), (1, 0), (0, -1), (0, 1)])
"""Directions of the extreme points, in the order of `Outlines.ends_px`."""


def outlines_of(
    regions: list[Region],
    dilation_px: tuple[float, float],
    shape: tuple[int, int],
    reduction: float,
    excluded: np.ndarray | None = None,
) -> np.ndarray:
    """Return the silhouettes of the regions of an image (H, W), shape (n, OUTLINE_COLUMNS) as `Outlines.ends_px`.

    `dilation_px` (x, y) of the regions is removed. The result is in pixels of the full image, `reduction` times the
    size. The gap of a region whose box contains a pixel of the mask `excluded` (H, W) is 0.
    """
    ends = np.zeros((len(regions), OUTLINE_COLUMNS))
    if not regions:
        return ends
    for row, region in zip(ends, regions, strict=True):
        row[:-1] = (_extreme_points(region) - EXTREME_DIRECTIONS * dilation_px).ravel()
    ends[:, -1] = _gaps_to_nearest(ends[:, :-1].reshape(-1, len(EXTREME_DIRECTIONS), 2), shape)
    ends[:, -1] *= [not _touches_excluded(region, excluded) for region in regions]
    ends *= reduction
    ends[:, :-1] -= 0.5  # origin from the image corner to the centre of the first pixel
    return ends


def _touches_excluded(region: Region, excluded: np.ndarray | None) -> bool:
    height, width = region.mask.shape
    return excluded is not None and bool(excluded[region.y : region.y + height, region.x : region.x + width].any())


def _extreme_points(region: Region) -> np.ndarray:
    """Return the extreme points (8, 2) of a region, with the origin at the image corner."""
    contours, _ = cv2.findContours(region.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    points = np.concatenate(contours).reshape(-1, 2)
    reach = points @ EXTREME_DIRECTIONS.T
    farthest = reach == reach.max(axis=0)
    # ties, as along a straight side, are averaged
    places = farthest.T @ points / farthest.sum(axis=0)[:, None]
    return places + [region.x + 0.5, region.y + 0.5] + 0.5 * EXTREME_DIRECTIONS


def _gaps_to_nearest(points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the gap (n,) from the box of each silhouette (n, 8, 2) to the nearest other box or the image border."""
    height, width = shape
    least, most = points.min(axis=1), points.max(axis=1)
    apart = np.maximum(least[:, None] - most, least - most[:, None]).max(axis=2)
    np.fill_diagonal(apart, np.inf)
    border = np.minimum(least, [width, height] - most).min(axis=1)
    return np.maximum(np.minimum(apart.min(axis=1), border), 0.0)
