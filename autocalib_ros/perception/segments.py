"""SIFT keypoints in the motion mask, and motion segments: keypoint matches between consecutive masked frames."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from autocalib_ros.perception.motion_mask import Region
from autocalib_ros.perception.ratio_test import distinctive_matches

FULL_RESOLUTION_SIDE_PX = 48
"""Longer side up to which regions are searched at full size; larger ones at half size, which skips mostly noise."""
MAX_KEYPOINTS_PER_REGION = 60
"""Most keypoints per region, by response."""
MIN_SEGMENT_LENGTH_PX = 5.0
"""Shortest segment, pixels of the tracked image; the direction of shorter ones is noise."""
MAX_SEGMENT_LENGTH = 0.2
"""Longest plausible motion between two masked frames, fraction of the image width. Judgement."""


@dataclass(frozen=True)
class Keypoints:
    """SIFT keypoints of one masked frame."""

    points_px: np.ndarray
    """Pixels of the tracked image, shape (n, 2), strongest first within a region."""
    responses: np.ndarray
    """Shape (n,)."""
    regions: np.ndarray
    """Region index of each, shape (n,)."""
    descriptors: np.ndarray
    """Shape (n, 128), float32."""

    def subset(self, keep: np.ndarray) -> Keypoints:
        """Return the keypoints that `keep`, a mask or indices (n,), selects."""
        return Keypoints(self.points_px[keep], self.responses[keep], self.regions[keep], self.descriptors[keep])


class KeypointSearch:
    """Detects SIFT keypoints inside the regions of a grey image (H, W), in two steps of about the same cost."""

    def __init__(self, grey: np.ndarray, regions: list[Region], sift: cv2.SIFT) -> None:
        self._grey, self._regions, self._sift = grey, regions, sift
        self._found: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        self._steps = _halves([_searched_pixels(region) for region in regions])

    def step(self) -> None:
        """Search the next half of the regions."""
        for index in self._steps.pop(0) if self._steps else []:
            self._found[index] = _region_keypoints(self._grey, self._regions[index], self._sift)

    def keypoints(self) -> Keypoints:
        """Return the keypoints of all regions, in the order of the regions, after the steps that are left."""
        while self._steps:
            self.step()
        found = [self._found[index] for index in range(len(self._regions))]
        labels = [np.full(len(points), index) for index, (points, _, _) in enumerate(found)]
        return Keypoints(
            points_px=np.concatenate([points for points, _, _ in found] or [np.zeros((0, 2))]),
            responses=np.concatenate([responses for _, responses, _ in found] or [np.zeros(0)]),
            regions=np.concatenate(labels or [np.zeros(0)]).astype(int),
            descriptors=np.concatenate([descriptors for _, _, descriptors in found] or [np.zeros((0, 128))]).astype(
                np.float32
            ),
        )


def _halves(costs: list[float]) -> list[list[int]]:
    """Divide indices into two lists of about the same sum of costs: each goes to the cheaper one, dearest first."""
    halves: list[list[int]] = [[], []]
    sums = [0.0, 0.0]
    for index in sorted(range(len(costs)), key=lambda index: -costs[index]):
        cheaper = int(sums[1] < sums[0])
        halves[cheaper].append(index)
        sums[cheaper] += costs[index]
    return halves


def _searched_pixels(region: Region) -> float:
    """Return the number of pixels in which a region is searched."""
    return region.mask.size / (4.0 if _is_coarse(region) else 1.0)


def _is_coarse(region: Region) -> bool:
    """Whether a region is searched at half size."""
    return max(region.mask.shape) > FULL_RESOLUTION_SIDE_PX


def _region_keypoints(grey: np.ndarray, region: Region, sift: cv2.SIFT) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    height, width = region.mask.shape
    crop = grey[region.y : region.y + height, region.x : region.x + width]
    mask = region.mask
    coarse = _is_coarse(region)
    if coarse:
        size = (max(1, width // 2), max(1, height // 2))
        crop = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
        mask = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
    found, descriptors = sift.detectAndCompute(np.ascontiguousarray(crop), mask)
    if descriptors is None or not len(found):
        return np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128))
    responses = np.array([keypoint.response for keypoint in found])
    best = np.argsort(-responses, kind='stable')[:MAX_KEYPOINTS_PER_REGION]
    points = np.array([found[index].pt for index in best])
    if coarse:
        points = (points + 0.5) * [width / size[0], height / size[1]] - 0.5
    return points + np.array([region.x, region.y]), responses[best], descriptors[best]


def match_segments(before: Keypoints, after: Keypoints, image_width: int) -> tuple[np.ndarray, np.ndarray]:
    """Match two masked frames; return segments x0, y0, x1, y1 (n, 4) and the index in `after` of each (n,)."""
    if len(before.points_px) < 2 or len(after.points_px) < 2:
        return np.zeros((0, 4)), np.zeros(0, int)
    query, train = distinctive_matches(after.descriptors, before.descriptors).T
    ends = np.hstack([before.points_px[train], after.points_px[query]])
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    keep = (length >= MIN_SEGMENT_LENGTH_PX) & (length <= MAX_SEGMENT_LENGTH * image_width)
    return ends[keep], query[keep]
