"""Combination of two independent estimates of lens and plane, either of which may be wrong.

Three hypotheses are left by the evidence: both estimates are right, the first alone is, or the other alone is. Their
difference decides how probable each is, and the result is the mean and the covariance over all three: where the
estimates agree it is more certain than either, where they contradict each other it covers both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import UNMODELLED_FOCAL, UNMODELLED_RAD, Adjustment
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState

WRONG_PROBABILITY = 0.05
"""Prior probability that one estimate is wrong, such as one whose lines are not parallel: one in twenty. Judgement."""
WRONG_FOCAL, WRONG_RAD = 0.1, np.radians(4.0)
"""Standard deviations of the errors of an estimate that is wrong: of the logarithm of the focal length, and of the
plane in radians. Judgement."""
MAX_LOG_ODDS = 50.0
"""Log odds beyond which one hypothesis is certain."""


@dataclass(frozen=True)
class Mode:
    """One of the possible values of an estimate: a minimum of its cost."""

    state: AdjustmentState
    covariance: np.ndarray
    """Of the parameters that are shared with the first estimate, shape (shared, shared)."""
    log_weight: float
    """Log probability against the other modes, up to a constant."""


@dataclass(frozen=True)
class Combination:
    """Mean and covariance over the hypotheses, as a step of the parameters of the first estimate."""

    step: np.ndarray
    """Shape (parameters,)."""
    covariance: np.ndarray
    """Shape (parameters, parameters)."""
    both_right: float
    """Probability, 0 to 1, that both estimates are right."""
    likeliest: Mode
    """The mode of the other estimate that agrees best."""


def combine(fit: Adjustment, modes: list[Mode], shared: np.ndarray) -> Combination:
    """Combine an adjustment with another estimate, made with the same lens prior, that may have several modes.

    The covariance of a mode is that of the parameters with the indices `shared`.
    """
    size = fit.problem.parameters.size
    weights = _normalised(np.array([mode.log_weight for mode in modes]))
    steps = [_step_to(fit, mode, shared) for mode in modes]
    right, astray = np.array(
        [_log_densities(fit, step, shared, mode) for step, mode in zip(steps, modes, strict=True)]
    ).T + np.log(np.maximum(weights, 1e-300))
    # only what the difference adds counts: that an estimate may be wrong anyway is so without the other one, too
    favour = np.clip(np.logaddexp.reduce(astray) - np.logaddexp.reduce(right), 0.0, MAX_LOG_ODDS)
    odds = WRONG_PROBABILITY * float(np.expm1(favour))
    hypotheses = [(odds, np.zeros(size), fit.covariance)]
    for step, mode, agrees, weight in zip(steps, modes, _normalised(right), weights, strict=True):
        hypotheses.append((agrees, *_both(fit, step, shared, mode)))
        hypotheses.append((odds * weight, *_other_alone(fit, step, shared, mode)))
    probabilities = np.array([odds for odds, _, _ in hypotheses]) / (1.0 + 2.0 * odds)
    means = np.array([mean for _, mean, _ in hypotheses])
    mean = probabilities @ means
    spread = (means - mean).T @ (probabilities[:, None] * (means - mean))
    within = np.tensordot(probabilities, np.array([covariance for _, _, covariance in hypotheses]), 1)
    return Combination(mean, within + spread, 1.0 / (1.0 + 2.0 * odds), modes[int(np.argmax(right))])


def _normalised(logs: np.ndarray) -> np.ndarray:
    """Return probabilities (n,) from their logs up to a constant."""
    return np.exp(logs - np.logaddexp.reduce(logs))


def _step_to(fit: Adjustment, mode: Mode, shared: np.ndarray) -> np.ndarray:
    step = np.zeros(fit.problem.parameters.size)
    step[shared] = fit.problem.parameters.step_to(mode.state)[shared]
    return step


def _both(fit: Adjustment, step: np.ndarray, shared: np.ndarray, mode: Mode) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance if both estimates are right; the information of the prior counts once."""
    _, prior = fit.problem.parameters.prior_gradient(fit.state)
    values, vectors = np.linalg.eigh(np.linalg.inv(mode.covariance) - np.diag(prior[shared]))
    added = np.zeros((len(step), len(step)))
    added[np.ix_(shared, shared)] = (vectors * np.maximum(values, 0.0)) @ vectors.T
    covariance = np.linalg.inv(np.linalg.inv(fit.covariance) + added)
    return covariance @ added @ step, covariance


def _other_alone(fit: Adjustment, step: np.ndarray, shared: np.ndarray, mode: Mode) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance if the other estimate alone is right; the rest follows by correlation."""
    first = fit.covariance[np.ix_(shared, shared)]
    gain = fit.covariance[:, shared] @ np.linalg.inv(first)
    return gain @ step[shared], fit.covariance + gain @ (mode.covariance - first) @ gain.T


def _log_densities(fit: Adjustment, step: np.ndarray, shared: np.ndarray, mode: Mode) -> tuple[float, float]:
    """Return the log densities of the differences of focal length and plane: both right, and one of them wrong."""
    parameters = fit.problem.parameters
    focal, tilts = np.flatnonzero(parameters.config.prior.free == 0), parameters.tilts
    compared = np.concatenate([focal, tilts])
    at = np.searchsorted(shared, compared)
    unmodelled = np.concatenate([np.full(len(focal), UNMODELLED_FOCAL), np.full(len(tilts), UNMODELLED_RAD)])
    wrong = np.concatenate([np.full(len(focal), WRONG_FOCAL), np.full(len(tilts), WRONG_RAD)])
    expected = fit.covariance[np.ix_(compared, compared)] + mode.covariance[np.ix_(at, at)] + np.diag(unmodelled**2)
    return log_density(step[compared], expected), log_density(step[compared], expected + np.diag(wrong**2))


def log_density(difference: np.ndarray, covariance: np.ndarray) -> float:
    """Return the log density, up to a constant, of a normal distribution about zero."""
    return float(-0.5 * (difference @ np.linalg.solve(covariance, difference) + np.linalg.slogdet(covariance)[1]))
