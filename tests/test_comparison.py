"""Differences between calibrations that are known by construction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autocalib_ros.comparison import compare_calibrations
from autocalib_ros.errors import UsageError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.ground import Ground
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.lens.opencv_lens import OpencvLens
from autocalib_ros.results.calibration import COVARIANCE_PARAMETERS, StandardDeviations
from autocalib_ros.results.saved_camera import SavedCamera

CAMERA = Camera(1280, 720, 560.0, (642.0, 357.0), (0.01, -0.002, 0.0, 0.0))
SIGMAS = np.array([3.0, 2.0, 2.0, 0.004, 0.002, 0.0, 0.0, 0.15, 0.1, 0.08])
STATED = StandardDeviations(
    focal_px=3.0, principal_point_px=(2.0, 2.0), k1=0.004, k2=0.002, tilt_deg=0.15, roll_deg=0.1, height_m=0.08
)
NONE = StandardDeviations()


def pose(tilt_deg: float = 28.0, roll_deg: float = 1.0, heading_deg: float = 0.0, height_m: float = 8.0) -> GroundPlane:
    """Return ground_from_camera of a camera that looks along the ground's x, turned by a heading."""
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turned = Rotation.from_euler('z', heading_deg, degrees=True).as_matrix()
    looks = Rotation.from_euler('XZ', [-tilt_deg, roll_deg], degrees=True).as_matrix()
    return GroundPlane(turned @ level @ looks, height_m)


def known(camera: Camera = CAMERA, ground: GroundPlane | None = None, *, sure: bool = False) -> SavedCamera:
    """Return a camera, and with `sure` its deviations with a covariance without correlations."""
    return SavedCamera(
        width=camera.width,
        height=camera.height,
        lens=camera,
        matrix=camera.matrix,
        k=camera.k,
        ground=ground or pose(),
        stddev=STATED if sure else NONE,
        covariance=np.diag(SIGMAS**2) if sure else None,
    )


def number(result, name):
    return next(item for item in (*result.lens, *result.pose) if item.name == name)


def test_a_calibration_is_its_own_equal():
    result = compare_calibrations(known(sure=True), known(sure=True))
    assert result.agrees
    assert result.rays.largest_deg == pytest.approx(0, abs=1e-6)
    assert [item.distance_m for item in result.road] == [10.0, 20.0, 40.0]
    assert [item.separation_m for item in result.road] == pytest.approx([0, 0, 0], abs=1e-9)


def test_numbers_are_those_put_in_and_counted_in_combined_sigmas():
    other = known(
        replace(CAMERA, focal_px=565.0, principal_point_px=(640.0, 360.0)), pose(28.5, 0.8, height_m=8.1), sure=True
    )
    result = compare_calibrations(known(sure=True), other)
    for name, difference, sigma in (
        ('focal length', 5.0, 3.0),
        ('principal point x', -2.0, 2.0),
        ('principal point y', 3.0, 2.0),
        ('tilt', 0.5, 0.15),
        ('roll', -0.2, 0.1),
        ('height', 0.1, 0.08),
    ):
        assert number(result, name).difference == pytest.approx(difference)
        assert number(result, name).sigma == pytest.approx(np.sqrt(2) * sigma)
        assert number(result, name).sigmas == pytest.approx(abs(difference) / (np.sqrt(2) * sigma))


def test_a_focal_length_shows_in_the_rays_at_the_border():
    lens = Camera(1280, 720, 560.0, (639.5, 359.5))
    longer = replace(lens, focal_px=565.6)
    result = compare_calibrations(known(lens), known(longer))
    corner = np.degrees(np.hypot(639.5, 359.5) / 560.0)
    assert result.rays.largest_deg == pytest.approx(corner * (1 - 1 / 1.01), rel=1e-6)
    assert result.rays_aligned.largest_deg == pytest.approx(result.rays.largest_deg, rel=1e-6)  # nothing to turn
    assert result.lens_px == pytest.approx(0.01 * np.hypot(639.5, 359.5), rel=1e-6)


def test_a_principal_point_is_traded_against_a_rotation():
    moved = replace(CAMERA, principal_point_px=(652.0, 357.0))
    result = compare_calibrations(known(), known(moved))
    assert result.rays.largest_deg == pytest.approx(np.degrees(10 / 560), rel=0.1)
    assert result.rays_aligned.largest_deg < 0.3 * result.rays.largest_deg
    assert result.alignment_deg == pytest.approx(np.degrees(10 / 560), rel=0.1)


def test_a_heading_of_the_ground_frame_is_no_difference():
    result = compare_calibrations(known(sure=True), known(ground=pose(heading_deg=123.0), sure=True))
    assert result.agrees
    assert max(item.separation_m for item in result.road) < 1e-9


def test_a_height_moves_the_road_in_proportion():
    result = compare_calibrations(known(), known(ground=pose(height_m=8.8)))
    assert [item.separation_m for item in result.road] == pytest.approx([1.0, 2.0, 4.0], rel=1e-6)


def test_a_tilt_moves_the_road_as_trigonometry_says():
    # without roll, straight ahead is straight up in the image; the dip of a point 20 m away from 8 m up grows by 0.5
    camera = Camera(1280, 720, 560.0, (639.5, 359.5))
    result = compare_calibrations(known(camera, pose(28.0, 0.0)), known(camera, pose(28.5, 0.0)))
    for item in result.road:
        dip = np.arctan2(8.0, item.distance_m) + np.radians(0.5)
        assert item.separation_m == pytest.approx(item.distance_m - 8.0 / np.tan(dip), rel=1e-6)
    assert result.normal_deg == pytest.approx(0.5)


