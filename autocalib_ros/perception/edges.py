"""Straight edges on vehicles: bumpers, windscreens, pillars, the gaps between a lorry and its load."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from autocalib_ros.perception.motion_mask import Region

MIN_EDGE_LENGTH = 0.012
"""Shortest edge, share of the image width; below, its direction is hardly known."""
MIN_EDGE_LENGTH_PX = 10.0
EDGE_FULL_RESOLUTION_SIDE_PX = 96
"""Regions beyond this side are searched at half size, beyond twice this at a quarter: large edges lose nothing."""
MAX_REGIONS = 8
"""Regions looked at in one image, largest first; smaller ones have hardly an edge."""
MAX_EDGES_PER_REGION = 24
SAMPLES_PER_EDGE = 7
"""Points along an edge at which it is checked."""
CONTRAST_OFFSET_PX = 2.0
"""How far beside an edge its contrast is taken."""
MIN_CONTRAST_CHANGE = 0.5
"""An edge whose contrast differed by less than this share of it, at the same place in an earlier image, stands
still: a lane marking or a kerb that shows beside the vehicle."""
EARLIER_IMAGES = 2


class EdgeFinder:
    """Finds straight edges that move, in pixels of the tracked image."""

    def __init__(self) -> None:
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
        self._earlier: deque[np.ndarray] = deque(maxlen=EARLIER_IMAGES)

    def find(self, grey: np.ndarray, regions: list[Region]) -> tuple[np.ndarray, np.ndarray]:
        """Return edges x0, y0, x1, y1 (n, 4) of a grey image (H, W) and the index of the region of each (n,)."""
        found = [self._in_region(grey, region) for region in regions[:MAX_REGIONS]] if self._earlier else []
        labels = [np.full(len(edges), index) for index, edges in enumerate(found)]
        self._earlier.append(grey)
        return (np.concatenate([*found, np.zeros((0, 4))]), np.concatenate([*labels, np.zeros(0)]).astype(int))

    def _in_region(self, grey: np.ndarray, region: Region) -> np.ndarray:
        height, width = region.mask.shape
        least = max(MIN_EDGE_LENGTH_PX, MIN_EDGE_LENGTH * grey.shape[1])
        if max(height, width) < least:
            return np.zeros((0, 4))
        edges = self._detect_lines(grey[region.y : region.y + height, region.x : region.x + width])
        length = np.hypot(edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1])
        on_edge, _ = _sample_points(edges)
        edges = (
            edges[(length >= least) & (_nearest_pixels(region.mask, on_edge) > 0).all(axis=1)]
            + [region.x, region.y] * 2
        )
        edges = edges[self._is_moving(grey, edges)]
        length = np.hypot(edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1])
        return edges[np.argsort(-length, kind='stable')[:MAX_EDGES_PER_REGION]]

    def _detect_lines(self, crop: np.ndarray) -> np.ndarray:
        """Line segments (n, 4) in pixels of a crop (h, w)."""
        height, width = crop.shape
        halvings = (
            0
            if max(height, width) <= EDGE_FULL_RESOLUTION_SIDE_PX
            else 1
            if max(height, width) <= 2 * EDGE_FULL_RESOLUTION_SIDE_PX
            else 2
        )
        size = (max(1, width >> halvings), max(1, height >> halvings))
        found = self._detector.detect(
            cv2.resize(crop, size, interpolation=cv2.INTER_AREA) if halvings else np.ascontiguousarray(crop)
        )[0]
        if found is None:
            return np.zeros((0, 4))
        return (found.reshape(-1, 4).astype(float) + 0.5) * ([width / size[0], height / size[1]] * 2) - 0.5

    def _is_moving(self, grey: np.ndarray, edges: np.ndarray) -> np.ndarray:
        """Say which edges (n, 4) were not there in the earlier images, shape (n,)."""
        now = _contrast(grey, edges)
        changes = [np.abs(_contrast(image, edges) - now) for image in self._earlier]
        return np.min(changes, axis=0) > MIN_CONTRAST_CHANGE * np.abs(now)


def _sample_points(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points along edges (n, 4), shape (n, SAMPLES, 2), and the edges' unit normals (n, 2)."""
    share = (np.arange(SAMPLES_PER_EDGE) + 0.5) / SAMPLES_PER_EDGE
    step = edges[:, 2:] - edges[:, :2]
    normals = np.column_stack([-step[:, 1], step[:, 0]]) / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    return edges[:, None, :2] + share[:, None] * step[:, None], normals


def _contrast(image: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean difference of grey levels between the two sides of edges (n, 4), shape (n,)."""
    points, normals = _sample_points(edges)
    aside = CONTRAST_OFFSET_PX * normals[:, None]
    return (_nearest_pixels(image, points + aside).astype(float) - _nearest_pixels(image, points - aside)).mean(axis=1)


def _nearest_pixels(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values of an image (H, W) at the pixels nearest to points (..., 2), clipped to it."""
    height, width = image.shape
    columns, rows = np.round(points).astype(int).T
    return image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].T
