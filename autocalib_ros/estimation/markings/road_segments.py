"""Straight lines on the road: those of the still background beside the traffic, and how a lens sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from autocalib_ros.estimation.observations.track_set import count_earlier, kish_weight
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.great_circles import bearing_change, unproject_rays
from autocalib_ros.geometry.robust_kernels import wrap_undirected
from autocalib_ros.lens.camera import Camera

MAX_DISTANCE_TO_TRAFFIC = 0.06
"""A line is on the road when all of it lies within this of a place where traffic was seen, share of the image width:
half of a lane, or what vehicles are high."""
TRAFFIC_CELL = 0.01
"""Places of traffic are told apart by so much, share of the image width."""
MAX_ROAD_LINES = 400
"""Lines in one solution: of each group in turn, the longest first."""
MAX_GROUP_DISTANCE, MAX_GROUP_ANGLE_RAD = 0.05, np.radians(12.0)
"""Lines of one group, a crosswalk say, lie within this of a neighbour, share of the image width, and are as parallel in
the image: whoever painted one askew did so with all."""
LINE_CORRELATION = 0.3
"""How much the errors of a group's lines correlate: several edges are of one stripe, and stripes of one crosswalk."""


@dataclass(frozen=True)
class RoadSegments:
    """Straight lines on the road."""

    ends_px: np.ndarray
    """x0, y0, x1, y1, shape (n, 4)."""
    groups: np.ndarray
    """Which belong together, shape (n,)."""

    def __len__(self) -> int:
        return len(self.groups)

    def subset(self, keep: np.ndarray) -> RoadSegments:
        """Return the lines that `keep`, a mask or indices, selects."""
        return RoadSegments(self.ends_px[keep], self.groups[keep])

    @property
    def lengths_px(self) -> np.ndarray:
        """Shape (n,)."""
        return np.hypot(*(self.ends_px[:, 2:] - self.ends_px[:, :2]).T)

    @property
    def weights(self) -> np.ndarray:
        """Shape (n,): those of one group count less each."""
        return kish_weight(self.groups, LINE_CORRELATION)


def segments_on_road(evidence: Evidence) -> RoadSegments:
    """Return the still lines where traffic was seen, at most `MAX_ROAD_LINES`."""
    width, ends = evidence.image_size[0], evidence.still_lines_px
    if not len(ends) or not len(evidence.points_px):
        return RoadSegments(np.zeros((0, 4)), np.zeros(0, int))
    ends = ends[all_within(sample_segments(ends), traffic_cells(evidence), MAX_DISTANCE_TO_TRAFFIC * width)]
    lines = RoadSegments(ends, _group_ids(ends, width))
    best_first = lines.subset(np.argsort(-lines.lengths_px, kind='stable'))
    return best_first.subset(np.argsort(count_earlier(best_first.groups), kind='stable')[:MAX_ROAD_LINES])


def traffic_cells(evidence: Evidence) -> np.ndarray:
    """Pixels (n, 2) where traffic was seen, each once."""
    grain = TRAFFIC_CELL * evidence.image_size[0]
    return np.unique(np.round(evidence.points_px / grain), axis=0) * grain


def sample_segments(ends: np.ndarray) -> np.ndarray:
    """Points along lines (n, 4), shape (n, 5, 2)."""
    share = np.linspace(0.0, 1.0, 5)[:, None]
    return ends[:, None, :2] + share * (ends[:, 2:] - ends[:, :2])[:, None]


def all_within(points: np.ndarray, places: np.ndarray, reach: float) -> np.ndarray:
    """Tell of which lines all points (n, m, 2) are within reach of one of some places (k, 2), shape (n,)."""
    away, _ = cKDTree(places).query(points.reshape(-1, 2), distance_upper_bound=reach)
    return np.isfinite(away).reshape(points.shape[:2]).all(axis=1)


def _group_ids(ends: np.ndarray, width: int) -> np.ndarray:
    """Number the groups of lines (n, 4), shape (n,)."""
    middle, step = (ends[:, :2] + ends[:, 2:]) / 2, ends[:, 2:] - ends[:, :2]
    heading = np.arctan2(step[:, 1], step[:, 0])
    near = np.hypot(*(middle[:, None] - middle).transpose(2, 0, 1)) < MAX_GROUP_DISTANCE * width
    parallel = np.abs(wrap_undirected(heading[:, None] - heading)) < MAX_GROUP_ANGLE_RAD
    return connected_components(coo_matrix(near & parallel), directed=False)[1]


@dataclass(frozen=True)
class ProjectedSegments:
    """Lines as a lens sees them, on the sphere about the camera."""

    bearings: np.ndarray
    """Of the lines' middles, shape (n, 3)."""
    along: np.ndarray
    """Unit tangents there, shape (n, 3)."""
    circles: np.ndarray
    """Normals of the lines' great circles, shape (n, 3)."""

    @classmethod
    def from_camera(cls, camera: Camera, ends_px: np.ndarray) -> ProjectedSegments:
        """See lines (n, 4) through a lens."""
        middle, step = (ends_px[:, :2] + ends_px[:, 2:]) / 2, ends_px[:, 2:] - ends_px[:, :2]
        rays = unproject_rays(camera, middle)
        along = bearing_change(rays, camera, middle, step)
        along /= np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
        return cls(rays.bearings, along, np.cross(rays.bearings, along))

    def residuals(self, directions: np.ndarray) -> np.ndarray:
        """Angle of each line from each of some directions (..., 3): within a quarter of a turn, shape (..., n)."""
        return wrap_undirected(np.arctan2(directions @ self.circles.T, directions @ self.along.T))

    def leverages(self, directions: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """How far misses change with a turn of the directions (k, 3) about the normal (3,), shape (k, n)."""
        turned = np.cross(normal, directions)
        sine, cosine = directions @ self.circles.T, directions @ self.along.T
        sine_by, cosine_by = turned @ self.circles.T, turned @ self.along.T
        return (cosine * sine_by - sine * cosine_by) / np.maximum(sine**2 + cosine**2, 1e-12)