def test_the_verdict_names_what_is_beyond_three_sigmas():
    result = compare_calibrations(known(sure=True), known(ground=pose(29.5), sure=True))
    assert result.agrees is False
    assert result.verdict().startswith('The calibrations differ in tilt (7.1 sigmas)')
    assert 'focal' not in result.verdict()


def test_within_three_sigmas_is_agreement_with_the_farthest_named():
    result = compare_calibrations(known(sure=True), known(ground=pose(28.4), sure=True))
    assert result.agrees
    assert result.verdict() == (
        'The calibrations agree within 3 combined sigmas; the largest difference is tilt, 1.9 sigmas.'
    )


def test_a_side_that_states_nothing_is_taken_as_exact_and_that_is_reported():
    result = compare_calibrations(known(sure=True), known(replace(CAMERA, focal_px=572.0)))
    assert number(result, 'focal length').sigmas == pytest.approx(4.0)
    assert 'B states no standard deviations and is taken as exact' in result.notes
    assert result.agrees is False


def test_where_nobody_states_deviations_only_equal_lenses_agree():
    assert compare_calibrations(known(), known(replace(CAMERA, focal_px=572.0))).agrees is None
    result = compare_calibrations(known(), known(replace(CAMERA, focal_px=572.0)))
    assert result.verdict().startswith('Agreement of the calibrations is unknown: neither states')
    assert compare_calibrations(known(), known(replace(CAMERA, focal_px=560.1))).agrees


def test_heights_that_were_given_differently_differ():
    given = replace(STATED, height_m=None)
    result = compare_calibrations(
        replace(known(sure=True), stddev=given), replace(known(ground=pose(height_m=8.2), sure=True), stddev=given)
    )
    assert 'height (both exact)' in result.verdict()


def draws(count: int) -> list[SavedCamera]:
    """Return cameras drawn from a covariance with realistic correlations."""
    generator = np.random.default_rng(4)
    ground = Ground(lens=CAMERA, rotation=pose().rotation, camera_m=pose().translation_m)
    found = []
    for step in generator.multivariate_normal(np.zeros(len(COVARIANCE_PARAMETERS)), CORRELATED, count):
        lens, rotation, camera_m = ground._perturbed(step)
        found.append(known(lens, GroundPlane(rotation, float(camera_m[2]))))
    return found


CORRELATION = np.eye(len(COVARIANCE_PARAMETERS))
CORRELATION[0, 3] = CORRELATION[3, 0] = -0.9  # focal length and k1
CORRELATION[2, 7] = CORRELATION[7, 2] = 0.8  # principal point and tilt
CORRELATED = np.outer(SIGMAS, SIGMAS) * CORRELATION


def test_sigmas_on_the_road_and_of_rays_are_those_of_draws_from_the_covariance():
    truth = replace(known(sure=True), covariance=CORRELATED)
    results = [compare_calibrations(truth, other) for other in draws(60)]
    # the mean square of what is counted in its own sigma is 1, to 20 % with 60 draws and two axes or so
    for index in range(3):
        counted = np.array([result.road[index].sigmas for result in results])
        assert np.sqrt((counted**2).mean()) == pytest.approx(1.0, abs=0.2)
    # at the pixel that is worst in each draw, a little more
    for rays in ('rays', 'rays_aligned'):
        counted = np.array([getattr(result, rays).sigmas for result in results])
        assert 0.85 < np.sqrt((counted**2).mean()) < 1.6
    assert np.mean([result.agrees for result in results]) > 0.95


def test_both_sides_deviations_add_up():
    alone, both = (
        compare_calibrations(known(sure=True), known(ground=pose(28.2), sure=sure)) for sure in (False, True)
    )
    for one, two in zip(alone.road, both.road, strict=True):
        assert two.sigma_m == pytest.approx(np.sqrt(2) * one.sigma_m, rel=0.05)  # the poses are not quite the same


def test_another_image_size_is_scaled_and_another_shape_is_wrong():
    half = replace(
        CAMERA,
        width=640,
        height=360,
        focal_px=280.0,
        principal_point_px=tuple((value + 0.5) / 2 - 0.5 for value in CAMERA.principal_point_px),
    )
    result = compare_calibrations(known(), known(half))
    assert result.lens_px == pytest.approx(0, abs=1e-6)
    assert 'B is scaled from 640x360 to 1280x720' in result.notes
    with pytest.raises(UsageError, match='another shape'):
        compare_calibrations(known(), known(replace(half, height=480)))


def test_a_checkerboards_rational_lens_is_compared_by_its_rays():
    info = camera_info(CAMERA, 'rational_polynomial')
    rational = SavedCamera.from_opencv_lens(
        OpencvLens(width=1280, height=720, matrix=CAMERA.matrix, equidistant=False, coefficients=tuple(info.d))
    )
    result = compare_calibrations(known(sure=True), rational)
    assert result.same_lens and result.agrees
    assert result.rays.largest_deg < np.degrees(0.1 / 560)
    assert result.pose == () and result.road == ()
    assert result.verdict().startswith('The lenses agree')
    assert 'poses are not compared: B has no ground plane' in result.notes


def test_a_plane_without_metres_is_compared_by_its_angles_only():
    unit = replace(pose(), height_m=1.0, metric=False)
    result = compare_calibrations(known(), known(ground=unit))
    assert [item.name for item in result.pose] == ['tilt', 'roll']
    assert result.road == ()
