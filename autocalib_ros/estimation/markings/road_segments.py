"""Line segments on the road: those of the background near traffic, and their projection through a lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from autocalib_ros.estimation.observations.grouping import component_labels
from autocalib_ros.estimation.observations.track_set import count_earlier, kish_weight
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.great_circles import bearing_change, middles_and_ways, unproject_rays
from autocalib_ros.geometry.robust_kernels import wrap_undirected
from autocalib_ros.geometry.small_matrices import cross
from autocalib_ros.lens.camera import Camera

MAX_DISTANCE_TO_TRAFFIC = 0.06
"""A segment counts as on the road if all of it is within this distance of observed traffic, as a fraction of the image
width: half a lane, or the height of a vehicle."""
TRAFFIC_CELL = 0.01
"""Cell size in which positions of traffic are merged, as a fraction of the image width."""
MAX_ROAD_LINES = 400
"""Most segments in one solution: of each group in turn, the longest first."""
MAX_GROUP_DISTANCE, MAX_GROUP_ANGLE_RAD = 0.05, np.radians(12.0)
"""Segments of one group, such as a crosswalk, are within this distance of a neighbour, as a fraction of the image
width, and as parallel in the image: a painting error is common to the group. Judgement."""
LINE_CORRELATION = 0.3
"""Correlation of the errors within a group: a stripe has several edges, a crosswalk several stripes. Judgement."""


@dataclass(frozen=True)
class RoadSegments:
    """Line segments on the road."""

    ends_px: np.ndarray
    """x0, y0, x1, y1, shape (n, 4)."""
    groups: np.ndarray
    """Group number of each segment, shape (n,)."""

    def __len__(self) -> int:
        return len(self.groups)

    def subset(self, keep: np.ndarray) -> RoadSegments:
        """Return the segments that `keep`, a mask or indices, selects."""
        return RoadSegments(self.ends_px[keep], self.groups[keep])

    @property
    def lengths_px(self) -> np.ndarray:
        """Shape (n,)."""
        return np.hypot(*(self.ends_px[:, 2:] - self.ends_px[:, :2]).T)

    @property
    def weights(self) -> np.ndarray:
        """Weights (n,) that account for the correlation within groups."""
        return kish_weight(self.groups, LINE_CORRELATION)


def segments_on_road(evidence: Evidence) -> RoadSegments:
    """Return the background segments near traffic, at most `MAX_ROAD_LINES`."""
    width, ends = evidence.image_size[0], evidence.still_lines_px
    if not len(ends) or not len(evidence.points_px):
        return RoadSegments(np.zeros((0, 4)), np.zeros(0, int))
    ends = ends[all_within(sample_segments(ends), traffic_cells(evidence), MAX_DISTANCE_TO_TRAFFIC * width)]
    segments = RoadSegments(ends, group_segments(ends, width))
    best_first = segments.subset(np.argsort(-segments.lengths_px, kind='stable'))
    return best_first.subset(np.argsort(count_earlier(best_first.groups), kind='stable')[:MAX_ROAD_LINES])


def traffic_cells(evidence: Evidence) -> np.ndarray:
    """Pixels (n, 2) of the distinct cells where traffic was seen."""
    cell = TRAFFIC_CELL * evidence.image_size[0]
    return np.unique(np.round(evidence.points_px / cell), axis=0) * cell


def sample_segments(ends: np.ndarray) -> np.ndarray:
    """Points along segments (n, 4), shape (n, 5, 2)."""
    fraction = np.linspace(0.0, 1.0, 5)[:, None]
    return ends[:, None, :2] + fraction * (ends[:, 2:] - ends[:, :2])[:, None]


def all_within(points: np.ndarray, positions: np.ndarray, max_distance: float) -> np.ndarray:
    """Mask (n,) of the sets of points (n, m, 2) that lie entirely within `max_distance` of some place (k, 2)."""
    distances, _ = cKDTree(positions).query(points.reshape(-1, 2), distance_upper_bound=max_distance)
    return np.isfinite(distances).reshape(points.shape[:2]).all(axis=1)


def group_segments(ends: np.ndarray, width: int) -> np.ndarray:
    """Number the groups of segments (n, 4), shape (n,)."""
    middle, step = middles_and_ways(ends)
    heading = np.arctan2(step[:, 1], step[:, 0])
    near = np.hypot(*(middle[:, None] - middle).transpose(2, 0, 1)) < MAX_GROUP_DISTANCE * width
    parallel = np.abs(wrap_undirected(heading[:, None] - heading)) < MAX_GROUP_ANGLE_RAD
    return component_labels(np.array(np.nonzero(near & parallel)), len(ends))


@dataclass(frozen=True)
class ProjectedSegments:
    """Segments on the unit sphere about the camera."""

    bearings: np.ndarray
    """Bearings of the middles, shape (n, 3)."""
    along: np.ndarray
    """Unit tangents at the middles, shape (n, 3)."""
    circles: np.ndarray
    """Normals of the great circles, shape (n, 3)."""

    @classmethod
    def from_camera(cls, camera: Camera, ends_px: np.ndarray) -> ProjectedSegments:
        """Unproject segments (n, 4) through a lens."""
        middle, step = middles_and_ways(ends_px)
        rays = unproject_rays(camera, middle)
        along = bearing_change(rays, camera, middle, step)
        along /= np.maximum(np.sqrt((along * along).sum(axis=1)), 1e-12)[:, None]
        return cls(rays.bearings, along, cross(rays.bearings, along))

    def residuals(self, directions: np.ndarray) -> np.ndarray:
        """Angle of each segment from each direction (..., 3), within plus and minus pi / 2, shape (..., n)."""
        return wrap_undirected(np.arctan2(directions @ self.circles.T, directions @ self.along.T))

    def residual_changes(self, directions: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Change (..., k, n) of the residuals for small changes (..., k, 3) of the directions (k, 3)."""
        sine, cosine = directions @ self.circles.T, directions @ self.along.T
        lever = np.maximum(sine * sine + cosine * cosine, 1e-12)
        return cosine / lever * (changes @ self.circles.T) - sine / lever * (changes @ self.along.T)
