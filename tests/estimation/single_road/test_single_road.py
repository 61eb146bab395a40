"""Lens and plane of a single road: the posterior over focal length, curvature and turn."""

from dataclasses import replace

import numpy as np
import pytest
from pinhole_road import PINHOLE, ROAD, SIZE

from autocalib_ros.config import JointOptions, LensOptions, Options
from autocalib_ros.estimation.adjustment.bundle_adjustment import evaluate_at
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState, Parameterisation
from autocalib_ros.estimation.observations.track_set import select_tracks
from autocalib_ros.estimation.single_road.barrel_lens import LensChoice, barrel_coefficients
from autocalib_ros.estimation.single_road.bent_road import across_and_up
from autocalib_ros.estimation.single_road.direction_mixture import (
    STILL_SEGMENTS,
    DirectionMixture,
)
from autocalib_ros.estimation.single_road.road_solution import SingleRoad
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.monte_carlo import draw_evidence
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.refusals import reason
from solved_once import solve_once


def scenery(junction: Junction, generator: np.random.Generator, count: int = 40) -> np.ndarray:
    """Return image segments (n, 4) across and upright to the road of a junction, with 0.3 px of noise."""
    height = junction.height_m
    places = np.column_stack([generator.uniform(8, 40, 2 * count), generator.uniform(-8, 8, 2 * count)])
    steps = np.repeat([[0.0, 2.0, 0.0], [0.0, 0.0, 2.0]], count, axis=0)
    starts = np.column_stack([places, np.zeros(len(places))])
    ends = []
    for points in (starts, starts + steps):
        in_camera = (points - [0.0, 0.0, height]) @ junction.camera_from_ground.T
        pixels, valid = junction.camera.project(in_camera)
        ends.append(np.where(valid[:, None], pixels + generator.normal(0, 0.3, pixels.shape), np.nan))
    segments = np.hstack(ends)
    inside = (segments >= 0).all(axis=1) & (segments <= np.tile(SIZE, 2)).all(axis=1)
    return segments[inside & (np.hypot(*(segments[:, 2:] - segments[:, :2]).T) > 12)]


def test_coefficients_are_those_of_the_classical_projections() -> None:
    assert barrel_coefficients(0.0) == (0.0, 0.0, 0.0, 0.0)
    assert barrel_coefficients(1.0) == pytest.approx((1 / 3, 2 / 15, 17 / 315, 62 / 2835))
    theta, kappa = 0.6, 0.4
    exact = np.tan(np.sqrt(kappa) * theta) / np.sqrt(kappa)
    lens = Camera(*SIZE, 1.0, (0.0, 0.0), barrel_coefficients(kappa))
    assert float(lens.radius(np.array(theta))) == pytest.approx(exact, rel=1e-4)


def test_a_given_focal_length_limits_those_that_are_tried() -> None:
    sheet = LensOptions(focal_px=900.0)
    given = LensChoice(lens_priors(SIZE, JointOptions(), known=sheet)[0], JointOptions())
    assert given.focal_lengths().min() > 0.7 * 900 and given.focal_lengths().max() < 1.4 * 900
    free = LensChoice(lens_priors(SIZE, JointOptions())[0], JointOptions())
    assert free.focal_lengths().min() < 410 and free.focal_lengths().max() > 4000
    # usual fields of view are the more probable ones
    assert free.log_prior(1400.0, 1.0) > free.log_prior(4000.0, 1.0) + 1.0


def test_longer_lenses_go_on_from_the_longest_to_a_field_of_view_of_four_degrees() -> None:
    prior = lens_priors(SIZE, JointOptions())[0]
    choice = LensChoice(prior.with_unknown_focal(), JointOptions())
    usual = choice.focal_lengths()
    longer = choice.longer_than(usual)
    np.testing.assert_allclose(np.diff(np.log(np.append(usual, longer))), np.log(usual[1] / usual[0]), rtol=1e-6)
    assert longer[-2] < 640.0 / np.tan(np.radians(2.0)) <= longer[-1]
    told = lens_priors(SIZE, JointOptions(focal_prior_px=900.0, focal_sigma_px=90.0))[0]
    told_choice = LensChoice(told, JointOptions())
    assert not len(told_choice.longer_than(told_choice.focal_lengths()))


@pytest.mark.solve
def test_a_telephoto_lens_is_not_taken_for_the_longest_of_usual_ones() -> None:
    junction, evidence = draw_evidence('single_road_telephoto', 1, 0)  # 12 degrees across
    found = solve_once(evidence, Options(camera_height=junction.height_m, lens=LensOptions(pixel_aspect=1.0))).candidate
    sigma = found.stddev.focal_px / found.camera.focal_px
    assert abs(np.log(found.camera.focal_px / junction.camera.focal_px)) < 2.0 * sigma


def test_directions_about_a_road_are_level_without_a_turn() -> None:
    along = pose(20.0, 0.0, 30.0)[:, 0]
    across, up = across_and_up(along, np.array([0.0, 0.1]))
    tilt, roll = tilt_and_roll_deg(up[0])
    assert (tilt, abs(roll)) == (pytest.approx(20.0), pytest.approx(0.0, abs=1e-9))
    np.testing.assert_allclose(across @ along, 0.0, atol=1e-12)
    assert abs(tilt_and_roll_deg(up[1])[1]) > 1.0


