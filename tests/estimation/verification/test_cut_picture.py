"""A picture that was cut off away from its centre: told by the traffic, covered where it does not tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from many_cases import one_and_exhaustive

from autocalib_ros.config import LensOptions, Options
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig
from autocalib_ros.estimation.estimate import find_solution
from autocalib_ros.estimation.observations.track_set import select_tracks
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.estimation.straight.initialisation import solve_from_consensus
from autocalib_ros.estimation.strategies import with_cut_picture
from autocalib_ros.estimation.verification.cut_picture import compare_cut_picture
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.monte_carlo import draw_evidence
from autocalib_ros.offline.synthetic.junction import Junction
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.refusals import reason
from solved_once import ONE_FAMILY, evidence_once, solve_once

pytestmark = pytest.mark.solve

SQUARE = Options(camera_height=8.0, joint=ONE_FAMILY, lens=LensOptions(pixel_aspect=1.0))


def off_centre(right_px: float) -> Junction:
    camera = Camera(1280, 720, 560.0, (639.5 + right_px, 359.5))
    return Junction(vehicles=60, points_per_vehicle=4, camera=camera)


def solved(junction: Junction, options: Options = SQUARE) -> Calibration:
    result = solve_once(evidence_once(junction), options)
    assert isinstance(result, Calibration), result.message
    return result


def kinds(result: Calibration) -> set[str]:
    return {statement.kind for statement in result.assumptions}


def test_a_cut_picture_is_told_by_its_traffic_and_said() -> None:
    junction = off_centre(-100.0)
    result = solved(junction)
    assert 'cut_picture' in kinds(result) and result.grade == 'fair'
    said = next(statement for statement in result.assumptions if statement.kind == 'cut_picture')
    assert said.values['right_px'] == pytest.approx(-100.0, abs=3.0 * said.values['sigma_px'])
    assert 'zoomed' in said.text and 'by the traffic' in said.text
    assert abs(result.camera.focal_px - 560.0) < 3.0 * result.stddev.focal_px
    assert result.ground is not None
    assert result.ground.normal_in_camera == pytest.approx(junction.normal_in_camera, abs=0.02)


def test_a_centred_picture_is_not_called_cut() -> None:
    result = solved(off_centre(0.0))
    assert 'cut_picture' not in kinds(result) and result.grade == 'full'


def test_a_given_uncertainty_of_the_principal_point_is_taken_for_granted() -> None:
    options = replace(SQUARE, joint=replace(ONE_FAMILY, principal_point_sigma_px=20.0))
    assert 'cut_picture' not in kinds(solved(off_centre(-100.0), options))


@pytest.mark.parametrize('run', one_and_exhaustive(range(12)))
def test_bars_that_nothing_else_shows_are_inside_the_standard_deviations(run: int) -> None:
    junction, evidence = draw_evidence('one_sided_bar', 201, run)
    result = solve_once(evidence, Options(camera_height=junction.height_m))
    if isinstance(result, Calibration):
        error = abs(np.log(result.camera.focal_px / junction.camera.focal_px))
        assert error < 3.0 * result.stddev.focal_px / result.camera.focal_px


def test_after_a_refusal_the_axis_has_to_be_off_the_centre_for_sure() -> None:
    refusal = reason('horizon', fraction=0.1, limit=0.05)
    for right_px, kind in ((-100.0, 'cut_picture'), (0.0, '')):
        evidence = evidence_once(off_centre(right_px))
        found = find_solution(evidence, select_tracks(evidence, 240), SQUARE)
        assert isinstance(found, Solution) and found.by_traffic
        taken = with_cut_picture(replace(found, assumptions=()), refusal)
        if kind:
            assert isinstance(taken, Solution) and taken.reduced
            assert [statement.kind for statement in taken.assumptions] == [kind]
        else:
            assert taken is refusal


def test_the_covariance_is_the_mean_over_both_by_their_probability() -> None:
    evidence = evidence_once(off_centre(-100.0))
    tracks = select_tracks(evidence, 240)
    config = AdjustmentConfig(lens_priors(evidence.image_size, ONE_FAMILY)[0], ONE_FAMILY)
    start = solve_from_consensus(tracks, config, np.random.default_rng(0))
    assert start is not None
    cut = compare_cut_picture(start[0], tracks)
    assert cut is not None and cut.is_clear

    def variance(log_odds: float) -> np.ndarray:
        return np.diag(replace(cut, log_odds=log_odds).covered().covariance)

    never, even, surely = variance(-50.0), variance(0.0), variance(50.0)
    assert never == pytest.approx(np.diag(start[0].covariance))
    assert even == pytest.approx(0.5 * (never + surely))
    assert not replace(cut, log_odds=4.0).is_clear
