"""The robust method on synthetic traffic: noise-free, noisy and contaminated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import GateOptions, JointOptions, LensOptions, Options
from autocalib_ros.estimation.adjustment.bundle_adjustment import adjust
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import RIGHT_ANGLE_SIGMA_RAD, AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.estimation.observations.track_set import select_tracks
from autocalib_ros.estimation.verification.gates import NOT_COMPARED, check_halves
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.monte_carlo import draw_evidence, families
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import solved_junction

pytestmark = pytest.mark.solve

OPTIONS = Options(camera_height=8.0, lens=LensOptions(pixel_aspect=1.0))
ONE_FAMILY = replace(OPTIONS, joint=JointOptions(lens_prior='equidistant', single_road=False))
"""For questions that do not depend on how the family of the lens is chosen: the others take half as long again."""
ONE_ROAD = Junction(
    road_angles_deg=(0.0,),
    turning_fraction=0.0,
    vehicles=120,
    points_per_vehicle=2,
    camera_from_ground=pose(35.0, 1.0, 60.0),
    centre_m=(6.0, -10.0),
)


def solved(
    junction: Junction, seed: int = 0, options: Options = OPTIONS, lens: Camera | None = None
) -> Calibration | Refusal:
    return solved_junction(junction, options, seed, lens)


def normal_error_deg(result: Calibration, junction: Junction) -> float:
    assert result.ground is not None
    cosine = result.ground.normal_in_camera @ junction.normal_in_camera
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_perfect_traffic_gives_the_truth() -> None:
    junction = Junction(turning_fraction=0.0, wander_m=0.0, noise_px=0.0)
    result = solved(junction)
    assert isinstance(result, Calibration)
    assert result.camera.focal_px == pytest.approx(560.0, rel=1e-3)
    assert normal_error_deg(result, junction) < 0.05


@pytest.mark.parametrize('seed', range(3))
def test_real_driving_is_solved_within_two_per_cent_and_half_a_degree(seed: int) -> None:
    junction = Junction()  # 0.5 px noise, 0.1 m wander, 20 % turning
    result = solved(junction, seed)
    assert isinstance(result, Calibration)
    assert result.camera.focal_px == pytest.approx(560.0, rel=0.02)
    assert normal_error_deg(result, junction) < 0.5


@pytest.mark.parametrize(('k1', 'shift'), [(0.04, (12.0, -8.0)), (-0.03, (-15.0, 5.0))])
def test_a_lens_that_is_not_quite_equidistant_is_found(k1: float, shift: tuple[float, float]) -> None:
    camera = Camera(1280, 720, 560.0, (639.5 + shift[0], 359.5 + shift[1]), (k1, 0.0, 0.0, 0.0))
    junction = Junction(camera=camera, vehicles=120, points_per_vehicle=2)
    result = solved(junction)
    assert isinstance(result, Calibration)
    assert result.camera.focal_px == pytest.approx(560.0, rel=0.03)
    assert normal_error_deg(result, junction) < 0.7


def test_turning_vehicles_do_not_pull_the_solution() -> None:
    junction = Junction(turning_fraction=0.5, vehicles=120, points_per_vehicle=2)
    result = solved(junction, options=ONE_FAMILY)
    assert isinstance(result, Calibration)
    assert result.camera.focal_px == pytest.approx(560.0, rel=0.03)


def test_skewed_roads_are_measured_not_squared() -> None:
    junction = Junction(road_angles_deg=(0.0, 70.0), vehicles=120, points_per_vehicle=2)
    result = solved(junction)
    assert isinstance(result, Calibration)
    assert [check.values['source'] for check in result.checks if check.kind == 'crossing_angle'] == ['measured']
    assert normal_error_deg(result, junction) < 1.0


def test_perpendicularity_is_tested_before_it_is_used() -> None:
    result = solved(Junction())
    assert isinstance(result, Calibration)
    assert [item.values['source'] for item in result.assumptions if item.kind == 'crossing_angle'] == ['expected']


def test_perpendicularity_can_be_asserted() -> None:
    result = solved(Junction(), options=replace(OPTIONS, joint=JointOptions(road_angle='90')))
    assert isinstance(result, Calibration)
    first, second = result.road_directions
    assert first @ second == pytest.approx(0.0, abs=1e-9)


def test_an_asserted_angle_other_than_90_degrees_is_fixed() -> None:
    junction = Junction(road_angles_deg=(0.0, 70.0), vehicles=120, points_per_vehicle=2)
    result = solved(junction, options=replace(OPTIONS, joint=JointOptions(road_angle='70')))
    assert isinstance(result, Calibration)
    assert 'roads cross at 70 degrees (given)' in map(str, result.assumptions)
    first, second = result.road_directions
    assert abs(first @ second) == pytest.approx(np.cos(np.radians(70.0)), abs=1e-9)
    assert normal_error_deg(result, junction) < 0.5


def test_three_roads_are_found_and_agree_with_the_truth() -> None:
    junction = Junction(road_angles_deg=(0.0, 60.0, 120.0), vehicles=150, points_per_vehicle=2)
    result = solved(junction, options=ONE_FAMILY)
    assert isinstance(result, Calibration)
    assert len(result.road_directions) == 3
    assert normal_error_deg(result, junction) < 0.7


def test_a_known_lens_is_kept_and_the_pose_solved() -> None:
    camera = Camera(1280, 720, 560.0, (650.0, 352.0), (0.05, 0.01, 0.0, 0.0))  # no family holds such a lens
    junction = Junction(camera=camera)
    result = solved(junction, lens=camera)
    assert isinstance(result, Calibration)
    assert result.camera == camera
    assert result.stddev.focal_px == 0.0
    assert result.assumptions[0].kind == 'lens_given'
    assert normal_error_deg(result, junction) < 0.5


def test_a_focal_length_that_is_given_exactly_is_kept() -> None:
    result = solved(Junction(), options=replace(OPTIONS, joint=JointOptions(focal_prior_px=560.0)))
    assert isinstance(result, Calibration)
    assert result.camera.focal_px == 560.0


def test_a_focal_length_with_a_sigma_is_a_prior() -> None:
    options = replace(OPTIONS, joint=JointOptions(focal_prior_px=560.0, focal_sigma_px=1.0))
    result = solved(Junction(), options=options)
    assert isinstance(result, Calibration)
    assert result.stddev.focal_px is not None
    assert result.camera.focal_px == pytest.approx(560.0, abs=3.0)  # 3 sigma of what is given
    assert 0.0 < result.stddev.focal_px <= 1.05


def test_a_distortion_free_lens_is_found_when_the_angle_of_the_roads_is_given() -> None:
    camera = Camera(1280, 720, 900.0, (639.5, 359.5), (1 / 3, 2 / 15, 17 / 315, 62 / 2835))
    junction = Junction(camera=camera, vehicles=150, points_per_vehicle=2, camera_from_ground=pose(25.0, 0.0, 35.0))
    options = replace(OPTIONS, joint=JointOptions(road_angle='90', lens_prior='distortion_free', k1_sigma=0.0))
    result = solved(junction, options=options)
    assert isinstance(result, Calibration)
    assert result.camera.focal_px == pytest.approx(900.0, rel=0.03)
    assert normal_error_deg(result, junction) < 0.7


def test_parameters_that_one_road_cannot_identify_are_fixed_and_reported() -> None:
    result = solved(ONE_ROAD, options=replace(OPTIONS, joint=JointOptions(single_road=False)))
    assert isinstance(result, Calibration)
    assert 'parameter_fixed' in [statement.kind for statement in result.assumptions]


def test_ground_points_are_more_uncertain_farther_away() -> None:
    result = solved(Junction())
    assert isinstance(result, Calibration)
    near, middle, far = result.stddev.ground_point_m
    assert near is not None
    assert middle is not None
    assert far is not None
    assert 0.0 < near < middle < far < 4.0  # metres; a tenth of the distance at the most


def test_one_road_gives_a_lens_and_the_refusal_of_a_plane() -> None:
    for single_road, code in ((False, 'one_direction'), (True, 'grade_too_low')):
        result = solved(ONE_ROAD, options=replace(OPTIONS, joint=JointOptions(single_road=single_road)))
        assert isinstance(result, Calibration)
        assert (result.grade, result.ground) == ('lens', None)
        assert result.ground_refusal is not None and result.ground_refusal.code == code


@pytest.mark.parametrize('roll_deg', [-1.5, 2.0])
def test_one_road_and_a_level_camera_give_an_assumed_plane_where_allowed(roll_deg: float) -> None:
    junction = replace(ONE_ROAD, camera_from_ground=pose(35.0, roll_deg, 60.0))
    joint, gate = replace(ONE_FAMILY.joint, roll_prior_deg=2.0), GateOptions(least_grade='assumed')
    result = solved(junction, options=replace(OPTIONS, joint=joint, gate=gate))
    assert isinstance(result, Calibration)
    assert result.grade == result.stddev.ground.grade != 'full' and result.ground is not None
    assert any(item.kind == 'level_camera' and item.values['sigma_deg'] == 2.0 for item in result.assumptions)
    assert result.stddev.roll_deg == pytest.approx(2.0, rel=0.2)
    sigma = np.hypot(result.stddev.roll_deg, result.stddev.tilt_deg or 0.0)
    assert normal_error_deg(result, junction) < 2.0 * sigma


def test_a_road_level_across_the_image_gives_no_plane_even_where_a_level_camera_is_assumed() -> None:
    junction = replace(ONE_ROAD, camera_from_ground=pose(32.0, 0.0, 90.0), centre_m=(16.0, 0.0))
    result = solved(junction, options=replace(OPTIONS, joint=replace(ONE_FAMILY.joint, roll_prior_deg=2.0)))
    if isinstance(result, Calibration):
        assert result.ground is None
        assert result.ground_refusal is not None
        assert result.ground_refusal.code == 'plane_uncertain'


def test_traffic_that_only_turns_is_refused() -> None:
    result = solved(Junction(turning_fraction=1.0, vehicles=80))
    assert isinstance(result, Refusal)
    assert result.code in ('turning_traffic', 'halves_disagree', 'no_direction')


def test_a_road_on_which_many_change_lanes_still_gives_the_lens() -> None:
    junction = replace(ONE_ROAD, lane_change_fraction=0.4, points_per_vehicle=4)
    result = solved(junction, options=ONE_FAMILY)
    assert isinstance(result, Calibration)
    assert abs(result.camera.focal_px - 560.0) < 3 * result.stddev.focal_px


@pytest.mark.parametrize('points', [3, 4])
def test_a_ring_of_which_an_arc_passes_for_a_road_is_refused(points: int) -> None:
    """With one point a vehicle: the golden case `roundabout`."""
    generator = np.random.default_rng([5, 1])
    ring = replace(families()['roundabout'](generator)[0], tracks=None, vehicles=60, points_per_vehicle=points)
    assert isinstance(solved(ring, options=ONE_FAMILY), Refusal)


def test_vehicles_of_one_track_each_cannot_show_lane_keeping() -> None:
    _, evidence = draw_evidence('roundabout', 0, 8)  # two thirds of its tracks, the short ones, pass for straight
    assert isinstance(solve(evidence, ONE_FAMILY), Refusal)


def test_a_lens_without_curvature_is_refused() -> None:
    camera = Camera(1280, 720, 1200.0, (639.5, 359.5), (1 / 3, 2 / 15, 17 / 315, 62 / 2835))
    junction = Junction(camera=camera, vehicles=120, points_per_vehicle=2, camera_from_ground=pose(25.0, 0.0, 35.0))
    result = solved(junction)
    assert isinstance(result, Refusal) and result.code == 'grade_too_low'
    # what is left are the usual fields of view
    assert result.candidate is not None and result.candidate.stddev.focal_px / result.candidate.camera.focal_px > 0.1


def test_too_few_tracks_are_refused_with_both_numbers() -> None:
    result = solved(Junction(vehicles=5))
    assert isinstance(result, Refusal)
    assert result.code == 'too_few_tracks'
    assert '40 needed' in result.message


def test_without_a_height_the_lens_is_still_given() -> None:
    result = solved(Junction(), options=replace(OPTIONS, camera_height=0.0))
    assert isinstance(result, Calibration)
    assert result.ground is None
    assert result.grade == 'lens'
    assert result.ground_refusal is not None
    assert result.ground_refusal.code == 'no_height'


def test_unit_scale_needs_its_option() -> None:
    result = solved(Junction(), options=replace(OPTIONS, camera_height=0.0, allow_unit_scale=True))
    assert isinstance(result, Calibration)
    assert result.ground is not None
    assert (result.grade, result.ground.metric, result.ground.height_m) == ('unit_scale', False, 1.0)


def test_the_same_evidence_gives_the_same_answer_to_the_last_bit() -> None:
    first, second = (solve(synthetic_evidence(Junction(), np.random.default_rng(0)), OPTIONS), solved(Junction()))
    assert isinstance(first, Calibration) and isinstance(second, Calibration)
    assert first.camera == second.camera
    np.testing.assert_array_equal(first.ground.rotation, second.ground.rotation)  # type: ignore[union-attr]


def test_standard_deviations_have_the_size_of_the_errors() -> None:
    """Five draws; `autocalib benchmark accuracy` has forty of this family."""
    crossings = 90.0 + np.random.default_rng(1).normal(scale=np.degrees(RIGHT_ANGLE_SIGMA_RAD), size=5)
    results = [
        solved(Junction(road_angles_deg=(0.0, float(angle))), seed, ONE_FAMILY) for seed, angle in enumerate(crossings)
    ]
    errors = [
        (result.camera.focal_px - 560.0) / result.stddev.focal_px
        for result in results
        if isinstance(result, Calibration) and result.stddev.focal_px
    ]
    assert len(errors) == 5
    assert 0.2 < np.sqrt(np.mean(np.square(errors))) < 2.0  # five runs tell a factor of two, no more


def test_a_half_without_tracks_is_reported_as_not_cross_checked() -> None:
    tracks = select_tracks(synthetic_evidence(Junction(), np.random.default_rng(0)), 500)
    one_vehicle = replace(tracks, vehicles=np.zeros(len(tracks), int))  # then all of it is in the earlier half
    state = AdjustmentState(Junction().camera, Junction().camera_from_ground, np.array([0.0, np.pi / 2]))
    prior = lens_priors((1280, 720), JointOptions())[0]
    fit = adjust(state, one_vehicle, AdjustmentConfig(prior, JointOptions()))
    assert check_halves(fit, one_vehicle, GateOptions()) == NOT_COMPARED


def test_a_moving_camera_is_refused() -> None:
    evidence: Evidence = replace(synthetic_evidence(Junction(), np.random.default_rng(0)), drift_px=12.0)
    result = solve(evidence, OPTIONS)
    assert isinstance(result, Refusal)
    assert result.code == 'camera_moving'
