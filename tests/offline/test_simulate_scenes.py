"""Every scene of the simulator: continuous roads, rolling vehicles, frames and ground truth."""

from __future__ import annotations

import itertools
import json
import math
from functools import lru_cache

import numpy as np
import pytest

from autocalib_ros.errors import UsageError
from autocalib_ros.offline.simulate.ground_surface import edge_distance, paint_ground
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.options import SCENES, SimulationOptions
from autocalib_ros.offline.simulate.palette import DAY
from autocalib_ros.offline.simulate.roundabout import RING_RADIUS_M
from autocalib_ros.offline.simulate.scenes import BEND_RADIUS_M, build_network
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.traffic_flow import simulate_traffic
from autocalib_ros.offline.simulate.truth import truth_of
from autocalib_ros.offline.simulate.vehicle_models import STEP_S, SimulatedTraffic, Vehicle, VehicleState

pytestmark = pytest.mark.render

TINY = {'width_px': 192, 'height_px': 108, 'focal_px': 84.0, 'rate_hz': 2.0, 'duration_s': 2.0}
TIMES_S = np.arange(0.03, 60.0, 4.7)
each_scene = pytest.mark.parametrize('scene', SCENES)


@lru_cache
def driven(scene: str) -> tuple[Network, SimulatedTraffic]:
    options = SimulationOptions(scene=scene)
    network = build_network(options)
    return network, simulate_traffic(network, options)


def states(traffic: SimulatedTraffic, times_s: np.ndarray = TIMES_S) -> list[tuple[Vehicle, float]]:
    return [(v, t) for t in times_s for v in traffic.vehicles if v.state(t) is not None and v.state(t + STEP_S)]


def rear_axle(vehicle: Vehicle, time_s: float) -> np.ndarray:
    state = vehicle.state(time_s)
    back = vehicle.shape.wheelbase_m / 2
    return np.array([state.x - back * math.cos(state.heading), state.y - back * math.sin(state.heading)])


def outline(state: VehicleState, vehicle: Vehicle) -> np.ndarray:
    """Points (n, 2) along the sides of a vehicle."""
    fractions = np.linspace(-0.5, 0.5, 7)
    body = np.concatenate([np.stack([fractions, 0 * fractions + side], 1) for side in (-0.5, 0.5)])
    body = body * (vehicle.shape.length_m, vehicle.shape.width_m)
    c, s = math.cos(state.heading), math.sin(state.heading)
    return body @ np.array([[c, s], [-s, c]]) + (state.x, state.y)


def overlap(a: tuple[Vehicle, VehicleState], b: tuple[Vehicle, VehicleState]) -> bool:
    (first, at), (second, there) = a, b
    if math.hypot(at.x - there.x, at.y - there.y) > 12.0:
        return False
    offset = outline(there, second) - (at.x, at.y)
    c, s = math.cos(at.heading), math.sin(at.heading)
    inside = np.abs(offset @ np.array([[c, -s], [s, c]]))
    half = np.array([first.shape.length_m, first.shape.width_m]) / 2
    return bool((inside < half).all(1).any())


def angle_between(a: float, b: float) -> float:
    return abs(math.remainder(a - b, 2 * math.pi))


@each_scene
def test_paths_are_continuous_in_pose_and_curvature(scene: str) -> None:
    for route in driven(scene)[0].routes:
        segments = route.path.segments
        assert min(segment.length for segment in segments) > 0
        for before, after in itertools.pairwise(segments):
            assert before.end() == pytest.approx((after.x, after.y, after.heading), abs=1e-9)
            curvature = before.curvature + before.sharpness * before.length
            assert curvature == pytest.approx(after.curvature, abs=1e-9)


@each_scene
def test_the_heading_of_a_path_is_its_tangent(scene: str) -> None:
    for route in driven(scene)[0].routes:
        x, y, heading = route.path.at(np.arange(0.0, route.path.length, 0.1)).T
        steps = np.hypot(np.diff(x), np.diff(y))
        assert np.abs(steps - 0.1).max() < 1e-5
        middle = (heading[1:] + heading[:-1]) / 2
        slip = np.angle(np.exp(1j * (np.arctan2(np.diff(y), np.diff(x)) - middle)))
        assert np.abs(slip).max() < 1e-3


@each_scene
def test_rear_axles_do_not_slip_sideways(scene: str) -> None:
    for vehicle, t in states(driven(scene)[1]):
        first, last = vehicle.state(t), vehicle.state(t + 0.02)
        if first.speed_mps > 1.0:
            dx, dy = rear_axle(vehicle, t + 0.02) - rear_axle(vehicle, t)
            turned = math.remainder(last.heading - first.heading, 2 * math.pi)
            assert angle_between(math.atan2(dy, dx), first.heading + turned / 2) < 1e-3


