"""The road network of each scene, and the networks with a single road."""

from __future__ import annotations

import math
from dataclasses import replace

from autocalib_ros.offline.simulate.junctions import junction
from autocalib_ros.offline.simulate.motorway import highway
from autocalib_ros.offline.simulate.network import (
    ARM_LENGTH_M,
    LANE_WIDTH_M,
    RURAL_LANE_WIDTH_M,
    Network,
    Road,
    Route,
    straight_road,
)
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.paths import Path, apex_per_radius, join_lines, straight_lane
from autocalib_ros.offline.simulate.roundabout import roundabout

SPARSE_TRAFFIC_FACTOR = 1 / 15
"""Traffic relative to that of a junction: one vehicle every 10 to 15 s on all arms together."""

BEND_RADIUS_M = 80.0
BEND_DEG = 80.0


def build_network(options: SimulationOptions) -> Network:
    """Build the road network of the options."""
    angle = math.radians(options.road_crossing_deg)
    turning = options.turning_fraction
    if options.scene == 'highway':
        return highway(options.one_way, turning)
    if options.scene == 'bend':
        return bend(options.one_way)
    if options.scene == 'roundabout':
        return roundabout(turning)
    if options.one_way or options.scene == 'road':
        return single_road(one_way=options.one_way)
    if options.scene == 'sparse':
        return scale_traffic(junction(angle, turning), SPARSE_TRAFFIC_FACTOR)
    return junction(angle, turning, tee=options.scene == 'tee')


def single_road(one_way: bool) -> Network:
    """Return one road along the x axis: three lanes one way, or two lanes each way."""
    offsets, half, edges = _lanes(one_way, LANE_WIDTH_M)
    routes = []
    for i in offsets:
        heading = 0.0 if one_way or i < 0 else math.pi
        lane = straight_lane(heading, math.copysign(i, -1 if heading else i) * LANE_WIDTH_M, ARM_LENGTH_M)
        name = f'lane{i:+g}'
        routes.append(Route(Path((lane,)), name, name, 'straight', 1.0))
    # Close enough to fill the image, and looking across the road rather than along it.
    return Network((straight_road(0.0, half, edges),), tuple(routes), (), None, (-8.0, -half - 5.0), 52.0)


def _lanes(one_way: bool, width_m: float) -> tuple[list[float], float, tuple[tuple[float, str], ...]]:
    """Return the lane offsets in lane widths, the half-width of the road and its markings."""
    half = (1.5 if one_way else 2.0) * width_m
    offsets, inner = [-1.5, -0.5, 0.5, 1.5], {-1.0: 'dash', 0.0: 'solid', 1.0: 'dash'}
    if one_way:
        offsets, inner = [-1.0, 0.0, 1.0], {0.5: 'dash', -0.5: 'dash'}
    edges = [(-half, 'edge'), (half, 'edge')]
    edges += [(i * width_m, kind) for i, kind in inner.items()]
    return offsets, half, tuple(edges)


def scale_traffic(network: Network, factor: float) -> Network:
    """Return a network with its traffic scaled by a factor."""
    return replace(network, routes=tuple(replace(r, share=factor * r.share) for r in network.routes))


def bend(one_way: bool) -> Network:
    """Return a rural road that bends to the left; its middle is at the origin, heading along x."""
    offsets, half, edges = _lanes(one_way, RURAL_LANE_WIDTH_M)
    turned = math.radians(BEND_DEG)
    along = BEND_RADIUS_M * apex_per_radius(turned)
    axis = _bend_lane(0.0, along, forward=True)
    axis = replace(axis, start_s=-axis.length / 2)
    routes = []
    for i in offsets:
        forward = one_way or i < 0
        name = f'lane{i:+g}'
        path = _bend_lane(i * RURAL_LANE_WIDTH_M, along, forward)
        routes.append(Route(path, name, name, 'straight', 1.0))
    return Network((Road(axis, half + 0.6, edges),), tuple(routes), (), None, (-6.0, -half - 7.0), 66.0, rural=True)


def _bend_lane(lateral_m: float, apex_m: float, forward: bool) -> Path:
    """Return a lane at an offset to the left of the bend's axis, in either direction."""
    half_turn = math.radians(BEND_DEG) / 2
    # Radius for which the lane keeps its distance from the axis at the apex of the bend as on the straights.
    radius = BEND_RADIUS_M - lateral_m * (1 / math.cos(half_turn) - 1) / apex_per_radius(2 * half_turn)
    ends = [straight_lane(h, lateral_m, ARM_LENGTH_M + 20.0, (0.0, -apex_m)) for h in (-half_turn, half_turn)]
    if forward:
        return join_lines(ends[0], ends[1], radius)
    back = [replace(p, x=x, y=y, heading=p.heading + math.pi) for p in ends for x, y, _ in [p.end()]]
    return join_lines(back[1], back[0], radius)
