"""How far a focal length that is told is believed, and the solution that this leaves.

A data sheet may be of another mode, zoom or crop than the recording. So the solution is a mixture: of the one with the
told focal length, and of the one without it, by the probability of each after the road was seen. Its mean and
covariance are those of the mixture, so that the standard deviations cover a wrong number where nothing on the road
contradicts it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, evaluate_at
from autocalib_ros.estimation.observations.track_set import TrackSet

WRONG_TOLD, WRONG_SIGMA = 0.2, 0.4
"""Probability, before the road is seen, that a told focal length is of another zoom, crop or mode, and how far the
logarithm of such a one lies from the right one: half as long again. Judgement."""


def probability_of_told(difference: float, road_sigma: float, told_sigma: float) -> float:
    """Return the probability that a told focal length is of this recording, after the road was seen.

    `difference` is that of the logarithms of the told one and of the road without it, the others their standard
    deviations.
    """
    right, wrong = (
        -0.5 * (difference / sigma) ** 2 - np.log(sigma)
        for sigma in np.hypot(road_sigma, [told_sigma, max(WRONG_SIGMA, told_sigma)])
    )
    odds = float(np.exp(np.clip(wrong - right, -50.0, 50.0))) * WRONG_TOLD / (1.0 - WRONG_TOLD)
    return 1.0 / (1.0 + odds)


def mixed(told: Adjustment, free: Adjustment, difference: float, believed: float, tracks: TrackSet) -> Adjustment:
    """Return the mean of two solutions of one road, with the covariance of their mixture.

    `told` is the one if the told focal length is right, of probability `believed`; else the one without it, `free`,
    holds, to which the told one, farther by `difference` in its logarithm, is a far weaker observation.
    """
    parameters, other = told.problem.parameters, free.problem.parameters
    gain = free.covariance[:, 0] / (free.covariance[0, 0] + WRONG_SIGMA**2)  # the first parameter is log f
    state = other.state(gain * difference)
    units = np.ones(parameters.size)
    if state.rotation[:, 0] @ told.state.rotation[:, 0] < 0:  # a road has two directions: turn about the normal
        state = replace(state, rotation=state.rotation * [-1.0, -1.0, 1.0])
        units[parameters.lens : parameters.lens + 2] = -1.0
    apart = parameters.step_to(state)
    units[: parameters.lens] = other.config.prior.units / parameters.config.prior.units
    doubted = 1.0 - believed
    covariance = (
        believed * told.covariance
        + doubted * units[:, None] * (free.covariance - np.outer(gain, free.covariance[0])) * units
        + believed * doubted * np.outer(apart, apart)
    )
    return evaluate_at(parameters.state(doubted * apart), tracks, parameters.config, covariance)
