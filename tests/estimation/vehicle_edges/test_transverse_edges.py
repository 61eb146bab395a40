"""Transverse direction of a road from edges of boxes that drive on it, with clutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autocalib_ros.config import GateOptions, Options
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.estimate import find_solution
from autocalib_ros.estimation.observations.track_set import select_tracks
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.estimation.vehicle_edges.transverse_edges import (
    TransverseDirection,
    VehicleEdges,
    transverse_direction_at,
)
from autocalib_ros.estimation.verification.gates import check_plane
from autocalib_ros.estimation.verification.ground_normal import LevelCamera, combine_assumptions
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.robust_kernels import wrap_undirected
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from solved_once import ONE_FAMILY, solve_once

pytestmark = pytest.mark.solve

CAMERA = Camera(1280, 720, 560.0, (639.5, 359.5))
HEIGHT_M = 8.0
ONE_ROAD = Junction(
    road_angles_deg=(0.0,),
    turning_fraction=0.0,
    vehicles=120,
    camera_from_ground=pose(35.0, 1.0, 60.0),
    centre_m=(6.0, -10.0),
)
BOX_M = np.array([[length, width, up] for length in (-2.2, 2.2) for width in (-0.9, 0.9) for up in (0.0, 1.5)])
"""Corners of a vehicle relative to its middle on the road, x ahead."""
SIDES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count('1') == 1]


def box_edges(
    camera: Camera,
    camera_from_ground: np.ndarray,
    middle_m: np.ndarray,
    generator: np.random.Generator,
    *,
    yaw_deg: float = 0.0,
    clutter: float = 0.5,
    noise_px: float = 0.4,
) -> np.ndarray:
    """Visible edges (n, 4) of a box on the road, with a fraction of clutter around it."""
    cosine, sine = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    turned = BOX_M @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    corners = np.append(middle_m, -HEIGHT_M) + turned
    pixels, valid = camera.project(corners @ camera_from_ground.T)
    if not (valid.all() and (pixels >= 0).all() and (pixels < [camera.width, camera.height]).all()):
        return np.zeros((0, 4))
    farthest = np.argmax(np.linalg.norm(corners, axis=1))
    ends = np.array([[*pixels[a], *pixels[b]] for a, b in SIDES if farthest not in (a, b)])
    count = generator.binomial(len(ends), clutter)
    starts = pixels[generator.integers(8, size=count)]
    angle = generator.uniform(0, np.pi, count)
    length = generator.uniform(15, 60, count)[:, None]
    ends = np.vstack([ends, np.hstack([starts, starts + length * np.column_stack([np.cos(angle), np.sin(angle)])])])
    ends = ends + generator.normal(scale=noise_px, size=ends.shape)
    return ends[np.hypot(*(ends[:, 2:] - ends[:, :2]).T) > 12]


def traffic(
    camera_from_ground: np.ndarray,
    generator: np.random.Generator,
    vehicles: int = 40,
    *,
    yaw_deg: float = 0.0,
    clutter: float = 0.5,
) -> VehicleEdges:
    """Edges of boxes on three lanes along ground x, each seen several times."""
    ends, owners = [], []
    heading = np.linalg.inv(camera_from_ground) @ [0.0, 0.0, 1.0]
    for vehicle in range(vehicles):
        lane, askew = generator.choice([-3.5, 0.0, 3.5]), yaw_deg + generator.normal(scale=1.0)
        for ahead in generator.uniform(-25, 25, 5):
            middle = 14.0 * heading[:2] / np.linalg.norm(heading[:2]) + [ahead, lane]
            found = box_edges(CAMERA, camera_from_ground, middle, generator, yaw_deg=askew, clutter=clutter)
            ends.append(found)
            owners.append(np.full(len(found), vehicle))
    return VehicleEdges(np.concatenate(ends), np.concatenate(owners))


def state_of(camera_from_ground: np.ndarray, camera: Camera = CAMERA) -> AdjustmentState:
    """State with one road along ground x and an arbitrary rotation of the plane about it."""
    along = camera_from_ground[:, 0]
    helper = np.cross(along, [0.3, 0.5, 0.8])
    helper /= np.linalg.norm(helper)
    return AdjustmentState(camera, np.column_stack([along, np.cross(helper, along), helper]), np.zeros(1))


def error_deg(found: TransverseDirection, camera_from_ground: np.ndarray) -> float:
    across = found.across(state_of(camera_from_ground))
    return float(
        np.degrees(wrap_undirected(np.arctan2(across @ camera_from_ground[:, 2], across @ camera_from_ground[:, 1])))
    )


@pytest.mark.parametrize(
    ('tilt', 'roll', 'heading'), [(30.0, 0.0, 10.0), (20.0, 4.0, 40.0), (35.0, -6.0, 75.0), (25.0, 10.0, -30.0)]
)
def test_boxes_give_the_direction_across_their_road(tilt: float, roll: float, heading: float) -> None:
    camera_from_ground = pose(tilt, roll, heading)
    generator = np.random.default_rng(1)
    found = transverse_direction_at(traffic(camera_from_ground, generator), state_of(camera_from_ground), generator)
    assert found is not None
    sigma = np.degrees(found.step_sigma_rad)
    assert sigma < 1.5  # degrees: the common error of all vehicles, and little for their number
    assert abs(error_deg(found, camera_from_ground)) < 2.0 * sigma


@pytest.mark.parametrize('seed', range(4))
def test_clutter_alone_gives_no_direction(seed: int) -> None:
    generator = np.random.default_rng(seed)
    camera_from_ground = pose(30.0, 0.0, 30.0)
    boxes = traffic(camera_from_ground, generator)
    angle, middle = generator.uniform(0, np.pi, len(boxes)), boxes.ends_px[:, :2]
    half = 15.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    clutter = VehicleEdges(np.hstack([middle - half, middle + half]), boxes.vehicles)
    assert transverse_direction_at(clutter, state_of(camera_from_ground), generator) is None


def test_few_vehicles_give_no_direction() -> None:
    generator = np.random.default_rng(0)
    camera_from_ground = pose(30.0, 0.0, 20.0)
    edges = traffic(camera_from_ground, generator, vehicles=6)
    assert transverse_direction_at(edges, state_of(camera_from_ground), generator) is None


def test_no_edges_give_no_direction() -> None:
    edges = VehicleEdges(np.zeros((0, 4)), np.zeros(0, int))
    assert transverse_direction_at(edges, state_of(pose(30.0, 0.0, 20.0)), np.random.default_rng(0)) is None


def test_one_vehicle_seen_very_often_does_not_outweigh_the_others() -> None:
    camera_from_ground, generator = pose(30.0, 2.0, 25.0), np.random.default_rng(3)
    many = traffic(camera_from_ground, generator)
    # a vehicle in a jam with a load that leans by 8 degrees about the road
    leaning = camera_from_ground @ np.array([[1, 0, 0], [0, 0.990, -0.139], [0, 0.139, 0.990]])
    jam = np.concatenate(
        [box_edges(CAMERA, leaning, np.array([14.0, 0.0]), generator, clutter=0.0) for _ in range(300)]
    )
    edges = VehicleEdges(np.vstack([many.ends_px, jam]), np.append(many.vehicles, np.full(len(jam), 999)))
    found = transverse_direction_at(edges, state_of(camera_from_ground), generator)
    assert found is not None
    assert abs(error_deg(found, camera_from_ground)) < 1.5


def test_the_standard_deviation_covers_the_error() -> None:
    misses = []
    for seed in range(12):
        generator = np.random.default_rng(seed)
        camera_from_ground = pose(generator.uniform(15, 40), generator.normal(scale=4), generator.uniform(-70, 70))
        found = transverse_direction_at(
            traffic(camera_from_ground, generator, 30), state_of(camera_from_ground), generator
        )
        assert found is not None
        misses.append(error_deg(found, camera_from_ground) / np.degrees(found.step_sigma_rad))
    assert np.sqrt(np.mean(np.square(misses))) < 1.2
    assert np.abs(misses).max() < 3.0


def test_the_same_edges_and_seed_give_the_same_bits() -> None:
    camera_from_ground = pose(30.0, 2.0, 25.0)
    edges = traffic(camera_from_ground, np.random.default_rng(5))
    first, second = (
        transverse_direction_at(edges, state_of(camera_from_ground), np.random.default_rng(0)) for _ in range(2)
    )
    assert first is not None and second is not None
    assert first.origin.tobytes() == second.origin.tobytes() and first.step_sigma_rad == second.step_sigma_rad


@pytest.mark.parametrize('axis', np.eye(3))
def test_the_direction_moves_with_the_road_as_the_edges_do(axis: np.ndarray) -> None:
    camera_from_ground = pose(30.0, 5.0, 40.0)
    edges = traffic(camera_from_ground, np.random.default_rng(2))
    state = state_of(camera_from_ground)
    turned = replace(state, rotation=Rotation.from_rotvec(np.radians(2.0) * axis).as_matrix() @ state.rotation)
    found, anew = (transverse_direction_at(edges, at, np.random.default_rng(0)) for at in (state, turned))
    assert found is not None and anew is not None
    moved = found.across(turned)
    assert abs(moved @ turned.directions[0]) < 1e-9
    # to first order, with the weights kept
    assert np.degrees(np.arccos(min(abs(moved @ anew.across(turned)), 1.0))) < 0.35


def test_a_level_camera_and_edges_are_combined_by_their_variances() -> None:
    camera_from_ground = pose(30.0, 2.0, 5.0)
    edges = traffic(camera_from_ground, np.random.default_rng(5))
    state = state_of(camera_from_ground)
    square = transverse_direction_at(edges, state, np.random.default_rng(0))
    assert square is not None
    joined, apart_deg, limit_deg = combine_assumptions(LevelCamera(1.0), square, state)
    assert joined is not None and apart_deg < limit_deg
    # for a road straight ahead, roll and rotation about the road are nearly the same
    assert apart_deg == pytest.approx(2.0, abs=1.0)
    assert joined.step_sigma_rad < square.step_sigma_rad
    before, after = error_deg(square, camera_from_ground), error_deg(joined, camera_from_ground)
    assert 0.1 < abs(after - before) < apart_deg


def test_edges_that_contradict_a_level_camera_are_noticed() -> None:
    camera_from_ground = pose(30.0, 8.0, 5.0)
    state = state_of(camera_from_ground)
    square = transverse_direction_at(
        traffic(camera_from_ground, np.random.default_rng(5)), state, np.random.default_rng(0)
    )
    assert square is not None
    joined, apart_deg, limit_deg = combine_assumptions(LevelCamera(1.0), square, state)
    assert joined is None and apart_deg > limit_deg > 2.0


def with_boxes(junction: Junction, clutter: float = 0.5) -> Evidence:
    """Evidence of a junction with edges of boxes at its vehicles, at the times of their tracks."""
    evidence, generator = synthetic_evidence(junction, np.random.default_rng(0)), np.random.default_rng(1)
    ends, owners, times = [], [], []
    for track in evidence.tracks():
        sample = len(track.times_s) // 2
        bearing, _ = junction.camera.unproject(track.points_px[sample])
        ground = bearing @ junction.camera_from_ground
        found = box_edges(
            junction.camera, junction.camera_from_ground, HEIGHT_M * ground[:2] / -ground[2], generator, clutter=clutter
        )
        ends.append(found)
        owners.append(np.full(len(found), track.vehicle))
        times.append(np.full(len(found), track.times_s[sample]))
    return replace(
        evidence,
        edges_px=np.concatenate(ends),
        edge_vehicles=np.concatenate(owners),
        edge_times_s=np.concatenate(times),
    )


EDGES_ALONE = replace(ONE_FAMILY, single_road=False)
ROLLED = replace(ONE_ROAD, camera_from_ground=pose(35.0, 5.0, 60.0))


def test_one_road_and_edges_give_an_assumed_plane_of_a_rolled_camera() -> None:
    result = solve_once(with_boxes(ROLLED), Options(camera_height=HEIGHT_M, joint=EDGES_ALONE))
    assert isinstance(result, Calibration) and result.ground is not None
    assert result.grade in ('fair', 'coarse')
    assert 'transverse_edges' in [statement.kind for statement in result.assumptions]
    error = np.degrees(np.arccos(np.clip(result.ground.normal_in_camera @ ROLLED.normal_in_camera, -1, 1)))
    assert result.stddev.roll_deg is not None and result.stddev.tilt_deg is not None
    assert error < 1.5 and error < 2.5 * np.hypot(result.stddev.roll_deg, result.stddev.tilt_deg)


@pytest.mark.solve
def test_edges_are_not_used_if_switched_off() -> None:
    joint = replace(EDGES_ALONE, transverse_edges=False)
    options = Options(camera_height=HEIGHT_M, joint=joint)
    result = solve_once(with_boxes(ROLLED), options)
    assert isinstance(result, Calibration) and result.ground_refusal is not None
    assert result.ground_refusal.code == 'one_direction'


@pytest.mark.solve
def test_edges_that_contradict_a_level_camera_are_refused_with_a_reason() -> None:
    junction = replace(ONE_ROAD, camera_from_ground=pose(35.0, 9.0, 60.0))
    result = solve_once(
        with_boxes(junction), Options(camera_height=HEIGHT_M, joint=replace(EDGES_ALONE, roll_prior_deg=1.0))
    )
    assert isinstance(result, Calibration) and result.ground is None and result.ground_refusal is not None
    assert result.ground_refusal.code == 'plane_uncertain'
    assert 'edges of vehicles and a level camera disagree' in result.ground_refusal.message


@pytest.fixture(scope='module')
def assumed() -> Solution:
    evidence, options = with_boxes(ROLLED), Options(camera_height=HEIGHT_M, joint=EDGES_ALONE)
    solution = find_solution(
        evidence,
        select_tracks(evidence, options.joint.max_tracks),
        options,
        height_m=HEIGHT_M,
    )
    assert isinstance(solution, Solution) and isinstance(solution.plane.assumed, TransverseDirection)
    return solution


@pytest.mark.solve
def test_a_plane_through_the_traffic_is_refused(assumed: Solution) -> None:
    assert assumed.plane.fraction_below_horizon > 0.99 and check_plane(assumed.plane, GateOptions()) is None
    doubt = check_plane(replace(assumed.plane, fraction_below_horizon=0.8), GateOptions())
    assert doubt is not None and doubt.code == 'horizon'


@pytest.mark.solve
def test_the_plane_is_no_more_certain_about_its_road_than_the_edges(assumed: Solution) -> None:
    plane, along = assumed.plane, assumed.fit.state.directions[0]
    across = np.cross(along, plane.normal(plane.fit.state))
    sigma = float(plane.sigma(lambda _, normal: np.atleast_1d(normal @ across))[0])
    told = float(assumed.fit.sigma(lambda state: np.atleast_1d(plane.normal(state) @ across))[0])
    assert plane.assumed is not None
    assert sigma == pytest.approx(np.hypot(plane.assumed.step_sigma_rad, told), rel=1e-3)
    # and the lens adds its own uncertainty, through the great circles of the edges
    assert told > 1e-4