@each_scene
def test_vehicles_move_at_their_speed_with_bounded_lateral_acceleration(scene: str) -> None:
    for vehicle, t in states(driven(scene)[1]):
        first, last = vehicle.state(t), vehicle.state(t + 0.02)
        moved = np.hypot(*(rear_axle(vehicle, t + 0.02) - rear_axle(vehicle, t))) / 0.02
        assert moved == pytest.approx(first.speed_mps, rel=0.03, abs=0.15)
        # Lateral acceleration in m/s^2: drivers accept three, tyres nine.
        assert angle_between(last.heading, first.heading) / 0.02 * first.speed_mps < 3.5


@each_scene
def test_wheels_stay_on_the_asphalt(scene: str) -> None:
    network, traffic = driven(scene)
    for vehicle, t in states(traffic):
        state, shape = vehicle.state(t), vehicle.shape
        across = (shape.width_m / 2 - 0.1) * np.array([-math.sin(state.heading), math.cos(state.heading)])
        along = shape.wheelbase_m / 2 * np.array([math.cos(state.heading), math.sin(state.heading)])
        wheels = np.array([state.x, state.y]) + [s * along + side * across for s in (-1, 1) for side in (-1, 1)]
        assert edge_distance(network, wheels).max() < 0.1  # a kerb is 0.25 m wide


@pytest.mark.parametrize(('scene', 'seed'), [*((scene, 0) for scene in SCENES), ('junction', 1), ('roundabout', 1)])
def test_vehicles_of_no_scene_overlap(scene: str, seed: int) -> None:
    """Where vehicles meet and wait for each other, in a second draw too."""
    options = SimulationOptions(scene=scene, seed=seed)
    traffic = driven(scene)[1] if seed == 0 else simulate_traffic(build_network(options), options)
    for t in TIMES_S:
        there = [(v, s) for v in traffic.vehicles if (s := v.state(t)) is not None]
        assert not [
            (a[0].number, b[0].number) for i, a in enumerate(there) for b in there[:i] if overlap(a, b) or overlap(b, a)
        ]


@each_scene
def test_every_scene_renders_and_has_ground_truth(scene: str) -> None:
    simulation = Simulation(SimulationOptions(**TINY, scene=scene))
    truth = json.loads(json.dumps(truth_of(simulation)))
    assert truth['scene'] == scene
    assert truth['road_directions']
    assert len(truth['ground_points']['rows']) == 48
    assert scene == 'sparse' or truth['vehicles']['tracks']
    frames = [simulation.frame(index).astype(int) for index in (0, 3)]
    assert frames[0].std() > 20
    assert scene == 'sparse' or (np.abs(frames[1] - frames[0]).max(-1) > 40).mean() > 0.001


@each_scene
def test_every_scene_has_asphalt_and_white_paint_under_its_lanes(scene: str) -> None:
    network = driven(scene)[0]
    ground = paint_ground(network, DAY, 45.0, 0.1, 0)
    grey = ground.levels[0].mean(-1)
    inside = np.concatenate([r.path.at(np.arange(0.0, r.path.length, 1.0))[:, :2] for r in network.routes])
    inside = inside[(np.abs(inside) < 44.0).all(1)]
    columns, rows = ((inside * (1, -1) + ground.half_m) / ground.texel_m).astype(int).T
    assert abs(np.median(grey[rows, columns]) - np.mean(DAY.asphalt)) < 10
    assert (grey > 0.75 * np.mean(DAY.marking)).mean() > 0.002


@pytest.mark.parametrize(
    ('scene', 'headings_deg'),
    [
        ('highway', {0}),
        ('skew', {0, 65}),
        ('tee', {0, 90}),
        ('sparse', {0, 90}),
        ('roundabout', {0, 90}),
        ('bend', {-40, 40}),
    ],
)
def test_truth_names_the_directions_of_straight_roads(scene: str, headings_deg: set[int]) -> None:
    directions = driven(scene)[0].directions()
    assert {round(math.degrees(math.atan2(y, x))) for x, y in directions} == headings_deg


def test_a_bend_has_constant_lane_offsets_and_its_radius() -> None:
    network, _ = driven('bend')
    road = network.roads[0]
    for route in network.routes:
        way = np.linspace(20.0, route.path.length - 20.0, 60)
        lateral = road.edge_distance(route.path.at(way)[:, :2]) + road.half_width_m
        assert np.ptp(lateral) < 0.05  # metres
        assert min(radius for *_, radius in route.path.curves) == pytest.approx(BEND_RADIUS_M, abs=9.0)


