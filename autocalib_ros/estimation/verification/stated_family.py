"""Test of a lens family that an option states, by the traffic.

A wrong family bends straight paths, and the adjustment then makes the best of the few that it can bend back: with
another focal length, another principal point or another road. Nothing within the family shows that. Through a lens of
the right family far more of the same vehicles drive straight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import INLIER_MEDIANS, Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.straight.initialisation import solve_from_consensus
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.verification_table import VerificationRow, verified

MAX_FAMILY_SIGMAS = 3.0
"""Standard deviations by which more vehicles follow roads through another lens family, from which on the stated one is
contradicted: 0.1 % of right ones."""


def verify_stated_family(
    fit: Adjustment | None,
    config: AdjustmentConfig,
    others: Sequence[LensPrior],
    tracks: TrackSet,
    subsample: TrackSet,
    generator: np.random.Generator,
) -> Reason | VerificationRow | None:
    """Compare a solution under a stated lens family with those that straight traffic gives under `others`.

    `fit` is the solution, if there is one, `config` that of straight traffic under the stated family. Returns why the
    traffic contradicts the family, else the comparison; None where no family shows a road.
    """
    config = config if fit is None else replace(config, drifting=fit.problem.config.drifting)

    def solved(prior: LensPrior) -> Adjustment | None:
        found = solve_from_consensus(subsample, replace(config, prior=prior), generator)
        return None if found is None else adjust(found[0].state, tracks, found[0].problem.config, refine=True)

    straight = solved(config.prior)
    stated = [each for each in (fit, straight) if each is not None]
    compared = []
    for prior in others:
        other = solved(prior)
        if other is not None and stated:
            more, following = min(_more_followed(other, each, tracks) for each in stated)
            compared.append((more, following, prior.family))
    if not compared:
        return None
    more, (there, here), family = max(compared)
    row = verified('lens_family', max(more, 0.0), MAX_FAMILY_SIGMAS)
    if row.passed:
        return row
    return reason(
        'lens_model',
        'family',
        stated=config.prior.family,
        other=family,
        following=here,
        other_following=there,
        sigmas=row.value,
        limit=row.limit,
    )


def _more_followed(other: Adjustment, stated: Adjustment, tracks: TrackSet) -> tuple[float, tuple[float, float]]:
    """Return by how many standard deviations more vehicles follow roads through another lens than through the stated.

    And the share that does through either. Vehicles are compared each with itself, so that those which follow through
    both, or through none, do not count (McNemar 1947). What follows is told by the larger noise of both.
    """
    scale = INLIER_MEDIANS * max(other.scale, stated.scale)
    _, vehicle = np.unique(tracks.vehicles, return_inverse=True)
    shares = np.array(
        [
            np.bincount(vehicle, (fit.labels >= 0) & (fit.whitened2 < scale)) / np.bincount(vehicle)
            for fit in (other, stated)
        ]
    )
    change = shares[0] - shares[1]
    there, here = shares.mean(axis=1).tolist()
    return float(change.sum() / np.sqrt(max(float(change @ change), 1e-9))), (there, here)
