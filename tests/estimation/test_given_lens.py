"""A given lens that is of these images, and such that are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from autocalib_ros.config import Options
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.monte_carlo import draw_evidence
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import solve_once

GOLDEN = Path(__file__).parents[1] / 'golden'
OPTIONS = Options(camera_height=8.0)


@pytest.fixture(scope='module')
def two_roads() -> Evidence:
    return Evidence.load(GOLDEN / 'two_roads.npz')


@pytest.fixture(scope='module')
def right(two_roads: Evidence) -> Camera:
    """Return the lens that the traffic itself gives."""
    free = solve_once(two_roads, OPTIONS)
    assert isinstance(free, Calibration)
    return free.camera


def refused(evidence: Evidence, lens: Camera) -> Refusal:
    result = solve_once(evidence, OPTIONS, lens=lens)
    assert isinstance(result, Refusal)
    assert result.code == 'given_lens'
    return result


def test_the_right_lens_is_taken_with_full_grade(two_roads: Evidence, right: Camera) -> None:
    result = solve_once(two_roads, OPTIONS, lens=right)
    assert isinstance(result, Calibration)
    assert (result.grade, result.camera) == ('full', right)


def test_a_lens_with_skew_and_two_focal_lengths_is_published_as_it_is(two_roads: Evidence, right: Camera) -> None:
    exact = replace(right, pixel_aspect=1.004, skew=0.002)
    result = solve_once(two_roads, OPTIONS, lens=exact)
    assert isinstance(result, Calibration)
    assert result.camera == exact
    assert result.camera_info.k == pytest.approx(exact.matrix.ravel().tolist())


@pytest.mark.parametrize('factor', [1.01, 1.025])
def test_a_difference_within_the_tolerance_widens_the_plane(two_roads: Evidence, right: Camera, factor: float) -> None:
    free = solve_once(two_roads, OPTIONS)
    held = solve_once(two_roads, OPTIONS, lens=replace(right, focal_px=factor * right.focal_px))
    assert isinstance(free, Calibration) and isinstance(held, Calibration)
    assert free.ground is not None and held.ground is not None
    change = tilt_and_roll_deg(held.ground.normal_in_camera) - tilt_and_roll_deg(free.ground.normal_in_camera)
    exact = solve_once(two_roads, OPTIONS, lens=right)
    assert isinstance(exact, Calibration) and exact.stddev.tilt_deg and held.stddev.tilt_deg
    assert abs(change[0]) < 1.5 * held.stddev.tilt_deg and held.stddev.tilt_deg > 1.2 * exact.stddev.tilt_deg


@pytest.mark.parametrize('factor', [0.5, 0.9, 1.1, 4 / 3, 2.0], ids=['half', 'short', 'long', 'crop', 'double'])
def test_a_focal_length_of_another_mode_is_refused_with_both_numbers(
    two_roads: Evidence, right: Camera, factor: float
) -> None:
    given = replace(right, focal_px=factor * right.focal_px)
    found = refused(two_roads, given)
    assert found.values['given_px'] == pytest.approx(given.focal_px)
    assert found.values['traffic_px'] == pytest.approx(right.focal_px, rel=0.01)
    assert f'{given.focal_px:.1f} px' in found.message and f'{right.focal_px:.1f} ±' in found.message


def test_a_matrix_that_was_not_scaled_to_the_images_is_refused(two_roads: Evidence, right: Camera) -> None:
    found = refused(two_roads, replace(right, focal_px=2 * right.focal_px, principal_point_px=(1279.5, 719.5)))
    assert found.values['traffic_px'] == pytest.approx(right.focal_px, rel=0.01)


def test_a_principal_point_outside_the_images_is_refused_at_once(two_roads: Evidence, right: Camera) -> None:
    empty = two_roads.select_tracks(two_roads.track_vehicles[:0])
    found = refused(empty, replace(right, principal_point_px=(1744.0, 597.0)))
    assert '(1744.0, 597.0)' in found.message and '1280x720' in found.message


def test_a_lens_that_does_not_image_the_traffic_is_refused_at_once(two_roads: Evidence, right: Camera) -> None:
    found = refused(two_roads, replace(right, k=(-0.4, 0.0, 0.0, 0.0)))
    # the image of such a lens ends where its slope is zero: theta^2 = 1 / 1.2, at 2/3 of f theta
    assert found.values['radius_px'] == pytest.approx(right.focal_px * 2 / 3 / 1.2**0.5, rel=1e-3)
    assert found.values['unseen'] > 0.05


def test_focal_length_and_k1_that_make_up_for_each_other_are_refused_with_both_numbers() -> None:
    # the file of another focal length with a distortion of its own: held, it gave a tilt wrong by 25 sigmas
    junction, evidence = draw_evidence('wrong_lens_file', 5, 11)
    true = junction.camera
    given = replace(true, focal_px=0.842 * true.focal_px, k=(0.0494, 0.0, 0.0, 0.0))
    found = refused(evidence, given)
    assert found.values['cause'] == 'focal_and_k1'
    assert found.values['traffic_px'] == pytest.approx(true.focal_px, rel=0.05)
    assert f'{given.focal_px:.1f} px with k1 = 0.049' in found.message


def test_focal_length_and_k1_that_differ_a_little_widen_the_plane(two_roads: Evidence, right: Camera) -> None:
    exact = solve_once(two_roads, OPTIONS, lens=right)
    k1 = right.k[0] - 0.038  # curves alike where the traffic is
    held = solve_once(two_roads, OPTIONS, lens=replace(right, focal_px=1.04 * right.focal_px, k=(k1, *right.k[1:])))
    assert isinstance(exact, Calibration) and isinstance(held, Calibration)
    assert exact.ground is not None and held.ground is not None and exact.stddev.tilt_deg and held.stddev.tilt_deg
    change = tilt_and_roll_deg(held.ground.normal_in_camera) - tilt_and_roll_deg(exact.ground.normal_in_camera)
    assert abs(change[0]) < 1.5 * held.stddev.tilt_deg and held.stddev.tilt_deg > 3.0 * exact.stddev.tilt_deg
    assert held.grade != 'full'


def test_a_lens_refuted_within_the_tolerance_is_as_uncertain_as_the_traffic() -> None:
    # the traffic gives a focal length that is 2 % shorter, by 7 sigma of it alone; with k1 it is 4 % uncertain itself
    junction, evidence = draw_evidence('wrong_lens_file', 33, 34)
    given = replace(junction.camera, focal_px=585.5, k=(0.0, 0.0, 0.0, 0.0))
    found = solve_once(evidence, Options(camera_height=junction.height_m), lens=given)
    assert isinstance(found, Calibration) and found.ground is not None and found.stddev.tilt_deg
    error = tilt_and_roll_deg(found.ground.normal_in_camera) - tilt_and_roll_deg(junction.normal_in_camera)
    assert 2.0 < abs(error[0]) < 2.5 * found.stddev.tilt_deg  # it was 4.0 sigma


def test_a_wrong_principal_point_is_refused_with_both_points(two_roads: Evidence, right: Camera) -> None:
    x, y = right.principal_point_px
    found = refused(two_roads, replace(right, principal_point_px=(x, y + 120.0)))
    assert found.values['y_px'] == pytest.approx(y + 120.0)
    assert found.values['traffic_y_px'] == pytest.approx(y, abs=20.0)


def test_a_lens_of_another_family_is_refused(two_roads: Evidence, right: Camera) -> None:
    refused(two_roads, replace(right, k=(1 / 3, 2 / 15, 17 / 315, 62 / 2835)))
