"""A picture that was cut off or zoomed away from its centre: told by the traffic, or not excluded by it.

The optical axis of a camera looks through the centre of its picture to about a hundredth of its width. Where a recorder
crops the picture, or a strip is covered that nobody could tell from scenery, nothing but the traffic tells. The
solution is adjusted again with a principal point that is known to a tenth of the width only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.model_selection import laplace_cost
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.verification.focal_modes import overdispersion

CUT_PROBABILITY = 0.05
"""Prior probability of a picture that was cut off or zoomed away from its centre: one in twenty. Judgement."""
CUT_LOG_ODDS = float(np.log(CUT_PROBABILITY / (1.0 - CUT_PROBABILITY)))
"""The same as log odds."""
CLEARLY_CUT_NATS = 4.5
"""Log odds of such a picture from which on it is taken for one: 1 in 90 is wrong."""
MAX_CUT_NATS = 50.0
"""Log odds beyond which it is certain."""


@dataclass(frozen=True)
class CutPicture:
    """How probable it is, by the traffic, that the picture was cut off."""

    centred: Adjustment
    """The solution with a centred picture."""
    loose: Adjustment
    """The same with a loose principal point."""
    log_odds: float
    """Of a picture that was cut off, in nats."""

    @property
    def is_clear(self) -> bool:
        """Whether the picture is taken for one that was cut off."""
        return self.log_odds > CLEARLY_CUT_NATS

    def covered(self) -> Adjustment:
        """Return the centred solution with a covariance that covers a cut picture, by the probability of one.

        Bayesian model averaging (Hoeting et al. 1999) over the two priors of the principal point.
        """
        fit, loose = self.centred, self.loose
        probability = 1.0 / (1.0 + float(np.exp(-self.log_odds)))
        step = fit.problem.parameters.step_to(loose.state)
        units = np.ones(len(step))
        units[: fit.problem.parameters.lens] = loose.problem.config.prior.units / fit.problem.config.prior.units
        other = loose.covariance * np.outer(units, units) + np.outer(step, step)
        return replace(fit, covariance=(1.0 - probability) * fit.covariance + probability * other)


def compare_cut_picture(fit: Adjustment, tracks: TrackSet) -> CutPicture | None:
    """Compare a solution with that of a picture that was cut off; None where the principal point is given or known.

    Log probabilities are divided by the ratio of the jackknife variance to that of independent rows (quasi-likelihood,
    McCullagh & Nelder 1989): rows of one vehicle repeat each other.
    """
    config, prior = fit.problem.config, fit.problem.config.prior
    given = config.options.principal_point_sigma_px >= 0 or not {1, 2} <= set(prior.free.tolist())
    loosened = prior.with_loose_centre()
    if given or (loosened.sigma == prior.sigma).all() or not np.isfinite(fit.covariance).all():
        return None
    wider = replace(config, prior=loosened)
    loose = adjust(fit.state, tracks, wider, refine=True, warm_start=fit.problem.warm_start)
    if not np.isfinite(loose.covariance).all():
        return None
    scales = np.minimum(fit.scales, loose.scales)
    gain = 0.5 * (laplace_cost(fit, tracks, scales) - laplace_cost(loose, tracks, scales)) / overdispersion(fit)
    return CutPicture(fit, loose, float(np.clip(gain + CUT_LOG_ODDS, -MAX_CUT_NATS, MAX_CUT_NATS)))
