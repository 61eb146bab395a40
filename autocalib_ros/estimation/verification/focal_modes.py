"""Other focal lengths that the evidence does not exclude: further minima of the cost, along the profile over log f.

Straight paths tell how the lens curves near the borders of the picture, which a longer lens with more barrel distortion
shows alike. Where the prior of k1 is wide, as of the family between the two usual ones, several minima may remain. The
solution is tried again from other focal lengths, each with the k1 that curves alike; what is about as probable as the
solution widens its covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.covariance import sigma_of_information
from autocalib_ros.estimation.adjustment.model_selection import MODEL_SELECTION_MARGIN, laplace_cost
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.straight.initialisation import MATCHED_RADIUS_DIAGONALS

LOG_FOCAL_SHIFTS = (-0.7, -0.45, -0.2, 0.2, 0.45, 0.7)
"""Starts, in log focal length from the solution: half to twice of it, each within the basin of the next."""
MAX_PRIOR_SIGMAS = 4.0
"""A start whose k1 is farther from its prior is no minimum: the usual families have none."""


def widen_by_focal_modes(fit: Adjustment, tracks: TrackSet) -> Adjustment:
    """Return a solution whose covariance covers other focal lengths that are about as probable; the best one of them.

    Log probabilities are divided by the ratio of the jackknife variance to that of independent rows (quasi-likelihood,
    McCullagh & Nelder 1989): rows of one vehicle repeat each other.
    """
    modes = [mode for start in _starts(fit) for mode in [_solve_from(start, fit, tracks)] if mode is not None]
    if not modes or not np.isfinite(fit.covariance).all():
        return fit
    here = adjust(fit.state, tracks, replace(fit.problem.config, bundle=None), refine=True)
    fits, scales = [here, *modes], np.min([each.scales for each in (here, *modes)], axis=0)
    costs = np.array([laplace_cost(each, tracks, scales) for each in fits]) / overdispersion(fit)
    weights = np.where(costs - costs.min() < MODEL_SELECTION_MARGIN, np.exp(0.5 * (costs.min() - costs)), 0.0)
    steps = np.array([fit.problem.parameters.step_to(each.state) for each in fits])
    distinct = _distinct(steps[:, 0])
    weights, steps = weights[distinct] / weights[distinct].sum(), steps[distinct]
    return replace(fit, covariance=fit.covariance + (steps * weights[:, None]).T @ steps)


def _starts(fit: Adjustment) -> list[AdjustmentState]:
    """Return states at other focal lengths whose lens has the same angle at the matched radius."""
    prior, camera = fit.problem.config.prior, fit.state.camera
    if prior.focal_known or not {0, 3} <= set(prior.free.tolist()):
        return []
    radius = MATCHED_RADIUS_DIAGONALS * camera.diagonal_px
    angle = float(camera.angle(np.array(radius))[0])
    found = []
    for shift in LOG_FOCAL_SHIFTS:
        focal_px = camera.focal_px * float(np.exp(shift))
        k1 = camera.k[0] + radius * (1.0 / focal_px - 1.0 / camera.focal_px) / angle**3
        if abs(k1 - prior.centre.k[0]) < MAX_PRIOR_SIGMAS * prior.sigma[3]:
            found.append(replace(fit.state, camera=replace(camera, focal_px=focal_px, k=(k1, *camera.k[1:]))))
    return found


def _solve_from(start: AdjustmentState, fit: Adjustment, tracks: TrackSet) -> Adjustment | None:
    """Adjust from a start; None if it ends where the traffic follows no road any more."""
    mode = adjust(start, tracks, replace(fit.problem.config, bundle=None), refine=True)
    return mode if np.isfinite(mode.covariance).all() else None


def overdispersion(fit: Adjustment) -> float:
    """Return the ratio of the stated variance of the focal length to that of independent rows, at least 1."""
    _, prior = fit.problem.parameters.prior_gradient(fit.state)
    return max(float((fit.focal_sigma / sigma_of_information(fit.information, prior)[0]) ** 2), 1.0)


def _distinct(log_focals: np.ndarray) -> np.ndarray:
    """Return the indices of one of each group of equal focal lengths, the solution itself first."""
    found: list[int] = []
    for index, value in enumerate(log_focals):
        if not any(abs(value - log_focals[other]) < 0.02 for other in found):
            found.append(index)
    return np.array(found)
