"""Lens and plane from road markings: accuracy, honesty of the uncertainty, and confirmation by traffic."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from squeezed_evidence import squeezed

from autocalib_ros.config import GateOptions, JointOptions, LensOptions, Options
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.lens_prior import known_lens, lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig
from autocalib_ros.estimation.estimate import find_solution, solve
from autocalib_ros.estimation.markings import grid_search as markings
from autocalib_ros.estimation.markings.grid_search import find_grids
from autocalib_ros.estimation.markings.markings_solution import (
    MarkingsFit,
    check_ambiguity,
    condition_on_lens,
    fit_to_markings,
)
from autocalib_ros.estimation.markings.road_segments import segments_on_road
from autocalib_ros.estimation.observations.track_set import TrackSet, select_tracks
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.estimation.strategies import verify_with_traffic
from autocalib_ros.estimation.verification.ground_normal import PlaneEstimate
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import GroundPlane, tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.families import standard_junction
from autocalib_ros.offline.benchmark.monte_carlo import distance_error
from autocalib_ros.offline.synthetic.drives import drive_ring
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.calibration_json import to_json
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import Statement
from road_lines import Paint, painted_lines, post_lines, random_lines
from solved_once import evidence_once, solve_once

pytestmark = pytest.mark.solve

WIDTH, HEIGHT = 1280, 720
CENTRE = (639.5, 359.5)
NEAR_EQUIDISTANT = JointOptions(lens_prior='equidistant', single_road=False)
"""One lens family, and no other strategy for a single road: each takes time."""
JUNCTION = Junction(vehicles=16, points_per_vehicle=5)
"""Traffic on both roads, so that the markings of both are near traffic."""
LONE_ROAD = Junction(road_angles_deg=(0.0,), vehicles=40, points_per_vehicle=2, turning_fraction=0.25)
"""Traffic that gives the lens only; a few turning vehicles show that the crossing road exists."""
RING = Junction(drive=partial(drive_ring, radius_m=15.0), vehicles=22, points_per_vehicle=6)
"""Traffic that is refused: all of it turns about one point."""
PAINT = Paint()
FINE = Paint(askew_deg=0.05, noise_px=0.1)
"""Standard deviation as in an average of many images."""
OPTIONS = Options(camera_height=8.0, joint=NEAR_EQUIDISTANT)


def driven(junction: Junction) -> Evidence:
    return evidence_once(junction)


def seen(junction: Junction, lines: np.ndarray) -> Evidence:
    return replace(driven(junction), still_lines_px=lines)


def painted(junction: Junction, paint: Paint = PAINT, seed: int = 1) -> Evidence:
    """Evidence of a junction with road markings and a few posts."""
    generator = np.random.default_rng(seed)
    return seen(
        junction, np.concatenate([painted_lines(junction, generator, paint), post_lines(junction, generator, 6, paint)])
    )


def told(evidence: Evidence, lens: Camera | None = None) -> tuple[Adjustment, TrackSet, Statement] | Reason:
    """Solve from the segments alone."""
    found, tracks = fit_alone(evidence, lens)
    return found if isinstance(found, Reason) else (found.fit, tracks, found.assumption)


def fit_alone(evidence: Evidence, lens: Camera | None = None) -> tuple[MarkingsFit | Reason, TrackSet]:
    options = OPTIONS.joint
    tracks = select_tracks(evidence, options.max_tracks)
    priors = (
        [known_lens(lens)]
        if lens
        else [prior.with_loose_principal_point() for prior in lens_priors(evidence.image_size, options)]
    )
    return fit_to_markings(evidence, tracks, priors, AdjustmentConfig(priors[0], options), GateOptions()), tracks


def fit_of(evidence: Evidence, lens: Camera | None = None) -> tuple[Adjustment, TrackSet, Statement]:
    found = told(evidence, lens)
    assert not isinstance(found, Reason), found.message
    return found


def refused(evidence: Evidence) -> str:
    found = told(evidence)
    assert isinstance(found, Reason) and found.code == 'no_markings', found
    return found.message


def focal_error(fit: Adjustment, junction: Junction) -> float:
    return float(np.log(fit.state.camera.focal_px / junction.camera.focal_px))


def angle_deg(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))


def tilt_and_roll_sigmas(fit: Adjustment, tracks: TrackSet, junction: Junction) -> np.ndarray:
    """Errors of tilt and roll in their standard deviations, shape (2,)."""
    sigmas = PlaneEstimate.of(fit, tracks).sigma(lambda _, normal: tilt_and_roll_deg(normal))
    return np.abs(
        np.subtract(tilt_and_roll_deg(fit.state.rotation[:, 2]), tilt_and_roll_deg(junction.normal_in_camera)) / sigmas
    )


def require_true(
    fit: Adjustment, tracks: TrackSet, junction: Junction, *, focal: float = 0.02, normal_deg: float = 1.0
) -> None:
    """Require errors of lens and plane that are small, and covered by their standard deviations."""
    assert abs(focal_error(fit, junction)) < min(focal, 3.0 * fit.focal_sigma)
    assert fit.focal_sigma < 0.045  # the stated uncertainty must be small too
    up = fit.state.rotation[:, 2]
    assert angle_deg(up, junction.normal_in_camera) < normal_deg
    assert (tilt_and_roll_sigmas(fit, tracks, junction) < 3.0).all()
    assert PlaneEstimate.of(fit, tracks).worst_sigma_deg < 1.5
    # any heading will do, because distances on the road are compared
    across = np.cross(up, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    ground = GroundPlane(np.stack([np.cross(across, up), across, up]), junction.height_m)
    assert distance_error(fit.state.camera, ground, junction) < 0.03


LENSES = {
    'equidistant': Camera(WIDTH, HEIGHT, 560.0, CENTRE),
    'wide': Camera(WIDTH, HEIGHT, 400.0, CENTRE),
    'bulging': Camera(WIDTH, HEIGHT, 560.0, CENTRE, (0.03, 0.0, 0.0, 0.0)),
    'shrinking': Camera(WIDTH, HEIGHT, 560.0, CENTRE, (-0.03, 0.0, 0.0, 0.0)),
    'cut_out_to_the_left': Camera(WIDTH, HEIGHT, 560.0, (CENTRE[0] - 0.08 * WIDTH, CENTRE[1])),
    'cut_out_to_the_right': Camera(WIDTH, HEIGHT, 560.0, (CENTRE[0] + 0.08 * WIDTH, CENTRE[1])),
}


@pytest.mark.parametrize('lens', LENSES)
def test_lines_determine_lens_and_plane(lens: str) -> None:
    junction = replace(JUNCTION, camera=LENSES[lens])
    fit, tracks, statement = fit_of(painted(junction))
    require_true(fit, tracks, junction, focal=0.025)
    assert (statement.kind, statement.values['sigma_deg']) == ('lane_markings', pytest.approx(1.0))
    # the true principal point is far from the centre, which the prior does not know
    assert abs(fit.state.camera.principal_point_px[0] - LENSES[lens].principal_point_px[0]) < 0.03 * WIDTH


def test_exact_lines_give_the_truth() -> None:
    exact = Paint(askew_deg=0.0, lean_deg=0.0, noise_px=0.0)
    fit, _, _ = fit_of(painted(JUNCTION, exact))
    # at its middle a chord has the direction of its arc up to third-order terms
    assert abs(focal_error(fit, JUNCTION)) < 2e-3
    assert angle_deg(fit.state.rotation[:, 2], JUNCTION.normal_in_camera) < 0.1
    # conditioning on the lens must not widen the plane, even without noise
    for known in (condition_on_lens(fit), condition_on_lens(replace(fit, covariance=0.0 * fit.covariance))):
        assert PlaneEstimate(known, 1.0).worst_sigma_deg <= PlaneEstimate(fit, 1.0).worst_sigma_deg + 1e-3


def test_half_of_the_lines_may_be_clutter() -> None:
    evidence = painted(JUNCTION)
    clutter = random_lines(JUNCTION, np.random.default_rng(2), len(evidence.still_lines_px))
    lines = np.concatenate([evidence.still_lines_px, clutter])
    beside = segments_on_road(seen(JUNCTION, lines))
    assert len(beside) > 1.15 * len(segments_on_road(evidence))  # some clutter is on the road
    fit, tracks, _ = fit_of(seen(JUNCTION, lines))
    require_true(fit, tracks, JUNCTION, focal=0.03, normal_deg=1.2)


def test_posts_are_distinguished_from_lines_across_the_road() -> None:
    generator = np.random.default_rng(3)
    posts = post_lines(JUNCTION, generator, 30)
    evidence = seen(JUNCTION, np.concatenate([painted_lines(JUNCTION, generator), posts]))
    lines = segments_on_road(evidence)
    upright = (lines.ends_px[:, None] == posts).all(axis=2).any(axis=1)
    assert upright.sum() >= 8 and (~upright).sum() > 80
    grid = find_grids(lines, [lens_priors(evidence.image_size, NEAR_EQUIDISTANT)[0]])[0]
    along = grid.responsibilities.argmax(axis=0)
    assert (along[upright] == 2).mean() > 0.8
    assert (along[~upright] == 2).mean() < 0.1
    assert angle_deg(grid.rotation[:, 2], JUNCTION.normal_in_camera) < 1.0


def test_without_lines_there_is_no_solution() -> None:
    assert refused(seen(JUNCTION, np.zeros((0, 4)))).endswith(': 0 lines')


def test_lines_away_from_traffic_are_not_on_the_road() -> None:
    lone = replace(JUNCTION, road_angles_deg=(0.0,), turning_fraction=0.0, vehicles=24, points_per_vehicle=2)
    places = driven(lone).points_px
    lines = painted_lines(lone, np.random.default_rng(1))
    away = np.hypot(*(0.5 * (lines[:, None, :2] + lines[:, None, 2:]) - places).transpose(2, 0, 1)).min(axis=1)
    assert (away > 0.1 * WIDTH).sum() > 15
    assert refused(seen(lone, lines[away > 0.1 * WIDTH])).endswith(': 0 lines')


def test_lines_of_one_direction_give_no_plane() -> None:
    lines = painted_lines(JUNCTION, np.random.default_rng(1), Paint(angles_deg=(0.0,), across=False))
    assert len(lines) > 40
    message = refused(seen(JUNCTION, lines))
    assert 'they fit two planes' in message or 'along the second of two directions' in message


def test_random_lines_give_no_solution() -> None:
    message = refused(seen(JUNCTION, random_lines(JUNCTION, np.random.default_rng(0), 150)))
    assert 'they fit two planes' in message or 'of two directions' in message or 'focal length' in message


def test_distant_lines_alone_give_no_solution() -> None:
    # a horizon so low in the image that all visible road is more than ten camera heights away
    low = replace(JUNCTION, camera_from_ground=pose(8.0, 1.0, 35.0), height_m=0.9)
    lines = painted_lines(low, np.random.default_rng(1))
    assert len(lines) > 20
    refused(seen(low, lines))


@pytest.mark.parametrize('crossing_deg', [70.0, 80.0])
def test_roads_that_cross_askew_are_never_assumed_square(crossing_deg: float) -> None:
    junction = replace(JUNCTION, camera=LENSES['wide'], road_angles_deg=(0.0, crossing_deg))
    found = told(painted(junction, Paint(angles_deg=(0.0, crossing_deg))))
    if isinstance(found, Reason):
        assert found.code == 'no_markings'
    else:  # stop lines are square to their own road at any crossing angle
        require_true(*found[:2], junction, focal=0.05, normal_deg=2.0)


@pytest.mark.parametrize('width', [1100, 1280, 1440])
def test_lines_measure_the_pixel_aspect(width: int) -> None:
    found, _ = fit_alone(squeezed(painted(JUNCTION), width, HEIGHT))
    assert not isinstance(found, Reason), found.message
    measured, aspect = found.with_free_aspect, WIDTH / width
    log_aspect = float(np.log(measured.state.camera.pixel_aspect / aspect))
    sigma = float(measured.sigma(lambda state: np.array([np.log(state.camera.pixel_aspect)]))[0])
    assert sigma < 0.1
    assert abs(log_aspect) < 3.0 * sigma
    assert measured.state.camera.focal_px == pytest.approx(560.0, abs=3.0 * 560.0 * measured.focal_sigma)


def test_lines_alone_are_as_uncertain_as_lines_make_them_by_the_pixel_aspect() -> None:
    evidence = painted(RING)
    square = replace(OPTIONS, lens=LensOptions(pixel_aspect=1.0))
    known, unknown = solve_once(evidence, square), solve_once(evidence, OPTIONS)
    assert isinstance(known, Calibration) and isinstance(unknown, Calibration)
    assert known.stddev.focal_px <= unknown.stddev.focal_px < 2.0 * known.stddev.focal_px


def test_lines_give_the_pose_of_a_known_lens() -> None:
    fit, tracks, _ = fit_of(painted(JUNCTION), JUNCTION.camera)
    assert fit.state.camera == JUNCTION.camera
    assert angle_deg(fit.state.rotation[:, 2], JUNCTION.normal_in_camera) < 0.5
    assert (tilt_and_roll_sigmas(fit, tracks, JUNCTION) < 3.0).all()


def by_traffic(evidence: Evidence, tracks: TrackSet, lens: Camera) -> Solution | Reason:
    """Solve from the traffic alone with a known lens."""
    return find_solution(
        evidence,
        tracks,
        replace(OPTIONS, joint=replace(OPTIONS.joint, road_markings=False)),
        lens=lens,
    )


def test_traffic_that_shows_another_plane_contradicts_lines() -> None:
    elsewhere = replace(LONE_ROAD, camera_from_ground=pose(40.0, 1.0, 35.0))
    lines = painted_lines(elsewhere, np.random.default_rng(1))
    fit, tracks, _ = fit_of(seen(LONE_ROAD, lines))
    assert abs(focal_error(fit, LONE_ROAD)) < 0.05
    plane = by_traffic(driven(LONE_ROAD), tracks, LONE_ROAD.camera).plane
    doubt = verify_with_traffic(fit, [plane])
    assert isinstance(doubt, Reason) and doubt.code == 'markings_contradicted'
    assert 'the road of the traffic and the markings along it differ by ' in doubt.message
    assert 'joint.road_markings' in doubt.remedy
    # one contradiction outweighs an agreement
    own, own_tracks, _ = fit_of(painted(LONE_ROAD))
    agreeing = PlaneEstimate.of(own, own_tracks)
    assert not isinstance(verify_with_traffic(own, [agreeing]), Reason)
    assert verify_with_traffic(fit, [PlaneEstimate.of(fit, tracks), plane]) == doubt


def test_lines_that_no_traffic_confirms_are_refused() -> None:
    fit, tracks, _ = fit_of(painted(JUNCTION))
    doubt = verify_with_traffic(fit, [])
    assert isinstance(doubt, Reason) and doubt.code == 'markings_unconfirmed'
    assert 'no traffic confirms them' in doubt.message
    vague = PlaneEstimate.of(replace(fit, covariance=fit.covariance + np.eye(len(fit.covariance))), tracks)
    doubt = verify_with_traffic(fit, [vague])
    assert isinstance(doubt, Reason) and doubt.code == 'markings_unconfirmed'
    assert 'degrees (at most 4.5 allowed)' in doubt.message


def test_traffic_that_contradicts_keeps_its_own_result(alone: Calibration) -> None:
    elsewhere = replace(LONE_ROAD, camera_from_ground=pose(40.0, 1.0, 35.0))
    lines = painted_lines(elsewhere, np.random.default_rng(1))
    result = solve_once(seen(LONE_ROAD, lines), OPTIONS)
    assert (result.camera, result.grade, result.ground) == (alone.camera, alone.grade, alone.ground)
    # the refusal reports both attempts
    assert result.ground_refusal.message.startswith(alone.ground_refusal.message)
    assert 'the road of the traffic and the markings along it differ by ' in result.ground_refusal.message


@pytest.fixture(scope='module')
def alone() -> Calibration:
    """The result without lines."""
    result = solve_once(driven(LONE_ROAD), OPTIONS)
    assert isinstance(result, Calibration)
    return result


@pytest.fixture(scope='module')
def assumed() -> Calibration:
    result = solve_once(painted(LONE_ROAD), OPTIONS)
    assert isinstance(result, Calibration)
    return result


def ground_errors(result: Calibration, junction: Junction) -> tuple[float, float]:
    """Error of the normal in degrees, and in standard deviations of tilt and roll."""
    assert result.ground is not None
    sigma = np.hypot(result.stddev.tilt_deg, result.stddev.roll_deg)
    error = angle_deg(result.ground.normal_in_camera, junction.normal_in_camera)
    return error, float(error / sigma)


def test_lines_complete_a_lens_to_a_ground_plane(assumed: Calibration, alone: Calibration) -> None:
    assert alone.grade == 'lens'
    assert assumed.grade == 'fair' and assumed.ground_refusal is None
    assert 'lane_markings' in [statement.kind for statement in assumed.assumptions]
    assert 'markings_and_traffic_road' in [check.kind for check in assumed.checks]
    error, sigmas = ground_errors(assumed, LONE_ROAD)
    assert error < 1.0 and sigmas < 3.0
    assert abs(assumed.camera.focal_px - 560.0) < min(3.0 * assumed.stddev.focal_px, 0.02 * 560.0)
    assert assumed.stddev.focal_px < alone.stddev.focal_px
    assert distance_error(assumed.camera, assumed.ground, LONE_ROAD) < 0.03
    variances = np.diag(assumed.covariance)
    assert assumed.covariance.shape == (10, 10) and (variances >= 0).all()
    np.testing.assert_allclose(
        np.sqrt(variances[[0, 7, 8]]),
        [assumed.stddev.focal_px, assumed.stddev.tilt_deg, assumed.stddev.roll_deg],
        rtol=1e-6,
    )


def test_the_same_lines_give_the_same_numbers(assumed: Calibration) -> None:
    again = solve(painted(LONE_ROAD), OPTIONS)
    assert isinstance(again, Calibration)
    assert to_json(again) == to_json(assumed)
    np.testing.assert_array_equal(again.covariance, assumed.covariance)


def test_lines_are_not_used_if_switched_off(alone: Calibration) -> None:
    options = replace(OPTIONS, joint=replace(OPTIONS.joint, road_markings=False))
    assert to_json(solve_once(painted(LONE_ROAD), options)) == to_json(alone)


BUSY = Junction(vehicles=30, points_per_vehicle=3)
"""Traffic that determines lens and plane on its own."""
HELD = replace(OPTIONS, joint=replace(NEAR_EQUIDISTANT, k1_sigma=0.0))
"""With known distortion the few lines here constrain more than that traffic."""


@pytest.fixture(scope='module')
def by_busy_traffic() -> Calibration:
    result = solve_once(driven(BUSY), HELD)
    assert isinstance(result, Calibration) and result.grade == 'full'
    return result


def test_lines_refine_the_solution_from_traffic(by_busy_traffic: Calibration) -> None:
    result = solve_once(painted(BUSY, FINE), HELD)
    assert isinstance(result, Calibration) and result.grade == 'full'
    assert result.stddev.focal_px < 0.7 * by_busy_traffic.stddev.focal_px
    assert abs(result.camera.focal_px - 560.0) < 3.0 * result.stddev.focal_px
    error, sigmas = ground_errors(result, BUSY)
    assert error < 0.5 and sigmas < 3.0
    assert result.road_directions.shape == by_busy_traffic.road_directions.shape
    for direction, before in zip(result.road_directions, by_busy_traffic.road_directions, strict=True):
        assert angle_deg(direction, before) < 2.0
    assert [check.values['used'] for check in result.checks if check.kind == 'lane_markings'] == [True]
    assert [statement.kind for statement in result.assumptions].count('lane_markings') == 1


def test_lines_that_contradict_sufficient_traffic_cost_the_grade_and_sigma(by_busy_traffic: Calibration) -> None:
    elsewhere = replace(BUSY, camera_from_ground=pose(36.0, 4.0, 35.0))
    result = solve_once(seen(BUSY, painted_lines(elsewhere, np.random.default_rng(1))), HELD)
    assert isinstance(result, Calibration) and result.grade in ('fair', 'coarse')
    assert [check.values['used'] for check in result.checks if check.kind == 'lane_markings'] == [False]
    # neither is believed alone: the standard deviation covers both
    assert result.stddev.tilt_deg > 3 * by_busy_traffic.stddev.tilt_deg
    assert ground_errors(result, BUSY)[1] < 3.0


def test_lines_suffice_where_all_traffic_turns_about_one_point() -> None:
    result = solve_once(painted(RING), OPTIONS)
    assert isinstance(result, Calibration) and result.ground is not None
    assert abs(result.camera.focal_px - 560.0) < min(3.0 * result.stddev.focal_px, 0.03 * 560.0)
    error, sigmas = ground_errors(result, RING)
    assert error < 1.5 and sigmas < 3.0
    assert {'lane_markings', 'markings_and_traffic_normal'} & {check.kind for check in result.checks}


def test_lines_complete_a_known_lens() -> None:
    alone, result = (
        solve_once(evidence, OPTIONS, lens=LONE_ROAD.camera) for evidence in (driven(LONE_ROAD), painted(LONE_ROAD))
    )
    assert not isinstance(alone, Calibration) or alone.ground is None
    assert isinstance(result, Calibration) and result.grade == 'fair'
    assert result.camera == LONE_ROAD.camera
    error, sigmas = ground_errors(result, LONE_ROAD)
    assert error < 0.6 and sigmas < 3.0


def drawn(seed: int) -> tuple[Junction, Evidence]:
    """A junction with random pose, lens and traffic, with markings, posts and clutter."""
    generator = np.random.default_rng([seed, 77])
    junction = replace(standard_junction(generator), tracks=None, vehicles=16, points_per_vehicle=3)
    evidence = synthetic_evidence(junction, generator)
    lines = painted_lines(junction, generator, Paint(askew_deg=0.3))
    return junction, replace(
        evidence,
        still_lines_px=np.concatenate(
            [lines, post_lines(junction, generator, 6), random_lines(junction, generator, len(lines) // 3)]
        ),
    )


def test_a_second_focal_length_that_fits_as_well_is_refused() -> None:
    segments = segments_on_road(painted(JUNCTION))
    best = find_grids(segments, [lens_priors((WIDTH, HEIGHT), NEAR_EQUIDISTANT)[0]])[0]
    shorter = replace(best, camera=replace(best.camera, focal_px=0.9 * best.camera.focal_px), cost=best.cost + 4.0)
    refusal = check_ambiguity(segments, [best, shorter], GateOptions(max_sigma_focal_rel=0.05))
    assert refusal is not None and 'they fit two focal lengths, ' in refusal.message
    assert check_ambiguity(segments, [best, replace(shorter, cost=best.cost + 6.0)], GateOptions()) is None


def test_errors_are_covered_by_their_standard_deviations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(markings, 'MAX_GRID_STARTS', 1)  # more starts only find ambiguities: with one, less is refused
    ratios = []
    for seed in range(5):
        junction, evidence = drawn(seed)
        found = told(evidence)
        if isinstance(found, Reason):
            continue
        fit, tracks, _ = found
        ratios.append([abs(focal_error(fit, junction)) / fit.focal_sigma, *tilt_and_roll_sigmas(fit, tracks, junction)])
    assert len(ratios) >= 5
    assert np.max(ratios) < 3.5
    # nor may the standard deviations be far too large
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.5
