"""Squeezed pixels, given or found by the traffic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from squeezed_evidence import squeezed

from autocalib_ros.config import LensOptions, Options
from autocalib_ros.estimation.pixels.aspect_test import MeasuredAspect
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.benchmark.monte_carlo import draw_evidence
from autocalib_ros.offline.synthetic.junction import Junction
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import ONE_FAMILY, evidence_once, solve_once

GOLDEN = Path(__file__).parents[2] / 'golden'
OPTIONS = Options(camera_height=8.0)
FOCAL_PX = 589.7
"""Of the two roads in images of 1280x720."""


@pytest.fixture(scope='module')
def two_roads() -> Evidence:
    return Evidence.load(GOLDEN / 'two_roads.npz')


def kinds(result: Calibration | Refusal) -> set[str]:
    assert isinstance(result, Calibration), result.message
    return {statement.kind for statement in (*result.assumptions, *result.checks)}


def test_square_pixels_are_not_called_squeezed(two_roads: Evidence) -> None:
    result = solve_once(two_roads, OPTIONS)
    assert result.camera.pixel_aspect == 1.0
    assert not kinds(result) & {'pixel_aspect', 'squeezed_pixels', 'nearly_square_pixels'}


def test_a_squeezed_picture_is_found_by_its_traffic_and_said() -> None:
    junction = Junction(vehicles=120)
    result = solve_once(squeezed(evidence_once(junction), 720, 576), replace(OPTIONS, joint=ONE_FAMILY))
    assert 'squeezed_pixels' in kinds(result)
    camera, sigma = result.camera, result.stddev.focal_px
    # CameraInfo is of the images as they are delivered
    assert abs(camera.matrix[1, 1] - 448.0) < 3 * sigma
    assert abs(camera.matrix[0, 0] - 315.0) < 3 * sigma
    assert camera.principal_point_px == pytest.approx((359.5, 287.5), abs=3 * max(result.stddev.principal_point_px))
    assert result.ground.normal_in_camera == pytest.approx(junction.normal_in_camera, abs=0.01)


@pytest.mark.parametrize('told', ['recording', 'given'])
def test_a_told_aspect_gives_the_calibration_of_the_picture_before_it_was_squeezed(
    two_roads: Evidence, told: str
) -> None:
    plain, pal = solve_once(two_roads, OPTIONS), squeezed(two_roads, 720, 576)
    if told == 'recording':
        result = solve_once(replace(pal, pixel_aspect=64 / 45), OPTIONS)
    else:
        result = solve_once(pal, replace(OPTIONS, lens=LensOptions(pixel_aspect=64 / 45)))
    said = next(statement for statement in result.assumptions if statement.kind == 'pixel_aspect')
    assert (said.values['aspect'], said.values['source']) == (64 / 45, told)
    # the noise of a tracked point is taken as round in other pixels, which moves the solution by less than its sigma
    assert result.camera.focal_px == pytest.approx(plain.camera.focal_px * 0.8, abs=0.8 * plain.stddev.focal_px)
    assert result.ground.normal_in_camera == pytest.approx(plain.ground.normal_in_camera, abs=0.01)
    assert result.ground.height_m == pytest.approx(8.0)


def test_a_rounded_size_widens_the_focal_length_by_the_squeeze(two_roads: Evidence) -> None:
    plain = solve_once(two_roads, replace(OPTIONS, lens=LensOptions(pixel_aspect=1.0)))
    rounded = solve_once(squeezed(two_roads, 1280, 704), OPTIONS)
    assert 'nearly_square_pixels' in kinds(rounded)
    across, down = rounded.camera.matrix[0, 0], rounded.camera.matrix[1, 1]
    assert rounded.stddev.focal_px > 1.3 * plain.stddev.focal_px
    assert abs(across - FOCAL_PX) < 3 * rounded.stddev.focal_px
    assert abs(down - FOCAL_PX * 704 / 720) < 3 * rounded.stddev.focal_px


def measured(aspect: float, sigma: float) -> MeasuredAspect:
    camera = SimpleNamespace(pixel_aspect=aspect)
    return MeasuredAspect(SimpleNamespace(state=SimpleNamespace(camera=camera), sigma=lambda _: np.array([sigma])))


def test_pixels_are_less_surely_square_the_farther_the_measured_aspect_is() -> None:
    odds = 0.05
    chances = [measured(aspect, 0.04).unexpected(1.0, odds)[0] for aspect in (1.0, 1.04, 1.08, 1.12, 1.2)]
    assert chances == sorted(chances) and chances[0] < 0.02 and chances[-1] > 0.5
    # a measurement that tells nothing leaves the prior
    chance, square = measured(1.0, 100.0).unexpected(1.0, odds)
    assert chance == pytest.approx(odds / (1 + odds), rel=0.01) and 0.1 < np.sqrt(square) < 0.14
    # one that is exact leaves nothing
    chance, square = measured(1.0, 1e-3).unexpected(1.0, odds)
    assert chance * square < 1e-6


def test_a_stated_aspect_adds_no_uncertainty(two_roads: Evidence) -> None:
    plain = solve_once(two_roads, OPTIONS)
    stated = solve_once(two_roads, replace(OPTIONS, lens=LensOptions(pixel_aspect=1.0)))
    assert stated.camera.focal_px == pytest.approx(plain.camera.focal_px)
    assert 1.05 < plain.stddev.focal_px / stated.stddev.focal_px < 1.5


@pytest.mark.parametrize('run', [5, 6])
def test_a_squeeze_that_the_traffic_hints_at_is_not_answered_with_confidence(run: int) -> None:
    junction, evidence = draw_evidence('squeezed_pixels', 0, run)
    result = solve_once(evidence, Options(camera_height=junction.height_m))
    assert not result or abs(result.camera.focal_px - junction.camera.focal_px) < 3 * result.stddev.focal_px


def test_an_undecided_aspect_of_a_squeezed_size_is_refused_with_the_option_to_set() -> None:
    skew = Evidence.load(GOLDEN / 'skew.npz')
    result = solve_once(squeezed(skew, 720, 576), replace(OPTIONS, joint=ONE_FAMILY))
    assert isinstance(result, Refusal)
    assert result.code == 'pixel_aspect'
    assert 'lens.pixel_aspect' in result.remedy
    assert '1.42 times as wide as high' in result.message


def test_the_published_method_takes_a_told_aspect(two_roads: Evidence) -> None:
    plain = solve_once(two_roads, replace(OPTIONS, method='paper'))
    pal = replace(squeezed(two_roads, 720, 576), pixel_aspect=64 / 45)
    result = solve_once(pal, replace(OPTIONS, method='paper'))
    # its focal lengths are 300 steps up to the diagonal
    assert result.camera.matrix[1, 1] == pytest.approx(0.8 * plain.camera.focal_px, rel=0.02)
    assert result.camera.matrix[0, 0] == pytest.approx(720 / 1280 * plain.camera.focal_px, rel=0.02)
