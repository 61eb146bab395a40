"""How made-up road users move over the ground: across a junction, round a bend, along a scene's routes, on foot.

Each function returns positions (n, 2) in metres and headings (n,) in radians, every `INTERVAL_S`, ground frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from autocalib_ros.offline.simulate.network import Network

INTERVAL_S = 0.1
DRIVE_REACH_M = 45.0
"""Vehicles come from so far before the middle of the junction and go as far beyond it."""
LANE_M = 3.5
MEAN_HEADING_TIME_S = 4.0
"""Mean time for which a pedestrian keeps a heading."""
WALK_DURATION_S = 30.0
ROUTE_REACH_M = 70.0
"""Routes are driven within so far of the scene's middle: farther than points are followed."""
ROUTE_STEP_M = 0.25
MAX_LATERAL_ACCELERATION_MPS2 = 2.0
MAX_BRAKING_MPS2 = 1.5
"""What drivers bear in curves, and on their way to and from them."""
SPEED_FACTORS = (0.8, 1.2)
"""Speed of a driver relative to that of the route."""

HITCH_M, DRAWBAR_M = 3.0, 6.0
"""A trailer hangs on so far behind the lorry's middle, and its axle is so far behind that."""
SHADOW_M = (0.5, 2.0)
"""How far a vehicle's shadow lies from it."""

Trajectory = tuple[np.ndarray, np.ndarray]
Companion = Callable[[np.ndarray, np.ndarray, np.random.Generator], Trajectory]
"""What moves with a vehicle and is taken for part of it: from its positions and headings, those of the other."""


class DriveSite(Protocol):
    """What a drive has to know of its junction; `synthetic.junction.Junction` describes each value."""

    @property
    def centre_m(self) -> tuple[float, float]:
        """Where the roads cross, ground frame, metres."""
        ...

    @property
    def lane_change_fraction(self) -> float:
        """Fraction of the vehicles that change lanes."""
        ...

    @property
    def lanes_m(self) -> tuple[float, ...]:
        """Offsets of the lanes to the right of the middle of the road, metres."""
        ...

    @property
    def road_angles_deg(self) -> tuple[float, ...]:
        """Direction of each road in the ground frame, degrees."""
        ...

    @property
    def turning_fraction(self) -> float:
        """Fraction of the vehicles that turn off."""
        ...

    @property
    def wander_m(self) -> float:
        """Lateral wander of a driver, one sigma, metres."""
        ...


Drive = Callable[[DriveSite, np.random.Generator], Trajectory]


def drive_across(junction: DriveSite, generator: np.random.Generator) -> Trajectory:
    """Follow one of the roads through the junction, or turn off it."""
    road = np.radians(generator.choice(junction.road_angles_deg))
    way = generator.choice([0.0, np.pi])
    speed = generator.uniform(6.0, 13.0)
    along = np.arange(-DRIVE_REACH_M, DRIVE_REACH_M, speed * INTERVAL_S)
    heading = np.full(len(along), road + way)
    lane = -junction.lanes_m[generator.integers(len(junction.lanes_m))]
    if generator.uniform() < junction.turning_fraction:
        radius = generator.uniform(8.0, 25.0)
        turned = np.clip((along + radius) / radius, 0.0, np.pi / 2) * generator.choice([-1.0, 1.0])
        heading = heading + turned
    forward = _unit(heading)
    start = np.array(junction.centre_m) + along[0] * forward[0] + lane * np.array([forward[0, 1], -forward[0, 0]])
    centre = start + np.concatenate([[[0.0, 0.0]], np.cumsum(forward[:-1], axis=0) * speed * INTERVAL_S])
    lateral = _wander(junction, generator, along)
    if junction.lane_change_fraction and generator.uniform() < junction.lane_change_fraction:
        shift = _lane_change(generator, along)
        lateral, heading = lateral + shift, heading + np.arctan(np.gradient(shift, along))
    return centre + lateral[:, None] * _left_of(forward), heading


