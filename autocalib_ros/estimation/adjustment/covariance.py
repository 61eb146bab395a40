"""How sure a solution is: vehicles, not points, are independent; and what the evidence cannot tell at all."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import stats

MIN_EIGENVALUE_RATIO = 1e-10
"""Directions of the parameters whose information is below this share of the largest are not determined."""
MIN_CURVATURE_RATIO = 0.5
"""A redescending loss curves less than its weights claim; what is left, as a share, when it would hardly curve."""

NOISE_PRIOR_VEHICLES = 5
"""How many vehicles the noise of the rows counts for as a witness of the spread: few against a road full of them, but
a dozen agree by chance to a third of their spread once in some dozens."""


def jackknife_covariance(
    gradients: np.ndarray,
    curvatures: np.ndarray,
    weight: np.ndarray,
    second_order: np.ndarray,
    vehicle_ids: np.ndarray,
    prior: np.ndarray,
) -> np.ndarray:
    """Covariance of a robust estimate by leaving out one vehicle at a time, shape (parameters, parameters).

    `gradients` g = J^T r (rows, parameters) and `curvatures` J^T J (rows, parameters, parameters) are of whitened
    residuals r; `weight` (rows,) is the derivative of a row's loss by half its squared distance, `second_order`
    (rows,) the
    factor of g g^T in the second derivative; `vehicle_ids` (rows,) are the vehicles, `prior` (parameters,) is the
    prior's
    information. One Newton step from the solution stands for each vehicle's solution without it: the cluster
    jackknife, CR3 of Bell & McCaffrey (2002), for an M-estimate. Few vehicles widen it, above all where they agree
    better than their noise lets them; the prior's own spread is added. Undetermined directions get an infinite
    variance.
    """
    size = gradients.shape[1]
    clusters, inverse = np.unique(vehicle_ids, return_inverse=True)
    matrices = np.zeros((len(clusters), size, size))
    np.add.at(matrices, inverse, weight[:, None, None] * curvatures)
    information = matrices.sum(axis=0) + np.diag(prior)
    values, vectors = np.linalg.eigh(information)
    if len(clusters) <= size or values[0] < MIN_EIGENVALUE_RATIO * values[-1]:
        return np.full((size, size), np.inf)
    whiten = vectors / np.sqrt(values)
    curved = np.eye(size) + whiten.T @ (gradients.T * second_order) @ gradients @ whiten
    shares, axes = np.linalg.eigh(curved)
    shares = np.maximum(shares, MIN_CURVATURE_RATIO)
    scores = np.zeros((len(clusters), size))
    np.add.at(scores, inverse, weight[:, None] * gradients)
    scores = scores @ whiten
    without = (axes * shares) @ axes.T - whiten.T @ matrices @ whiten
    low, turned = np.linalg.eigh(without)
    inverted = np.einsum('vij,vj,vkj->vik', turned, 1.0 / np.maximum(low, 0.5 * MIN_CURVATURE_RATIO), turned)
    moves = np.einsum('vij,vj->vi', inverted, scores)
    inverse_curved = (axes / shares) @ axes.T
    by_prior = (inverse_curved @ whiten.T) * np.sqrt(prior)
    moved = moves @ whiten.T
    moved = moved * small_sample_factor(moved)
    besides = by_prior @ by_prior.T
    besides += _chance_agreement_variance(moves.T @ moves + besides, len(clusters))
    return moved.T @ moved + whiten @ besides @ whiten.T


def _chance_agreement_variance(spread: np.ndarray, vehicles: int) -> np.ndarray:
    """Variance (parameters, parameters) by which few vehicles that happen to agree fall short of what noise leaves.

    The `spread` (parameters, parameters) that they show is in units of what the noise of the rows would leave, which
    counts as so many vehicles more where it is the larger.
    """
    found, axes = np.linalg.eigh(spread)
    missing = np.maximum(1.0 - found, 0.0) * NOISE_PRIOR_VEHICLES / (vehicles + NOISE_PRIOR_VEHICLES)
    return (axes * missing) @ axes.T


def small_sample_factor(moves: np.ndarray) -> np.ndarray:
    """Factor (parameters,) by which deviations widen where few vehicles (vehicles, parameters) move the solution.

    The 95 % interval of Student's distribution over the normal one's, with as many degrees of freedom as the sum of
    the squared moves has by Satterthwaite (1946): about the number of vehicles that matter.
    """
    squares = moves**2
    dof = 3.0 * squares.sum(axis=0) ** 2 / np.maximum((squares**2).sum(axis=0), 1e-300)
    return stats.t.ppf(0.975, np.maximum(dof, 1.0)) / stats.norm.ppf(0.975)


def intraclass_correlation(groups: np.ndarray, pulls: np.ndarray) -> float:
    """Intraclass correlation, 0 to 1, of vectors (n, p) within their groups (n,): pairs against the spread."""
    _, inverse, counts = np.unique(groups, return_inverse=True, return_counts=True)
    sums = np.zeros((len(counts), pulls.shape[1]))
    np.add.at(sums, inverse, pulls)
    own = np.bincount(inverse, (pulls**2).sum(axis=1), minlength=len(counts))
    pairs = (sums**2).sum(axis=1) - own
    among = float(((counts - 1) * own).sum())
    return float(np.clip(pairs.sum() / among, 0.0, 1.0)) if among > 0 else 0.0


def propagate_sigma(function: Callable[[np.ndarray], np.ndarray], size: int, covariance: np.ndarray) -> np.ndarray:
    """Standard deviations of `function` (of a parameter step, at 0) under `covariance`; shape of its result."""
    return np.sqrt(np.maximum(np.diag(propagate_covariance(function, size, covariance)), 0.0))


def propagate_covariance(function: Callable[[np.ndarray], np.ndarray], size: int, covariance: np.ndarray) -> np.ndarray:
    """Covariance (n, n) of a `function` with n results (of a parameter step, at 0) under `covariance`."""
    step = 1e-5
    results = len(np.atleast_1d(function(np.zeros(size))))
    if not np.isfinite(covariance).all():
        return np.full((results, results), np.inf)
    slopes = np.array(
        [
            (np.atleast_1d(function(step * unit)) - np.atleast_1d(function(-step * unit))) / (2 * step)
            for unit in np.eye(size)
        ]
    ).reshape(size, results)
    return slopes.T @ covariance @ slopes


def sigma_without_prior(information: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Return the standard deviation that the evidence alone leaves each parameter, shape (parameters,).

    `information` (parameters, parameters) is the evidence's, `prior` (parameters,) the prior's on the other
    parameters, which stays. Infinite where less than 1e-6 of a parameter's information is its own.
    """
    size = len(prior)
    result = np.full(size, np.inf)
    for index in range(size):
        rest = np.delete(np.arange(size), index)
        others, shared = information[np.ix_(rest, rest)] + np.diag(prior[rest]), information[index, rest]
        left = information[index, index] - shared @ np.linalg.pinv(others, rcond=1e-9) @ shared
        if left > 1e-6 * max(information[index, index], 1e-12):
            result[index] = 1.0 / np.sqrt(left)
    return result
