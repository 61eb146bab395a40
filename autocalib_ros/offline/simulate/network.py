"""Road networks: roads, routes and signals.

A network is geometry only, and the traffic simulation uses its routes only; `scenes.py` builds the networks.
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
"""Length of a lane on an arm, from the origin."""
CROSSING_WIDTH_M = 3.5
CITY_SPEED_MPS = 12.5
"""Mean cruise speed in town."""
_AXIS_SAMPLES_M = np.arange(-400.0, 400.0, 0.5)
"""Arc lengths at which the axis of a curved road is sampled; roads are painted no farther."""
_MAX_AXIS_DISTANCE_M = 60.0
"""Distances from the axis of a curved road are clipped here."""


@dataclass(frozen=True)
class Circulation:
    """Part of a route on the ring of a roundabout.

    entry_s, exit_s: arc lengths along the route; entry_m: position on the ring where the route enters.
    """

    entry_s: float
    exit_s: float
    entry_m: float
    circumference_m: float

    def position_m(self, s: float) -> float:
        """Return the position on the ring at an arc length of the route, extrapolated before the entry."""
        return self.entry_m + s - self.entry_s

    def distance_ahead_m(self, position_m: float, s: float) -> float:
        """Return the distance round the ring from arc length s of the route to a ring position, 0..circumference."""
        return (position_m - self.position_m(s)) % self.circumference_m


@dataclass(frozen=True)
class Route:
    """A route through the network.

    entry_lane, exit_lane: names of the lanes that it shares with other routes.
    share: traffic relative to that of one lane.
    stop_s: arc length of the stop line; 0 without one, and then the route occupies both lanes from its start.
    diverge_s: arc length at which it diverges from the other routes of its entry lane.
    ring: the part on a roundabout, where entering vehicles yield.
    narrow: its turns are too tight for long vehicles.
    """

    path: Path
    entry_lane: str
    exit_lane: str
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
        """Lanes that a vehicle occupies from the start of the route."""
        return frozenset({self.entry_lane, self.exit_lane} if self.stop_s <= 0 else {self.entry_lane})


@dataclass(frozen=True)
class Road:
    """A strip of asphalt along an axis.

    lane_edges_m: (offset to the left of the axis, kind) with kind 'edge', 'dash' or 'solid'.
    begin_m: arc length at which a straight road begins.
    """

    path: Path
    half_width_m: float
    lane_edges_m: tuple[tuple[float, str], ...]
    begin_m: float = -math.inf

    @property
    def straight(self) -> bool:
        """Whether the road has one heading."""
        return self.path.straight

    @property
    def headings(self) -> tuple[float, ...]:
        """Headings of the straight segments."""
        return tuple(segment.heading for segment in self.path.segments if segment.straight)

    def reaches(self, along: float) -> bool:
        """Whether the road exists at a distance along its axis."""
        return along >= self.begin_m

    def at(self, along: np.ndarray | float, lateral: np.ndarray | float) -> np.ndarray:
        """Return ground points (..., 2) at distances along the axis and to its left."""
        poses = self.path.at(along)
        left = np.stack([-np.sin(poses[..., 2]), np.cos(poses[..., 2])], -1)
        return poses[..., :2] + np.asarray(lateral, float)[..., None] * left

    def heading(self, along: float) -> float:
        """Return the heading of the axis at a distance along it."""
        return float(self.path.at(along)[2])

    def edge_distance(self, xy: np.ndarray) -> np.ndarray:
        """Return the signed distance of points (..., 2) to the edge of the road in metres, negative on it."""
        if not self.straight:
            distance, _ = self._axis_tree.query(xy, distance_upper_bound=_MAX_AXIS_DISTANCE_M)
            return np.minimum(distance, _MAX_AXIS_DISTANCE_M) - self.half_width_m
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
    """A ring about the origin: radii of the outer edge of the asphalt and of the island."""

    outer_m: float
    island_m: float


@dataclass(frozen=True)
class StopLines:
    """Markings across the arms of a junction, as distances from the origin.

    stop_m: stop or give-way line.  crossing_m: nearer edge of the zebra crossing.
    """

    stop_m: float
    crossing_m: float

    @property
    def clear_m(self) -> float:
        """Distance beyond which an arm has neither stop line nor crossing."""
        return max(self.stop_m, self.crossing_m + CROSSING_WIDTH_M)


@dataclass(frozen=True)
class Network:
    """Roads, routes and signals.

    phases: signal names and their green times in seconds, in order.
    stop_lines: None without a junction.
    viewpoint_m, view_yaw_deg: default ground point and yaw of the camera.
    rural: no pavements, houses or pedestrians.
    barriers_m: offsets of crash barriers from the axis of the first road.
    """

    roads: tuple[Road, ...]
    routes: tuple[Route, ...]
    phases: tuple[tuple[str, float], ...]
    stop_lines: StopLines | None
    viewpoint_m: tuple[float, float]
    view_yaw_deg: float
    corner_radius_m: float = 6.5
    roundabout: Roundabout | None = None
    rural: bool = False
    barriers_m: tuple[float, ...] = ()

    def directions(self) -> np.ndarray:
        """Return unit vectors (n, 2) along the straight roads."""
        headings = [heading for road in self.roads for heading in road.headings]
        return np.array([(math.cos(h), math.sin(h)) for h in headings]).reshape(-1, 2)
