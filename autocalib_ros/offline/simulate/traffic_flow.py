"""Microscopic traffic simulation on the routes of a network, run once before the first frame.

Drivers follow the intelligent driver model (Treiber et al. 2000), stop at signals, slow down for curves, yield to
vehicles on a roundabout and wander laterally within their lanes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import permutations

import numpy as np

from autocalib_ros.offline.simulate.network import CITY_SPEED_MPS, Circulation, Network, Route
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.shapes import SHAPES, VehicleShape
from autocalib_ros.offline.simulate.signals import SignalController
from autocalib_ros.offline.simulate.vehicle_models import STEP_S, SimulatedTraffic, Vehicle, Wander

WARM_UP_S = 52.0  # simulated before the first frame, so that the roads are filled
STANDSTILL_GAP_M = 2.0  # s0 of the intelligent driver model
COLOUR_COUNT = 10  # number of body colours of a palette
_CURVE_BRAKING_MPS2 = 1.5  # deceleration before a curve or a roundabout
_LATERAL_ACCELERATION_MPS2 = 2.0  # comfortable lateral acceleration in a curve
_COMFORTABLE_BRAKING_MPS2 = 2.2  # b of the intelligent driver model
_MAX_BRAKING_MPS2 = 7.0
_ENTRY_ROOM_M = 20.0  # free distance that a vehicle needs to enter its lane
_CRITICAL_GAP_S = 4.0  # gap acceptance at a roundabout: shortest time gap that a driver enters
_EXIT_CLEARANCE_M = 8.0  # distance past the exit after which a vehicle no longer occupies the ring


@dataclass
class _Driver:
    """State of a driver and the vehicle during the simulation."""

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
    """Simulate the traffic of a whole recording, including a warm-up before the first frame."""
    if options.empty or options.density == 0:
        return SimulatedTraffic((), ())
    rng = np.random.default_rng([options.seed, 1])
    signals = SignalController(network.phases, -WARM_UP_S)
    arrivals = _Arrivals(network.routes, options, rng)
    drivers: list[_Driver] = []
    fleet = _Fleet(drivers)
    done: list[Vehicle] = []
    steps = math.ceil((options.duration_s + WARM_UP_S) / STEP_S) + 2
    for i in range(steps):
        now = i * STEP_S - WARM_UP_S
        signals.update(now, {d.route.signal for d in drivers if _requests_green(d)})
        arrivals.admit(now, drivers)
        if len(drivers) > len(fleet.drivers):
            fleet = _Fleet(drivers)
        _step_drivers(fleet, signals)
        gone = [d for d in drivers if d.s > d.route.path.length]
        if gone:
            done += [d.vehicle() for d in gone]
            drivers = [d for d in drivers if d.s <= d.route.path.length]
            fleet = _Fleet(drivers)
    done += [d.vehicle() for d in drivers if len(d.trace) > 1]
    recorded = [v for v in done if v.start_s + len(v.s) * STEP_S > 0.0]
    return SimulatedTraffic(tuple(sorted(recorded, key=lambda v: v.number)), tuple(signals.green_phases))


class _Fleet:
    """Drivers with what does not change as they drive, (n,) and (n, n) each."""

    def __init__(self, drivers: list[_Driver]) -> None:
        self.drivers = tuple(drivers)
        self.max_acceleration = np.array([d.shape.acceleration_mps2 for d in drivers])
        self.headway = np.array([d.headway_s for d in drivers])
        self.half = np.array([d.shape.length_m / 2 for d in drivers])
        self.lengths = np.array([d.route.path.length for d in drivers])
        stop = np.array([d.route.stop_s for d in drivers])
        self.line = np.minimum(stop, self.lengths)
        # A leader counts on the entry lane until its tail has diverged, then on a shared exit lane.
        self.diverge = np.array([d.route.diverge_s for d in drivers]) + 2 * self.half + 1.0
        names = [d.route.entry_lane for d in drivers] + [d.route.exit_lane for d in drivers]
        entry_lane, exit_lane = np.split(_integer_codes(names), 2)
        self.same_entry, self.same_exit = entry_lane[:, None] == entry_lane, exit_lane[:, None] == exit_lane
        self.same_route = self.same_entry & self.same_exit
        no_stop_line = stop <= 0
        self.both_without_line = no_stop_line[:, None] & no_stop_line
        self.enters_exit_lane = entry_lane[:, None] == exit_lane


class _Arrivals:
    """Poisson arrivals; a vehicle enters as soon as its lane has room."""

    def __init__(self, routes: tuple[Route, ...], options: SimulationOptions, rng: np.random.Generator) -> None:
        self._rng = rng
        self._wander_m = options.wander_m
        self._count = 0
        self._flows = [(r, options.density * r.share / 60.0) for r in routes if r.share > 0]
        self._next = [rng.exponential(1 / rate) - WARM_UP_S for _, rate in self._flows]
        self._waiting: dict[str, list[Route]] = {}

    def admit(self, now: float, drivers: list[_Driver]) -> None:
        """Add the vehicles that arrive by now to the drivers."""
        for i, (route, rate) in enumerate(self._flows):
            while self._next[i] <= now:
                self._waiting.setdefault(route.entry_lane, []).append(route)
                self._next[i] += self._rng.exponential(1 / rate)
        for queue in self._waiting.values():
            if queue and (room := _entry_gap(queue[0], drivers))[0] > _ENTRY_ROOM_M:
                drivers.append(self._driver(now, queue.pop(0), *room))

    def _driver(self, now: float, route: Route, room_m: float, leader_mps: float) -> _Driver:
        rng = self._rng
        shapes = [s for s in SHAPES.values() if s.fits_narrow_turns or not route.narrow]
        fractions = np.array([s.fraction for s in shapes])
        shape = shapes[int(rng.choice(len(shapes), p=fractions / fractions.sum()))]
        cruise = float(np.clip(rng.normal(12.5, 1.3), 9.5, 16.0)) * route.speed_mps / CITY_SPEED_MPS
        cruise = min(cruise, shape.top_speed_mps)
        safe = max(0.0, min(cruise, leader_mps + 0.1 * (room_m - _ENTRY_ROOM_M)))
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
    """Return the free distance at the start of a route and the speed of the last vehicle there."""
    inside = [d for d in drivers if d.route.entry_lanes & route.entry_lanes]
    if not inside:
        return math.inf, math.inf
    last = min(inside, key=lambda d: d.s)
    return last.s - last.shape.length_m / 2, last.v


def _requests_green(driver: _Driver) -> bool:
    """Whether a vehicle is within 40 m before its stop line, where it requests a green phase."""
    ahead = driver.route.stop_s - driver.s
    return math.isfinite(ahead) and 0.0 < ahead < 40.0


def _step_drivers(fleet: _Fleet, signals: SignalController) -> None:
    """Advance all drivers by one time step."""
    drivers = fleet.drivers
    if not drivers:
        return
    v = np.array([d.v for d in drivers])
    gap, leader_v = _leaders(fleet, v)
    stop = np.array([_stop_line_gap(d, signals, drivers) for d in drivers])
    leader_v = np.where(stop < gap, 0.0, leader_v)
    gap = np.minimum(gap, stop)
    desired_v = np.array([min(d.cruise_mps, _curve_speed_limit(d)) for d in drivers])
    max_acceleration = fleet.max_acceleration
    # Intelligent driver model: free-road term, desired gap s*, acceleration.
    free = 1 - (v / desired_v) ** 4
    desired_gap = STANDSTILL_GAP_M + np.maximum(
        0.0, v * fleet.headway + v * (v - leader_v) / (2 * np.sqrt(max_acceleration * _COMFORTABLE_BRAKING_MPS2))
    )
    acceleration = max_acceleration * (free - (desired_gap / np.maximum(gap, 0.1)) ** 2)
    new_v = np.maximum(0.0, v + np.clip(acceleration, -_MAX_BRAKING_MPS2, None) * STEP_S)
    new_v[(new_v < 0.02) & (gap < STANDSTILL_GAP_M + 0.5)] = 0.0
    for d, speed in zip(drivers, new_v.tolist(), strict=True):
        d.trace.append((d.s, d.v))
        d.s += 0.5 * (d.v + speed) * STEP_S
        d.v = speed


def _leaders(fleet: _Fleet, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gap to the leading vehicle and its speed, (n,) each; (inf, 0) without a leader."""
    s = np.array([d.s for d in fleet.drivers])
    past_line, remaining, on_entry_lane = s > fleet.line, fleet.lengths - s, s < fleet.diverge
    ahead = fleet.same_entry & (fleet.same_route | on_entry_lane[None, :])
    along = np.where(ahead, s[None, :] - s[:, None], np.inf)
    merging = fleet.same_exit & past_line[:, None] & past_line[None, :]
    # A vehicle that changes lanes occupies the target lane from the start and its old lane until it has left it.
    crossing = fleet.enters_exit_lane & on_entry_lane[:, None]
    crossing |= crossing.T | (fleet.same_entry & on_entry_lane[:, None] & on_entry_lane)
    merging |= crossing & fleet.both_without_line
    merged = np.where(merging & ~fleet.same_route, remaining[:, None] - remaining[None, :], np.inf)
    along[along <= 0] = np.inf
    merged[merged <= 0] = np.inf
    gaps = np.minimum(along, merged)
    _lower_to_ring_distances(gaps, fleet.drivers)
    gaps = gaps - fleet.half[:, None] - fleet.half[None, :]
    np.fill_diagonal(gaps, np.inf)
    leader = gaps.argmin(1)
    gap = gaps[np.arange(len(s)), leader]
    return gap, np.where(np.isfinite(gap), v[leader], 0.0)


