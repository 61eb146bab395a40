"""Single-lane roundabout with four arms."""

from __future__ import annotations

import math

from scipy.optimize import brentq

from autocalib_ros.offline.simulate.network import (
    ARM_LENGTH_M,
    RURAL_LANE_WIDTH_M,
    Circulation,
    Network,
    Roundabout,
    Route,
    StopLines,
    straight_road,
)
from autocalib_ros.offline.simulate.paths import Path, PathSegment, chain_segments, straight_lane

RING_RADIUS_M = 19.0
"""Radius of the path on the ring."""
RING_WIDTH_M = 7.6
ENTRY_RADIUS_M = 16.0
ENTRY_SPIRAL_M = 5.0
RING_SPIRAL_M = 7.0
"""Length of the clothoid from the entry curve to the ring, and back."""


def roundabout(turning_fraction: float) -> Network:
    """Return a ring with four arms of one lane each way; entering vehicles yield."""
    half = RURAL_LANE_WIDTH_M
    edges = ((-half, 'edge'), (half, 'edge'), (0.0, 'solid'))
    ring = Roundabout(RING_RADIUS_M + RING_WIDTH_M / 2, RING_RADIUS_M - RING_WIDTH_M / 2)
    stop_m = ring.outer_m + 1.5
    turning = turning_fraction / 2
    routes = [
        _ring_route(arm * math.pi / 2, exits, share, stop_m)
        for arm in range(4)
        for exits, share in ((1, turning), (2, 1.0 - turning_fraction), (3, turning))
    ]
    foot = -ring.outer_m - 1.0, -ring.outer_m + 4.0
    yaw = math.degrees(math.atan2(-foot[1], -foot[0])) + 4.0
    return Network(
        tuple(straight_road(h, half, edges) for h in (0.0, math.pi / 2)),
        tuple(routes),
        (),
        StopLines(stop_m, stop_m + 6.0),
        foot,
        yaw,
        corner_radius_m=10.0,
        roundabout=ring,
    )


def _ring_route(heading: float, exits: int, share: float, stop_m: float) -> Route:
    """Return the route that enters with a heading and leaves at the first, second or third exit."""
    offset = -RURAL_LANE_WIDTH_M / 2
    entry, before_m, joined_rad = _entry(offset)
    lane = straight_lane(heading, offset, ARM_LENGTH_M)
    lead = PathSegment(lane.x, lane.y, heading, ARM_LENGTH_M - before_m)
    # Exit k is k quarter turns from the entry arm; the exit curve mirrors the entry curve.
    around = exits * math.pi / 2 - 2 * joined_rad
    curvature = 1 / RING_RADIUS_M
    spans = [*entry, (around * RING_RADIUS_M, curvature, curvature)]
    spans += [(length, last, first) for length, first, last in reversed(entry)]
    curve = chain_segments(lead.end(), spans)
    path = Path((lead, *curve, PathSegment(*curve[-1].end(), ARM_LENGTH_M - before_m)))
    entry_s = float(path.starts[1 + len(entry)])
    exit_s = entry_s + around * RING_RADIUS_M
    exit_heading = heading + math.pi + exits * math.pi / 2
    return Route(
        path=path,
        entry_lane=f'in {math.degrees(heading):.0f}',
        exit_lane=f'out {math.degrees(exit_heading) % 360:.0f}',
        movement={1: 'right', 2: 'straight', 3: 'left'}[exits],
        share=share,
        stop_s=ARM_LENGTH_M - stop_m,
        diverge_s=exit_s + 4.0,
        ring=Circulation(
            entry_s, exit_s, (heading + math.pi + joined_rad) * RING_RADIUS_M, 2 * math.pi * RING_RADIUS_M
        ),
        narrow=True,
    )


def _entry(offset: float) -> tuple[list[tuple[float, float, float]], float, float]:
    """Return the spans from a lane onto the ring, their start and their end.

    Start: distance before the centre of the ring.  End: angle round the ring from the entry arm.
    """
    entering, circling = -1 / ENTRY_RADIUS_M, 1 / RING_RADIUS_M

    def spans(arc_m: float) -> list[tuple[float, float, float]]:
        return [(ENTRY_SPIRAL_M, 0.0, entering), (arc_m, entering, entering), (RING_SPIRAL_M, entering, circling)]

    def centre(arc_m: float) -> tuple[float, float, float]:
        """Return the centre of the ring relative to the start of the spans, and their deflection."""
        x, y, heading = chain_segments((0.0, 0.0, 0.0), spans(arc_m))[-1].end()
        return x - RING_RADIUS_M * math.sin(heading), y + RING_RADIUS_M * math.cos(heading), heading

    arc_m = brentq(lambda arc: centre(arc)[1] + offset, 0.1, ENTRY_RADIUS_M * math.pi / 2)
    before_m, _, heading = centre(arc_m)
    return spans(arc_m), before_m, heading + math.pi / 2
