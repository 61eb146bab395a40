"""The simulated traffic is plausible."""

from __future__ import annotations

import math

import numpy as np
import pytest

from autocalib_ros.offline.simulate.junctions import junction
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.scenes import build_network
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.traffic_flow import simulate_traffic
from autocalib_ros.offline.simulate.truth import truth_of
from autocalib_ros.offline.simulate.vehicle_models import STEP_S, SimulatedTraffic, Vehicle, Wander

pytestmark = pytest.mark.render

MINUTE = SimulationOptions()


@pytest.fixture(scope='module')
def network() -> Network:
    return build_network(MINUTE)


@pytest.fixture(scope='module')
def traffic(network) -> SimulatedTraffic:
    return simulate_traffic(network, MINUTE)


def _crossing_time(vehicle: Vehicle) -> float | None:
    """Return the time at which a vehicle passes the centre of the junction, or None."""
    passed = vehicle.s > vehicle.route.stop_s + 10.0
    return vehicle.start_s + STEP_S * int(passed.argmax()) if passed.any() else None


def _crossings(traffic: SimulatedTraffic, movement: str) -> list[Vehicle]:
    return [
        v
        for v in traffic.vehicles
        if v.route.movement == movement and (t := _crossing_time(v)) is not None and 0 <= t < MINUTE.duration_s
    ]


@pytest.mark.parametrize('signal', ['main0', 'main1'])
def test_straight_traffic_crosses_on_both_roads_within_a_minute(traffic, signal):
    assert sum(v.route.signal == signal for v in _crossings(traffic, 'straight')) >= 6


@pytest.mark.parametrize('movement', ['left', 'right'])
def test_some_vehicles_turn_within_a_minute(traffic, movement):
    assert _crossings(traffic, movement)


def test_every_path_is_smooth(network):
    for route in network.routes:
        s = np.arange(0.0, route.path.length, 0.1)
        x, y, heading = route.path.at(s).T
        tangent = np.arctan2(np.diff(y), np.diff(x))
        bend = np.angle(np.exp(1j * (tangent - heading[:-1])))
        assert np.hypot(np.diff(x), np.diff(y)) == pytest.approx(0.1, abs=1e-4)
        assert np.abs(bend).max() < 0.02


@pytest.mark.parametrize('angle_deg', [60.0, 90.0, 120.0])
def test_routes_leave_on_the_lanes_of_straight_traffic(angle_deg):
    routes = junction(math.radians(angle_deg), 0.2).routes
    ends = {r.exit_lane: r.path.at(r.path.length)[:2] for r in routes if r.movement == 'straight'}
    for route in routes:
        assert route.path.at(route.path.length)[:2] == pytest.approx(ends[route.exit_lane], abs=1e-6)


def test_wander_has_the_stated_standard_deviation():
    rng = np.random.default_rng(1)
    values = np.concatenate([Wander.draw(0.1, rng).at(np.arange(0, 200, 5.0)) for _ in range(300)])
    assert values.std() == pytest.approx(0.1, rel=0.05)


def test_straight_vehicles_keep_their_lane_up_to_the_wander(traffic):
    offsets = []
    for vehicle in (v for v in traffic.vehicles if v.route.movement == 'straight'):
        for s in np.arange(20.0, 200.0, 10.0):
            x, y, heading = vehicle.route.path.at(s)
            there = np.array(vehicle.pose(s)[:2]) - (x, y)
            offsets.append(there @ (-math.sin(heading), math.cos(heading)))
    assert np.std(offsets) == pytest.approx(MINUTE.wander_m, rel=0.2)


def test_some_vehicles_stop_at_the_signals(traffic):
    waiting = [v for v in traffic.vehicles if (v.speeds_mps[20:] == 0).sum() * STEP_S > 5.0]
    assert len(waiting) >= 5


def test_waiting_vehicles_stand_still(traffic):
    vehicle = max(traffic.vehicles, key=lambda v: int((v.speeds_mps == 0).sum()))
    first = int(np.flatnonzero(vehicle.speeds_mps == 0)[0]) + 1
    a, b = (vehicle.state(vehicle.start_s + STEP_S * (first + n)) for n in (0.3, 5.7))
    assert (a.x, a.y, a.heading) == (b.x, b.y, b.heading)


