"""Cluster-robust covariance (leave-one-vehicle-out jackknife), error propagation and identifiability.

Errors are independent between vehicles, not between the tracks or points of one vehicle.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import special

MIN_EIGENVALUE_RATIO = 1e-10
"""Smallest eigenvalue of the information over the largest; below it the covariance is infinite (singular)."""
MIN_CURVATURE_RATIO = 0.5
"""Lower bound of the true curvature over the Gauss-Newton curvature: a redescending loss curves less than its weights
suggest. Judgement."""
NOISE_PRIOR_VEHICLES = 5
"""Vehicles that the residual noise counts for as prior of the spread between vehicles: few against a busy road. A dozen
vehicles agree by chance to a third of their true spread once in some dozens of recordings."""


def jackknife_covariance(
    gradients: np.ndarray,
    curvatures: np.ndarray,
    weight: np.ndarray,
    second_order: np.ndarray,
    vehicle_ids: np.ndarray,
    prior: np.ndarray,
) -> np.ndarray:
    """Return the cluster jackknife covariance of a robust estimate, shape (parameters, parameters).

    CR3 (Bell & McCaffrey 2002; MacKinnon & White 1985) for an M-estimate: the solution without one vehicle is one
    Newton step from the solution. Small samples widen it (`small_sample_factor`), above all where vehicles agree
    better than their noise allows; the spread of the prior is added. Infinite where the information is singular or
    there are no more vehicles than parameters that the evidence, not the prior, determines.

    - `gradients` g = J^T r (rows, parameters), of whitened residuals r
    - `curvatures` J^T J (rows, parameters, parameters)
    - `weight` (rows,): derivative of a row's loss by half its squared residual
    - `second_order` (rows,): factor of g g^T in the Hessian of the loss
    - `vehicle_ids` (rows,): clusters
    - `prior` (parameters,): diagonal information of the prior
    """
    size = gradients.shape[1]
    clusters, inverse = np.unique(vehicle_ids, return_inverse=True)
    # information, whole and of each vehicle
    matrices = np.zeros((len(clusters), size, size))
    np.add.at(matrices, inverse, weight[:, None, None] * curvatures)
    information = matrices.sum(axis=0) + np.diag(prior)
    values, vectors = np.linalg.eigh(information)
    if not values[0] > MIN_EIGENVALUE_RATIO * values[-1]:  # all of them are zero where no track has weight
        return np.full((size, size), np.inf)
    # Hessian of the redescending loss in whitened parameters, where the information is the identity
    whiten = vectors / np.sqrt(values)
    from_evidence = size - float(prior @ (whiten**2).sum(axis=1))
    if len(clusters) <= from_evidence:
        return np.full((size, size), np.inf)
    hessian = np.eye(size) + whiten.T @ (gradients.T * second_order) @ gradients @ whiten
    curvature_ratios, axes = np.linalg.eigh(hessian)
    curvature_ratios = np.maximum(curvature_ratios, MIN_CURVATURE_RATIO)
    # one Newton step without each vehicle
    scores = np.zeros((len(clusters), size))
    np.add.at(scores, inverse, weight[:, None] * gradients)
    scores = scores @ whiten
    without = (axes * curvature_ratios) @ axes.T - whiten.T @ matrices @ whiten
    eigenvalues, eigenvectors = np.linalg.eigh(without)
    inverses = np.einsum(
        'vij,vj,vkj->vik', eigenvectors, 1.0 / np.maximum(eigenvalues, 0.5 * MIN_CURVATURE_RATIO), eigenvectors
    )
    moves = np.einsum('vij,vj->vi', inverses, scores)
    # sandwich: spread of the steps, of the prior, and of vehicles that agree by chance
    inverse_hessian = (axes / curvature_ratios) @ axes.T
    by_prior = (inverse_hessian @ whiten.T) * np.sqrt(prior)
    parameter_moves = moves @ whiten.T
    parameter_moves = parameter_moves * small_sample_factor(parameter_moves)
    added = by_prior @ by_prior.T
    added += _chance_agreement_variance(moves.T @ moves + added, len(clusters))
    return parameter_moves.T @ parameter_moves + whiten @ added @ whiten.T


def _chance_agreement_variance(spread: np.ndarray, vehicles: int) -> np.ndarray:
    """Return the variance (parameters, parameters) to add where few vehicles agree better than their noise allows.

    `spread` (parameters, parameters) is the observed variance in units of the variance from residual noise. The noise
    counts as `NOISE_PRIOR_VEHICLES` more vehicles along directions where it is larger than the spread.
    """
    observed, axes = np.linalg.eigh(spread)
    missing = np.maximum(1.0 - observed, 0.0) * NOISE_PRIOR_VEHICLES / (vehicles + NOISE_PRIOR_VEHICLES)
    return (axes * missing) @ axes.T


def small_sample_factor(moves: np.ndarray) -> np.ndarray:
    """Return the factor (parameters,) that widens standard deviations when few vehicles determine the solution.

    Ratio of the 97.5 % quantiles of Student's t and the normal distribution, with the degrees of freedom of
    Satterthwaite (1946) for the sum of the squared jackknife steps `moves` (vehicles, parameters): about the number of
    influential vehicles.
    """
    squares = moves**2
    dof = 3.0 * squares.sum(axis=0) ** 2 / np.maximum((squares**2).sum(axis=0), 1e-300)
    return special.stdtrit(np.maximum(dof, 1.0), 0.975) / special.ndtri(0.975)


def intraclass_correlation(groups: np.ndarray, scores: np.ndarray) -> float:
    """Return the intraclass correlation, 0 to 1, of zero-mean vectors `scores` (n, p) within their groups (n,).

    Sum of products over pairs of one group, over the value it has for equal vectors.
    """
    _, inverse, counts = np.unique(groups, return_inverse=True, return_counts=True)
    sums = np.zeros((len(counts), scores.shape[1]))
    np.add.at(sums, inverse, scores)
    own = np.bincount(inverse, (scores**2).sum(axis=1), minlength=len(counts))
    pairs = (sums**2).sum(axis=1) - own
    largest = float(((counts - 1) * own).sum())
    return float(np.clip(pairs.sum() / largest, 0.0, 1.0)) if largest > 0 else 0.0


def propagate_sigma(function: Callable[[np.ndarray], np.ndarray], size: int, covariance: np.ndarray) -> np.ndarray:
    """Return the standard deviations of a function of `size` parameters at step 0, shape of its result."""
    return np.sqrt(np.maximum(np.diag(propagate_covariance(function, size, covariance)), 0.0))


def propagate_covariance(function: Callable[[np.ndarray], np.ndarray], size: int, covariance: np.ndarray) -> np.ndarray:
    """Return the covariance (n, n) of a function of `size` parameters with n results, linearised at step 0.

    Central differences. Infinite where `covariance` is.
    """
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


def sigma_of_information(information: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Return the standard deviations (parameters,) of independent rows, with the diagonal `prior` (parameters,)."""
    inverse = np.linalg.pinv(information + np.diag(prior), hermitian=True)
    return np.sqrt(np.maximum(np.diag(inverse), 1e-300))


def sigma_without_prior(information: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each parameter without its own prior, shape (parameters,).

    Marginalises the information of the evidence (parameters, parameters) over the other parameters, which keep their
    diagonal `prior` (parameters,). Infinite where the marginal information is below 1e-6 of the conditional one: the
    parameter is not identifiable.
    """
    size = len(prior)
    result = np.full(size, np.inf)
    for index in range(size):
        rest = np.delete(np.arange(size), index)
        others, shared = information[np.ix_(rest, rest)] + np.diag(prior[rest]), information[index, rest]
        marginal = information[index, index] - shared @ np.linalg.pinv(others, rcond=1e-9) @ shared
        if marginal > 1e-6 * max(information[index, index], 1e-12):
            result[index] = 1.0 / np.sqrt(marginal)
    return result
