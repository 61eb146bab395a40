"""Trajectories of synthetic road users: across a junction, round a bend, along the routes of a scene, on foot.

Each function returns positions (n, 2) in metres and headings (n,) in radians in the ground frame, one per `INTERVAL_S`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from autocalib_ros.offline.simulate.network import Network

INTERVAL_S = 0.1
DRIVE_REACH_M = 45.0
"""Length of a trajectory before and after the centre of the junction."""
LANE_M = 3.5
MEAN_HEADING_TIME_S = 4.0
"""Mean time between changes of a pedestrian's heading."""
WALK_DURATION_S = 30.0
ROUTE_REACH_M = 70.0
"""Routes are cut at this distance from the centre of the scene, beyond the range of the tracker."""
ROUTE_STEP_M = 0.25
MAX_LATERAL_ACCELERATION_MPS2 = 2.0
MAX_BRAKING_MPS2 = 1.5
"""Comfortable lateral acceleration in curves, and deceleration before them; judgement."""
SPEED_FACTORS = (0.8, 1.2)
"""Range of the speed of a driver relative to the speed of the route."""

HITCH_M, DRAWBAR_M = 3.0, 6.0
"""Distance of the hitch behind the centre of the lorry, and of the trailer axle behind the hitch."""
SHADOW_M = (0.5, 2.0)
"""Range of the distance of a shadow from its vehicle."""

Trajectory = tuple[np.ndarray, np.ndarray]
Companion = Callable[[np.ndarray, np.ndarray, np.random.Generator], Trajectory]
"""Trajectory of an object that moves with a vehicle and is merged with it, from the trajectory of the vehicle."""


class DriveSite(Protocol):
    """The properties of a junction that a trajectory depends on; see `synthetic.junction.Junction`."""

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
    """Return a trajectory along one of the roads through the junction, or one that turns off it."""
    road = np.radians(generator.choice(junction.road_angles_deg))
    direction = generator.choice([0.0, np.pi])
    speed = generator.uniform(6.0, 13.0)
    along = np.arange(-DRIVE_REACH_M, DRIVE_REACH_M, speed * INTERVAL_S)
    heading = np.full(len(along), road + direction)
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
    """Return a trajectory on a circle through the centre of the junction, with its centre towards `towards_rad`."""
    middle = np.array(junction.centre_m) + radius_m * _unit(np.array(towards_rad))
    turn_sign = generator.choice([-1.0, 1.0])
    speed = generator.uniform(6.0, 13.0)
    along = np.arange(-DRIVE_REACH_M, DRIVE_REACH_M, speed * INTERVAL_S)
    bearing = towards_rad + np.pi + turn_sign * along / radius_m
    return _on_circle(junction, generator, along, middle, radius_m + turn_sign * LANE_M / 2, bearing, turn_sign)


