"""Vehicle trajectories: the state of each vehicle at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autocalib_ros.offline.simulate.network import CITY_SPEED_MPS, Route
from autocalib_ros.offline.simulate.shapes import SHAPES, VehicleShape

STEP_S = 0.1
_TANGENT_STEP_M = 0.1  # step of the finite difference for the tangent of a path


@dataclass(frozen=True)
class Wander:
    """Lateral offset within the lane as a smooth function of arc length.

    It depends on arc length, not time, so that a waiting vehicle does not slip sideways.
    """

    amplitudes_m: np.ndarray
    wavelengths_m: np.ndarray
    phases: np.ndarray

    @classmethod
    def draw(cls, stddev_m: float, rng: np.random.Generator, speed_mps: float = CITY_SPEED_MPS) -> Wander:
        """Draw a wander of a standard deviation; its wavelengths scale with the speed."""
        count = 4
        return cls(
            np.full(count, stddev_m * math.sqrt(2.0 / count)),
            np.exp(rng.uniform(math.log(35.0), math.log(140.0), count)) * (speed_mps / CITY_SPEED_MPS),
            rng.uniform(0.0, 2 * math.pi, count),
        )

    def at(self, s: np.ndarray) -> np.ndarray:
        """Return the offset to the left in metres at arc lengths s (...)."""
        angle = 2 * math.pi * np.asarray(s, float)[..., None] / self.wavelengths_m + self.phases
        return (self.amplitudes_m * np.sin(angle)).sum(-1)


@dataclass(frozen=True)
class VehicleState:
    """State of a vehicle: centre of its footprint in metres, heading in radians, speed."""

    x: float
    y: float
    heading: float
    speed_mps: float


@dataclass(frozen=True)
class Vehicle:
    """One vehicle and its trajectory: arc length and speed every STEP_S from start_s on."""

    number: int
    kind: str
    colour: int
    route: Route
    wander: Wander
    start_s: float
    s: np.ndarray
    speeds_mps: np.ndarray

    @property
    def shape(self) -> VehicleShape:
        """The shape of its type."""
        return SHAPES[self.kind]

    def state(self, time_s: float) -> VehicleState | None:
        """Return the state at a time, or None before and after the trajectory."""
        position = (time_s - self.start_s) / STEP_S
        index = math.floor(position + 1e-9)
        if index < 0 or index > len(self.s) - 2:
            return None
        tau = (position - index) * STEP_S
        v0, v1 = self.speeds_mps[index], self.speeds_mps[index + 1]
        s = self.s[index] + v0 * tau + 0.5 * (v1 - v0) / STEP_S * tau * tau
        x, y, heading = self.pose(s)
        return VehicleState(x, y, heading, float(v0 + (v1 - v0) * tau / STEP_S))

    def pose(self, s: float) -> tuple[float, float, float]:
        """Return (x, y, heading) of the centre; the rear axle follows the path without side slip."""
        half_m = self.shape.wheelbase_m / 2
        near = s - half_m + np.array([-0.5, 0.5]) * _TANGENT_STEP_M
        poses = self.route.path.at(near)
        lateral = self.wander.at(near)
        xy = poses[:, :2] + lateral[:, None] * np.stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])], -1)
        (x0, y0), (x1, y1) = xy.tolist()
        heading = math.atan2(y1 - y0, x1 - x0)
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        return x + half_m * math.cos(heading), y + half_m * math.sin(heading), heading


@dataclass(frozen=True)
class SimulatedTraffic:
    """All vehicles of a recording, and the green phases (signal, start, end) of its signals."""

    vehicles: tuple[Vehicle, ...]
    green_phases: tuple[tuple[str, float, float], ...]
