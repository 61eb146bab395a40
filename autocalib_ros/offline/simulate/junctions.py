"""Signalised junctions of two roads: crossings and tees."""

from __future__ import annotations

import math

from autocalib_ros.offline.simulate.network import (
    ARM_LENGTH_M,
    CROSSING_WIDTH_M,
    LANE_WIDTH_M,
    Network,
    Route,
    StopLines,
    straight_road,
)
from autocalib_ros.offline.simulate.paths import Path, join_lines, line_intersection, straight_lane, tangent_per_radius

RIGHT_RADIUS_M = 8.0
"""Roughly concentric with the kerb of the corner."""
LEFT_RADIUS_M = 16.0


def junction(angle: float, turning_fraction: float, tee: bool = False) -> Network:
    """Return two roads that cross at an angle (radians), each with two lanes and a left-turn lane.

    Straight and right-turning traffic of a road share a green phase; left turns have their own phase, which is
    skipped without a waiting vehicle.  tee: the second road ends at the first one.
    """
    half = 2.5 * LANE_WIDTH_M
    reach = half * (1 + abs(math.cos(angle))) / math.sin(angle)
    stop_m = reach + CROSSING_WIDTH_M + 4.0
    w = LANE_WIDTH_M
    edges = [(-half, 'edge'), (half, 'edge'), (-1.5 * w, 'dash'), (1.5 * w, 'dash')]
    edges += [(-0.5 * w, 'solid'), (0.5 * w, 'solid')]
    roads = (
        straight_road(0.0, half, tuple(edges)),
        straight_road(angle, half, tuple(edges), 0.0 if tee else -math.inf),
    )
    # An arm is identified by the heading of the traffic that exits on it.
    arms = (0.0, angle, math.pi) if tee else (0.0, angle, math.pi, math.pi + angle)
    routes: list[Route] = []
    for road, heading in enumerate((0.0, angle, math.pi, math.pi + angle)):
        if _is_among(heading + math.pi, arms):
            routes += _arm_routes(heading, road % 2, angle, stop_m, turning_fraction, arms)
    phases = (('main0', 13.0), ('left0', 5.0), ('main1', 13.0), ('left1', 5.0))
    # In the corner between the two arms behind the origin, at different distances from both roads.
    lateral = half + 7.5
    foot = -(half + 4.0 + lateral * math.cos(angle)) / math.sin(angle), -lateral
    yaw = math.degrees(math.atan2(-foot[1], -foot[0])) + 6.0
    stop_lines = StopLines(stop_m, stop_m - 2.0 - CROSSING_WIDTH_M)
    return Network(roads, tuple(routes), phases, stop_lines, foot, yaw)


def _is_among(heading: float, headings: tuple[float, ...]) -> bool:
    return any(abs(math.remainder(heading - h, 2 * math.pi)) < 1e-6 for h in headings)


def _arm_routes(
    heading: float,
    road: int,
    angle: float,
    stop_m: float,
    turning_fraction: float,
    arms: tuple[float, ...],
) -> list[Route]:
    """Return the routes to existing arms of the traffic that enters with a heading."""
    w = LANE_WIDTH_M
    turned = angle if road == 0 else math.pi - angle
    left, right = heading + turned, heading + turned - math.pi
    name = f'{math.degrees(heading):.0f}'
    # Without an arm straight ahead all traffic turns.
    turning = turning_fraction if _is_among(heading, arms) else 1.0
    plans = [
        ('straight', -w, heading, 1.0 - turning),
        ('straight', -2 * w, heading, 1.0 - turning),
        ('left', 0.0, left, turning),
        ('right', -2 * w, right, turning),
    ]
    routes = []
    for movement, offset, exit_heading, share in plans:
        if not _is_among(exit_heading, arms):
            continue
        exit_offset = {'straight': offset, 'left': -w, 'right': -2 * w}[movement]
        path, split = _through(heading, offset, exit_heading, exit_offset, stop_m, movement)
        routes.append(
            Route(
                path=path,
                entry_lane=f'in {name} {offset:.1f}',
                exit_lane=f'out {math.degrees(exit_heading) % 360:.0f} {exit_offset:.1f}',
                movement=movement,
                share=share,
                stop_s=ARM_LENGTH_M - stop_m - 0.5,
                diverge_s=split,
                narrow=movement == 'right',
                signal=f'{"left" if movement == "left" else "main"}{road}',
            )
        )
    return routes


def _through(
    heading: float, offset: float, exit_heading: float, exit_offset: float, stop_m: float, movement: str
) -> tuple[Path, float]:
    """Connect an entry lane to an exit lane by a turn; return the path and the arc length where the turn starts."""
    lane = straight_lane(heading, offset, ARM_LENGTH_M)
    if movement == 'straight':
        return Path((lane,)), math.inf
    out = straight_lane(exit_heading, exit_offset, ARM_LENGTH_M)
    d_in, d_out = line_intersection(lane, out)
    stop_s = ARM_LENGTH_M - stop_m
    # A clothoid deviates slowly from the lane at first: it may begin before the stop line.
    room = min(d_in - stop_s, (2 * ARM_LENGTH_M - stop_s) - d_out) + 2.0
    per_radius = tangent_per_radius(math.remainder(exit_heading - heading, 2 * math.pi))
    path = join_lines(lane, out, min(room / per_radius, RIGHT_RADIUS_M if movement == 'right' else LEFT_RADIUS_M))
    return path, path.segments[0].length
