"""How far two solutions are apart in focal length and ground normal, and how far they should be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.covariance import propagate_sigma
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.geometry.ground_plane import unsigned_angle_deg

REGULARISING_INFORMATION = 1e-9
"""Information that is added along every parameter, so that what nothing tells has a large variance and not none."""


@dataclass(frozen=True)
class SolutionDifference:
    """Of two solutions."""

    focal: float
    """Of the focal lengths, relative."""
    normal_deg: float
    """Angle between the ground normals, degrees, whichever side they point to."""
    sigmas_of_each: np.ndarray
    """Standard deviations of what is compared by either solution, shape (solutions, 2)."""

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviations (2,) of the two differences, were the solutions independent."""
        return np.hypot(*self.sigmas_of_each)

    def exceeds(self, sigmas: float) -> bool:
        """Whether either is larger than so many standard deviations of the less sure solution.

        Two solutions by the same evidence, the one using it better, differ by less than that (Hausman 1978).
        """
        return bool((np.array([self.focal, self.normal_deg]) > sigmas * self.sigmas_of_each.max(axis=0)).any())


def compare_solutions(first: Adjustment, second: Adjustment) -> SolutionDifference:
    """Compare two solutions."""
    focal = abs(float(np.log(first.state.camera.focal_px / second.state.camera.focal_px)))
    return SolutionDifference(
        focal,
        unsigned_angle_deg(first.state.rotation[:, 2], second.state.rotation[:, 2]),
        np.array([_focal_and_normal_sigma(fit.sigma(_change_from(fit))) for fit in (first, second)]),
    )


def expected_half_differences(whole: Adjustment, *halves: Adjustment) -> np.ndarray:
    """Standard deviations (2,) of the differences between halves by what the whole says of itself.

    Two halves that tell alike differ by twice the whole's deviation, unequal ones by more; how unequal they are, the
    curvature of their costs tells, which rests on more than the few vehicles of a half.
    """
    in_whole, *in_halves = (
        _focal_and_normal_sigma(
            propagate_sigma(
                lambda step, fit=fit: _change_from(fit)(fit.problem.parameters.state(step)),
                fit.problem.parameters.size,
                _curvature_covariance(fit),
            )
        )
        for fit in (whole, *halves)
    )
    return (
        _focal_and_normal_sigma(whole.sigma(_change_from(whole))) * np.hypot(*in_halves) / np.maximum(in_whole, 1e-12)
    )


def _change_from(fit: Adjustment) -> Callable[[AdjustmentState], np.ndarray]:
    """Log focal length, and how the normal has moved from that of a fit in degrees, shape (4,)."""
    normal = fit.state.rotation[:, 2]
    return lambda state: np.array([np.log(state.camera.focal_px), *np.degrees(np.cross(normal, state.rotation[:, 2]))])


def _focal_and_normal_sigma(sigmas: np.ndarray) -> np.ndarray:
    """Standard deviations (2,) of focal length and normal out of those of `_change_from` (4,)."""
    return np.array([sigmas[0], np.linalg.norm(sigmas[1:])])


def _curvature_covariance(fit: Adjustment) -> np.ndarray:
    """Covariance (parameters, parameters) that the curvature of the cost alone would give."""
    _, prior = fit.problem.parameters.prior_gradient(fit.state.camera)
    return np.linalg.inv(fit.information + np.diag(prior) + REGULARISING_INFORMATION * np.eye(len(prior)))
