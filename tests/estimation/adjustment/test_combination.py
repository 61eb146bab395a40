"""Combination of two estimates: agreement sharpens, contradiction widens, weak evidence changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.combination import Combination, Mode, combine
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.observations.track_set import select_tracks
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence

FOCAL = 0


@pytest.fixture(scope='module')
def fit() -> Adjustment:
    tracks = select_tracks(synthetic_evidence(Junction(), np.random.default_rng(0)), 500)
    state = AdjustmentState(Junction().camera, Junction().camera_from_ground, np.array([0.0, np.pi / 2]))
    return adjust(state, tracks, AdjustmentConfig(lens_priors((1280, 720), JointOptions())[0], JointOptions()))


def shared_by(fit: Adjustment) -> np.ndarray:
    """Indices of the lens parameters and of the rotations that tilt the plane."""
    return np.arange(fit.problem.parameters.lens + 2)


def mode(
    fit: Adjustment, *, focal: float = 0.0, tilt_deg: float = 0.0, widen: float = 1.0, weight: float = 0.0
) -> Mode:
    """Another estimate, away from a solution and as certain times a factor."""
    camera = replace(fit.state.camera, focal_px=fit.state.camera.focal_px * float(np.exp(focal)))
    rotation = fit.state.rotation @ Rotation.from_rotvec([np.radians(tilt_deg), 0.0, 0.0]).as_matrix()
    shared = shared_by(fit)
    covariance = widen**2 * fit.covariance[np.ix_(shared, shared)]
    return Mode(replace(fit.state, camera=camera, rotation=rotation), covariance, weight)


def combined_with(fit: Adjustment, *modes: Mode) -> Combination:
    return combine(fit, list(modes), shared_by(fit))


def focal_sigma(covariance: np.ndarray) -> float:
    return float(np.sqrt(covariance[FOCAL, FOCAL]))


def test_estimates_that_agree_are_more_certain_together(fit: Adjustment) -> None:
    together = combined_with(fit, mode(fit))
    assert together.both_right == 1.0
    np.testing.assert_allclose(together.step, 0.0, atol=1e-9)
    sigma = focal_sigma(fit.covariance)
    # twice the information, but that of the prior counts once
    assert 0.7 * sigma < focal_sigma(together.covariance) < 0.95 * sigma


def test_the_more_certain_estimate_has_the_larger_weight(fit: Adjustment) -> None:
    sigma = focal_sigma(fit.covariance)
    precise, coarse = (combined_with(fit, mode(fit, focal=sigma, widen=factor)) for factor in (0.3, 3.0))
    assert precise.step[FOCAL] > 0.7 * sigma
    assert coarse.step[FOCAL] < 0.3 * sigma


def test_a_contradiction_covers_both(fit: Adjustment) -> None:
    sigma = focal_sigma(fit.covariance)
    difference = 12.0 * sigma
    together = combined_with(fit, mode(fit, focal=difference))
    assert together.both_right < 0.05
    assert together.step[FOCAL] == pytest.approx(difference / 2, rel=0.1)
    assert focal_sigma(together.covariance) > 0.45 * difference


def test_the_standard_deviation_never_shrinks_as_the_difference_grows(fit: Adjustment) -> None:
    sigma = focal_sigma(fit.covariance)
    sigmas = [focal_sigma(combined_with(fit, mode(fit, focal=ratio * sigma)).covariance) for ratio in range(12)]
    assert (np.diff(sigmas) > -1e-12).all()


def test_another_plane_is_a_contradiction_too(fit: Adjustment) -> None:
    assert combined_with(fit, mode(fit, tilt_deg=15.0)).both_right < 0.05


def test_an_estimate_that_tells_nothing_changes_nothing(fit: Adjustment) -> None:
    together = combined_with(fit, mode(fit, focal=0.1, widen=1000.0))
    np.testing.assert_allclose(together.step, 0.0, atol=1e-3)
    np.testing.assert_allclose(together.covariance, fit.covariance, rtol=1e-2, atol=1e-9)


def test_the_traffic_decides_between_modes_that_fit_equally_well(fit: Adjustment) -> None:
    near, far = mode(fit), mode(fit, focal=20.0 * focal_sigma(fit.covariance))
    together = combined_with(fit, far, near)
    assert together.likeliest is near and together.both_right == 1.0
    np.testing.assert_allclose(together.step, 0.0, atol=1e-3)


def test_modes_that_nothing_excludes_are_an_interval(fit: Adjustment) -> None:
    sigma = focal_sigma(fit.covariance)
    low, high = (mode(fit, focal=sign * 1.5 * sigma, widen=0.2) for sign in (-1.0, 1.0))
    together = combined_with(fit, low, high)
    assert abs(together.step[FOCAL]) < 0.1 * sigma
    assert focal_sigma(together.covariance) == pytest.approx(1.45 * sigma, rel=0.1)
    # a clear advantage of one of them decides
    assert combined_with(fit, low, replace(high, log_weight=8.0)).step[FOCAL] > 1.3 * sigma