def test_the_likelihood_of_the_scenery_is_highest_at_the_true_turn_and_lens() -> None:
    generator = np.random.default_rng(0)
    ends = scenery(ROAD, generator)
    mixture = DirectionMixture(STILL_SEGMENTS, ends, np.ones(len(ends)))
    along = ROAD.camera_from_ground[:, 0]
    turns = np.radians(np.arange(-10.0, 10.1, 0.5))
    by_lens = {}
    for factor in (0.7, 1.0, 1.4):
        camera = replace(PINHOLE, focal_px=factor * PINHOLE.focal_px)
        seen_at = PINHOLE.project(along[None])[0]
        through, _ = camera.unproject(seen_at)
        by_lens[factor] = mixture.log_likelihood(mixture.through(camera, through[0]), turns)
    _, up = across_and_up(along, turns)
    found = up[np.argmax(by_lens[1.0])]
    assert float(found @ ROAD.normal_in_camera) > np.cos(np.radians(1.0))
    assert by_lens[1.0].max() > max(by_lens[0.7].max(), by_lens[1.4].max()) + 5.0


@pytest.fixture(scope='module')
def seen_road() -> Evidence:
    """Traffic of the road, and its scenery."""
    generator = np.random.default_rng(1)
    return replace(synthetic_evidence(ROAD, generator), still_lines_px=scenery(ROAD, generator))


def found_with(evidence: Evidence, joint: JointOptions | None = None, **lens: float) -> Calibration:
    lens_options = LensOptions(pixel_aspect=1.0, **lens)
    options = Options(camera_height=ROAD.height_m, joint=joint or JointOptions(), lens=lens_options)
    found = solve_once(evidence, options).candidate
    assert found is not None and found.ground is not None
    return found


@pytest.mark.solve
@pytest.mark.parametrize(('focal_px', 'kind'), [(0.0, 'field_of_view'), (1050.0, 'focal_given')])
def test_a_road_without_curvature_gives_what_its_scenery_shows(seen_road: Evidence, focal_px: float, kind: str) -> None:
    found = found_with(seen_road, focal_px=focal_px)
    sigma = found.stddev.focal_px / found.camera.focal_px
    assert abs(np.log(found.camera.focal_px / PINHOLE.focal_px)) < 2.5 * sigma < 0.5
    error = np.subtract(tilt_and_roll_deg(found.ground.normal_in_camera), tilt_and_roll_deg(ROAD.normal_in_camera))
    assert (np.abs(error) < 2.5 * np.array([found.stddev.tilt_deg, found.stddev.roll_deg])).all()
    assert {'level_camera', kind} <= {statement.kind for statement in found.assumptions}


@pytest.mark.solve
def test_a_field_of_view_is_as_good_as_the_focal_length() -> None:
    evidence = synthetic_evidence(ROAD, np.random.default_rng(2))
    found = found_with(evidence, hfov_deg=2 * float(np.degrees(np.arctan(640 / PINHOLE.focal_px))))
    assert abs(np.log(found.camera.focal_px / PINHOLE.focal_px)) < 2 * found.stddev.focal_px / found.camera.focal_px
    # 10 %, and one in five that it is another one
    assert found.stddev.focal_px < 0.2 * found.camera.focal_px and found.grade == 'coarse'
    (given,) = [statement for statement in found.assumptions if statement.kind == 'view_given']
    assert given.text.startswith('field of view across the image 65.2')


@pytest.mark.solve
def test_a_wider_uncertainty_of_the_focal_length_makes_lengths_less_certain(seen_road: Evidence) -> None:
    sure = found_with(seen_road, JointOptions(focal_prior_px=1000.0, focal_sigma_px=20.0))
    unsure = found_with(seen_road, focal_px=1050.0)  # to a tenth
    assert sure.stddev.ground.worst < unsure.stddev.ground.worst
    assert 'focal_given' in {statement.kind for statement in sure.assumptions}


@pytest.mark.solve
def test_a_focal_length_that_the_road_shows_is_not_doubted(seen_road: Evidence) -> None:
    (row,) = [row for row in found_with(seen_road, focal_px=1050.0).verification if row.kind == 'given_focal']
    assert row.passed and not row.contradicts


def test_a_focal_length_that_the_road_contradicts_is_doubted() -> None:
    state = AdjustmentState(PINHOLE, ROAD.camera_from_ground, np.zeros(1))
    tracks = select_tracks(synthetic_evidence(ROAD, np.random.default_rng(1)), 20)

    def road(sheet: LensOptions, sigma: float) -> SingleRoad:
        """A road of which a solution gave the focal length of the truth."""
        prior = lens_priors(SIZE, JointOptions(), known=sheet)[0]
        config = AdjustmentConfig(prior, JointOptions())
        fit = evaluate_at(state, tracks, config, sigma**2 * np.eye(Parameterisation(state, config).size))
        return SingleRoad(fit, LensChoice(prior, JointOptions()), (), (), ())

    free = road(LensOptions(), 0.15)
    for factor, passed in ((1.05, True), (2.5, False)):
        given = road(LensOptions(focal_px=factor * PINHOLE.focal_px), 0.1)
        compared = given.compared_with_given(free, tracks)
        (row,) = compared.rows
        assert row.kind == 'given_focal' and row.passed is passed and row.contradicts is not passed
        (said,) = [statement.values for statement in compared.checks]
        assert said['given_px'] == pytest.approx(factor * PINHOLE.focal_px) and (said['believed'] > 0.5) is passed
        # the standard deviation covers a wrong number
        mixed_px = compared.fit.state.camera.focal_px
        assert abs(np.log(mixed_px / PINHOLE.focal_px)) < 2.0 * compared.fit.focal_sigma
    assert given.compared_with_given(reason('no_direction', tracks=20), tracks) is given


@pytest.mark.solve
def test_the_option_switches_it_off() -> None:
    evidence = synthetic_evidence(ROAD, np.random.default_rng(2))
    joint = JointOptions(single_road=False)
    result = solve_once(evidence, Options(camera_height=ROAD.height_m, joint=joint, lens=LensOptions(pixel_aspect=1.0)))
    assert not isinstance(result, Calibration) and result.candidate is None
