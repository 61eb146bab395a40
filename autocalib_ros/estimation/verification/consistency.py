"""How far two solutions are apart in focal length and ground normal, and how far they should be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import JointFit
from autocalib_ros.estimation.adjustment.covariance import propagate
from autocalib_ros.estimation.adjustment.parameters import State
from autocalib_ros.geometry.ground_plane import undirected_deg

UNTOLD = 1e-9
"""Information that is added along every parameter, so that what nothing tells has a large variance and not none."""


@dataclass(frozen=True)
class Differences:
    """Of two solutions."""

    focal: float
    """Of the focal lengths, relative."""
    normal_deg: float
    """Angle between the ground normals, degrees, whichever side they point to."""
    of_each: np.ndarray
    """Standard deviations of what is compared by either solution, shape (solutions, 2)."""

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviations (2,) of the two differences, were the solutions independent."""
        return np.hypot(*self.of_each)

    def beyond(self, sigmas: float) -> bool:
        """Whether either is larger than so many standard deviations of the less sure solution.

        Two solutions by the same evidence, the one using it better, differ by less than that (Hausman 1978).
        """
        return bool((np.array([self.focal, self.normal_deg]) > sigmas * self.of_each.max(axis=0)).any())


def differences(first: JointFit, second: JointFit) -> Differences:
    """Compare two solutions."""
    focal = abs(float(np.log(first.state.camera.focal_px / second.state.camera.focal_px)))
    return Differences(focal, undirected_deg(first.state.rotation[:, 2], second.state.rotation[:, 2]),
                       np.array([_both(fit.sigma(_moved_from(fit))) for fit in (first, second)]))


def expected_of_halves(whole: JointFit, *halves: JointFit) -> np.ndarray:
    """Standard deviations (2,) of the differences between halves by what the whole says of itself.

    Two halves that tell alike differ by twice the whole's deviation, unequal ones by more; how unequal they are, the
    curvature of their costs tells, which rests on more than the few vehicles of a half.
    """
    in_whole, *in_halves = (_both(propagate(
        lambda step, fit=fit: _moved_from(fit)(fit.problem.steps.state(step)), fit.problem.steps.size,
        _by_curvature(fit))) for fit in (whole, *halves))
    return _both(whole.sigma(_moved_from(whole))) * np.hypot(*in_halves) / np.maximum(in_whole, 1e-12)


def _moved_from(fit: JointFit) -> Callable[[State], np.ndarray]:
    """Log focal length, and how the normal has moved from that of a fit in degrees, shape (4,)."""
    normal = fit.state.rotation[:, 2]
    return lambda state: np.array([np.log(state.camera.focal_px),
                                   *np.degrees(np.cross(normal, state.rotation[:, 2]))])


def _both(sigmas: np.ndarray) -> np.ndarray:
    """Standard deviations (2,) of focal length and normal out of those of `_moved_from` (4,)."""
    return np.array([sigmas[0], np.linalg.norm(sigmas[1:])])


def _by_curvature(fit: JointFit) -> np.ndarray:
    """Covariance (parameters, parameters) that the curvature of the cost alone would give."""
    _, prior = fit.problem.steps.prior_gradient(fit.state.camera)
    return np.linalg.inv(fit.information + np.diag(prior) + UNTOLD * np.eye(len(prior)))