def _lower_to_ring_distances(distances: np.ndarray, drivers: tuple[_Driver, ...]) -> None:
    """Lower distances (n, n) to those round a ring from each vehicle on it to each one ahead.

    A vehicle is on the ring from its give-way line until its tail has left.
    """
    on_ring = [i for i, d in enumerate(drivers) if _is_on_ring(d)]
    for i, j in permutations(on_ring, 2):
        distances[i, j] = min(distances[i, j], _ring_distance(drivers[i], drivers[j]))


def _ring_distance(driver: _Driver, other: _Driver) -> float:
    """Return the distance round the ring to another vehicle on it if that one is relevant and ahead, else inf."""
    ring, other_ring = driver.route.ring, other.route.ring
    if ring is None or other_ring is None:
        return math.inf
    ahead = ring.distance_ahead_m(other_ring.position_m(other.s), driver.s)
    to_exit = ring.exit_s - driver.s
    if other.s < other_ring.entry_s:
        relevant = to_exit > ring.distance_ahead_m(other_ring.entry_m, driver.s)
    else:
        relevant = ahead < to_exit + (driver.shape.length_m + other.shape.length_m) / 2 + _EXIT_CLEARANCE_M
    return ahead if relevant and ahead < ring.circumference_m / 2 else math.inf


