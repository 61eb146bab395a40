"""Road networks: lane paths, the routes over them and the signals that guard them.

A network knows geometry only.  Traffic knows routes only: another scene is another function here
that returns a `Network`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .options import SimulationOptions

LANE_WIDTH_M = 3.2
ARM_LENGTH_M = 110.0
CROSSING_WIDTH_M = 3.5


@dataclass(frozen=True)
class Piece:
    """A straight line (curvature 0) or an arc (positive curvature turns left)."""

    x: float
    y: float
    heading: float
    length: float
    curvature: float = 0.0

    def at(self, s: np.ndarray | np.float64) -> np.ndarray:
        """Return (x, y, heading) rows (..., 3) at arc lengths s, extended beyond both ends."""
        heading = self.heading + self.curvature * s
        if abs(self.curvature) < 1e-9:
            dx, dy = s * math.cos(self.heading), s * math.sin(self.heading)
        else:
            dx = (np.sin(heading) - math.sin(self.heading)) / self.curvature
            dy = (math.cos(self.heading) - np.cos(heading)) / self.curvature
        return np.stack([self.x + dx, self.y + dy, heading], -1)

    def end(self) -> tuple[float, float, float]:
        """Return (x, y, heading) at the end."""
        x, y, heading = self.at(np.float64(self.length))
        return float(x), float(y), float(heading)


@dataclass(frozen=True)
class Path:
    """Pieces joined end to end, addressed by arc length."""

    pieces: tuple[Piece, ...]

    @cached_property
    def starts(self) -> np.ndarray:
        """Arc length at which each piece starts."""
        return np.concatenate([[0.0], np.cumsum([p.length for p in self.pieces[:-1]])])

    @cached_property
    def length(self) -> float:
        """Length in metres."""
        return float(sum(p.length for p in self.pieces))

    def at(self, s: np.ndarray | float) -> np.ndarray:
        """Return (x, y, heading) rows (..., 3) at arc lengths s; straight on beyond both ends."""
        s = np.asarray(s, float)
        if len(self.pieces) == 1:
            return self.pieces[0].at(s)
        starts = self.starts
        index = np.clip(np.searchsorted(starts, s, side='right') - 1, 0, len(self.pieces) - 1)
        out = np.empty((*s.shape, 3))
        for i, piece in enumerate(self.pieces):
            here = index == i
            out[here] = piece.at(s[here] - starts[i])
        return out

    def curves(self) -> list[tuple[float, float, float]]:
        """Return (start, end, radius) of every arc."""
        return [
            (float(start), float(start) + p.length, 1.0 / abs(p.curvature))
            for start, p in zip(self.starts, self.pieces, strict=True)
            if p.curvature
        ]


@dataclass(frozen=True)
class Route:
    """A way through the network.

    approach and leave name the lanes it shares with other routes; stop_s is the arc length of its
    stop line, split_s the one at which it parts from the other routes of its approach lane.
    share is its traffic relative to that of one lane.
    """

    path: Path
    approach: str
    leave: str
    movement: str
    share: float
    stop_s: float = math.inf
    split_s: float = math.inf
    signal: str | None = None


@dataclass(frozen=True)
class Road:
    """A straight two-sided strip of asphalt through the origin, for painting.

    lane_edges_m: (offset to the left of the axis, kind) with kind 'edge', 'dash' or 'solid'.
    """

    heading: float
    half_width_m: float
    lane_edges_m: tuple[tuple[float, str], ...]

    @property
    def axis(self) -> np.ndarray:
        """Unit vector (2,) along the road."""
        return np.array([math.cos(self.heading), math.sin(self.heading)])


@dataclass(frozen=True)
class Network:
    """Roads, routes and signals; stop_m is the distance of the stop lines from the origin."""

    roads: tuple[Road, ...]
    routes: tuple[Route, ...]
    phases: tuple[tuple[str, float], ...]
    stop_m: float | None
    viewpoint_m: tuple[float, float]
    view_yaw_deg: float


def network_of(options: SimulationOptions) -> Network:
    """Return the road network that the options ask for."""
    if options.one_way or options.scene == 'road':
        return single_road(one_way=options.one_way)
    return junction(math.radians(options.road_angle_deg), options.turning_fraction)


def single_road(one_way: bool) -> Network:
    """Return one road along the x axis: three lanes one way, or two lanes each way."""
    half = (1.5 if one_way else 2.0) * LANE_WIDTH_M
    offsets, inner = [-1.5, -0.5, 0.5, 1.5], {-1.0: 'dash', 0.0: 'solid', 1.0: 'dash'}
    if one_way:
        offsets, inner = [-1.0, 0.0, 1.0], {0.5: 'dash', -0.5: 'dash'}
    edges = [(-half, 'edge'), (half, 'edge')]
    edges += [(i * LANE_WIDTH_M, kind) for i, kind in inner.items()]
    routes = []
    for i in offsets:
        heading = 0.0 if one_way or i < 0 else math.pi
        lane = f'lane{i:+g}'
        path = Path((_line_at(heading, abs(i) * -LANE_WIDTH_M if heading else i * LANE_WIDTH_M),))
        routes.append(Route(path, lane, lane, 'straight', 1.0))
    # Near enough to fill the picture, and looking across the road, not along it.
    return Network(
        (Road(0.0, half, tuple(edges)),), tuple(routes), (), None, (-8.0, -half - 5.0), 52.0
    )


def junction(angle: float, turning_fraction: float) -> Network:
    """Return two roads that cross at an angle (radians), each with two lanes and a left-turn lane.

    Straight and right-turning traffic of one road has green together; left turns have their own
    phase, which traffic skips when nobody waits.
    """
    half = 2.5 * LANE_WIDTH_M
    reach = half * (1 + abs(math.cos(angle))) / math.sin(angle)
    stop_m = reach + CROSSING_WIDTH_M + 4.0
    w = LANE_WIDTH_M
    edges = [(-half, 'edge'), (half, 'edge'), (-1.5 * w, 'dash'), (1.5 * w, 'dash')]
    edges += [(-0.5 * w, 'solid'), (0.5 * w, 'solid')]
    roads = tuple(Road(h, half, tuple(edges)) for h in (0.0, angle))
    routes: list[Route] = []
    for road, heading in enumerate((0.0, angle, math.pi, math.pi + angle)):
        routes += _arm_routes(heading, road % 2, angle, stop_m, turning_fraction)
    phases = (('main0', 13.0), ('left0', 5.0), ('main1', 13.0), ('left1', 5.0))
    # In the corner between the two arms behind the origin, unequally far from both roads.
    along, across = np.array([1.0, 0.0]), np.array([math.cos(angle), math.sin(angle)])
    foot = -(along * (half + 4.0) + across * (half + 7.5)) / math.sin(angle)
    yaw = math.degrees(math.atan2(-foot[1], -foot[0])) + 6.0
    return Network(roads, tuple(routes), phases, stop_m, (float(foot[0]), float(foot[1])), yaw)


def _arm_routes(
    heading: float, road: int, angle: float, stop_m: float, turning_fraction: float
) -> list[Route]:
    """Return the routes of the traffic that enters with a heading on road 0 or 1."""
    w = LANE_WIDTH_M
    turned = angle if road == 0 else math.pi - angle
    left, right = heading + turned, heading + turned - math.pi
    name = f'{math.degrees(heading):.0f}'
    plans = [
        ('straight', -w, heading, 1.0 - turning_fraction),
        ('straight', -2 * w, heading, 1.0 - turning_fraction),
        ('left', 0.0, left, turning_fraction),
        ('right', -2 * w, right, turning_fraction),
    ]
    routes = []
    for movement, offset, leave, share in plans:
        exit_offset = {'straight': offset, 'left': -w, 'right': -2 * w}[movement]
        path, split = _through(heading, offset, leave, exit_offset, stop_m, movement)
        routes.append(
            Route(
                path=path,
                approach=f'in {name} {offset:.1f}',
                leave=f'out {math.degrees(leave) % 360:.0f} {exit_offset:.1f}',
                movement=movement,
                share=share,
                stop_s=ARM_LENGTH_M - stop_m - 0.5,
                split_s=split,
                signal=f'{"left" if movement == "left" else "main"}{road}',
            )
        )
    return routes


def _line_at(heading: float, offset: float, start_m: float = -ARM_LENGTH_M) -> Piece:
    """Return a lane: a line parallel to a heading through the origin, offset to its left."""
    c, s = math.cos(heading), math.sin(heading)
    x, y = start_m * c - offset * s, start_m * s + offset * c
    return Piece(x, y, heading, -2 * start_m)


def _through(
    heading: float, offset: float, leave: float, exit_offset: float, stop_m: float, movement: str
) -> tuple[Path, float]:
    """Join an approach lane to an exit lane by an arc; return the path and the arc's start."""
    lane = _line_at(heading, offset)
    if movement == 'straight':
        return Path((lane,)), math.inf
    out = _line_at(leave, exit_offset)
    deflection = math.remainder(leave - heading, 2 * math.pi)
    # Where the two lanes meet: distances along each, measured from their starts.
    d_in, d_out = np.linalg.solve(
        np.array(
            [
                [math.cos(heading), -math.cos(leave)],
                [math.sin(heading), -math.sin(leave)],
            ]
        ),
        np.array([out.x - lane.x, out.y - lane.y]),
    )
    stop_s = ARM_LENGTH_M - stop_m
    tangent = min(d_in - stop_s, (2 * ARM_LENGTH_M - stop_s) - d_out) - 1.0
    radius = min(tangent / math.tan(abs(deflection) / 2), 9.0 if movement == 'right' else 16.0)
    tangent = radius * math.tan(abs(deflection) / 2)
    first = Piece(lane.x, lane.y, heading, float(d_in - tangent))
    arc = Piece(*first.end(), radius * abs(deflection), math.copysign(1 / radius, deflection))
    last = Piece(*arc.end(), float(2 * ARM_LENGTH_M - d_out - tangent))
    return Path((first, arc, last)), first.length
