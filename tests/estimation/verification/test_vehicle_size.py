"""Vehicles of a usual size tell a wrong scale."""

from __future__ import annotations

from functools import cache

import numpy as np
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
from silhouette_evidence import driven, with_outlines
from solved_once import evidence_once, solve_once

JUNCTION = Junction()
SEEN_M = (SILHOUETTE_SHARE * USUAL_CAR_M[0], SILHOUETTE_SHARE * USUAL_CAR_M[1], 1.3)
"""What a mask of moving regions shows of a usual car."""


@cache
def cars(count: int, seed: int = 1) -> Evidence:
    """Return cars that cross the junction along either road, in either direction."""
    generator, tracks, outlines = np.random.default_rng(seed), [], []
    for number in range(count):
        heading, speed = np.pi / 2 * generator.integers(4), generator.uniform(7.0, 12.0)
        way = np.array([np.cos(heading), np.sin(heading)])
        start = np.array(JUNCTION.centre_m) + generator.uniform(-5.0, 5.0, 2) - 5.0 * speed * way
        own = driven(JUNCTION, number, 3.0 * number, SEEN_M, start, heading, speed, generator)
        tracks, outlines = [*tracks, *own[0]], [*outlines, *own[1]]
    newest_s = max(float(track.times_s[-1]) for track in tracks)
    return with_outlines(evidence_from_tracks(tracks, JUNCTION.image_size, newest_s), outlines)


@pytest.mark.parametrize('told', [0.5, 1.0, 1.7])
def test_the_ratio_is_that_of_the_told_height_and_the_true_one(told: float) -> None:
    size = measure_vehicle_size(cars(30), JUNCTION.camera, JUNCTION.normal_in_camera, told * JUNCTION.height_m)
    assert size.ratio == pytest.approx(told, rel=0.15)
    assert size.row.passed is (told == 1.0)
    values = size.statement(told * JUNCTION.height_m).values
    assert values['usual_height_m'] == pytest.approx(JUNCTION.height_m, abs=2.0 * values['usual_height_sigma_m'])


def test_few_vehicles_or_no_silhouettes_measure_nothing() -> None:
    for evidence in (cars(MIN_VEHICLES - 2), evidence_once(JUNCTION)):
        assert measure_vehicle_size(evidence, JUNCTION.camera, JUNCTION.normal_in_camera, JUNCTION.height_m) is None


@pytest.mark.solve
@pytest.mark.parametrize(('told', 'grade'), [(1.0, 'full'), (1.7, 'assumed')])
def test_a_wrong_height_costs_grade_full(told: float, grade: str) -> None:
    result = solve_once(cars(30), Options(camera_height=told * JUNCTION.height_m))
    assert isinstance(result, Calibration) and result.grade == grade
    (row,) = [row for row in result.verification if row.kind == 'vehicle_size']
    assert row.passed is (grade == 'full')
    assert ('Check the camera height' in next_step(result)) is not row.passed
    assert verdict(result).startswith('Calibrated:' if row.passed else 'Calibrated, but a check contradicts it:')
