"""Straight edges on moving vehicles by LSD (Grompone von Gioi et al. 2010): bumpers, windscreens, pillars."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from autocalib_ros.perception.motion_mask import Region

MIN_EDGE_LENGTH = 0.012
"""Shortest edge, fraction of the image width; the direction of shorter ones is too uncertain. Judgement."""
MIN_EDGE_LENGTH_PX = 10.0
"""Shortest edge, pixels of the tracked image; LSD directions of shorter ones are noisy."""
EDGE_FULL_RESOLUTION_SIDE_PX = 96
"""Longer side up to which regions are searched at full size; up to twice this at half size, beyond at a quarter, which
large edges survive."""
MAX_REGIONS = 8
"""Regions searched per image, largest first; smaller ones rarely have edges. Bounds the cost."""
MAX_EDGES_PER_REGION = 24
"""Most edges per region, longest first."""
SAMPLES_PER_EDGE = 7
"""Points along an edge at which mask and contrast are sampled."""
CONTRAST_OFFSET_PX = 2.0
"""Distance from the edge at which its contrast is sampled, to each side."""
MIN_CONTRAST_CHANGE = 0.5
"""Least change of contrast at the place of a moving edge since earlier images, fraction of its contrast; static edges,
lane markings or kerbs next to the vehicle, change less. Judgement."""
EARLIER_IMAGES = 2
"""Images before the present one with which contrast is compared."""


class EdgeFinder:
    """Finds moving straight edges, in pixels of the tracked image."""

    def __init__(self) -> None:
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
        self._earlier: deque[np.ndarray] = deque(maxlen=EARLIER_IMAGES)

    def find(self, grey: np.ndarray, regions: list[Region]) -> tuple[np.ndarray, np.ndarray]:
        """Return edges x0, y0, x1, y1 (n, 4) of a grey image (H, W) and the region index of each (n,)."""
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
        """Return line segments (n, 4) in pixels of a crop (h, w)."""
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
        """Return the mask (n,) of edges (n, 4) that were absent from all earlier images."""
        now = _contrast(grey, edges)
        changes = [np.abs(_contrast(image, edges) - now) for image in self._earlier]
        return np.min(changes, axis=0) > MIN_CONTRAST_CHANGE * np.abs(now)


def _sample_points(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points along edges (n, 4), shape (n, SAMPLES, 2), and the edges' unit normals (n, 2)."""
    share = (np.arange(SAMPLES_PER_EDGE) + 0.5) / SAMPLES_PER_EDGE
    step = edges[:, 2:] - edges[:, :2]
    normals = np.column_stack([-step[:, 1], step[:, 0]]) / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    return edges[:, None, :2] + share[:, None] * step[:, None], normals


def _contrast(image: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the mean grey level difference (n,) between the two sides of edges (n, 4)."""
    points, normals = _sample_points(edges)
    aside = CONTRAST_OFFSET_PX * normals[:, None]
    return (_nearest_pixels(image, points + aside).astype(float) - _nearest_pixels(image, points - aside)).mean(axis=1)


def _nearest_pixels(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the values of an image (H, W) at the pixels nearest to points (..., 2), clipped to the image."""
    height, width = image.shape
    columns, rows = np.round(points).astype(int).T
    return image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].T
