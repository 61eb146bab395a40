"""Confirmation and replacement of a restored calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import JointOptions, LensOptions, Options
from autocalib_ros.errors import UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence
from autocalib_ros.results.calibration import StandardDeviations
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import assumption
from autocalib_ros.revalidation import CalibrationState, reconcile, with_current_options
from stored_results import SIZE, calibration, lens_only

NONE, RESTORED, VERIFIED, MENDED, DEGRADED, CALIBRATED = CalibrationState
KEPT = calibration()
VAGUE = calibration(302.0, tilt_deg=12.5, sigmas=3.0)
"""Agrees with the stored calibration, and is less precise."""


def test_first_solution_is_taken():
    decision = reconcile(NONE, None, KEPT)
    assert (decision.state, decision.calibration, decision.text) == (CALIBRATED, KEPT, '')


def test_solution_of_this_run_is_replaced_by_one_that_is_as_precise_whatever_it_says():
    newer = calibration(400.0)
    decision = reconcile(CALIBRATED, KEPT, newer)
    assert (decision.state, decision.calibration) == (CALIBRATED, newer)
    assert 'focal length before 300 ± 1 px, new 400 ± 1 px' in decision.text


def test_vague_solution_that_agrees_changes_nothing():
    assert reconcile(CALIBRATED, KEPT, VAGUE).calibration is KEPT


def test_traffic_that_contradicts_degrades_and_twice_in_a_row_replaces():
    contrary = calibration(330.0, sigmas=3.0)
    first = reconcile(CALIBRATED, KEPT, contrary)
    assert (first.state, first.calibration) == (DEGRADED, KEPT)
    assert 'focal length before 300 ± 1 px, new 330 ± 3 px' in first.text
    again = reconcile(DEGRADED, KEPT, contrary)
    assert (again.state, again.calibration) == (CALIBRATED, contrary)
    assert reconcile(DEGRADED, KEPT, VAGUE).state is CALIBRATED  # it was an episode


def test_mended_calibration_is_confirmed_like_a_stored_one():
    decision = reconcile(MENDED, KEPT, VAGUE)
    assert (decision.state, decision.calibration) == (VERIFIED, KEPT)
    assert 'mended calibration' in decision.text


@pytest.mark.parametrize('state', [RESTORED, VERIFIED])
def test_vague_solution_that_agrees_confirms_the_kept_one_which_stays(state):
    decision = reconcile(state, KEPT, VAGUE)
    assert (decision.state, decision.calibration, decision.contradicted) == (VERIFIED, KEPT, False)
    assert bool(decision.text) == (state is RESTORED)


def test_solution_that_agrees_and_is_as_precise_takes_over():
    fresh = calibration(300.5, tilt_deg=12.4)
    decision = reconcile(RESTORED, KEPT, fresh)
    assert (decision.state, decision.calibration, decision.contradicted) == (CALIBRATED, fresh, False)
    assert 'stored calibration confirmed' in decision.text


@pytest.mark.parametrize(
    ('fresh', 'expected'),
    [
        (calibration(310.0, sigmas=3.0), 'focal length before 300 ± 1 px, new 310 ± 3 px'),
        (calibration(tilt_deg=14.5, sigmas=3.0), 'tilt before 12.3 ± 0.2 deg, new 14.5 ± 0.6 deg'),
        (calibration(roll_deg=3.0, sigmas=3.0), 'roll'),
        (calibration(height_m=8.7, sigmas=3.0), 'height before 8.1 ± 0.05 m, new 8.7 ± 0.15 m'),
        (replace(VAGUE, camera=replace(VAGUE.camera, principal_point_px=(340.0, 179.5))), 'principal point x'),
    ],
)
def test_solution_that_does_not_agree_replaces_the_kept_one(fresh, expected):
    decision = reconcile(RESTORED, KEPT, fresh)
    assert (decision.state, decision.calibration, decision.contradicted) == (CALIBRATED, fresh, True)
    assert expected in decision.text


def test_difference_counts_by_both_deviations():
    # 4 px apart: 4 sigmas of the stored one alone, 2.8 of both together
    agrees, differs = (calibration(304.0, sigmas=sigmas) for sigmas in (1.0, 0.5))
    assert not reconcile(RESTORED, KEPT, agrees).contradicted
    assert reconcile(RESTORED, KEPT, differs).contradicted


def test_lens_alone_confirms_the_lens_and_leaves_the_plane_unverified():
    fresh = replace(lens_only(VAGUE), ground_refusal=Reason('one_direction', 'one road only.', 'wait'))
    decision = reconcile(RESTORED, KEPT, fresh)
    assert (decision.state, decision.calibration) == (RESTORED, KEPT)
    assert 'confirms the stored lens' in decision.text and 'one road only.' in decision.text


def test_other_lens_without_a_plane_replaces_lens_and_plane():
    fresh = lens_only(calibration(320.0))
    decision = reconcile(RESTORED, KEPT, fresh)
    assert (decision.state, decision.calibration, decision.contradicted) == (CALIBRATED, fresh, True)


def test_plane_is_taken_where_none_was_kept():
    decision = reconcile(RESTORED, lens_only(KEPT), VAGUE)
    assert (decision.state, decision.calibration, decision.contradicted) == (CALIBRATED, VAGUE, False)


def test_same_lens_needs_no_deviations():
    given = replace(KEPT, stddev=replace(KEPT.stddev, focal_px=0.0, principal_point_px=(0.0, 0.0), k1=0.0, k2=0.0))
    assert reconcile(RESTORED, given, given).state is CALIBRATED


def test_without_deviations_the_newer_is_taken():
    published = replace(calibration(310.0), stddev=StandardDeviations())
    decision = reconcile(RESTORED, KEPT, published)
    assert (decision.state, decision.calibration) == (CALIBRATED, published)
    assert 'without standard deviations' in decision.text


@pytest.mark.solve
def test_solutions_of_one_camera_agree_and_of_a_turned_one_do_not():
    lens = LensOptions(pixel_aspect=1.0)
    options = Options(camera_height=8.0, lens=lens, joint=JointOptions(lens_prior='equidistant'))

    def seen(tilt_deg: float, seed: int):
        junction = Junction(camera_from_ground=pose(tilt_deg, 1.0, 35.0), vehicles=30)
        return solve(synthetic_evidence(junction, np.random.default_rng(seed)), options)

    kept, again, turned = seen(32.0, 1), seen(32.0, 2), seen(37.0, 3)
    assert kept and again and turned
    assert not reconcile(RESTORED, kept, again).contradicted
    assert reconcile(RESTORED, kept, turned).contradicted


def test_height_that_is_given_now_scales_the_kept_plane():
    scaled = with_current_options(KEPT, Options(camera_height=16.2, camera_height_sigma=0.4), None)
    assert (scaled.ground.height_m, scaled.stddev.height_m, scaled.stddev.ground_point_m) == (16.2, 0.4, ())
    np.testing.assert_array_equal(scaled.ground.rotation, KEPT.ground.rotation)
    assert scaled.assumptions == (
        assumption('paper_roads'),
        assumption('scale_height', given_m=16.2, given_sigma_m=0.4),
    )
    assert (scaled.camera, scaled.grade) == (KEPT.camera, 'full')


@pytest.mark.parametrize(
    'options',
    [
        Options(),
        Options(camera_height=8.1),
        Options(scale_from='speed', scale=replace(Options().scale, speed_km_h=50.0)),
    ],
)
def test_kept_plane_keeps_its_scale_when_nothing_else_is_given(options):
    assert with_current_options(KEPT, options, None) is KEPT


def test_distance_that_is_given_now_scales_the_kept_plane():
    scale = replace(Options().scale, distance_px='250 300 400 310', distance_m=5.0)
    scaled = with_current_options(KEPT, Options(scale_from='distance', scale=scale), None)
    bearings, _ = KEPT.camera.unproject(np.array(scale.pixels))
    rays = bearings @ scaled.ground.rotation.T
    points = -rays / rays[:, 2:] * scaled.ground.height_m
    assert np.linalg.norm(points[0] - points[1]) == pytest.approx(5.0, rel=1e-9)


def test_distance_between_pixels_off_the_kept_road_takes_the_plane_away():
    scale = replace(Options().scale, distance_px='250 3 400 310', distance_m=5.0)
    lens = with_current_options(KEPT, Options(scale_from='distance', scale=scale), None)
    assert (lens.grade, lens.ground, lens.ground_refusal.code) == ('lens', None, 'scale_off_road')


def test_plane_in_heights_becomes_metres_when_the_height_is_given():
    unit = replace(KEPT, grade='unit_scale', ground=replace(KEPT.ground, height_m=1.0, metric=False))
    scaled = with_current_options(unit, Options(camera_height=7.0), None)
    assert (scaled.ground.height_m, scaled.ground.metric, scaled.grade) == (7.0, True, 'fair')


def test_lens_that_is_given_now_has_to_be_the_kept_one():
    double = replace(
        KEPT.camera,
        width=2 * SIZE[0],
        height=2 * SIZE[1],
        focal_px=600.0,
        principal_point_px=tuple(2 * x + 0.5 for x in KEPT.camera.principal_point_px),
    )
    assert with_current_options(KEPT, Options(), double) is KEPT
    with pytest.raises(UsageError, match='camera_info_file'):
        with_current_options(KEPT, Options(), Camera.equidistant(*SIZE, 320.0))
