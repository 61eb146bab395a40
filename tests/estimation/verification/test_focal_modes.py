"""Focal lengths that a wide prior of the lens leaves possible are covered by the standard deviation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet, select_tracks
from autocalib_ros.estimation.verification.focal_modes import widen_by_focal_modes
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence

ONE_ROAD = Junction(road_angles_deg=(0.0,), camera_from_ground=pose(30.0, 1.0, 55.0), turning_fraction=0.0, vehicles=60)


@pytest.fixture(scope='module')
def tracks() -> TrackSet:
    return select_tracks(synthetic_evidence(ONE_ROAD, np.random.default_rng(3)), 200)


def adjusted(tracks: TrackSet, family: str) -> Adjustment:
    options = JointOptions(lens_prior=family)
    prior = lens_priors((1280, 720), options)[0]
    camera = prior.start(0.6 * ONE_ROAD.camera.focal_px) if family == 'kannala_brandt' else ONE_ROAD.camera
    state = AdjustmentState(camera, ONE_ROAD.camera_from_ground, np.zeros(1))
    return adjust(state, tracks, AdjustmentConfig(prior, options))


def test_a_wide_prior_leaves_other_focal_lengths_to_the_standard_deviation(tracks: TrackSet) -> None:
    fit = adjusted(tracks, 'kannala_brandt')
    error = abs(np.log(fit.state.camera.focal_px / ONE_ROAD.camera.focal_px))
    widened = widen_by_focal_modes(fit, tracks)
    # the start ended far from the truth, and its own standard deviation does not tell
    assert error > 0.3
    assert widened.focal_sigma > max(0.1, 0.25 * error)
    assert widened.state == fit.state


def test_a_usual_family_has_one_focal_length(tracks: TrackSet) -> None:
    fit = adjusted(tracks, 'equidistant')
    assert widen_by_focal_modes(fit, tracks) is fit


def test_a_known_focal_length_has_no_other(tracks: TrackSet) -> None:
    fit = adjusted(tracks, 'kannala_brandt')
    known = replace(fit.problem.config.prior, sigma=np.array([0.01, 5.0, 5.0, 0.1, 0.03, 0.0]))
    fit = adjust(fit.state, tracks, replace(fit.problem.config, prior=known), refine=True)
    assert widen_by_focal_modes(fit, tracks) is fit