def drive_ring(junction: DriveSite, generator: np.random.Generator, *, radius_m: float) -> Trajectory:
    """Return an anticlockwise trajectory on the ring of a roundabout."""
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
    """Return a trajectory on a route of a network that is centred on the junction, rotated and scaled."""
    weights = np.array([route.share for route in network.routes])
    route = network.routes[generator.choice(len(weights), p=weights / weights.sum())]
    along = np.arange(0.0, scale * route.path.length, ROUTE_STEP_M)
    x, y, heading = route.path.at(along / scale).T
    x, y, heading = scale * x, scale * y, heading + rotation_rad
    cruise = route.speed_mps * generator.uniform(*SPEED_FACTORS)
    # The period of the wander is constant in time: at twice the speed it is twice as long.
    lateral = _wander(junction, generator, along * 10.0 / cruise)
    c, s = np.cos(rotation_rad), np.sin(rotation_rad)
    path = np.column_stack([c * x - s * y, s * x + c * y]) + lateral[:, None] * _left_of(_unit(heading))
    near = np.flatnonzero(np.hypot(*path.T) < ROUTE_REACH_M)
    part = slice(near[0], near[-1] + 1)
    path, arc_length = path[part] + np.array(junction.centre_m), along[part]
    steps = np.gradient(path, axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    times = _times(arc_length, _speeds(np.gradient(heading, arc_length), cruise))
    at = np.arange(0.0, times[-1], INTERVAL_S)
    return (np.column_stack([np.interp(at, times, path[:, axis]) for axis in (0, 1)]), np.interp(at, times, heading))


def walk_along_road(junction: DriveSite, generator: np.random.Generator) -> Trajectory:
    """Return the trajectory of a pedestrian on a pavement along a road, with sudden changes of heading."""
    road = np.radians(generator.choice(junction.road_angles_deg))
    along_road = _unit(np.array(road))
    offset_m = generator.choice([-1.0, 1.0]) * generator.uniform(6.0, 10.0)
    start = np.array(junction.centre_m) + generator.uniform(-20.0, 20.0) * along_road + offset_m * _left_of(along_road)
    steps = int(WALK_DURATION_S / INTERVAL_S)
    leg = np.cumsum(generator.uniform(size=steps) < INTERVAL_S / MEAN_HEADING_TIME_S)
    heading = road + generator.choice([0.0, np.pi]) + generator.normal(scale=0.7, size=steps)[leg]
    speed = generator.uniform(0.3, 1.7, steps)[leg]
    return start + np.cumsum(speed[:, None] * INTERVAL_S * _unit(heading), axis=0), heading


def drive_arc(junction: DriveSite, generator: np.random.Generator, *, radii_m: tuple[float, float]) -> Trajectory:
    """Return a trajectory on an arc of random radius and direction through the centre of the junction."""
    return drive_bend(
        junction, generator, radius_m=generator.uniform(*radii_m), towards_rad=generator.uniform(0, 2 * np.pi)
    )


def beside(
    path: np.ndarray, heading: np.ndarray, generator: np.random.Generator, speeds: tuple[float, float] = (0.8, 1.2)
) -> Trajectory:
    """Return the trajectory of a vehicle in the adjacent lane, faster or slower than the given vehicle."""
    steps = np.arange(len(path), dtype=float)
    middle = 0.5 * (len(path) - 1)
    at = np.clip(middle + (steps - middle) * generator.uniform(*speeds), 0, len(path) - 1)
    shifted = path + generator.choice([-1.0, 1.0]) * LANE_M * _left_of(_unit(heading))
    return (
        np.column_stack([np.interp(at, steps, shifted[:, axis]) for axis in (0, 1)]),
        np.interp(at, steps, np.unwrap(heading)),
    )


def trailer(path: np.ndarray, heading: np.ndarray, _: np.random.Generator) -> Trajectory:
    """Return the trajectory of a lorry's trailer: its axle follows the hitch (tractrix)."""
    hitch = path - HITCH_M * _unit(heading)
    axle = hitch[0] - DRAWBAR_M * _unit(heading[0])
    axles = [axle]
    for pulled in hitch[1:]:
        axle = pulled - DRAWBAR_M * (pulled - axle) / np.hypot(*(pulled - axle))
        axles.append(axle)
    bars = hitch - np.array(axles)
    return hitch - 0.5 * bars, np.unwrap(np.arctan2(bars[:, 1], bars[:, 0]))


def shadow(path: np.ndarray, heading: np.ndarray, generator: np.random.Generator) -> Trajectory:
    """Return the trajectory of a shadow: the vehicle's, shifted by a constant offset in the ground frame."""
    return path + generator.uniform(*SHADOW_M) * _unit(generator.uniform(0, 2 * np.pi)), heading


def _on_circle(
    junction: DriveSite,
    generator: np.random.Generator,
    along: np.ndarray,
    centre: np.ndarray,
    radius_m: float,
    bearing: np.ndarray,
    turn_sign: float,
) -> Trajectory:
    outward = _unit(bearing)
    radius = radius_m + _wander(junction, generator, along)
    return centre + radius[:, None] * outward, bearing + turn_sign * np.pi / 2


def _speeds(curvature: np.ndarray, cruise_mps: float) -> np.ndarray:
    """Return speeds (n,) on a path with curvatures (n,) in 1/m, limited in curves, with braking before them."""
    squares = np.minimum(cruise_mps**2, MAX_LATERAL_ACCELERATION_MPS2 / np.maximum(np.abs(curvature), 1e-6))
    # One pass in each direction: v^2 changes by at most 2 a per metre.
    rise = 2 * MAX_BRAKING_MPS2 * ROUTE_STEP_M * np.arange(len(squares))
    squares = np.minimum.accumulate(squares - rise) + rise
    return np.sqrt((np.minimum.accumulate((squares - rise[::-1])[::-1])[::-1]) + rise[::-1])


def _times(arc_length: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Return the times (n,) at which arc lengths (n,) are reached with speeds (n,)."""
    return np.concatenate([[0.0], np.cumsum(2 * np.diff(arc_length) / (speeds[1:] + speeds[:-1]))])


def _wander(junction: DriveSite, generator: np.random.Generator, along: np.ndarray) -> np.ndarray:
    """Return lateral offsets (n,) within the lane, RMS `wander_m`, with wavelengths of 25 to 80 m."""
    sway = sum(
        np.sin(along * 2 * np.pi / generator.uniform(25, 80) + generator.uniform(0, 2 * np.pi)) for _ in range(2)
    )
    return junction.wander_m * np.asarray(sway)


def _lane_change(generator: np.random.Generator, along: np.ndarray) -> np.ndarray:
    """Return lateral offsets (n,) of a smooth change to the next lane over 30 to 50 m."""
    length, begin = generator.uniform(30.0, 50.0), generator.uniform(-DRIVE_REACH_M, 0.0)
    fraction = np.clip((along - begin) / length, 0.0, 1.0)
    return generator.choice([-1.0, 1.0]) * LANE_M * (1 - np.cos(np.pi * fraction)) / 2


def _unit(heading: np.ndarray | float) -> np.ndarray:
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def _left_of(forward: np.ndarray) -> np.ndarray:
    return np.stack([-forward[..., 1], forward[..., 0]], axis=-1)
