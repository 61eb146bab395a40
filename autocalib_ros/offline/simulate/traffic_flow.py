"""Traffic over the routes of a network, simulated once and before the first frame is drawn.

Drivers follow the intelligent driver model (Treiber et al. 2000), stop at signals, slow down for
curves, give way to who circles on a ring and wander within their lanes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import permutations

import numpy as np

from autocalib_ros.offline.simulate.network import CITY_SPEED_MPS, Network, Route
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.shapes import SHAPES, VehicleShape
from autocalib_ros.offline.simulate.signals import SignalController
from autocalib_ros.offline.simulate.vehicle_models import STEP_S, SimulatedTraffic, Vehicle, Wander

WARM_UP_S = 52.0
STANDSTILL_GAP_M = 2.0
COLOUR_COUNT = 10  # how many body colours a palette has
_BRAKING_MPS2 = 1.5  # for a curve or a ring ahead
_CRITICAL_GAP_S = 4.0  # drivers enter a ring when nobody will be at their place for so long
_EXIT_CLEARANCE_M = 8.0  # beyond an exit, until a vehicle's tail is clear of the ring


@dataclass
class _Driver:
    """A vehicle under way."""

    number: int
    shape: VehicleShape
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
            self.number,
            self.shape.kind,
            self.colour,
            self.route,
            self.wander,
            self.start_s,
            trace[:, 0],
            trace[:, 1],
        )


def simulate_traffic(network: Network, options: SimulationOptions) -> SimulatedTraffic:
    """Simulate the traffic of a whole recording, with a warm-up before its first frame."""
    if options.empty or options.density == 0:
        return SimulatedTraffic((), ())
    rng = np.random.default_rng([options.seed, 1])
    signals = SignalController(network.phases, -WARM_UP_S)
    arrivals = _Arrivals(network.routes, options, rng)
    drivers: list[_Driver] = []
    done: list[Vehicle] = []
    steps = math.ceil((options.duration_s + WARM_UP_S) / STEP_S) + 2
    for i in range(steps):
        now = i * STEP_S - WARM_UP_S
        signals.update(now, {d.route.signal for d in drivers if _requests_green(d)})
        arrivals.admit(now, drivers)
        _step_drivers(drivers, signals)
        gone = [d for d in drivers if d.s > d.route.path.length]
        done += [d.vehicle() for d in gone]
        drivers = [d for d in drivers if d.s <= d.route.path.length]
    done += [d.vehicle() for d in drivers if len(d.trace) > 1]
    seen = [v for v in done if v.start_s + len(v.s) * STEP_S > 0.0]
    return SimulatedTraffic(tuple(sorted(seen, key=lambda v: v.number)), tuple(signals.green_phases))


class _Arrivals:
    """Vehicles that arrive at random and enter as soon as their lane has room."""

    def __init__(self, routes: tuple[Route, ...], options: SimulationOptions, rng: np.random.Generator) -> None:
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
        for queue in self._waiting.values():
            if queue and (room := _entry_gap(queue[0], drivers))[0] > 20.0:
                drivers.append(self._driver(now, queue.pop(0), *room))

    def _driver(self, now: float, route: Route, room_m: float, leader_mps: float) -> _Driver:
        rng = self._rng
        shapes = [s for s in SHAPES.values() if s.fits_narrow_turns or not route.narrow]
        shares = np.array([s.share for s in shapes])
        shape = shapes[int(rng.choice(len(shapes), p=shares / shares.sum()))]
        cruise = float(np.clip(rng.normal(12.5, 1.3), 9.5, 16.0)) * route.speed_mps / CITY_SPEED_MPS
        cruise = min(cruise, shape.top_speed_mps)
        safe = max(0.0, min(cruise, leader_mps + 0.1 * (room_m - 20.0)))
        self._count += 1
        return _Driver(
            self._count,
            shape,
            int(rng.integers(COLOUR_COUNT)),
            route,
            Wander.draw(self._wander_m, rng, route.speed_mps),
            cruise,
            float(rng.uniform(1.0, 1.5)),
            now,
            shape.length_m / 2,
            safe,
        )


def _entry_gap(route: Route, drivers: list[_Driver]) -> tuple[float, float]:
    """Return the free way at the start of a route and the speed of the last vehicle there."""
    inside = [d for d in drivers if d.route.entry_lanes & route.entry_lanes]
    if not inside:
        return math.inf, math.inf
    last = min(inside, key=lambda d: d.s)
    return last.s - last.shape.length_m / 2, last.v


def _requests_green(driver: _Driver) -> bool:
    """Tell whether a vehicle is before its stop line and close enough to call for a green."""
    ahead = driver.route.stop_s - driver.s
    return math.isfinite(ahead) and 0.0 < ahead < 40.0


def _step_drivers(drivers: list[_Driver], signals: SignalController) -> None:
    """Move all drivers by one step."""
    if not drivers:
        return
    v = np.array([d.v for d in drivers])
    gap, leader_v = _leaders(drivers)
    stop = np.array([_stop_line_gap(d, signals, drivers) for d in drivers])
    leader_v = np.where(stop < gap, 0.0, leader_v)
    gap = np.minimum(gap, stop)
    wish = np.array([min(d.cruise_mps, _curve_speed_limit(d)) for d in drivers])
    strength = np.array([d.shape.acceleration_mps2 for d in drivers])
    headway = np.array([d.headway_s for d in drivers])
    free = 1 - (v / wish) ** 4
    desired = STANDSTILL_GAP_M + np.maximum(0.0, v * headway + v * (v - leader_v) / (2 * np.sqrt(strength * 2.2)))
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
    names = [d.route.approach for d in drivers] + [d.route.leave for d in drivers]
    approach, leave = np.split(_integer_codes(names), 2)
    stop = np.array([d.route.stop_s for d in drivers])
    past_line = s > np.minimum(stop, [d.route.path.length for d in drivers])
    left = np.array([d.route.path.length for d in drivers]) - s
    # On the approach lane until the leader's tail has turned off; then towards a shared exit lane.
    split = np.array([d.route.diverge_s for d in drivers]) + 2 * half + 1.0
    same_route = (approach[:, None] == approach) & (leave[:, None] == leave)
    ahead = (approach[:, None] == approach) & (same_route | (s < split)[None, :])
    along = np.where(ahead, s[None, :] - s[:, None], np.inf)
    merging = (leave[:, None] == leave) & past_line[:, None] & past_line[None, :]
    # Who changes lanes belongs to the new one from the start, and to the old one until it has left.
    free, stays = stop <= 0, s < split
    crossing = (approach[:, None] == leave) & stays[:, None]
    crossing |= crossing.T | ((approach[:, None] == approach) & stays[:, None] & stays)
    merging |= crossing & free[:, None] & free
    merged = np.where(merging & ~same_route, left[:, None] - left[None, :], np.inf)
    along[along <= 0] = np.inf
    merged[merged <= 0] = np.inf
    distance_ahead_m = np.minimum(np.minimum(along, merged), _ring_distances(drivers))
    gaps = distance_ahead_m - half[:, None] - half[None, :]
    np.fill_diagonal(gaps, np.inf)
    first = gaps.argmin(1)
    rows = np.arange(len(drivers))
    speeds = np.array([d.v for d in drivers])[first]
    return gaps[rows, first], np.where(np.isfinite(gaps[rows, first]), speeds, 0.0)


def _ring_distances(drivers: list[_Driver]) -> np.ndarray:
    """Return the way round a ring (n, n) from each vehicle on it to each one ahead; else inf.

    On the ring is who has passed its give-way line and has not left with its tail.
    """
    ways = np.full((len(drivers), len(drivers)), np.inf)
    on_ring = [i for i, d in enumerate(drivers) if _is_on_ring(d)]
    for i, j in permutations(on_ring, 2):
        ways[i, j] = _ring_distance(drivers[i], drivers[j])
    return ways


def _ring_distance(driver: _Driver, other: _Driver) -> float:
    """Return the way round the ring to another vehicle on it if that is ahead, else inf."""
    ring, there = driver.route.ring, other.route.ring
    ahead = ring.distance_ahead_m(there.position_m(other.s), driver.s)
    stays = ring.exit_s - driver.s
    if other.s < there.entry_s:
        concerned = stays > ring.distance_ahead_m(there.entry_m, driver.s)
    else:
        concerned = ahead < stays + (driver.shape.length_m + other.shape.length_m) / 2 + _EXIT_CLEARANCE_M
    return ahead if concerned and ahead < ring.circumference_m / 2 else math.inf


def _is_on_ring(driver: _Driver) -> bool:
    ring, half_m = driver.route.ring, driver.shape.length_m / 2
    return (
        ring is not None
        and driver.s + half_m > driver.route.stop_s
        and driver.s < (ring.exit_s + half_m + _EXIT_CLEARANCE_M)
    )


def _must_yield(driver: _Driver, drivers: list[_Driver]) -> bool:
    """Tell whether somebody on the ring will soon pass where a vehicle wants to join it."""
    ring = driver.route.ring
    for other in drivers:
        if other is driver or not _is_on_ring(other) or other.route.approach == driver.route.approach:
            continue
        round_m = other.route.ring.distance_ahead_m(ring.entry_m, other.s)
        passes = other.route.ring.exit_s - other.s > round_m
        if passes and round_m < _CRITICAL_GAP_S * max(other.v, 3.0) + other.shape.length_m:
            return True
    return False


def _integer_codes(names: list[str]) -> np.ndarray:
    """Number the names, equal names alike: numbers compare faster."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(name, len(numbers)) for name in names])


