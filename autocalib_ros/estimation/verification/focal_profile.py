"""How far the focal length may be from the solution: the profile of the cost over log f.

The covariance of a solution is that of a cost which is quadratic about it. Where the evidence and a wide prior leave
the focal length to more than a few per cent, the cost is not: it may stay flat for far, to one side. There the solution
is followed to shorter and to longer focal lengths, and the second moment over all of them widens the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import (
    FINAL_ROBUST_LIMIT,
    Adjustment,
    adjust,
    evaluate_with,
)
from autocalib_ros.estimation.adjustment.model_selection import MODEL_SELECTION_MARGIN
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet, evenly_spaced
from autocalib_ros.estimation.verification.focal_modes import overdispersion
from autocalib_ros.geometry.robust_kernels import geman_mcclure_bounded_loss

QUADRATIC_FOCAL_SIGMA = 0.04
"""Standard deviation of log f up to which the cost is quadratic: lens curvature goes with 1 / f^2, so that its slope by
log f changes by less than a tenth within one."""
PROFILE_STEP = 0.1
"""Step of the profile in log f."""
MAX_PROFILE_TURNS = 40
"""Windows and tracklets of turning vehicles by which focal lengths are compared: they cost most of the time."""
MAX_PROFILE_STEPS = 12
"""Steps to either side: a third to three times the focal length. Wider or narrower lenses are no neighbours."""


def widen_by_focal_profile(fit: Adjustment, tracks: TrackSet) -> Adjustment:
    """Return a solution whose covariance covers all focal lengths that are about as probable as its own.

    `tracks` may be some of those of the solution: their log probability counts as that of all, and in vehicles.
    """
    prior = fit.problem.config.prior
    if prior.focal_known or 0 not in prior.free or not QUADRATIC_FOCAL_SIGMA < fit.focal_sigma < np.inf:
        return fit
    here = _with_some_turns(fit, tracks)
    share = float(here.information[0, 0] / fit.information[0, 0])
    if not share > 0.0 or not np.isfinite(here.covariance).all():
        return fit
    profile = _Profile(here, tracks, 1.0 / (share * overdispersion(fit)))
    nodes = [(here.state, 0.0), *profile.followed(PROFILE_STEP), *profile.followed(-PROFILE_STEP)]
    costs = np.array([cost for _, cost in nodes])
    weights = np.exp(0.5 * (costs.min() - costs))
    steps = np.array([fit.problem.parameters.step_to(state) for state, _ in nodes])
    moments = (steps * (weights / weights.sum())[:, None]).T @ steps
    # what the covariance covers already is not added twice
    missing = 1.0 - fit.focal_sigma**2 / max(float(moments[0, 0]), 1e-12)
    return replace(fit, covariance=fit.covariance + missing * moments) if missing > 0.0 else fit


def _with_some_turns(fit: Adjustment, tracks: TrackSet) -> Adjustment:
    """Adjust with at most `MAX_PROFILE_TURNS` windows and tracklets, evenly spaced in their lists."""
    config, (_, motion, shapes) = fit.problem.config, fit.problem.warm_start
    seen = np.zeros(len(config.windows), bool)
    seen[evenly_spaced(len(seen), MAX_PROFILE_TURNS)] = True
    living = np.zeros(0 if config.bundle is None else len(config.bundle.tracklets), bool)
    living[evenly_spaced(len(living), MAX_PROFILE_TURNS)] = True
    some = replace(
        config,
        windows=config.windows.subset(seen),
        bundle=None if config.bundle is None else config.bundle.subset(living),
    )
    warm_start = (
        None,
        None if motion is None else motion.subset(seen),
        None if shapes is None else shapes.subset(living),
    )
    return adjust(fit.state, tracks, some, refine=True, warm_start=warm_start)


@dataclass(frozen=True)
class _Profile:
    """The profile of the cost over log f about a solution."""

    here: Adjustment
    tracks: TrackSet
    weight: float
    """Weight of the evidence: its log probability is that of independent rows of some of the tracks."""

    def followed(self, step: float) -> list[tuple[AdjustmentState, float]]:
        """Return the states at focal lengths that are a `step` in log f apart, until they are improbable.

        Each with its cost, twice the negative log probability over that of the solution. The noise of a track in pixels
        depends on the plane, so that costs through two states do not compare. What is integrated along the profile is
        the estimating function: each step counts by the mean of its cost with the noise at either end
        (quasi-likelihood, Wedderburn 1974).
        """
        found: list[tuple[AdjustmentState, float]] = []
        last, cost, least = self.here, 0.0, 0.0
        # each starts along the line through the two before it, the first one by the covariance
        start = self.here.problem.parameters.state(self.here.covariance[:, 0] / self.here.covariance[0, 0] * step)
        for _ in range(MAX_PROFILE_STEPS):
            node = self._at_focal_length_of(start, last)
            if not np.isfinite(node.covariance).all():
                break
            cost += self._cost_of_step(last, node)
            if not cost < least + MODEL_SELECTION_MARGIN:
                break
            found.append((node.state, cost))
            parameters = node.problem.parameters
            start, last, least = parameters.state(-parameters.step_to(last.state)), node, min(least, cost)
        return found

    def _at_focal_length_of(self, start: AdjustmentState, near: Adjustment) -> Adjustment:
        """Adjust all but the focal length, which stays as at the start, near a solution."""
        config, warm_start = self.here.problem.config, near.problem.warm_start
        held = replace(config, prior=config.prior.with_fixed(('focal length',)))
        fit = adjust(start, self.tracks, held, refine=True, warm_start=warm_start)
        return evaluate_with(fit, self.tracks, config)

    def _cost_of_step(self, one: Adjustment, other: Adjustment) -> float:
        """Return by how much the cost grows from one state of the profile to the next."""
        evidence = 0.5 * sum(
            self._evidence_cost(each, other.state) - self._evidence_cost(each, one.state) for each in (one, other)
        )
        return self.weight * evidence + self._prior_and_volume(other) - self._prior_and_volume(one)

    def _evidence_cost(self, fit: Adjustment, state: AdjustmentState) -> float:
        """Return the cost of the evidence at a state, with the noise and the roads of the tracks as of a fit."""
        problem = fit.problem
        squared = problem.at(problem.parameters.step_to(state))[1]
        scale = self.here.scales[problem.block_of_row]
        loss = geman_mcclure_bounded_loss(squared, FINAL_ROBUST_LIMIT * scale)
        return float((problem.vehicle_weight / scale * problem.dof * loss).sum())

    def _prior_and_volume(self, fit: Adjustment) -> float:
        """Return the cost of the prior, and the log determinant of the information about all but the focal length."""
        parameters = fit.problem.parameters
        _, prior = parameters.prior_gradient(fit.state)
        information = self.weight * fit.information + np.diag(prior) + 1e-9 * np.eye(len(prior))
        return parameters.prior_cost(fit.state) + float(np.linalg.slogdet(information[1:, 1:])[1])
