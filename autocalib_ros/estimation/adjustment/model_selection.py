"""DOCSTRING."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import (
    FINAL_ROBUST_LIMIT,
    MIN_RESIDUAL_ROWS,
    MIN_RESIDUAL_SCALE,
    Adjustment,
    bounded_loss,
)
from autocalib_ros.estimation.adjustment.parameters import Parameterisation
from autocalib_ros.estimation.adjustment.residual_blocks import StraightTrackBlock
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks

MODEL_SELECTION_MARGIN = 9.0
"""k2 is set free, or a rarer family of lenses chosen, when that makes the traffic so much more probable: twice the
logarithm, three sigmas."""


def select_model(fits: list[Adjustment], tracks: TrackSet, margin: float = 0.0) -> Adjustment:
    """Choose the solution that makes the traffic most probable; the first unless it is beaten by a margin."""
    scales = np.min([fit.scales for fit in fits], axis=0)
    costs = [laplace_cost(fit, tracks, scales) + (margin if index else 0.0) for index, fit in enumerate(fits)]
    return fits[int(np.argmin(costs))]


def noise_cost(fit: Adjustment, tracks: TrackSet, *, drifting: bool) -> float:
    """Twice the negative logarithm of how probable the residuals are with or without drift, their scale fitted.

    Infinite where hardly a track is explained.
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
    _, squared = rows.at(np.zeros(parameters.size))
    scale = max(float(np.median(squared)), MIN_RESIDUAL_SCALE)
    return float((rows.dof * np.log(scale) - 2.0 * rows.log_density()).sum())


def laplace_cost(fit: Adjustment, tracks: TrackSet, scales: np.ndarray) -> float:
    """Twice the negative logarithm of a fit's probability, for comparison between fits of the same evidence.

    All at one scale for each kind of row (kinds,), with the prior and, by Laplace's approximation, the volume that
    the evidence leaves of it.
    """
    problem, turning = fit.problem, fit.problem.block_of_row > 0
    dof = np.concatenate([np.maximum((tracks.weights > 0).sum(axis=1) - 1, 1), problem.dof[turning]])
    vehicle_weight = np.concatenate(
        [tracks.kish_weight(problem.config.vehicle_correlation), problem.vehicle_weight[turning]]
    )
    scale = np.concatenate([np.full(len(tracks), scales[0]), scales[problem.block_of_row[turning]]])
    squared = np.concatenate([fit.whitened2, fit.turning2])
    deviations, prior = problem.parameters.prior_gradient(fit.state.camera)
    volume = np.linalg.slogdet(fit.information + np.diag(prior) + 1e-9 * np.eye(len(prior)))[1]
    cost = (vehicle_weight / scale * dof * bounded_loss(squared, FINAL_ROBUST_LIMIT * scale)).sum()
    return float(cost + deviations @ deviations + volume)
