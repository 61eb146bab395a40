"""How sure a solution is: vehicles, not points, are independent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

SINGULAR = 1e-8
"""Directions of the parameters whose information is below this share of the largest are not determined."""


def cluster_covariance(jacobian: np.ndarray, residuals: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Cluster-robust covariance of least-squares parameters, shape (parameters, parameters).

    `jacobian` (residuals, parameters) and `residuals` are weighted; residuals of one group (a vehicle) may
    depend on each other, those of different groups do not; group -1 holds priors of unit variance. The sandwich
    of White (1980) in its form for clusters, with two cautions: the correction for few clusters, and never less
    than the covariance that the weights claim, because a redescending weight hides the spread it cuts off.
    Undetermined directions get an infinite variance.
    """
    size = jacobian.shape[1]
    information = jacobian.T @ jacobian
    values, vectors = np.linalg.eigh(information)
    prior = groups < 0
    vehicles, inverse = np.unique(groups[~prior], return_inverse=True)
    count = len(vehicles)
    if count <= 1 or values[0] < SINGULAR * values[-1]:
        return np.full((size, size), np.inf)
    scores = np.zeros((count, size))
    np.add.at(scores, inverse, jacobian[~prior] * residuals[~prior, None])
    meat = scores.T @ scores * (count / (count - 1)) + jacobian[prior].T @ jacobian[prior]
    whiten = vectors / np.sqrt(values)
    inflation, axes = np.linalg.eigh(whiten.T @ meat @ whiten)
    spread = whiten @ axes * np.sqrt(np.maximum(inflation, 1.0))
    return spread @ spread.T


def propagate(function: Callable[[np.ndarray], np.ndarray], size: int, covariance: np.ndarray) -> np.ndarray:
    """Standard deviations of `function` (of a parameter step, at 0) under `covariance`; shape of its result."""
    step = 1e-5
    slopes = np.array([(np.atleast_1d(function(step * unit)) - np.atleast_1d(function(-step * unit))) / (2 * step)
                       for unit in np.eye(size)])
    if not np.isfinite(covariance).all():
        return np.full(slopes.shape[1], np.inf)
    return np.sqrt(np.maximum(np.einsum('pi,pq,qi->i', slopes, covariance, slopes), 0.0))
