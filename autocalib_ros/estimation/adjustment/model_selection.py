"""DOCSTRING."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import (
    LEAST_SCALE,
    MIN_ROWS,
    TIGHTEST,
    JointFit,
    bounded_loss,
)
from autocalib_ros.estimation.adjustment.parameters import Steps
from autocalib_ros.estimation.adjustment.residual_blocks import RoadRows
from autocalib_ros.estimation.observations.track_set import Seen, TrackSet

ASKED_FOR = 9.0
"""k2 is set free, or a rarer family of lenses chosen, when that makes the traffic so much more probable: twice the
logarithm, three sigmas."""


def most_probable(fits: list[JointFit], tracks: TrackSet, margin: float = 0.0) -> JointFit:
    """Choose the solution that makes the traffic most probable; the first unless it is beaten by a margin."""
    scales = np.min([fit.scales for fit in fits], axis=0)
    costs = [cost_at(fit, tracks, scales) + (margin if index else 0.0) for index, fit in enumerate(fits)]
    return fits[int(np.argmin(costs))]


def noise_cost(fit: JointFit, tracks: TrackSet, *, drifting: bool) -> float:
    """Twice the negative logarithm of how probable the residuals are with or without drift, their scale fitted.

    Infinite where hardly a track is explained.
    """
    labels = np.where(fit.explained(), fit.labels, -2)
    if np.count_nonzero(labels >= 0) < MIN_ROWS:
        return np.inf
    steps = Steps(fit.state, replace(fit.problem.setting, drifting=drifting))
    used = labels >= 0
    on_roads = tracks.subset(used)
    rows = RoadRows(steps, on_roads, labels[used], Seen.through(fit.state.camera, on_roads), np.ones(len(on_roads)))
    _, squared = rows.at(np.zeros(steps.size))
    scale = max(float(np.median(squared)), LEAST_SCALE)
    return float((rows.freedom * np.log(scale) - 2.0 * rows.log_density()).sum())


def cost_at(fit: JointFit, tracks: TrackSet, scales: np.ndarray) -> float:
    """Twice the negative logarithm of a fit's probability, for comparison between fits of the same evidence.

    All at one scale for each kind of row (kinds,), with the prior and, by Laplace's approximation, the volume that
    the evidence leaves of it.
    """
    problem, turning = fit.problem, fit.problem.kind > 0
    freedom = np.concatenate([np.maximum((tracks.weights > 0).sum(axis=1) - 1, 1), problem.freedom[turning]])
    share = np.concatenate([tracks.independence(problem.setting.vehicle_correlation), problem.share[turning]])
    scale = np.concatenate([np.full(len(tracks), scales[0]), scales[problem.kind[turning]]])
    squared = np.concatenate([fit.whitened2, fit.turning2])
    deviations, prior = problem.steps.prior_gradient(fit.state.camera)
    volume = np.linalg.slogdet(fit.information + np.diag(prior) + 1e-9 * np.eye(len(prior)))[1]
    cost = (share / scale * freedom * bounded_loss(squared, TIGHTEST * scale)).sum()
    return float(cost + deviations @ deviations + volume)
