"""Consistency of two solutions: their differences in focal length and ground normal, and the expected differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import special
from scipy.spatial.transform import Rotation

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.covariance import propagate_sigma
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.geometry.ground_plane import unsigned_angle_deg

REGULARISING_INFORMATION = 1e-9
"""Information added along every parameter, so that an undetermined parameter has a large variance and the inverse
exists."""

HALF_MODEL_SIGMAS = (0.01, np.radians(0.3))
"""Standard deviations of the difference between two halves that no residual shows: log focal length, and rotation of
the camera about each axis in radians (their traffic covers other parts of the road, which is not planar)."""
HALF_CONTRADICTION = 3e-3
"""Probability that two consistent halves differ by more."""
TURNED_PROBABILITY = 0.05
"""Probability, before the traffic is compared, that the camera turned between two halves unnoticed: where the still
scene has few corners, as at night, nothing else shows it. Judgement."""
TURNED_SIGMA_RAD = np.radians(3.0)
"""Standard deviation of such a turn about each axis: smaller ones are followed, larger ones change the whole picture.
Judgement."""


@dataclass(frozen=True)
class SolutionDifference:
    """Differences between two solutions."""

    focal: float
    """Relative difference of the focal lengths."""
    normal_deg: float
    """Angle between the ground normals without regard to their sign, degrees."""
    sigmas_of_each: np.ndarray
    """Standard deviations of focal length and normal in either solution, shape (solutions, 2)."""

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviations (2,) of the two differences between independent solutions."""
        return np.hypot(*self.sigmas_of_each)

    @property
    def in_sigmas(self) -> float:
        """The larger of both differences, in standard deviations of the less certain solution.

        Two estimates from the same evidence, one of them efficient, differ by less than that: the variance of the
        difference is the difference of the variances (Hausman 1978, "Specification tests in econometrics").
        """
        sigmas = np.maximum(self.sigmas_of_each.max(axis=0), 1e-12)
        return float((np.array([self.focal, self.normal_deg]) / sigmas).max())


def compare_solutions(first: Adjustment, second: Adjustment) -> SolutionDifference:
    """Return the differences between two solutions."""
    focal = abs(float(np.log(first.state.camera.focal_px / second.state.camera.focal_px)))
    return SolutionDifference(
        focal,
        unsigned_angle_deg(first.state.rotation[:, 2], second.state.rotation[:, 2]),
        np.array([_focal_and_normal_sigma(fit.sigma(_change_from(fit))) for fit in (first, second)]),
    )


def half_change(first: Adjustment, second: Adjustment) -> np.ndarray:
    """Return the difference of log focal length and of the rotation of the camera (radians) of two halves, (4,)."""
    return _pose_about(first, second.state)


def _pose_about(origin: Adjustment, state: AdjustmentState) -> np.ndarray:
    """Return log focal length and rotation vector of a state, each from that of a fit, shape (4,)."""
    focal = np.log(state.camera.focal_px / origin.state.camera.focal_px)
    return np.array([focal, *Rotation.from_matrix(origin.state.rotation.T @ state.rotation).as_rotvec()])


@dataclass(frozen=True)
class HalfDifference:
    """The difference between the poses and focal lengths of two halves of the traffic, with what explains it."""

    sigmas: float
    """The difference in standard deviations."""
    limit: float
    """Its limit: two halves of one view exceed it with the probability `HALF_CONTRADICTION`."""
    turned: float
    """Probability that the camera turned in between."""


def half_difference(
    first: Adjustment, second: Adjustment, vehicles: int, common: np.ndarray | float = 0.0
) -> HalfDifference | None:
    """Return the difference between the solutions of two halves of at least `vehicles` vehicles each.

    Focal length and all of the rotation of the camera against the roads together, with their covariance: a camera that
    turned in between turns about an axis of which traffic is far more certain than of others. Hotelling's T squared
    (1931), whose limit allows for covariances that are estimated from few vehicles, those of the smaller half. None
    where a half determines nothing. `common` is the covariance (4, 4) of the difference by what both halves share.
    """

    def pose(state: AdjustmentState) -> np.ndarray:
        return _pose_about(first, state)

    covariance = first.covariance_of(pose) + second.covariance_of(pose) + common
    compared = 1 + len(first.problem.parameters.axes)
    if not np.isfinite(covariance).all() or vehicles <= compared:
        return None
    change = half_change(first, second)
    one_view = covariance + np.diag(np.square([HALF_MODEL_SIGMAS[0], *3 * (HALF_MODEL_SIGMAS[1],)]))
    two_views = one_view + np.diag(np.square([0.0, *3 * (TURNED_SIGMA_RAD,)]))
    scale = compared * (vehicles - 1) / (vehicles - compared)
    limit = float(np.sqrt(scale * special.fdtri(compared, vehicles - compared, 1.0 - HALF_CONTRADICTION)))
    log_odds = special.logit(TURNED_PROBABILITY) + (
        _log_density(change, two_views, vehicles - compared) - _log_density(change, one_view, vehicles - compared)
    )
    return HalfDifference(
        float(np.sqrt(change @ np.linalg.solve(one_view, change))), limit, float(special.expit(log_odds))
    )


def _log_density(change: np.ndarray, covariance: np.ndarray, freedom: int) -> float:
    """Log density of Student's distribution, up to a constant, at a difference (n,) with its covariance (n, n)."""
    square = float(change @ np.linalg.solve(covariance, change))
    return float(-0.5 * np.linalg.slogdet(covariance)[1] - 0.5 * (freedom + len(change)) * np.log1p(square / freedom))


def expected_half_differences(whole: Adjustment, *halves: Adjustment) -> np.ndarray:
    """Return the standard deviations (2,) of the differences between halves that the sigma of the whole implies.

    Two equally informative halves differ by twice the standard deviation of the whole, unequal ones by more. How
    informative each half is follows from the curvature of its cost, which is more stable than a jackknife over the
    few vehicles of a half.
    """
    in_whole, *in_halves = (_curvature_sigma(fit) for fit in (whole, *halves))
    return (
        _focal_and_normal_sigma(whole.sigma(_change_from(whole))) * np.hypot(*in_halves) / np.maximum(in_whole, 1e-12)
    )


def _curvature_sigma(fit: Adjustment) -> np.ndarray:
    """Standard deviations (2,) of focal length and normal from the curvature of the cost."""
    change, parameters = _change_from(fit), fit.problem.parameters
    sigma = propagate_sigma(lambda step: change(parameters.state(step)), parameters.size, _curvature_covariance(fit))
    return _focal_and_normal_sigma(sigma)


def _change_from(fit: Adjustment) -> Callable[[AdjustmentState], np.ndarray]:
    """Function of a state: log focal length, and the rotation of the normal from that of a fit, degrees, (4,)."""
    normal = fit.state.rotation[:, 2]
    return lambda state: np.array([np.log(state.camera.focal_px), *np.degrees(np.cross(normal, state.rotation[:, 2]))])


def _focal_and_normal_sigma(sigmas: np.ndarray) -> np.ndarray:
    """Standard deviations (2,) of focal length and normal from those of `_change_from` (4,)."""
    return np.array([sigmas[0], np.linalg.norm(sigmas[1:])])


def _curvature_covariance(fit: Adjustment) -> np.ndarray:
    """Covariance (parameters, parameters) from the curvature of the cost: the inverse of the information."""
    _, prior = fit.problem.parameters.prior_gradient(fit.state)
    return np.linalg.inv(fit.information + np.diag(prior) + REGULARISING_INFORMATION * np.eye(len(prior)))