def drive_bend(
    junction: DriveSite, generator: np.random.Generator, *, radius_m: float, towards_rad: float
) -> Trajectory:
    """Follow a bend of one radius through the junction's middle; its centre lies `towards_rad` of there."""
    middle = np.array(junction.centre_m) + radius_m * _unit(np.array(towards_rad))
    way = generator.choice([-1.0, 1.0])
    speed = generator.uniform(6.0, 13.0)
    along = np.arange(-DRIVE_REACH_M, DRIVE_REACH_M, speed * INTERVAL_S)
    bearing = towards_rad + np.pi + way * along / radius_m
    return _on_circle(junction, generator, along, middle, radius_m + way * LANE_M / 2, bearing, way)


def drive_ring(junction: DriveSite, generator: np.random.Generator, *, radius_m: float) -> Trajectory:
    """Go round a roundabout, anticlockwise, from one arm to another."""
    speed = generator.uniform(4.0, 9.0)
    along = np.arange(0.0, generator.uniform(0.5, 1.5) * np.pi * radius_m, speed * INTERVAL_S)
    bearing = generator.uniform(0.0, 2 * np.pi) + along / radius_m
    lane = generator.choice([-1.0, 1.0]) * LANE_M / 2
    return _on_circle(junction, generator, along, np.array(junction.centre_m), radius_m + lane, bearing, 1.0)


