"""The verification table of whole solutions, and what a contradicted principal point costs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from autocalib_ros.config import GateOptions, Options
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.estimation.solution_rows import with_solution_rows
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from solved_once import solve_once

SIZE = (1280, 720)


def solution_with_point(x_px: float) -> Solution:
    """Return a solution with a principal point; of the rest, what the rows read."""
    prior = lens_priors(SIZE, Options().joint, None, 1.0)[0]
    state = SimpleNamespace(camera=replace(prior.start(600.0), principal_point_px=(x_px, 359.5)))
    problem = SimpleNamespace(config=SimpleNamespace(prior=prior))
    fit = SimpleNamespace(state=state, problem=problem, focal_sigma=0.01)
    plane = SimpleNamespace(fraction_below_horizon=1.0, worst_sigma_deg=0.2, assumed=None)
    return Solution(fit, plane, np.zeros(3), None, (), (), None)


@pytest.mark.parametrize(('sigmas', 'contradicted'), [(1.0, False), (3.4, False), (-3.6, True)])
def test_a_principal_point_far_from_the_centre_lowers_the_grade(sigmas: float, contradicted: bool) -> None:
    prior = lens_priors(SIZE, Options().joint, None, 1.0)[0]
    found = with_solution_rows(solution_with_point(639.5 + sigmas * prior.sigma[1]), GateOptions())
    assert found.reduced is contradicted
    (row,) = [row for row in found.comparisons if row.kind == 'principal_point_prior']
    assert row.passed is not contradicted and row.value == pytest.approx(abs(sigmas))


@pytest.mark.solve
def test_a_junction_has_a_table_of_what_was_verified() -> None:
    evidence = synthetic_evidence(Junction(), np.random.default_rng(0))
    result = solve_once(evidence, Options(camera_height=8.0))
    assert isinstance(result, Calibration)
    rows = {row.kind: row for row in result.verification}
    assert len(rows) == len(result.verification) and all(row.passed for row in result.verification)
    assert {'focal_sigma', 'plane_sigma', 'k1_prior', 'straight_share', 'halves_focal', 'pixel_aspect'} <= rows.keys()
    assert rows['focal_sigma'].value == pytest.approx(result.stddev.focal_px / result.camera.focal_px, rel=1e-6)
    assert rows['plane_sigma'].value == pytest.approx(max(result.stddev.tilt_deg, result.stddev.roll_deg), rel=1e-6)
