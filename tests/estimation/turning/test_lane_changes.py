"""Rotation of the plane about a single road, from lane changes on a motorway."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.benchmark.families import motorway
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from solved_once import ONE_FAMILY

pytestmark = pytest.mark.solve

SEED = 4


def watched(vehicles: int) -> tuple[Junction, Evidence]:
    """Evidence of a motorway on which a third of the vehicles change lanes; no edges, no lines."""
    generator = np.random.default_rng(SEED)
    junction = replace(motorway(generator), vehicles=vehicles)
    return junction, synthetic_evidence(junction, generator)


def solved(junction: Junction, evidence: Evidence) -> Calibration:
    options = Options(camera_height=junction.height_m, joint=replace(ONE_FAMILY, single_road=False))
    result = solve(evidence, options)
    assert isinstance(result, Calibration), result.message
    return result


@pytest.fixture(scope='module')
def many() -> tuple[Junction, Calibration]:
    junction, evidence = watched(350)
    return junction, solved(junction, evidence)


def test_many_lane_changes_determine_the_plane(many):
    junction, result = many
    assert result.grade in ('fair', 'coarse') and result.ground is not None
    cosine = abs(float(result.ground.normal_in_camera @ junction.camera_from_ground[:, 2]))
    error_deg, sigma_deg = np.degrees(np.arccos(min(cosine, 1.0))), result.stddev.tilt_deg
    assert error_deg < 3.0 * np.hypot(sigma_deg, result.stddev.roll_deg)
    assert error_deg < 2.0
    assert sigma_deg < 1.5


def test_they_are_reported_with_their_standard_deviation(many):
    (named,) = (statement for statement in many[1].assumptions if statement.kind == 'lane_changes')
    assert named.values['vehicles'] >= 8 and 0.0 < named.values['sigma_deg'] < 1.5


def test_few_lane_changes_do_not():
    result = solved(*watched(25))
    assert result.grade == 'lens' and result.ground is None
    assert result.ground_refusal.code == 'one_direction'