def _stop_line_gap(driver: _Driver, signals: SignalController, drivers: list[_Driver]) -> float:
    """Return the way to the stop line if the driver has to stop there, else inf."""
    ahead = driver.route.stop_s - driver.s - driver.shape.length_m / 2
    if ahead < -0.3 or math.isinf(ahead):
        return math.inf
    if driver.route.ring is not None:
        light = 'amber' if _must_yield(driver, drivers) else 'green'
    elif driver.route.signal is not None:
        light = signals.light(driver.route.signal)
    else:
        return math.inf
    braking = {'green': 0.0, 'amber': 2.0, 'red': 5.0}[light]
    if light == 'green' or driver.v**2 > 2 * braking * max(ahead, 0.0) + 0.5:
        return math.inf
    # The gap of the model is one to a bumper; drivers stop closer to a line.
    return max(ahead, 0.0) + STANDSTILL_GAP_M - 0.6


def _curve_speed_limit(driver: _Driver) -> float:
    """Return the speed that the curve of the route allows here, braking early for it."""
    limit = math.inf
    for start, end, radius in driver.route.path.curves():
        comfortable = 2.0 * radius
        if driver.s < end:
            ahead = max(0.0, start - driver.s)
            limit = min(limit, math.sqrt(comfortable + 2 * _BRAKING_MPS2 * ahead))
    return limit