def drive_route(
    junction: DriveSite,
    generator: np.random.Generator,
    *,
    network: Network,
    rotation_rad: float = 0.0,
    scale: float = 1.0,
) -> Trajectory:
    """Drive a route of a network whose middle lies at the junction's, turned there and scaled."""
    weights = np.array([route.share for route in network.routes])
    route = network.routes[generator.choice(len(weights), p=weights / weights.sum())]
    along = np.arange(0.0, scale * route.path.length, ROUTE_STEP_M)
    x, y, heading = route.path.at(along / scale).T
    x, y, heading = scale * x, scale * y, heading + rotation_rad
    cruise = route.speed_mps * generator.uniform(*SPEED_FACTORS)
    # At twice the speed drivers wander over twice the way.
    aside = _wander(junction, generator, along * 10.0 / cruise)
    c, s = np.cos(rotation_rad), np.sin(rotation_rad)
    path = np.column_stack([c * x - s * y, s * x + c * y]) + aside[:, None] * _left_of(_unit(heading))
    near = np.flatnonzero(np.hypot(*path.T) < ROUTE_REACH_M)
    part = slice(near[0], near[-1] + 1)
    path, way = path[part] + np.array(junction.centre_m), along[part]
    steps = np.gradient(path, axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    times = _times(way, _speeds(np.gradient(heading, way), cruise))
    at = np.arange(0.0, times[-1], INTERVAL_S)
    return (np.column_stack([np.interp(at, times, path[:, axis]) for axis in (0, 1)]), np.interp(at, times, heading))


def walk_along_road(junction: DriveSite, generator: np.random.Generator) -> Trajectory:
    """Walk on a pavement along a road, slowly, with sudden changes of heading."""
    road = np.radians(generator.choice(junction.road_angles_deg))
    along_road = _unit(np.array(road))
    beside = generator.choice([-1.0, 1.0]) * generator.uniform(6.0, 10.0)
    start = np.array(junction.centre_m) + generator.uniform(-20.0, 20.0) * along_road + beside * _left_of(along_road)
    steps = int(WALK_DURATION_S / INTERVAL_S)
    leg = np.cumsum(generator.uniform(size=steps) < INTERVAL_S / MEAN_HEADING_TIME_S)
    heading = road + generator.choice([0.0, np.pi]) + generator.normal(scale=0.7, size=steps)[leg]
    speed = generator.uniform(0.3, 1.7, steps)[leg]
    return start + np.cumsum(speed[:, None] * INTERVAL_S * _unit(heading), axis=0), heading


def drive_arc(junction: DriveSite, generator: np.random.Generator, *, radii_m: tuple[float, float]) -> Trajectory:
    """Turn on an arc of the vehicle's own through the junction's middle."""
    return drive_bend(
        junction, generator, radius_m=generator.uniform(*radii_m), towards_rad=generator.uniform(0, 2 * np.pi)
    )


def beside(
    path: np.ndarray, heading: np.ndarray, generator: np.random.Generator, speeds: tuple[float, float] = (0.8, 1.2)
) -> Trajectory:
    """Drive in the next lane of a path (n, 2) with headings (n,), faster or slower than who drives there."""
    steps = np.arange(len(path), dtype=float)
    middle = 0.5 * (len(path) - 1)
    at = np.clip(middle + (steps - middle) * generator.uniform(*speeds), 0, len(path) - 1)
    shifted = path + generator.choice([-1.0, 1.0]) * LANE_M * _left_of(_unit(heading))
    return (
        np.column_stack([np.interp(at, steps, shifted[:, axis]) for axis in (0, 1)]),
        np.interp(at, steps, np.unwrap(heading)),
    )


def trailer(path: np.ndarray, heading: np.ndarray, _: np.random.Generator) -> Trajectory:
    """Follow a lorry as its trailer does, whose axle runs after the hitch."""
    hitch = path - HITCH_M * _unit(heading)
    axle = hitch[0] - DRAWBAR_M * _unit(heading[0])
    axles = [axle]
    for pulled in hitch[1:]:
        axle = pulled - DRAWBAR_M * (pulled - axle) / np.hypot(*(pulled - axle))
        axles.append(axle)
    bars = hitch - np.array(axles)
    return hitch - 0.5 * bars, np.unwrap(np.arctan2(bars[:, 1], bars[:, 0]))


def shadow(path: np.ndarray, heading: np.ndarray, generator: np.random.Generator) -> Trajectory:
    """Lie on the road to one side of a vehicle, wherever it heads."""
    return path + generator.uniform(*SHADOW_M) * _unit(generator.uniform(0, 2 * np.pi)), heading


def _on_circle(
    junction: DriveSite,
    generator: np.random.Generator,
    along: np.ndarray,
    centre: np.ndarray,
    radius_m: float,
    bearing: np.ndarray,
    way: float,
) -> Trajectory:
    outward = _unit(bearing)
    radius = radius_m + _wander(junction, generator, along)
    return centre + radius[:, None] * outward, bearing + way * np.pi / 2


def _speeds(curvature: np.ndarray, cruise_mps: float) -> np.ndarray:
    """Speeds (n,) on a path of curvatures (n,), 1/m: slower in curves, and slowing down ahead of them."""
    squares = np.minimum(cruise_mps**2, MAX_LATERAL_ACCELERATION_MPS2 / np.maximum(np.abs(curvature), 1e-6))
    # Against the way and along it: v^2 rises by at most 2 a a metre.
    rise = 2 * MAX_BRAKING_MPS2 * ROUTE_STEP_M * np.arange(len(squares))
    squares = np.minimum.accumulate(squares - rise) + rise
    return np.sqrt((np.minimum.accumulate((squares - rise[::-1])[::-1])[::-1]) + rise[::-1])


def _times(way: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Times (n,) at which places (n,) along a path are reached with speeds (n,)."""
    return np.concatenate([[0.0], np.cumsum(2 * np.diff(way) / (speeds[1:] + speeds[:-1]))])


def _wander(junction: DriveSite, generator: np.random.Generator, along: np.ndarray) -> np.ndarray:
    """Lateral offset (n,) within the lane, `wander_m` root mean square, in waves of 25 to 80 m."""
    sway = sum(
        np.sin(along * 2 * np.pi / generator.uniform(25, 80) + generator.uniform(0, 2 * np.pi)) for _ in range(2)
    )
    return junction.wander_m * np.asarray(sway)


def _lane_change(generator: np.random.Generator, along: np.ndarray) -> np.ndarray:
    """Lateral offset (n,) of a smooth change to the next lane over 30 to 50 m."""
    length, begin = generator.uniform(30.0, 50.0), generator.uniform(-DRIVE_REACH_M, 0.0)
    share = np.clip((along - begin) / length, 0.0, 1.0)
    return generator.choice([-1.0, 1.0]) * LANE_M * (1 - np.cos(np.pi * share)) / 2


def _unit(heading: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def _left_of(forward: np.ndarray) -> np.ndarray:
    return np.stack([-forward[..., 1], forward[..., 0]], axis=-1)
