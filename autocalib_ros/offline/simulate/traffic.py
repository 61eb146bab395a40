"""Traffic over the routes of a network, simulated once and before the first frame is drawn.

Drivers follow the intelligent driver model (Treiber et al. 2000), stop at signals, slow down for
curves and wander within their lanes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from .network import Network, Route
from .options import SimulationOptions
from .shapes import SHAPES, Shape
from .signals import Signals

STEP_S = 0.1
WARM_UP_S = 52.0
STANDSTILL_GAP_M = 2.0
COLOURS = 10  # how many body colours a palette has


@dataclass(frozen=True)
class Wander:
    """Lateral offset within the lane as a smooth function of the way gone.

    A function of the way, not of time: a waiting vehicle does not slide sideways.
    """

    amplitudes_m: np.ndarray
    wavelengths_m: np.ndarray
    phases: np.ndarray

    @classmethod
    def draw(cls, stddev_m: float, rng: np.random.Generator) -> Wander:
        """Draw a wander of a standard deviation; at city speed it is correlated over seconds."""
        count = 4
        return cls(
            np.full(count, stddev_m * math.sqrt(2.0 / count)),
            np.exp(rng.uniform(math.log(35.0), math.log(140.0), count)),
            rng.uniform(0.0, 2 * math.pi, count),
        )

    def at(self, s: np.ndarray) -> np.ndarray:
        """Return the offset to the left in metres at arc lengths s (...)."""
        angle = 2 * math.pi * np.asarray(s, float)[..., None] / self.wavelengths_m + self.phases
        return (self.amplitudes_m * np.sin(angle)).sum(-1)


@dataclass(frozen=True)
class VehicleState:
    """Where a vehicle is: centre of its footprint in metres, heading in radians, speed."""

    x: float
    y: float
    heading: float
    speed_mps: float


@dataclass(frozen=True)
class Vehicle:
    """One vehicle and its whole life: arc length and speed every STEP_S from start_s on."""

    number: int
    kind: str
    colour: int
    route: Route
    wander: Wander
    start_s: float
    s: np.ndarray
    speeds_mps: np.ndarray

    @property
    def shape(self) -> Shape:
        """Its dimensions."""
        return SHAPES[self.kind]

    def state(self, time_s: float) -> VehicleState | None:
        """Return where it is at a time, or None before and after its life."""
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
        """Return (x, y, heading) with both axles on the wandering path."""
        axles = s + np.array([-0.5, 0.5]) * self.shape.wheelbase_m
        rows = self.route.path.at(axles)
        aside = self.wander.at(axles)
        xy = rows[:, :2] + aside[:, None] * np.stack([-np.sin(rows[:, 2]), np.cos(rows[:, 2])], -1)
        (rear_x, rear_y), (front_x, front_y) = xy.tolist()
        heading = math.atan2(front_y - rear_y, front_x - rear_x)
        return (rear_x + front_x) / 2, (rear_y + front_y) / 2, heading


@dataclass(frozen=True)
class Traffic:
    """All vehicles, and the green times (signal, start, end) that they obeyed."""

    vehicles: tuple[Vehicle, ...]
    greens: tuple[tuple[str, float, float], ...]


@dataclass
class _Driver:
    """A vehicle under way."""

    number: int
    shape: Shape
    colour: int
    route: Route
    wander: Wander
    cruise_mps: float
    headway_s: float
    start_s: float
    s: float
    v: float
    trace: list[tuple[float, float]] = field(default_factory=list)

    def vehicle(self) -> Vehicle:
        trace = np.array(self.trace)
        return Vehicle(
            self.number, self.shape.kind, self.colour, self.route, self.wander, self.start_s,
            trace[:, 0], trace[:, 1],
        )


def simulate_traffic(network: Network, options: SimulationOptions) -> Traffic:
    """Simulate the traffic of a whole recording, with a warm-up before its first frame."""
    if options.empty or options.density == 0:
        return Traffic((), ())
    rng = np.random.default_rng([options.seed, 1])
    signals = Signals(network.phases, -WARM_UP_S)
    arrivals = _Arrivals(network.routes, options, rng)
    drivers: list[_Driver] = []
    done: list[Vehicle] = []
    steps = math.ceil((options.duration_s + WARM_UP_S) / STEP_S) + 2
    for i in range(steps):
        now = i * STEP_S - WARM_UP_S
        signals.update(now, {d.route.signal for d in drivers if _waits(d)})
        arrivals.admit(now, drivers)
        _advance(drivers, signals)
        gone = [d for d in drivers if d.s > d.route.path.length]
        done += [d.vehicle() for d in gone]
        drivers = [d for d in drivers if d.s <= d.route.path.length]
    done += [d.vehicle() for d in drivers if len(d.trace) > 1]
    seen = [v for v in done if v.start_s + len(v.s) * STEP_S > 0.0]
    return Traffic(tuple(sorted(seen, key=lambda v: v.number)), tuple(signals.greens))


class _Arrivals:
    """Vehicles that arrive at random and enter as soon as their lane has room."""

    def __init__(
        self, routes: tuple[Route, ...], options: SimulationOptions, rng: np.random.Generator
    ) -> None:
        self._rng = rng
        self._wander_m = options.wander_m
        self._count = 0
        self._flows = [(r, options.density * r.share / 60.0) for r in routes if r.share > 0]
        self._next = [rng.exponential(1 / rate) - WARM_UP_S for _, rate in self._flows]
        self._waiting: dict[str, list[Route]] = {}

    def admit(self, now: float, drivers: list[_Driver]) -> None:
        """Add the vehicles that arrive now to the drivers."""
        for i, (route, rate) in enumerate(self._flows):
            while self._next[i] <= now:
                self._waiting.setdefault(route.approach, []).append(route)
                self._next[i] += self._rng.exponential(1 / rate)
        for lane, queue in self._waiting.items():
            if queue and (room := _room(lane, drivers))[0] > 20.0:
                drivers.append(self._driver(now, queue.pop(0), *room))

    def _driver(self, now: float, route: Route, room_m: float, leader_mps: float) -> _Driver:
        rng = self._rng
        shapes = [s for s in SHAPES.values() if s.turns_right or route.movement != 'right']
        shares = np.array([s.share for s in shapes])
        shape = shapes[int(rng.choice(len(shapes), p=shares / shares.sum()))]
        cruise = float(np.clip(rng.normal(12.5, 1.3), 9.5, 16.0))
        safe = max(0.0, min(cruise, leader_mps + 0.1 * (room_m - 20.0)))
        self._count += 1
        return _Driver(
            self._count, shape, int(rng.integers(COLOURS)), route,
            Wander.draw(self._wander_m, rng), cruise, float(rng.uniform(1.0, 1.5)), now,
            shape.length_m / 2, safe,
        )


def _room(lane: str, drivers: list[_Driver]) -> tuple[float, float]:
    """Return the free way at the start of a lane and the speed of the last vehicle in it."""
    inside = [d for d in drivers if d.route.approach == lane]
    if not inside:
        return math.inf, math.inf
    last = min(inside, key=lambda d: d.s)
    return last.s - last.shape.length_m / 2, last.v


def _waits(driver: _Driver) -> bool:
    """Tell whether a vehicle is before its stop line and close enough to call for a green."""
    ahead = driver.route.stop_s - driver.s
    return math.isfinite(ahead) and 0.0 < ahead < 40.0


def _advance(drivers: list[_Driver], signals: Signals) -> None:
    """Move all drivers by one step."""
    if not drivers:
        return
    v = np.array([d.v for d in drivers])
    gap, leader_v = _leaders(drivers)
    stop = np.array([_stop_gap(d, signals) for d in drivers])
    leader_v = np.where(stop < gap, 0.0, leader_v)
    gap = np.minimum(gap, stop)
    wish = np.array([min(d.cruise_mps, _curve_limit(d)) for d in drivers])
    strength = np.array([d.shape.acceleration_mps2 for d in drivers])
    headway = np.array([d.headway_s for d in drivers])
    free = 1 - (v / wish) ** 4
    desired = STANDSTILL_GAP_M + np.maximum(
        0.0, v * headway + v * (v - leader_v) / (2 * np.sqrt(strength * 2.2))
    )
    acceleration = strength * (free - (desired / np.maximum(gap, 0.1)) ** 2)
    new_v = np.maximum(0.0, v + np.clip(acceleration, -7.0, None) * STEP_S)
    new_v[(new_v < 0.02) & (gap < STANDSTILL_GAP_M + 0.5)] = 0.0
    for d, speed in zip(drivers, new_v.tolist(), strict=True):
        d.trace.append((d.s, d.v))
        d.s += 0.5 * (d.v + speed) * STEP_S
        d.v = speed


def _leaders(drivers: list[_Driver]) -> tuple[np.ndarray, np.ndarray]:
    """Return the gap to the vehicle ahead and its speed, (n,) each; no leader: (inf, 0)."""
    s = np.array([d.s for d in drivers])
    half = np.array([d.shape.length_m / 2 for d in drivers])
    approach = _codes([d.route.approach for d in drivers])
    leave = _codes([d.route.leave for d in drivers])
    past_line = s > np.array([min(d.route.stop_s, d.route.path.length) for d in drivers])
    left = np.array([d.route.path.length for d in drivers]) - s
    # On the approach lane until the leader's tail has turned off; then towards a shared exit lane.
    split = np.array([d.route.split_s for d in drivers]) + 2 * half + 1.0
    same_route = (approach[:, None] == approach) & (leave[:, None] == leave)
    ahead = (approach[:, None] == approach) & (same_route | (s < split)[None, :])
    along = np.where(ahead, s[None, :] - s[:, None], np.inf)
    merging = (leave[:, None] == leave) & past_line[:, None] & past_line[None, :]
    merged = np.where(merging & ~same_route, left[:, None] - left[None, :], np.inf)
    along[along <= 0] = np.inf
    merged[merged <= 0] = np.inf
    gaps = np.minimum(along, merged) - half[:, None] - half[None, :]
    np.fill_diagonal(gaps, np.inf)
    first = gaps.argmin(1)
    rows = np.arange(len(drivers))
    speeds = np.array([d.v for d in drivers])[first]
    return gaps[rows, first], np.where(np.isfinite(gaps[rows, first]), speeds, 0.0)


def _codes(names: list[str]) -> np.ndarray:
    """Number the names, equal names alike: numbers compare faster."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(name, len(numbers)) for name in names])


def _stop_gap(driver: _Driver, signals: Signals) -> float:
    """Return the way to the stop line if the driver has to stop there, else inf."""
    if driver.route.signal is None:
        return math.inf
    ahead = driver.route.stop_s - driver.s - driver.shape.length_m / 2
    light = signals.light(driver.route.signal)
    braking = {'green': 0.0, 'amber': 2.0, 'red': 5.0}[light]
    if light == 'green' or ahead < -0.3 or driver.v**2 > 2 * braking * max(ahead, 0.0) + 0.5:
        return math.inf
    # The gap of the model is one to a bumper; drivers stop closer to a line.
    return max(ahead, 0.0) + STANDSTILL_GAP_M - 0.6


def _curve_limit(driver: _Driver) -> float:
    """Return the speed that the curve of the route allows here, braking early for it."""
    limit = math.inf
    for start, end, radius in driver.route.path.curves():
        comfortable = 2.0 * radius
        if driver.s < end:
            ahead = max(0.0, start - driver.s)
            limit = min(limit, math.sqrt(comfortable + 2 * 1.5 * ahead))
    return limit