def _is_on_ring(driver: _Driver) -> bool:
    ring, half_m = driver.route.ring, driver.shape.length_m / 2
    return (
        ring is not None
        and driver.s + half_m > driver.route.stop_s
        and driver.s < (ring.exit_s + half_m + _EXIT_CLEARANCE_M)
    )


def _must_yield(driver: _Driver, ring: Circulation, drivers: tuple[_Driver, ...]) -> bool:
    """Whether a vehicle on the ring passes the entry of this driver within the critical gap."""
    for other in drivers:
        other_ring = other.route.ring
        if other_ring is None or other is driver or other.route.entry_lane == driver.route.entry_lane:
            continue
        distance_m = other_ring.distance_ahead_m(ring.entry_m, other.s)
        passes = _is_on_ring(other) and other_ring.exit_s - other.s > distance_m
        if passes and distance_m < _CRITICAL_GAP_S * max(other.v, 3.0) + other.shape.length_m:
            return True
    return False


def _integer_codes(names: list[str]) -> np.ndarray:
    """Return integer codes of names: integers compare faster."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(name, len(numbers)) for name in names])


def _stop_line_gap(driver: _Driver, signals: SignalController, drivers: tuple[_Driver, ...]) -> float:
    """Return the gap to the stop line if the driver has to stop there, else inf."""
    ahead = driver.route.stop_s - driver.s - driver.shape.length_m / 2
    if ahead < -0.3 or math.isinf(ahead):
        return math.inf
    if driver.route.ring is not None:
        light = 'amber' if _must_yield(driver, driver.route.ring, drivers) else 'green'
    elif driver.route.signal is not None:
        light = signals.light(driver.route.signal)
    else:
        return math.inf
    braking = {'green': 0.0, 'amber': 2.0, 'red': 5.0}[light]
    if light == 'green' or driver.v**2 > 2 * braking * max(ahead, 0.0) + 0.5:
        return math.inf
    # The model keeps its standstill gap to a bumper; drivers stop closer to a line.
    return max(ahead, 0.0) + STANDSTILL_GAP_M - 0.6


def _curve_speed_limit(driver: _Driver) -> float:
    """Return the speed limit of the curves ahead, with comfortable braking before them."""
    limit = math.inf
    for start, end, radius in driver.route.path.curves:
        if driver.s < end:
            ahead = max(0.0, start - driver.s)
            limit = min(limit, math.sqrt(_LATERAL_ACCELERATION_MPS2 * radius + 2 * _CURVE_BRAKING_MPS2 * ahead))
    return limit
