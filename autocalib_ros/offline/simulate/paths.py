"""Lane paths: lines, arcs and clothoids between them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

GAUSS_NODES, GAUSS_WEIGHTS = (a / 2 for a in np.polynomial.legendre.leggauss(16))
GAUSS_NODES = GAUSS_NODES + 0.5
"""Gauss-Legendre quadrature on 0..1: exact to 1 nm for segments that turn by less than a full circle."""
SPIRAL_FRACTION = 0.125
"""Fraction of the deflection of a turn on each of its two clothoids; the rest is on the arc."""
OFFSET_ITERATIONS = 8
"""Fixed-point iterations after which the offset of a lane change is exact to 1 um."""

Pose = tuple[float, float, float]
"""x and y in metres, heading in radians."""


@dataclass(frozen=True)
class PathSegment:
    """A line, an arc or a clothoid; positive curvature (1/m) turns left.

    sharpness: change of curvature per metre.
    """

    x: float
    y: float
    heading: float
    length: float
    curvature: float = 0.0
    sharpness: float = 0.0

    def at(self, s: np.ndarray | float) -> np.ndarray:
        """Return (x, y, heading) rows (..., 3) at arc lengths s, extrapolated beyond both ends."""
        s = np.asarray(s, float)
        if self.straight:
            poses = np.empty((*s.shape, 3))
            poses[..., 0] = self.x + s * math.cos(self.heading)
            poses[..., 1] = self.y + s * math.sin(self.heading)
            poses[..., 2] = self.heading
            return poses
        between = self._heading(s[..., None] * GAUSS_NODES)
        dx, dy = s * (np.cos(between) @ GAUSS_WEIGHTS), s * (np.sin(between) @ GAUSS_WEIGHTS)
        return np.stack([self.x + dx, self.y + dy, self._heading(s)], -1)

    def end(self) -> Pose:
        """Return (x, y, heading) at the end."""
        x, y, heading = self.at(self.length).tolist()
        return x, y, heading

    @property
    def straight(self) -> bool:
        """Whether the segment is a line."""
        return not self.curvature and not self.sharpness

    @property
    def max_curvature(self) -> float:
        """Largest absolute curvature."""
        return max(abs(self.curvature), abs(self.curvature + self.sharpness * self.length))

    def _heading(self, s: np.ndarray) -> np.ndarray:
        return self.heading + (self.curvature + 0.5 * self.sharpness * s) * s


@dataclass(frozen=True)
class Path:
    """Segments joined end to end, parameterised by arc length from start_s on."""

    segments: tuple[PathSegment, ...]
    start_s: float = 0.0

    @cached_property
    def starts(self) -> np.ndarray:
        """Arc length at which each segment starts."""
        return self.start_s + np.concatenate([[0.0], np.cumsum([p.length for p in self.segments[:-1]])])

    @cached_property
    def length(self) -> float:
        """Length in metres."""
        return float(sum(p.length for p in self.segments))

    @property
    def straight(self) -> bool:
        """Whether the path is a line."""
        return all(segment.straight for segment in self.segments)

    def at(self, s: np.ndarray | float) -> np.ndarray:
        """Return (x, y, heading) rows (..., 3) at arc lengths s; end segments are extrapolated."""
        s = np.asarray(s, float)
        starts = self.starts
        if len(self.segments) == 1:
            return self.segments[0].at(s - starts[0])
        index = np.clip(np.searchsorted(starts, s, side='right') - 1, 0, len(self.segments) - 1)
        out = np.empty((*s.shape, 3))
        for i, segment in enumerate(self.segments):
            on_segment = index == i
            if on_segment.any():
                out[on_segment] = segment.at(s[on_segment] - starts[i])
        return out

    @cached_property
    def curves(self) -> tuple[tuple[float, float, float], ...]:
        """Start, end and minimum radius of every curved segment."""
        return tuple(
            (float(start), float(start) + p.length, 1.0 / p.max_curvature)
            for start, p in zip(self.starts, self.segments, strict=True)
            if not p.straight
        )


def straight_lane(
    heading: float, offset: float, reach_m: float, about: tuple[float, float] = (0.0, 0.0)
) -> PathSegment:
    """Return a straight lane of length 2 reach_m about a point, offset to the left of its heading."""
    c, s = math.cos(heading), math.sin(heading)
    x, y = about[0] - reach_m * c - offset * s, about[1] - reach_m * s + offset * c
    return PathSegment(x, y, heading, 2 * reach_m)


def chain_segments(start: Pose, spans: Iterable[tuple[float, float, float]]) -> tuple[PathSegment, ...]:
    """Return segments end to end; spans are (length, initial curvature, final curvature)."""
    segments = []
    for length, first, last in spans:
        segments.append(PathSegment(*start, length, first, (last - first) / length if length else 0.0))
        start = segments[-1].end()
    return tuple(segments)


def clothoid_turn(start: Pose, radius: float, deflection: float) -> tuple[PathSegment, ...]:
    """Return a turn by a signed angle: clothoid, arc of a radius, clothoid."""
    curvature = math.copysign(1.0 / radius, deflection)
    spiral = 2 * SPIRAL_FRACTION * abs(deflection) * radius
    arc = (1 - 2 * SPIRAL_FRACTION) * abs(deflection) * radius
    return chain_segments(start, [(spiral, 0.0, curvature), (arc, curvature, curvature), (spiral, curvature, 0.0)])


def tangent_per_radius(deflection: float) -> float:
    """Return the tangent length of a turn of radius 1: from its start to the intersection of its tangents."""
    return clothoid_turn((0.0, 0.0, 0.0), 1.0, abs(deflection))[-1].end()[0] / (1 + math.cos(deflection))


def apex_per_radius(deflection: float) -> float:
    """Return the distance of the apex of a turn of radius 1 from the intersection of its tangents."""
    middle = Path(clothoid_turn((0.0, 0.0, 0.0), 1.0, abs(deflection)))
    x, y, _ = middle.at(middle.length / 2).tolist()
    return math.hypot(x - tangent_per_radius(deflection), y)


def line_intersection(first: PathSegment, last: PathSegment) -> tuple[float, float]:
    """Return the intersection of two lines as the distance along each."""
    directions = np.array([[math.cos(p.heading), math.sin(p.heading)] for p in (first, last)])
    gap = np.array([last.x - first.x, last.y - first.y])
    along, back = np.linalg.solve(np.stack([directions[0], -directions[1]], 1), gap).tolist()
    return along, back


def join_lines(first: PathSegment, last: PathSegment, radius: float) -> Path:
    """Return the path along one line, through a turn of a given radius, and along another line."""
    deflection = math.remainder(last.heading - first.heading, 2 * math.pi)
    tangent = radius * tangent_per_radius(deflection)
    along, back = line_intersection(first, last)
    lead = PathSegment(first.x, first.y, first.heading, along - tangent)
    curve = clothoid_turn(lead.end(), radius, deflection)
    return Path((lead, *curve, PathSegment(*curve[-1].end(), last.length - back - tangent)))


def lane_change(lane: PathSegment, begin_s: float, length: float, lateral_m: float) -> Path:
    """Return a lane change that starts at begin_s and moves lateral_m to the left over a length."""
    lead = PathSegment(lane.x, lane.y, lane.heading, begin_s)
    curvature = 8 * lateral_m / length**2
    for _ in range(OFFSET_ITERATIONS):
        shift = _swerve((0.0, 0.0, 0.0), length, curvature)[-1].end()[1]
        curvature *= lateral_m / shift
    swerve = _swerve(lead.end(), length, curvature)
    advance = _swerve((0.0, 0.0, 0.0), length, curvature)[-1].end()[0]
    return Path((lead, *swerve, PathSegment(*swerve[-1].end(), lane.length - begin_s - advance)))


def _swerve(start: Pose, length: float, curvature: float) -> tuple[PathSegment, ...]:
    """Return four clothoids that turn to one side and back."""
    quarter = length / 4
    return chain_segments(
        start,
        [(quarter, 0.0, curvature), (quarter, curvature, 0.0), (quarter, 0.0, -curvature), (quarter, -curvature, 0.0)],
    )
