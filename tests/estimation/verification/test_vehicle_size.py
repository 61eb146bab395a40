"""The size of the vehicles reveals a wrong scale."""

from __future__ import annotations

from functools import cache

import pytest

from autocalib_ros.config import Options
from autocalib_ros.estimation.verification.vehicle_size import (
    MIN_VEHICLES,
    SILHOUETTE_SHARE,
    USUAL_CAR_M,
    measure_vehicle_size,
)
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.synthetic.junction import Junction, evidence_from_tracks
from autocalib_ros.report.text import next_step, verdict
from autocalib_ros.results.calibration import Calibration
from silhouette_evidence import crossing_bodies, with_outlines
from solved_once import ONE_FAMILY, evidence_once, solve_once

JUNCTION = Junction()
SEEN_M = (SILHOUETTE_SHARE * USUAL_CAR_M[0], SILHOUETTE_SHARE * USUAL_CAR_M[1], 1.3)
"""What a mask of moving regions shows of a usual car."""


@cache
def cars(count: int) -> Evidence:
    """Return evidence of usual cars that cross the junction."""
    tracks, outlines = crossing_bodies(JUNCTION, 0, count, SEEN_M, (7.0, 12.0))
    newest_s = max(float(track.times_s[-1]) for track in tracks)
    return with_outlines(evidence_from_tracks(tracks, JUNCTION.image_size, newest_s), outlines)


@pytest.mark.parametrize('height_ratio', [0.5, 1.0, 1.7])
def test_vehicle_size_is_proportional_to_the_given_height(height_ratio: float) -> None:
    given_m = height_ratio * JUNCTION.height_m
    size = measure_vehicle_size(cars(30), JUNCTION.camera, JUNCTION.normal_in_camera, given_m)
    assert size.ratio == pytest.approx(height_ratio, rel=0.15)
    assert size.row.passed is (height_ratio == 1.0)
    values = size.statement(given_m).values
    assert (
        values['width_m'] == pytest.approx(1.8 * size.ratio)
        and 'm wide, 1.8 m is usual' in size.statement(given_m).text
    )
    assert values['usual_height_m'] == pytest.approx(JUNCTION.height_m, abs=2.0 * values['usual_height_sigma_m'])


def test_few_vehicles_or_no_silhouettes_measure_nothing() -> None:
    for evidence in (cars(MIN_VEHICLES - 2), evidence_once(JUNCTION)):
        assert measure_vehicle_size(evidence, JUNCTION.camera, JUNCTION.normal_in_camera, JUNCTION.height_m) is None


@pytest.mark.solve
@pytest.mark.parametrize(('height_ratio', 'grade'), [(1.0, 'full'), (1.5, 'coarse')])
def test_a_wrong_height_costs_the_grade(height_ratio: float, grade: str) -> None:
    result = solve_once(cars(30), Options(camera_height=height_ratio * JUNCTION.height_m, joint=ONE_FAMILY))
    assert isinstance(result, Calibration) and result.grade == grade
    (row,) = [row for row in result.verification if row.kind == 'vehicle_size']
    assert row.passed is (grade == 'full')
    assert ('Check the camera height' in next_step(result)) is not row.passed
    doubt = '' if row.passed else ' (grade coarse, but a check contradicts it)'
    assert verdict(result).startswith(f'Calibrated{doubt}:')


def test_the_usual_size_gives_the_height_where_no_length_is_told() -> None:
    at = JUNCTION.camera, JUNCTION.normal_in_camera
    scale = measure_vehicle_size(cars(30), *at, 5.0).scale(*at, 5.0)
    assert scale.height(*at) == pytest.approx(JUNCTION.height_m, rel=0.15)
    assert 0.13 < scale.sigma / scale.height(*at) < 0.17 and scale.kind == 'scale_vehicles'


@pytest.mark.solve
def test_without_a_length_the_plane_is_coarse_and_names_the_vehicles() -> None:
    result = solve_once(cars(30), Options(joint=ONE_FAMILY))
    assert isinstance(result, Calibration) and result.grade == 'coarse'
    assert result.ground.height_m == pytest.approx(JUNCTION.height_m, abs=2.0 * result.stddev.height_m)
    (said,) = [statement.text for statement in result.assumptions if statement.kind == 'scale_vehicles']
    assert said.startswith('scale from the size of') and 'as no length is given' in said
    assert all(row.kind != 'vehicle_size' for row in result.verification)  # it would test itself
