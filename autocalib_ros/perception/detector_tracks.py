"""Tracking by detection: detector boxes associated over time by IoU and propagated by the KLT points inside them.

Stationary objects, parked cars or false detections, also have boxes but yield no region.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import DetectorOptions
from autocalib_ros.evidence.snapshot import TrackKind
from autocalib_ros.perception.detector.detector import Detections, VehicleDetector
from autocalib_ros.perception.klt_tracker import PointTracker
from autocalib_ros.perception.motion_mask import Region

MIN_IOU = 0.3
"""Least intersection over union of a track and its detection (SORT, Bewley et al. 2016)."""
MAX_UNSEEN_S = 1.0
"""Time without a detection after which a track ends: detectors miss a vehicle now and then."""
MIN_MOVING_FRACTION = 0.2
"""Least fraction of a moving box covered by the motion mask: a vehicle fills most of its box, traffic passing behind a
parked one little of it. Judgement."""
MIN_SPEED_PER_S = 0.1
"""Least speed of a moving box by its points, longer sides of the box per second. Judgement."""
MIN_POINTS_PER_BOX = 3
"""Least number of points that propagate a box; fewer may lie on another object. Judgement."""


@dataclass
class _Box:
    """Track of one detected vehicle or person."""

    vehicle: int
    edges_px: np.ndarray
    """Left, top, right, bottom in pixels of the tracked image, origin at the image corner, shape (4,)."""
    seen_s: float
    speed_px_s: float = 0.0
    """Median speed of the points inside; 0 if there are too few."""


class DetectorTracks:
    """Tracks the boxes of one image stream; the detector may be shared between streams but not called concurrently."""

    def __init__(self, detector: VehicleDetector, options: DetectorOptions) -> None:
        self._detector, self._every_s = detector, options.every_s
        self._boxes: list[_Box] = []
        self._votes: dict[int, float] = {}
        self._vehicles = 0
        self._detected_s, self._time_s = -np.inf, -np.inf

    def follow(self, image: np.ndarray, time_s: float, tracker: PointTracker, reduction: float) -> None:
        """Propagate the boxes to a new image by their points, and run the detector every `every_s` seconds.

        `image` (H, W) or (H, W, 3) is `reduction` times the size of the tracked image.
        """
        points, vehicle_ids = tracker.positions()
        self._propagate(vehicle_ids, tracker.steps(), time_s)
        # detect on the image nearest to the due time: stamps jitter
        if time_s + 0.5 * min(time_s - self._time_s, self._every_s) >= self._detected_s + self._every_s:
            found = self._detector.detect(image)
            self._associate(found, found.edges_px / reduction, points + 0.5, vehicle_ids, time_s)
            self._detected_s = time_s
            self._drop_stale_votes(vehicle_ids)
        self._time_s = time_s

    def regions(
        self, moving: list[Region], shape: tuple[int, int], excluded: np.ndarray | None = None
    ) -> tuple[list[Region], np.ndarray]:
        """Return the moving part of each moving box, nearest first, and the vehicle ids (n,).

        `moving` are the regions of the motion mask, `shape` the size (H, W) of the image; pixels where the mask
        `excluded` (H, W) is not 0 belong to no region.
        """
        differs = np.zeros(shape, np.uint8)
        for region in moving:
            height, width = region.mask.shape
            differs[region.y : region.y + height, region.x : region.x + width] |= region.mask
        found, free = [], np.full(shape, 255, np.uint8)
        if excluded is not None:
            free[excluded > 0] = 0
        # A person is in front of a vehicle whose box overlaps; of two vehicles the lower one is nearer.
        for box in sorted(
            self._boxes, key=lambda box: (self.kind(box.vehicle) is not TrackKind.PERSON, -box.edges_px[3])
        ):
            left, top, right, bottom = _pixel_bounds(box.edges_px, shape)
            if right <= left or bottom <= top:
                continue
            own = free[top:bottom, left:right]
            mask = differs[top:bottom, left:right] & own
            if np.count_nonzero(mask) < MIN_MOVING_FRACTION * mask.size:
                if box.speed_px_s < MIN_SPEED_PER_S * max(right - left, bottom - top):
                    continue
                mask = own.copy()
            own[:] = 0
            found.append((Region(left, top, mask), box.vehicle))
        return [region for region, _ in found], np.array([vehicle for _, vehicle in found], int)

    def kind(self, vehicle: int) -> TrackKind:
        """Return the class of a vehicle by the score-weighted majority of its detections."""
        votes = self._votes.get(vehicle)
        return TrackKind.UNKNOWN if votes is None else TrackKind.PERSON if votes < 0 else TrackKind.VEHICLE

    def _propagate(self, vehicle_ids: np.ndarray, steps: np.ndarray, time_s: float) -> None:
        """Move each box by the median displacement of the points of its vehicle since the previous image."""
        for box in self._boxes:
            mine = steps[vehicle_ids == box.vehicle]
            box.speed_px_s = 0.0
            if len(mine) >= MIN_POINTS_PER_BOX:
                step = np.median(mine, axis=0)
                box.edges_px = box.edges_px + np.tile(step, 2)
                box.speed_px_s = float(np.hypot(*step) / max(time_s - self._time_s, 1e-3))

    def _associate(
        self, found: Detections, edges_px: np.ndarray, points: np.ndarray, vehicle_ids: np.ndarray, time_s: float
    ) -> None:
        """Associate each detection with a track by IoU, else by the points inside it, else start a new track."""
        matched = _greedy_iou_matches(edges_px, np.array([box.edges_px for box in self._boxes]).reshape(-1, 4))
        taken = {self._boxes[index].vehicle for index in matched.values()}
        unseen = [box for index, box in enumerate(self._boxes) if index not in matched.values()]
        fresh: list[_Box] = []
        for row, edges in enumerate(edges_px):
            if row in matched:
                vehicle = self._boxes[matched[row]].vehicle
            else:
                vehicle = _vehicle_of_points(edges, points, vehicle_ids, taken) or self._new_vehicle()
            taken.add(vehicle)
            speed = self._boxes[matched[row]].speed_px_s if row in matched else 0.0
            fresh.append(_Box(vehicle, edges, time_s, speed))
            self._votes[vehicle] = self._votes.get(vehicle, 0.0) + found.scores[row] * (-1 if found.people[row] else 1)
        self._boxes = fresh + [
            box for box in unseen if box.vehicle not in taken and time_s - box.seen_s <= MAX_UNSEEN_S
        ]

    def _new_vehicle(self) -> int:
        self._vehicles += 1
        return self._vehicles

    def _drop_stale_votes(self, vehicle_ids: np.ndarray) -> None:
        """Drop the class votes of vehicles that have neither a box nor a point left."""
        alive = {box.vehicle for box in self._boxes} | set(vehicle_ids.tolist())
        self._votes = {vehicle: votes for vehicle, votes in self._votes.items() if vehicle in alive}


def _greedy_iou_matches(detected: np.ndarray, known: np.ndarray) -> dict[int, int]:
    """Match detections (n, 4) to boxes (m, 4) greedily, highest IoU first."""
    overlap = _ious(detected, known)
    pairs: dict[int, int] = {}
    order = np.argsort(-overlap.ravel(), kind='stable')
    for row, column in zip(*np.unravel_index(order, overlap.shape), strict=True):
        if overlap[row, column] < MIN_IOU:
            break
        if row not in pairs and column not in pairs.values():
            pairs[int(row)] = int(column)
    return pairs


def _ious(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the intersection over union of boxes (n, 4) with boxes (m, 4), shape (n, m)."""
    left_top = np.maximum(first[:, None, :2], second[None, :, :2])
    right_bottom = np.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = np.maximum(right_bottom - left_top, 0.0).prod(axis=-1)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=-1) for boxes in (first, second)]
    return shared / np.maximum(areas[0][:, None] + areas[1][None] - shared, 1e-9)


def _vehicle_of_points(edges: np.ndarray, points: np.ndarray, vehicle_ids: np.ndarray, taken: set[int]) -> int:
    """Return the vehicle id of most points (n, 2) inside a box, ids in `taken` excluded; 0 if there is none."""
    inside = ((points >= edges[:2]) & (points < edges[2:])).all(axis=1)
    votes = np.bincount(
        np.array([owner for owner in vehicle_ids[inside].tolist() if owner not in taken], int), minlength=1
    )
    return int(votes.argmax())


def _pixel_bounds(edges: np.ndarray, shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return the pixel range left, top, right, bottom that a box covers of an image (height, width)."""
    left, top = np.maximum(np.floor(edges[:2]), 0).astype(int)
    right, bottom = np.minimum(np.ceil(edges[2:]), shape[::-1]).astype(int)
    return int(left), int(top), int(right), int(bottom)
