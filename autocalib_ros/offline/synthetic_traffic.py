"""How made-up road users move over the ground: across a junction, round a bend, round a roundabout, on foot.

Each function returns positions (n, 2) in metres and headings (n,) in radians, every `INTERVAL_S`, ground frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autocalib_ros.offline.synthetic_evidence import Junction

INTERVAL_S = 0.1
REACH_M = 45.0
"""Vehicles come from so far before the middle of the junction and go as far beyond it."""
LANE_M = 3.5
STEADY_S = 4.0
"""Mean time for which a pedestrian keeps a heading."""
STROLL_S = 30.0

Path = tuple[np.ndarray, np.ndarray]
Drive = Callable[['Junction', np.random.Generator], Path]


def drive_across(junction: Junction, generator: np.random.Generator) -> Path:
    """Follow one of the roads through the junction, or turn off it."""
    road = np.radians(generator.choice(junction.road_angles_deg))
    way = generator.choice([0.0, np.pi])
    speed = generator.uniform(6.0, 13.0)
    along = np.arange(-REACH_M, REACH_M, speed * INTERVAL_S)
    heading = np.full(len(along), road + way)
    lane = -junction.lanes_m[generator.integers(len(junction.lanes_m))]
    if generator.uniform() < junction.turning_share:
        radius = generator.uniform(8.0, 25.0)
        turned = np.clip((along + radius) / radius, 0.0, np.pi / 2) * generator.choice([-1.0, 1.0])
        heading = heading + turned
    forward = _unit(heading)
    start = np.array(junction.centre_m) + along[0] * forward[0] + lane * np.array([forward[0, 1], -forward[0, 0]])
    centre = start + np.concatenate([[[0.0, 0.0]], np.cumsum(forward[:-1], axis=0) * speed * INTERVAL_S])
    lateral = _wander(junction, generator, along)
    if junction.lane_change_share and generator.uniform() < junction.lane_change_share:
        shift = _lane_change(generator, along)
        lateral, heading = lateral + shift, heading + np.arctan(np.gradient(shift, along))
    return centre + lateral[:, None] * _left_of(forward), heading


def drive_bend(junction: Junction, generator: np.random.Generator, *, radius_m: float, towards_rad: float) -> Path:
    """Follow a bend of one radius through the junction's middle; its centre lies `towards_rad` of there."""
    middle = np.array(junction.centre_m) + radius_m * _unit(np.array(towards_rad))
    way = generator.choice([-1.0, 1.0])
    speed = generator.uniform(6.0, 13.0)
    along = np.arange(-REACH_M, REACH_M, speed * INTERVAL_S)
    bearing = towards_rad + np.pi + way * along / radius_m
    return _on_circle(junction, generator, along, middle, radius_m + way * LANE_M / 2, bearing, way)


def drive_ring(junction: Junction, generator: np.random.Generator, *, radius_m: float) -> Path:
    """Go round a roundabout, anticlockwise, from one arm to another."""
    speed = generator.uniform(4.0, 9.0)
    along = np.arange(0.0, generator.uniform(0.5, 1.5) * np.pi * radius_m, speed * INTERVAL_S)
    bearing = generator.uniform(0.0, 2 * np.pi) + along / radius_m
    lane = generator.choice([-1.0, 1.0]) * LANE_M / 2
    return _on_circle(junction, generator, along, np.array(junction.centre_m), radius_m + lane, bearing, 1.0)


def stroll(junction: Junction, generator: np.random.Generator) -> Path:
    """Walk on a pavement along a road, slowly, with sudden changes of heading."""
    road = np.radians(generator.choice(junction.road_angles_deg))
    along_road = _unit(np.array(road))
    beside = generator.choice([-1.0, 1.0]) * generator.uniform(6.0, 10.0)
    start = np.array(junction.centre_m) + generator.uniform(-20.0, 20.0) * along_road + beside * _left_of(along_road)
    steps = int(STROLL_S / INTERVAL_S)
    leg = np.cumsum(generator.uniform(size=steps) < INTERVAL_S / STEADY_S)
    heading = road + generator.choice([0.0, np.pi]) + generator.normal(scale=0.7, size=steps)[leg]
    speed = generator.uniform(0.3, 1.7, steps)[leg]
    return start + np.cumsum(speed[:, None] * INTERVAL_S * _unit(heading), axis=0), heading


def drive_arc(junction: Junction, generator: np.random.Generator, *, radii_m: tuple[float, float]) -> Path:
    """Turn on an arc of the vehicle's own through the junction's middle."""
    return drive_bend(junction, generator, radius_m=generator.uniform(*radii_m),
                      towards_rad=generator.uniform(0, 2 * np.pi))


def beside(path: np.ndarray, heading: np.ndarray, generator: np.random.Generator) -> Path:
    """Drive in the next lane of a path (n, 2) with headings (n,), faster or slower than who drives there."""
    steps = np.arange(len(path), dtype=float)
    middle = 0.5 * (len(path) - 1)
    at = np.clip(middle + (steps - middle) * generator.uniform(0.8, 1.2), 0, len(path) - 1)
    shifted = path + generator.choice([-1.0, 1.0]) * LANE_M * _left_of(_unit(heading))
    return (np.column_stack([np.interp(at, steps, shifted[:, axis]) for axis in (0, 1)]),
            np.interp(at, steps, np.unwrap(heading)))


def _on_circle(junction: Junction, generator: np.random.Generator, along: np.ndarray, centre: np.ndarray,
               radius_m: float, bearing: np.ndarray, way: float) -> Path:
    outward = _unit(bearing)
    radius = radius_m + _wander(junction, generator, along)
    return centre + radius[:, None] * outward, bearing + way * np.pi / 2


def _wander(junction: Junction, generator: np.random.Generator, along: np.ndarray) -> np.ndarray:
    """Lateral offset (n,) within the lane, `wander_m` root mean square, in waves of 25 to 80 m."""
    sway = sum(np.sin(along * 2 * np.pi / generator.uniform(25, 80) + generator.uniform(0, 2 * np.pi))
               for _ in range(2))
    return junction.wander_m * np.asarray(sway)


def _lane_change(generator: np.random.Generator, along: np.ndarray) -> np.ndarray:
    """Lateral offset (n,) of a smooth change to the next lane over 30 to 50 m."""
    length, begin = generator.uniform(30.0, 50.0), generator.uniform(-REACH_M, 0.0)
    share = np.clip((along - begin) / length, 0.0, 1.0)
    return generator.choice([-1.0, 1.0]) * LANE_M * (1 - np.cos(np.pi * share)) / 2


def _unit(heading: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def _left_of(forward: np.ndarray) -> np.ndarray:
    return np.stack([-forward[..., 1], forward[..., 0]], axis=-1)
