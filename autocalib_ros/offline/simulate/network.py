"""Road networks: roads, the routes over them and the signals that guard them.

A network knows geometry only, and traffic knows routes only: `scenes.py` holds the networks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from autocalib_ros.offline.simulate.paths import Path, PathSegment

LANE_WIDTH_M = 3.2
RURAL_LANE_WIDTH_M = 3.5
ARM_LENGTH_M = 110.0
CROSSING_WIDTH_M = 3.5
CITY_SPEED_MPS = 12.5
_AXIS_SAMPLES_M = np.arange(-400.0, 400.0, 0.5)
"""Where a curved road is looked up; roads are painted no farther."""
_MAX_AXIS_DISTANCE_M = 60.0
"""Farther from a curved road nobody asks how far exactly."""


@dataclass(frozen=True)
class Circulation:
    """The part of a route that lies on the ring of a roundabout.

    joins_s, leaves_s: arc lengths of the route; joins_m: place on the ring where it joins.
    """

    entry_s: float
    exit_s: float
    entry_m: float
    circumference_m: float

    def position_m(self, s: float) -> float:
        """Return the place on the ring at an arc length of the route; before the ring, ahead of it."""
        return self.entry_m + s - self.entry_s

    def distance_ahead_m(self, position_m: float, s: float) -> float:
        """Return the way round the ring from where a route is at s to a place, 0..circumference."""
        return (position_m - self.position_m(s)) % self.circumference_m


@dataclass(frozen=True)
class Route:
    """A way through the network.

    approach and leave name the lanes it shares with other routes; stop_s is the arc length of its
    stop line, split_s the one at which it parts from the other routes of its approach lane.
    share is its traffic relative to that of one lane.  Where stop_s is 0 there is no stop line, and
    the route belongs to both its lanes from the start.  ring: who enters it gives way.  narrow: its
    turns are too tight for long vehicles.
    """

    path: Path
    approach: str
    leave: str
    movement: str
    share: float
    stop_s: float = math.inf
    diverge_s: float = math.inf
    signal: str | None = None
    ring: Circulation | None = None
    narrow: bool = False
    speed_mps: float = CITY_SPEED_MPS

    @property
    def entry_lanes(self) -> frozenset[str]:
        """The lanes that it uses from its start."""
        return frozenset({self.approach, self.leave} if self.stop_s <= 0 else {self.approach})


@dataclass(frozen=True)
class Road:
    """A strip of asphalt for painting, about the path of its axis.

    lane_edges_m: (offset to the left of the axis, kind) with kind 'edge', 'dash' or 'solid'.
    begin_m: where along the axis it begins; only a straight road may.
    """

    path: Path
    half_width_m: float
    lane_edges_m: tuple[tuple[float, str], ...]
    begin_m: float = -math.inf

    @property
    def straight(self) -> bool:
        """Whether it has one heading."""
        return self.path.straight

    @property
    def headings(self) -> tuple[float, ...]:
        """The headings of its straight parts."""
        return tuple(segment.heading for segment in self.path.segments if segment.straight)

    def reaches(self, along: float) -> bool:
        """Tell whether it is there at a distance along its axis."""
        return along >= self.begin_m

    def at(self, along: np.ndarray | float, aside: np.ndarray | float) -> np.ndarray:
        """Return ground points (..., 2) at distances along the road and to the left of its axis."""
        rows = self.path.at(along)
        left = np.stack([-np.sin(rows[..., 2]), np.cos(rows[..., 2])], -1)
        return rows[..., :2] + np.asarray(aside, float)[..., None] * left

    def heading(self, along: float) -> float:
        """Return the heading of the axis at a distance along it."""
        return float(self.path.at(along)[2])

    def edge_distance(self, xy: np.ndarray) -> np.ndarray:
        """Return how far points (..., 2) lie outside the strip, in metres; negative on it."""
        if not self.straight:
            found, _ = self._axis_tree.query(xy, distance_upper_bound=_MAX_AXIS_DISTANCE_M)
            return np.minimum(found, _MAX_AXIS_DISTANCE_M) - self.half_width_m
        x, y, heading = self.path.at(0.0).tolist()
        dx, dy = xy[..., 0] - x, xy[..., 1] - y
        c, s = math.cos(heading), math.sin(heading)
        beside = np.abs(dy * c - dx * s) - self.half_width_m
        if math.isinf(self.begin_m):
            return beside
        before = self.begin_m - (dx * c + dy * s)
        return np.hypot(np.maximum(beside, 0.0), np.maximum(before, 0.0)) + np.minimum(np.maximum(beside, before), 0.0)

    @cached_property
    def _axis_tree(self) -> cKDTree:
        return cKDTree(self.path.at(_AXIS_SAMPLES_M)[:, :2])


def straight_road(
    heading: float,
    half_width_m: float,
    lane_edges_m: tuple[tuple[float, str], ...],
    begin_m: float = -math.inf,
) -> Road:
    """Return a road through the origin."""
    return Road(Path((PathSegment(0.0, 0.0, heading, 0.0),)), half_width_m, lane_edges_m, begin_m)


@dataclass(frozen=True)
class Roundabout:
    """A ring about the origin: radii of the asphalt's outer edge and of the island."""

    outer_m: float
    island_m: float


@dataclass(frozen=True)
class Network:
    """Roads, routes and signals.

    stop_m is the distance of the stop or give-way lines from the origin, crossing_m that of the
    nearer edge of the zebra crossings.  Where it is rural there are no pavements, houses or people;
    barriers_m are offsets from the axis of the first road at which crash barriers stand.
    """

    roads: tuple[Road, ...]
    routes: tuple[Route, ...]
    phases: tuple[tuple[str, float], ...]
    stop_m: float | None
    viewpoint_m: tuple[float, float]
    view_yaw_deg: float
    crossing_m: float | None = None
    corner_radius_m: float = 6.5
    roundabout: Roundabout | None = None
    rural: bool = False
    barriers_m: tuple[float, ...] = ()

    @property
    def clear_m(self) -> float:
        """Distance from the origin beyond which an arm is a plain road: past its stop line and crossing."""
        if self.stop_m is None:
            return 0.0
        return max(self.stop_m, self.crossing_m + CROSSING_WIDTH_M)

    def directions(self) -> np.ndarray:
        """Return unit vectors (n, 2) along the straight roads."""
        headings = [heading for road in self.roads for heading in road.headings]
        return np.array([(math.cos(h), math.sin(h)) for h in headings]).reshape(-1, 2)