def test_no_vehicle_brakes_or_accelerates_beyond_reason(traffic):
    steps = np.concatenate([np.diff(v.speeds_mps) for v in traffic.vehicles]) / STEP_S
    assert steps.max() < 3.0
    assert steps.min() > -7.5


def test_turning_vehicles_slow_down_in_the_curve(traffic):
    vehicle = _crossings(traffic, 'right')[0]
    _, (start, end, radius), _ = vehicle.route.path.curves  # the arc between its clothoids
    inside = (vehicle.s > start + 1) & (vehicle.s < end)
    assert vehicle.speeds_mps[inside].max() ** 2 / radius < 4.0  # m/s^2


@pytest.mark.parametrize('given', [{'empty': True}, {'density': 0.0}])
def test_empty_road_has_no_vehicles(given, network):
    assert not simulate_traffic(network, SimulationOptions(**given)).vehicles


def test_one_way_traffic_has_one_heading():
    options = SimulationOptions(one_way=True)
    traffic = simulate_traffic(build_network(options), options)
    headings = {round(float(v.route.path.at(50.0)[2]), 6) for v in traffic.vehicles}
    assert headings == {0.0}


def test_same_seed_gives_the_same_traffic(network, traffic):
    again = simulate_traffic(network, MINUTE)
    assert [v.number for v in again.vehicles] == [v.number for v in traffic.vehicles]
    assert np.array_equal(*(np.concatenate([v.s for v in t.vehicles]) for t in (traffic, again)))


def test_another_seed_gives_other_traffic(network, traffic):
    other = simulate_traffic(network, SimulationOptions(seed=1))
    assert [v.start_s for v in other.vehicles] != [v.start_s for v in traffic.vehicles]


def test_cyclists_ride_along_their_road_and_are_in_the_truth():
    options = SimulationOptions(
        cyclists=8, pedestrians=4, duration_s=10.0, rate_hz=5.0, width_px=320, height_px=180, focal_px=140.0
    )
    truth = truth_of(Simulation(options))
    cyclists = [track for track in truth['people']['tracks'] if track['type'] == 'cyclist']
    assert len(cyclists) >= 6
    assert {track['type'] for track in truth['people']['tracks']} == {'cyclist', 'pedestrian'}
    for track in cyclists:
        t, x, y, heading, speed = np.array(track['rows'])[:, :5].T
        on = np.diff(t) < 0.3
        way = np.hypot(np.diff(x), np.diff(y))
        restarts = way > 5.0
        assert 4.0 <= speed[0] <= 7.0
        np.testing.assert_allclose((way / np.diff(t))[on & ~restarts], speed[0], atol=0.1)
        turn = np.arctan2(np.diff(y), np.diff(x)) - heading[:-1]
        assert np.abs(np.angle(np.exp(1j * turn)))[on & ~restarts].max() < 0.1


def test_cyclists_change_only_the_pixels_around_them():
    small = {'width_px': 320, 'height_px': 180, 'focal_px': 140.0, 'noise_sigma': 0.0, 'duration_s': 5.0}
    alone, ridden = (Simulation(SimulationOptions(cyclists=number, **small)) for number in (0, 6))
    assert len(alone.traffic.vehicles) == len(ridden.traffic.vehicles)
    changed = (alone.frame(10) != ridden.frame(10)).any(axis=2)
    assert 10 < changed.sum() < 0.05 * changed.size
    time_s = ridden.time_s(10)
    positions = np.array([cyclist.state(time_s)[:2] for cyclist in ridden.cyclists])
    pixels, seen = ridden.lens.project(ridden.pose.to_camera(np.pad(positions, ((0, 0), (0, 1)), constant_values=0.9)))
    rows, columns = np.nonzero(changed)
    distance = np.hypot(columns[:, None] - pixels[seen, 0], rows[:, None] - pixels[seen, 1]).min(axis=1)
    assert distance.max() < 25.0  # a rider is 15 px tall at 15 m


@pytest.mark.parametrize('scene', ['highway', 'roundabout'])
def test_some_scenes_have_no_cyclists(scene):
    assert not Simulation(SimulationOptions(scene=scene, cyclists=8)).cyclists
