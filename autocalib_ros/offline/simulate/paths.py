"""Paths of lanes: straight lines, arcs and the clothoids that lead from one to the other."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

GAUSS_NODES, GAUSS_WEIGHTS = (a / 2 for a in np.polynomial.legendre.leggauss(16))
GAUSS_NODES = GAUSS_NODES + 0.5
"""Quadrature on 0..1: exact to a nanometre for pieces that turn by less than a full circle."""
SPIRAL_FRACTION = 0.125
"""Part of a turn that each of its two clothoids takes; the arc between them takes the rest."""
NEWTON_STEPS = 8
"""Newton steps until a length is found to a micrometre."""

Pose = tuple[float, float, float]
"""x and y in metres, heading in radians."""


@dataclass(frozen=True)
class PathSegment:
    """A line, an arc or a clothoid; positive curvature (1/m) turns left.

    sharpness: change of the curvature per metre.
    """

    x: float
    y: float
    heading: float
    length: float
    curvature: float = 0.0
    sharpness: float = 0.0

    def at(self, s: np.ndarray | float) -> np.ndarray:
        """Return (x, y, heading) rows (..., 3) at arc lengths s, extended beyond both ends."""
        s = np.asarray(s, float)
        between = self._heading(s[..., None] * GAUSS_NODES)
        dx, dy = s * (np.cos(between) @ GAUSS_WEIGHTS), s * (np.sin(between) @ GAUSS_WEIGHTS)
        return np.stack([self.x + dx, self.y + dy, self._heading(s)], -1)

    def end(self) -> Pose:
        """Return (x, y, heading) at the end."""
        x, y, heading = self.at(self.length).tolist()
        return x, y, heading

    @property
    def straight(self) -> bool:
        """Whether it is a line."""
        return not self.curvature and not self.sharpness

    @property
    def max_curvature(self) -> float:
        """Its largest curvature without sign."""
        return max(abs(self.curvature), abs(self.curvature + self.sharpness * self.length))

    def _heading(self, s: np.ndarray) -> np.ndarray:
        return self.heading + (self.curvature + 0.5 * self.sharpness * s) * s


@dataclass(frozen=True)
class Path:
    """Pieces joined end to end, addressed by arc length from start_s on."""

    segments: tuple[PathSegment, ...]
    start_s: float = 0.0

    @cached_property
    def starts(self) -> np.ndarray:
        """Arc length at which each piece starts."""
        return self.start_s + np.concatenate([[0.0], np.cumsum([p.length for p in self.segments[:-1]])])

    @cached_property
    def length(self) -> float:
        """Length in metres."""
        return float(sum(p.length for p in self.segments))

    @property
    def straight(self) -> bool:
        """Whether it is one line."""
        return all(segment.straight for segment in self.segments)

    def at(self, s: np.ndarray | float) -> np.ndarray:
        """Return (x, y, heading) rows (..., 3) at arc lengths s; ends go on as they are."""
        s = np.asarray(s, float)
        starts = self.starts
        if len(self.segments) == 1:
            return self.segments[0].at(s - starts[0])
        index = np.clip(np.searchsorted(starts, s, side='right') - 1, 0, len(self.segments) - 1)
        out = np.empty((*s.shape, 3))
        for i, segment in enumerate(self.segments):
            here = index == i
            if here.any():
                out[here] = segment.at(s[here] - starts[i])
        return out

    def curves(self) -> list[tuple[float, float, float]]:
        """Return (start, end, least radius) of every piece that is not straight."""
        return [
            (float(start), float(start) + p.length, 1.0 / p.max_curvature)
            for start, p in zip(self.starts, self.segments, strict=True)
            if not p.straight
        ]


def straight_lane(
    heading: float, offset: float, reach_m: float, about: tuple[float, float] = (0.0, 0.0)
) -> PathSegment:
    """Return a lane: parallel to a heading through a point, offset to its left, reach_m both ways."""
    c, s = math.cos(heading), math.sin(heading)
    x, y = about[0] - reach_m * c - offset * s, about[1] - reach_m * s + offset * c
    return PathSegment(x, y, heading, 2 * reach_m)


def chain_segments(start: Pose, spans: Iterable[tuple[float, float, float]]) -> tuple[PathSegment, ...]:
    """Return pieces end to end: spans are (length, curvature where it begins, where it ends)."""
    segments = []
    for length, first, last in spans:
        segments.append(PathSegment(*start, length, first, (last - first) / length if length else 0.0))
        start = segments[-1].end()
    return tuple(segments)


def clothoid_turn(start: Pose, radius: float, deflection: float) -> tuple[PathSegment, ...]:
    """Return clothoid, arc and clothoid that turn by a signed angle; radius is that of the arc."""
    curvature = math.copysign(1.0 / radius, deflection)
    spiral = 2 * SPIRAL_FRACTION * abs(deflection) * radius
    arc = (1 - 2 * SPIRAL_FRACTION) * abs(deflection) * radius
    return chain_segments(start, [(spiral, 0.0, curvature), (arc, curvature, curvature), (spiral, curvature, 0.0)])


def tangent_per_radius(deflection: float) -> float:
    """Return how far before the corner of its tangents a turn of radius 1 begins."""
    return clothoid_turn((0.0, 0.0, 0.0), 1.0, abs(deflection))[-1].end()[0] / (1 + math.cos(deflection))


def apex_per_radius(deflection: float) -> float:
    """Return how far from the corner of its tangents a turn of radius 1 passes."""
    middle = Path(clothoid_turn((0.0, 0.0, 0.0), 1.0, abs(deflection)))
    x, y, _ = middle.at(middle.length / 2).tolist()
    return math.hypot(x - tangent_per_radius(deflection), y)


def line_intersection(first: PathSegment, last: PathSegment) -> tuple[float, float]:
    """Return where two lines meet, as the distance along each."""
    directions = np.array([[math.cos(p.heading), math.sin(p.heading)] for p in (first, last)])
    gap = np.array([last.x - first.x, last.y - first.y])
    along, back = np.linalg.solve(np.stack([directions[0], -directions[1]], 1), gap).tolist()
    return along, back


def join_lines(first: PathSegment, last: PathSegment, radius: float) -> Path:
    """Return the path along one line, through a turn of a radius, and along another line."""
    deflection = math.remainder(last.heading - first.heading, 2 * math.pi)
    tangent = radius * tangent_per_radius(deflection)
    along, back = line_intersection(first, last)
    lead = PathSegment(first.x, first.y, first.heading, along - tangent)
    curve = clothoid_turn(lead.end(), radius, deflection)
    return Path((lead, *curve, PathSegment(*curve[-1].end(), last.length - back - tangent)))


def lane_change(lane: PathSegment, begin_s: float, length: float, aside_m: float) -> Path:
    """Return a lane that is left at begin_s for one aside_m to its left, over a length."""
    lead = PathSegment(lane.x, lane.y, lane.heading, begin_s)
    curvature = 8 * aside_m / length**2
    for _ in range(NEWTON_STEPS):
        shift = _swerve((0.0, 0.0, 0.0), length, curvature)[-1].end()[1]
        curvature *= aside_m / shift
    swerve = _swerve(lead.end(), length, curvature)
    gone = _swerve((0.0, 0.0, 0.0), length, curvature)[-1].end()[0]
    return Path((lead, *swerve, PathSegment(*swerve[-1].end(), lane.length - begin_s - gone)))


def _swerve(start: Pose, length: float, curvature: float) -> tuple[PathSegment, ...]:
    """Return four clothoids that turn one way and back again."""
    quarter = length / 4
    return chain_segments(
        start,
        [(quarter, 0.0, curvature), (quarter, curvature, 0.0), (quarter, 0.0, -curvature), (quarter, -curvature, 0.0)],
    )
