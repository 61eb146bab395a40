"""The verification table of whole solutions, and what a contradicted principal point costs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from autocalib_ros.config import GateOptions, Options
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.solution import Solution, is_better
from autocalib_ros.estimation.solution_rows import with_solution_rows
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.refusals import reason
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


class UncertainPlane:
    """A camera 30 degrees down, with independent errors of focal length and tilt."""

    def __init__(self, focal_sigma: float, tilt_sigma_deg: float) -> None:
        self.lens_and_normal = Camera(*SIZE, 600.0, (639.5, 359.5)), self._up(30.0)
        self.worst_sigma_deg, self._focal_sigma = tilt_sigma_deg, focal_sigma

    @staticmethod
    def _up(tilt_deg: float) -> np.ndarray:
        tilt = np.radians(tilt_deg)
        return np.array([0.0, -np.cos(tilt), -np.sin(tilt)])

    def covariance(self, function) -> np.ndarray:
        camera, up = self.lens_and_normal
        one_sigma = [(replace(camera, focal_px=600.0 * (1 + 1e-3)), up), (camera, self._up(30.0 + 1e-3))]
        steps = np.array([function(*state) - function(camera, up) for state in one_sigma]) / 1e-3
        steps *= np.array([[self._focal_sigma], [self.worst_sigma_deg]])
        return steps.T @ steps


def solution_with_plane(focal_sigma: float, tilt_sigma_deg: float) -> Solution:
    return replace(solution_with_point(639.5), plane=UncertainPlane(focal_sigma, tilt_sigma_deg))


def test_the_better_solution_has_the_more_certain_lengths_on_the_road() -> None:
    by_lens, by_plane = solution_with_plane(0.05, 1.3), solution_with_plane(0.13, 1.0)
    assert is_better(by_lens, by_plane) and not is_better(by_plane, by_lens)
    assert is_better(solution_with_plane(0.05, 1.0), by_lens)
    no_plane = replace(solution_with_plane(0.01, 0.1), plane_refusal=reason('plane_uncertain', 'level_road'))
    assert not is_better(no_plane, by_lens) and is_better(by_lens, no_plane)


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
