"""Straight motorway with three lanes each way and lane changes."""

from __future__ import annotations

import math

from autocalib_ros.offline.simulate.network import Network, Route, straight_road
from autocalib_ros.offline.simulate.paths import Path, lane_change, straight_lane

MOTORWAY_LANE_WIDTH_M = 3.6
MOTORWAY_HALF_LENGTH_M = 150.0
MOTORWAY_TRAFFIC_FACTOR = 1.2
"""Traffic of a lane relative to an urban one."""
MOTORWAY_SPEEDS_MPS = (24.0, 28.0, 32.0)
"""Cruise speeds of the lanes, the outer one first."""
MEDIAN_WIDTH_M = 1.4
"""From the central barrier to the inner edge line."""
SHOULDER_WIDTH_M = 2.6
LANE_CHANGE_LENGTH_M = 110.0
"""Length of a lane change: four seconds at the speed of the middle lane."""
LANE_CHANGE_STARTS_M = (60.0, 95.0, 130.0)
"""Arc lengths at which lane changes begin."""


def highway(one_way: bool, changing_fraction: float) -> Network:
    """Return a motorway along the x axis, three lanes each way; a fraction of the vehicles changes lanes."""
    w = MOTORWAY_LANE_WIDTH_M
    inner = -1.5 * w if one_way else MEDIAN_WIDTH_M
    markings = [(inner, 'solid'), (inner + w, 'dash'), (inner + 2 * w, 'dash'), (inner + 3 * w, 'solid')]
    half = inner + 3 * w + SHOULDER_WIDTH_M
    sides = (1,) if one_way else (1, -1)
    edges = tuple((side * offset, kind) for side in sides for offset, kind in markings)
    # From the outer (rightmost) lane inwards.
    offsets = [-(inner + (2.5 - i) * w) for i in range(3)]
    routes = [
        route
        for heading in ((0.0,) if one_way else (0.0, math.pi))
        for i in range(3)
        for route in _motorway_routes(heading, offsets, i, changing_fraction)
    ]
    barriers = (-half + 0.4, half - 0.4) + (() if one_way else (0.0,))
    return Network(
        (straight_road(0.0, half, edges),),
        tuple(routes),
        (),
        None,
        (-14.0, -half - 4.0),
        52.0,
        rural=True,
        barriers_m=barriers,
    )


def _motorway_routes(heading: float, offsets: list[float], index: int, changing_fraction: float) -> list[Route]:
    """Return the routes that begin in a lane: straight on, and into the adjacent lanes."""
    lane = straight_lane(heading, offsets[index], MOTORWAY_HALF_LENGTH_M)
    names = [f'lane {math.degrees(heading):.0f} {offset:+.1f}' for offset in offsets]
    speed = MOTORWAY_SPEEDS_MPS[index]
    targets = [i for i in (index - 1, index + 1) if 0 <= i < len(offsets)]
    share = MOTORWAY_TRAFFIC_FACTOR * changing_fraction / (len(targets) * len(LANE_CHANGE_STARTS_M))
    routes = [
        Route(
            Path((lane,)),
            names[index],
            names[index],
            'straight',
            MOTORWAY_TRAFFIC_FACTOR * (1.0 - changing_fraction),
            stop_s=0.0,
            speed_mps=speed,
        )
    ]
    for target in targets:
        for begin_s in LANE_CHANGE_STARTS_M:
            lateral = offsets[target] - offsets[index]
            path = lane_change(lane, begin_s, LANE_CHANGE_LENGTH_M, lateral)
            routes.append(
                Route(
                    path,
                    names[index],
                    names[target],
                    'lane change',
                    share,
                    stop_s=0.0,
                    diverge_s=begin_s + 0.75 * LANE_CHANGE_LENGTH_M,
                    speed_mps=speed,
                )
            )
    return routes
