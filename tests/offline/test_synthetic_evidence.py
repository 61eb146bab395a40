"""Synthetic evidence: counts, geometry and disturbances as specified."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import lru_cache

import numpy as np
import pytest

from autocalib_ros.errors import UsageError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.families import (
    PRINCIPAL_POINT_SIGMA,
    WIDTH,
    draw_distortion_free_lens,
    radial,
    short_piece,
    standard_junction,
)
from autocalib_ros.offline.benchmark.monte_carlo import Task, draw_evidence, families, given_lens
from autocalib_ros.offline.simulate.junctions import junction as crossing
from autocalib_ros.offline.simulate.motorway import highway
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.roundabout import RING_RADIUS_M, roundabout
from autocalib_ros.offline.simulate.scenes import bend
from autocalib_ros.offline.synthetic.disturbances import (
    background_drift_px,
    corrupt_track,
    random_sway,
    reflect_into_image,
)
from autocalib_ros.offline.synthetic.drives import (
    INTERVAL_S,
    ROUTE_REACH_M,
    Trajectory,
    drive_across,
    drive_bend,
    drive_ring,
    drive_route,
    shadow,
    trailer,
    walk_along_road,
)
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence

pytestmark = pytest.mark.render

FAMILIES = tuple(families())
TRACKS = {'standard': 60, 'few': 40, 'many': 400}
CLEAN = Junction(turning_fraction=0.0, wander_m=0.0, noise_px=0.0)
NETWORKS = {
    'highway': highway(one_way=True, changing_fraction=1.0),
    'bend': bend(one_way=False),
    'roundabout': roundabout(turning_fraction=0.5),
    'skew': crossing(np.radians(65.0), turning_fraction=1.0),
    'tee': crossing(np.pi / 2, turning_fraction=0.5, tee=True),
}
each_network = pytest.mark.parametrize('network', NETWORKS.values(), ids=NETWORKS)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@lru_cache
def drawn(name: str) -> tuple[Junction, Evidence]:
    return families()[name](rng())


def circles(junction: Junction, evidence: Evidence) -> tuple[np.ndarray, np.ndarray]:
    """Return great-circle normals (tracks, 3) of the tracks in the true lens, and their largest residuals in pixels."""
    normals, worst = [], []
    for track in evidence.tracks():
        bearings, _ = junction.camera.unproject(track.points_px)
        normals.append(np.linalg.svd(bearings)[2][2])
        worst.append(junction.camera.focal_px * np.abs(bearings @ normals[-1]).max())
    return np.array(normals), np.array(worst)


@pytest.mark.parametrize('name', FAMILIES)
def test_every_family_records_as_many_tracks_as_asked_for(name: str) -> None:
    junction, evidence = drawn(name)
    if name == 'noise':
        assert 60 <= evidence.track_count < 240
    elif junction.tracks is None:
        assert 0.5 * junction.points_per_vehicle * junction.vehicles < evidence.track_count
    else:
        assert evidence.track_count == TRACKS.get(name, junction.tracks)


@pytest.mark.parametrize('name', FAMILIES)
def test_every_point_lies_in_the_image(name: str) -> None:
    junction, evidence = drawn(name)
    margin = 5 * junction.noise_px  # a point at the border is tracked with noise like any other
    assert (evidence.points_px > -margin).all()
    assert (evidence.points_px < np.array(evidence.image_size) + margin).all()


@pytest.mark.parametrize('name', FAMILIES)
def test_a_seed_gives_the_same_evidence_again(name: str) -> None:
    _, first = drawn(name)
    _, again = families()[name](rng())
    for item in fields(Evidence):
        np.testing.assert_array_equal(getattr(first, item.name), getattr(again, item.name))


@pytest.mark.parametrize('name', ['standard', 'noise'])
def test_another_seed_gives_other_evidence(name: str) -> None:
    assert not np.array_equal(drawn(name)[1].points_px[:20], families()[name](rng(1))[1].points_px[:20])


@pytest.mark.parametrize(('name', 'least_vehicles'), [('standard', 60), ('many', 100)])
def test_tracks_are_shared_among_vehicles(name: str, least_vehicles: int) -> None:
    junction, evidence = drawn(name)
    _, counts = np.unique(evidence.track_vehicles, return_counts=True)
    assert len(counts) >= least_vehicles and counts.max() <= junction.points_per_vehicle


@pytest.mark.parametrize(
    'camera',
    [
        Camera.equidistant(1280, 720, 560.0),
        Camera(1280, 720, 610.0, (655.0, 345.0), (-0.05, 0.0, 0.0, 0.0)),
        draw_distortion_free_lens(rng()),
    ],
    ids=['equidistant', 'kannala_brandt', 'distortion_free'],
)
def test_parallel_noise_free_tracks_meet_in_the_true_direction(camera: Camera) -> None:
    junction = replace(CLEAN, camera=camera, camera_from_ground=pose(30.0, -1.5, 40.0), road_angles_deg=(20.0,))
    normals, worst = circles(junction, synthetic_evidence(junction, rng()))
    truth = junction.camera_from_ground @ [np.cos(np.radians(20.0)), np.sin(np.radians(20.0)), 0.0]
    meeting = np.linalg.svd(normals)[2][2]
    assert worst.max() < 1e-3  # pixels
    assert abs(meeting @ truth) == pytest.approx(1.0, abs=1e-9)


def test_the_truth_has_the_normal_of_its_roads() -> None:
    junction, _ = drawn('standard')
    roads = junction.camera_from_ground @ [[1, 0], [0, 1], [0, 0]]
    np.testing.assert_allclose(np.cross(*roads.T), junction.normal_in_camera, atol=1e-12)
    assert junction.normal_in_camera[1] < 0  # up is against the camera's y


def test_a_distortion_free_lens_keeps_straight_lines() -> None:
    camera = draw_distortion_free_lens(rng())
    pixels = np.stack(np.meshgrid(np.linspace(0, 1279, 20), np.linspace(0, 719, 12)), axis=-1).reshape(-1, 2)
    assert np.abs(camera.undistort(pixels) - pixels).max() < 1.0  # the series of the tangent ends


def test_the_asked_for_share_of_tracks_is_spoilt() -> None:
    junction = replace(CLEAN, tracks=300, points_per_vehicle=1, outlier_fraction=0.2)
    _, worst = circles(junction, synthetic_evidence(junction, rng()))
    assert 0.13 < (worst > 1.0).mean() < 0.27  # three sigmas of 300 throws


def test_gross_outliers_are_jumps_and_curves_inside_the_image() -> None:
    line = np.column_stack([np.linspace(300, 900, 20), np.full(20, 300.0)])
    spoilt = [corrupt_track(line, (1280, 720), rng(seed)) for seed in range(40)]
    kept = np.array([(points[:2] == line[:2]).all() for points in spoilt])
    assert 8 < kept.sum() < 32  # a jump leaves the beginning as it was
    assert all((points >= 0).all() and (points <= (1279, 719)).all() for points in spoilt)
    assert all(np.abs(points - line).max() > 20 for points in spoilt)


def test_folding_mirrors_at_the_border_and_leaves_the_inside_alone() -> None:
    points = np.array([[5.0, 5.0], [-3.0, 4.0], [12.0, 21.0]])
    np.testing.assert_allclose(reflect_into_image(points, (11, 11)), [[5.0, 5.0], [3.0, 4.0], [8.0, 1.0]])


@pytest.mark.parametrize('seed', range(5))
def test_a_lane_change_goes_one_lane_sideways_over_thirty_to_fifty_metres(seed: int) -> None:
    junction = replace(CLEAN, road_angles_deg=(0.0,), lane_change_fraction=1.0)
    path, heading = drive_across(junction, rng(seed))
    moving = np.abs(np.gradient(path[:, 1])) > 1e-6
    assert np.ptp(path[:, 1]) == pytest.approx(3.5, abs=1e-6)
    assert 26.0 < np.ptp(path[moving, 0]) < 53.0  # metres; a step is about one
    along = np.diff(path, axis=0)
    mean_heading = (heading[1:] + heading[:-1]) / 2
    assert (along[:, 0] * np.cos(mean_heading) + along[:, 1] * np.sin(mean_heading) > 0).all()
    slip = along[:, 1] * np.cos(mean_heading) - along[:, 0] * np.sin(mean_heading)
    assert np.abs(slip).max() < 0.02  # metres a step: the body points where it goes


@pytest.mark.parametrize(
    'drive',
    [
        lambda junction, generator: drive_bend(junction, generator, radius_m=30.0, towards_rad=0.7),
        lambda junction, generator: drive_ring(junction, generator, radius_m=20.0),
    ],
    ids=['bend', 'ring'],
)
def test_curved_traffic_keeps_its_radius_and_points_along_it(drive) -> None:
    path, heading = drive(CLEAN, rng())
    middle = _centre_of_circle(path)
    radius = np.hypot(*(path - middle).T)
    assert 15.0 < radius[0] < 33.0 and np.ptp(radius) < 1e-6
    steps = np.diff(path, axis=0)
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    assert ((steps * forward[1:]).sum(axis=1) > 0.99 * np.hypot(*steps.T)).all()


def _centre_of_circle(path: np.ndarray) -> np.ndarray:
    solution, *_ = np.linalg.lstsq(np.column_stack([2 * path, np.ones(len(path))]), (path**2).sum(axis=1), rcond=None)
    return solution[:2]


def routes(network: Network, count: int = 12, wander_m: float = 0.0) -> list[Trajectory]:
    junction = replace(CLEAN, centre_m=(0.0, 0.0), wander_m=wander_m)
    return [drive_route(junction, rng(seed), network=network) for seed in range(count)]


@each_network
def test_routes_are_driven_without_slip_and_without_jumps(network: Network) -> None:
    for path, heading in routes(network, wander_m=0.1):
        steps = np.diff(path, axis=0)
        lengths = np.hypot(*steps.T)
        slip = np.angle(np.exp(1j * (np.arctan2(steps[:, 1], steps[:, 0]) - (heading[1:] + heading[:-1]) / 2)))
        assert np.abs(slip).max() < 0.02  # radians; the body points where its rear axle goes
        assert lengths.max() / INTERVAL_S < 40.0 and lengths.min() / INTERVAL_S > 2.0  # metres per second
        assert np.abs(np.diff(lengths)).max() / INTERVAL_S**2 < 3.0  # metres per second squared
        assert np.abs(np.diff(heading)).max() < 0.15
        assert np.hypot(*path.T).max() < ROUTE_REACH_M


@each_network
def test_drivers_slow_down_for_tight_turns(network: Network) -> None:
    for path, heading in routes(network):
        speed = np.hypot(*np.diff(path, axis=0).T) / INTERVAL_S
        assert (speed * np.abs(np.diff(heading)) / INTERVAL_S).max() < 2.5  # m/s^2, of the 2 that they bear


def test_a_roundabout_is_entered_circled_and_left() -> None:
    for path, heading in routes(NETWORKS['roundabout']):
        radius = np.hypot(*path.T)
        assert min(radius[0], radius[-1]) > 60.0 and radius.min() == pytest.approx(RING_RADIUS_M, abs=0.05)
        turned = np.diff(heading)
        assert turned.min() < -0.01 and turned.max() > 0.01  # right on to the ring, left along it


def test_a_network_can_be_turned_scaled_and_placed() -> None:
    junction = replace(CLEAN, centre_m=(30.0, -7.0))
    path, heading = drive_route(junction, rng(1), network=NETWORKS['roundabout'], rotation_rad=0.5, scale=1.25)
    radius = np.hypot(*(path - junction.centre_m).T)
    assert radius.min() == pytest.approx(1.25 * RING_RADIUS_M, abs=0.05)
    assert abs(np.sin(2 * (heading[0] - 0.5))) < 1e-6  # arms are square to each other, and turned


@pytest.mark.parametrize(
    ('name', 'vehicles'),
    [('highway', 40), ('long_bend', 40), ('roundabout_arms', 40), ('skew_turning', 40), ('tee', 40)],
)
def test_vehicles_of_scenes_have_up_to_eight_points(name: str, vehicles: int) -> None:
    _, evidence = drawn(name)
    numbers, counts = np.unique(evidence.track_vehicles, return_counts=True)
    assert 0.6 * vehicles < len(numbers) <= vehicles and counts.max() == 8 and np.median(counts) >= 6


def test_sparse_traffic_is_a_vehicle_every_twelve_seconds() -> None:
    _, evidence = drawn('sparse')
    begins = [
        min(track.times_s[0] for track in evidence.tracks() if track.vehicle == vehicle)
        for vehicle in np.unique(evidence.track_vehicles)
    ]
    assert 5 <= len(begins) <= 20 and np.median(np.diff(begins)) > 8.0


def test_pedestrians_are_slow_and_change_their_minds() -> None:
    path, heading = walk_along_road(CLEAN, rng())
    assert np.hypot(*np.diff(path, axis=0).T).max() / INTERVAL_S < 1.8  # metres per second
    assert 3 <= (np.abs(np.diff(heading)) > 0.1).sum() <= 20  # about every four of thirty seconds


def test_a_road_straight_ahead_passes_near_the_distortion_centre() -> None:
    junction = radial(rng(3))
    evidence = synthetic_evidence(junction, rng(3))
    nearest = [np.hypot(*(track.points_px - junction.camera.principal_point_px).T).min() for track in evidence.tracks()]
    assert np.max(nearest) < 160  # pixels; the image is 1280 wide


def test_a_short_piece_of_road_is_all_that_is_seen() -> None:
    junction = short_piece(rng())
    evidence = synthetic_evidence(junction, rng())
    assert junction.visible_columns_px is not None
    assert evidence.points_px[:, 0].min() > junction.visible_columns_px[0] - 5 * junction.noise_px
    assert np.ptp(evidence.points_px[:, 0]) < 0.31 * 1280


@pytest.mark.parametrize('seed', range(4))
def test_a_waving_camera_turns_by_half_to_a_few_degrees_and_its_monitor_sees_it(seed: int) -> None:
    sway = random_sway(rng(seed))
    trace = np.trace(sway(np.arange(0.0, 200.0, 0.1)), axis1=1, axis2=2)
    largest_deg = np.degrees(np.arccos((trace.min() - 1) / 2))
    assert 0.5 < largest_deg < 12.0  # up to 3 degrees of swing, and four sigmas of the walk
    assert background_drift_px(Junction().camera, sway, 200.0) > 3.0


def test_the_harder_waving_camera_goes_unnoticed() -> None:
    assert drawn('waved')[1].drift_px > 3.0
    assert drawn('waved_unseen')[0].sway is not None and drawn('waved_unseen')[1].drift_px == 0.0
    np.testing.assert_array_equal(drawn('waved')[1].points_px, drawn('waved_unseen')[1].points_px)


def test_a_sway_moves_the_tracks_with_the_camera() -> None:
    turn = pose(90.0, 0.0, 0.0) @ pose(89.0, 0.0, 0.0).T  # one degree about the camera's x, all the time
    turned = replace(CLEAN, sway=lambda times: np.broadcast_to(turn, (len(times), 3, 3)))
    again = replace(CLEAN, camera_from_ground=turn @ CLEAN.camera_from_ground)
    np.testing.assert_allclose(
        synthetic_evidence(turned, rng()).points_px, synthetic_evidence(again, rng()).points_px, atol=1e-9
    )


def test_a_road_out_of_view_is_an_error() -> None:
    with pytest.raises(UsageError, match='out of view'):
        synthetic_evidence(replace(CLEAN, centre_m=(-200.0, 0.0), tracks=2), rng())


def test_viewpoints_differ_in_lens_and_pose() -> None:
    junctions = [standard_junction(rng(seed)) for seed in range(30)]
    tilt = np.degrees(np.arcsin([-junction.normal_in_camera[2] for junction in junctions]))
    k1 = np.array([junction.camera.k[0] for junction in junctions])
    assert 26 <= tilt.min() < 29 and 35 < tilt.max() <= 38
    assert -0.05 <= k1.min() < -0.03 and 0.03 < k1.max() <= 0.05


def test_the_axle_of_a_trailer_rolls_and_does_not_slip() -> None:
    generator = np.random.default_rng(0)
    path, heading = drive_ring(CLEAN, generator, radius_m=15.0)
    middle, bar = trailer(path, heading, generator)
    axle = middle - 3.0 * np.column_stack([np.cos(bar), np.sin(bar)])
    rolled = np.diff(axle, axis=0)
    aside = np.sin(np.arctan2(rolled[:, 1], rolled[:, 0]) - bar[1:])
    assert np.abs(aside).max() < 1e-6
    assert np.degrees(np.abs(np.angle(np.exp(1j * (bar - heading))))[-1]) > 10.0  # it cuts the corner


def test_a_shadow_stays_on_one_side_whatever_the_heading() -> None:
    generator = np.random.default_rng(0)
    path, heading = drive_ring(CLEAN, generator, radius_m=15.0)
    offset = shadow(path, heading, generator)[0] - path
    assert np.ptp(offset, axis=0).max() < 1e-9 and 0.5 <= np.hypot(*offset[0]) <= 2.0


def test_a_wrong_lens_file_is_of_another_focal_length_each_run() -> None:
    lenses = []
    for run in range(4):
        task = Task('wrong_lens_file', 0, run, ('joint',))
        junction, _ = draw_evidence(task.family, task.seed, task.run)
        lens = given_lens(task, junction.camera)
        assert lens is not None and lens == given_lens(task, junction.camera)
        assert abs(np.log(lens.focal_px / junction.camera.focal_px)) > 0.05
        lenses.append(lens.focal_px / junction.camera.focal_px)
    assert len(set(lenses)) == 4
    assert given_lens(Task('standard', 0, 0, ('joint',)), junction.camera) is None


def test_a_bar_hides_one_side_and_moves_the_centre() -> None:
    junction, evidence = drawn('one_sided_bar')
    first, last = junction.visible_columns_px
    assert (first > 0) != (last < WIDTH)
    assert abs(junction.camera.principal_point_px[0] - 0.5 * (first + last)) < 5 * PRINCIPAL_POINT_SIGMA * WIDTH
    assert evidence.points_px[:, 0].min() > first - 5 and evidence.points_px[:, 0].max() < last + 5


def test_the_earlier_view_of_two_is_turned() -> None:
    junction, evidence = drawn('mixed_views')
    middle_s = 0.5 * (evidence.times_s.max() + evidence.times_s.min())
    roads = junction.camera_from_ground @ np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    normals, _ = circles(junction, evidence)
    through = np.abs(normals @ roads).min(axis=1)
    earlier = np.array([track.times_s.max() < middle_s for track in evidence.tracks()])
    assert np.median(through[~earlier]) < 0.3 * np.median(through[earlier])