def test_a_ring_is_driven_anticlockwise_on_its_radius() -> None:
    for route in driven('roundabout')[0].routes:
        ring = route.ring
        x, y, heading = route.path.at(np.linspace(ring.entry_s, ring.exit_s, 20)).T
        assert np.hypot(x, y) == pytest.approx(RING_RADIUS_M, abs=1e-6)
        assert (x * np.sin(heading) - y * np.cos(heading) > 0).all()
        start, end = route.path.at(np.array([0.0, route.path.length]))
        assert np.hypot(start[0], start[1]) > 100
        assert np.hypot(end[0], end[1]) > 100
        expected = {'right': -90, 'straight': 0, 'left': 90}[route.movement]
        assert math.degrees(math.remainder(end[2] - start[2], 2 * math.pi)) == pytest.approx(expected, abs=1e-6)


def test_vehicles_slow_down_and_yield_at_a_roundabout() -> None:
    _, traffic = driven('roundabout')
    on_ring = [
        float(v.speeds_mps[(v.s > v.route.ring.entry_s) & (v.s < v.route.ring.exit_s)].max(initial=0.0))
        for v in traffic.vehicles
    ]
    assert 4.0 < max(on_ring) < 7.0  # metres per second; 2 m/s^2 of lateral acceleration at 19 m are 6.2 m/s
    assert any((v.speeds_mps[(v.s > 70) & (v.s < v.route.stop_s)] < 0.5).any() for v in traffic.vehicles)


def test_a_fraction_of_the_motorway_traffic_changes_lanes_at_motorway_speed() -> None:
    _, traffic = driven('highway')
    changing = [v for v in traffic.vehicles if v.route.movement == 'lane change']
    assert 0.08 < len(changing) / len(traffic.vehicles) < 0.35  # 0.18 requested
    for vehicle in changing:
        start, end = vehicle.route.path.at(np.array([0.0, vehicle.route.path.length]))
        assert abs(end[1] - start[1]) == pytest.approx(3.6, abs=1e-3)
        assert angle_between(start[2], end[2]) < 1e-9
    assert 20.0 < np.median(np.concatenate([v.speeds_mps for v in traffic.vehicles])) < 33.0
    assert max(float(v.speeds_mps.max()) for v in traffic.vehicles if v.kind == 'truck') < 25.0


def test_a_one_way_motorway_has_one_heading() -> None:
    network = build_network(SimulationOptions(scene='highway', one_way=True))
    ends = [route.path.at(np.array([0.0, route.path.length]))[:, 2] for route in network.routes]
    assert np.abs(ends).max() < 1e-9
    assert len({route.entry_lane for route in network.routes}) == 3


def test_no_vehicle_drives_on_the_missing_arm_of_a_tee() -> None:
    network, traffic = driven('tee')
    positions = np.array([(v.state(t).x, v.state(t).y) for v, t in states(traffic)])
    assert positions[:, 1].min() > -9.0
    assert positions[:, 1].max() > 40.0
    assert {r.movement for r in network.routes} == {'straight', 'left', 'right'}
    assert edge_distance(network, np.array([[0.0, 60.0], [0.0, -60.0]])).tolist() == pytest.approx([-8.0, 52.0])


def test_a_sparse_junction_has_a_vehicle_every_ten_seconds_or_rarer() -> None:
    counts = []
    for seed in range(3):
        options = SimulationOptions(scene='sparse', seed=seed, duration_s=200.0)
        traffic = simulate_traffic(build_network(options), options)
        counts.append(sum(v.start_s > 0 for v in traffic.vehicles))
    assert 10 < np.mean(counts) < 20  # of at most twenty in 200 s


def test_a_skew_crossing_takes_the_road_angle_option() -> None:
    assert SimulationOptions(scene='skew').road_crossing_deg == 65.0
    assert SimulationOptions().road_crossing_deg == 90.0
    assert SimulationOptions(scene='skew', road_angle_deg=70.0).road_crossing_deg == 70.0


@pytest.mark.parametrize('scene', ['roundabout', 'tee', 'skew', 'sparse'])
def test_a_scene_that_needs_several_roads_is_not_one_way(scene: str) -> None:
    with pytest.raises(UsageError, match='has no one_way: choose junction'):
        SimulationOptions(scene=scene, one_way=True)
