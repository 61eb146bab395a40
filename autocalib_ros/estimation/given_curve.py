"""Focal length and k1 of a given lens against those of the traffic.

Both make up for each other where most of the traffic is, so that neither alone shows a lens that is off in both: the
file of another mode, or of another focal length with a distortion of its own.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.combination import log_density
from autocalib_ros.estimation.released_lens import ReleasedLens, step_of_released, step_to_released
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.verification_table import VerificationRow, verified

FOCAL_AND_K1 = (np.inf, 0.0, 0.0, np.inf, 0.0, 0.0)
"""Standard deviations of the `LENS_PARAMETERS` where focal length and k1 are released."""
LENS_TOLERANCE = 0.03
"""Difference that is always allowed, in log focal length, log pixel aspect, and widths of the image for the principal
point: the promised accuracy, as between two halves of the traffic."""
CURVE_CONTRADICTION_SIGMAS, CURVE_DOUBT_SIGMAS = 3.4, 2.45
"""A lens whose focal length and k1 together differ by more standard deviations from those of the traffic is refused
(0.3 % of right ones), or believed less (5 %)."""
MIN_OFF_SIGMAS = 2.0
"""Standard deviations of the focal length by the traffic, by which that of a refused lens is off besides."""
WRONG_LENS, WRONG_CURVE_SIGMAS = 0.05, (0.2, 0.1)
"""Probability, before the traffic is seen, that a lens file is of another mode, zoom or lens; and how far log focal
length and k1 of such a one lie from the right ones. Judgement."""


def compare_curve(lens: Camera, release: ReleasedLens) -> Reason | VerificationRow | None:
    """Compare focal length and k1 of a lens, released, with those of the traffic; a reason if these contradict them.

    None if the traffic gives neither.
    """
    (off, _), sigmas = release.change(_focal_and_k1)
    if not sigmas > 0.0:
        return None
    if sigmas > CURVE_CONTRADICTION_SIGMAS and abs(off) > max(LENS_TOLERANCE, MIN_OFF_SIGMAS * release.fit.focal_sigma):
        return curve_contradiction(lens, release.fit)
    return verified('given_curve', abs(off), max(CURVE_DOUBT_SIGMAS * abs(off) / sigmas, LENS_TOLERANCE))


def curve_contradiction(lens: Camera, fit: Adjustment) -> Reason:
    """Return the contradiction with the numbers of both."""
    camera = fit.state.camera
    focal_sigma, k1_sigma = fit.sigma(lambda state: _focal_and_k1(state.camera))
    return reason(
        'given_lens',
        'focal_and_k1',
        given_px=lens.focal_px,
        given_k1=lens.k[0],
        traffic_px=camera.focal_px,
        sigma_px=focal_sigma * camera.focal_px,
        traffic_k1=camera.k[0],
        k1_sigma=k1_sigma,
    )


def steps_with_curve(found: Solution, release: ReleasedLens) -> np.ndarray:
    """Return the steps (3, parameters) of a solution that cover the plane with focal length and k1 of the traffic.

    The step to these, and one standard deviation of theirs along each axis, all times the root of the probability that
    the lens is wrong, after the traffic was seen (model averaging). A lens that is doubted is believed no more than the
    traffic: what exceeds the error of the traffic is the error of the lens (moment estimator of DerSimonian and Laird
    1986, for one difference in two dimensions).
    """
    change, sigmas = release.change(_focal_and_k1)
    covariance = release.fit.covariance_of(lambda state: _focal_and_k1(state.camera))
    step = step_to_released(found, release)
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0.0):
        return np.zeros((3, len(step)))
    wrong = covariance + np.diag(np.square(WRONG_CURVE_SIGMAS))
    log_odds = special.logit(WRONG_LENS) + log_density(change, wrong) - log_density(change, covariance)
    exceeding = 1.0 - 2.0 / sigmas**2 if sigmas > CURVE_DOUBT_SIGMAS else 0.0
    with_lens = release.fit.covariance[:, :2] @ np.linalg.inv(np.linalg.cholesky(release.fit.covariance[:2, :2])).T
    spread = [step_of_released(found, release, each) for each in with_lens.T]
    return np.sqrt(max(float(special.expit(log_odds)), exceeding)) * np.array([step, *spread])


def _focal_and_k1(camera: Camera) -> np.ndarray:
    """Return log focal length and k1 (2,)."""
    return np.array([np.log(camera.focal_px), camera.k[0]])
