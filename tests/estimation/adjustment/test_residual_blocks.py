"""Residual blocks of straight tracks: rows agree with finite differences of their residuals."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import assign_roads
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.adjustment.problem import Problem
from autocalib_ros.estimation.observations.track_set import UnprojectedTracks, select_tracks
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence

JUNCTION = Junction(turning_fraction=0.0)
STATE = AdjustmentState(JUNCTION.camera, JUNCTION.camera_from_ground, np.radians([0.0, 90.0]))


@pytest.fixture(scope='module')
def problem() -> Problem:
    tracks = select_tracks(synthetic_evidence(JUNCTION, np.random.default_rng(1)), 100)
    labels, _ = assign_roads(STATE, UnprojectedTracks.through(STATE.camera, tracks))
    config = AdjustmentConfig(lens_priors((1280, 720), JointOptions())[0].with_free_k2(), JointOptions(), 8.0)
    return Problem(STATE, tracks, labels, config)


def test_gradients_match_finite_differences(problem: Problem) -> None:
    rows, step = problem.linearise(), 1e-5
    for index, unit in enumerate(np.eye(problem.parameters.size)):
        ahead, behind = (problem.at(sign * step * unit)[1] for sign in (1.0, -1.0))
        numeric = 0.5 * problem.dof * (ahead - behind) / (2 * step)
        scale = np.abs(numeric).max()
        np.testing.assert_allclose(rows.gradient[:, index], numeric, rtol=1e-2, atol=5e-3 * scale)


def test_rows_at_the_base_are_those_of_a_step_of_zero(problem: Problem) -> None:
    np.testing.assert_allclose(problem.linearise().squared, problem.at(np.zeros(problem.parameters.size))[1])
