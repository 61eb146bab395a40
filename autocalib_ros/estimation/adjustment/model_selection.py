"""Model selection between adjustments of the same evidence: lens family, k2, point drift.

Models are compared by twice the negative log probability: robust residual cost, prior and the Laplace approximation
of the evidence (MacKay 1992).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import (
    FINAL_ROBUST_LIMIT,
    MIN_RESIDUAL_ROWS,
    Adjustment,
)
from autocalib_ros.estimation.adjustment.parameters import Parameterisation
from autocalib_ros.estimation.adjustment.problem import MIN_RESIDUAL_SCALE
from autocalib_ros.estimation.adjustment.residual_blocks import StraightTrackBlock
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks
from autocalib_ros.geometry.robust_kernels import geman_mcclure_bounded_loss

MODEL_SELECTION_MARGIN = 9.0
"""Smallest gain in twice the log probability for which k2 is freed, or a rarer lens family chosen: three sigmas."""


def select_model(fits: list[Adjustment], tracks: TrackSet, margin: float = 0.0) -> Adjustment:
    """Return the most probable solution; the first one unless another beats it by `margin` (twice the log)."""
    scales = np.min([fit.scales for fit in fits], axis=0)
    costs = [laplace_cost(fit, tracks, scales) + (margin if index else 0.0) for index, fit in enumerate(fits)]
    return fits[int(np.argmin(costs))]


def noise_cost(fit: Adjustment, tracks: TrackSet, *, drifting: bool) -> float:
    """Return twice the negative log likelihood of the inlier tracks with or without point drift, scale fitted.

    Infinite with fewer than `MIN_RESIDUAL_ROWS` inliers.
    """
    labels = np.where(fit.inliers(), fit.labels, -2)
    if np.count_nonzero(labels >= 0) < MIN_RESIDUAL_ROWS:
        return np.inf
    parameters = Parameterisation(fit.state, replace(fit.problem.config, drifting=drifting))
    used = labels >= 0
    on_roads = tracks.subset(used)
    rows = StraightTrackBlock(
        parameters,
        on_roads,
        labels[used],
        UnprojectedTracks.through(fit.state.camera, on_roads),
        np.ones(len(on_roads)),
    )
    squared = rows.at(np.zeros(parameters.size))
    scale = max(float(np.median(squared)), MIN_RESIDUAL_SCALE)
    return float((rows.dof * np.log(scale) - 2.0 * rows.log_density()).sum())


def laplace_cost(fit: Adjustment, tracks: TrackSet, scales: np.ndarray) -> float:
    """Return twice the negative log probability of a fit, to compare fits of the same evidence.

    Robust residual cost at one scale per residual block, `scales` (blocks,), plus the prior's, plus the log determinant
    of the posterior information (Laplace approximation).
    """
    problem, turning = fit.problem, fit.problem.block_of_row > 0
    dof = np.concatenate([np.maximum((tracks.weights > 0).sum(axis=1) - 1, 1), problem.dof[turning]])
    vehicle_weight = np.concatenate(
        [tracks.kish_weight(problem.config.vehicle_correlation), problem.vehicle_weight[turning]]
    )
    scale = np.concatenate([np.full(len(tracks), scales[0]), scales[problem.block_of_row[turning]]])
    squared = np.concatenate([fit.whitened2, fit.turning2])
    _, prior = problem.parameters.prior_gradient(fit.state)
    volume = np.linalg.slogdet(fit.information + np.diag(prior) + 1e-9 * np.eye(len(prior)))[1]
    cost = (vehicle_weight / scale * dof * geman_mcclure_bounded_loss(squared, FINAL_ROBUST_LIMIT * scale)).sum()
    return float(cost + problem.parameters.prior_cost(fit.state) + volume)
