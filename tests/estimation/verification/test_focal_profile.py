"""Where the cost stays flat over the focal length, the standard deviation covers all that is left."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet, select_tracks
from autocalib_ros.estimation.straight.initialisation import solve_from_consensus
from autocalib_ros.estimation.verification.focal_profile import QUADRATIC_FOCAL_SIGMA, widen_by_focal_profile
from autocalib_ros.evidence.snapshot import Evidence

TRUE_FOCAL_PX = 587.7


@pytest.fixture(scope='module')
def tracks() -> TrackSet:
    return select_tracks(Evidence.load(Path(__file__).parents[2] / 'golden' / 'two_roads.npz'), 200)


def solved(tracks: TrackSet, crossing_rad: float | None = None, **changes: object) -> Adjustment:
    options = JointOptions(**changes)  # type: ignore[arg-type]
    config = AdjustmentConfig(lens_priors((1280, 720), options)[0], options, crossing_rad=crossing_rad)
    found = solve_from_consensus(tracks, config, np.random.default_rng(0))
    assert found is not None
    return found[0]


@pytest.mark.parametrize('wander_m', [0.06, 0.2])
def test_a_flat_cost_leaves_far_focal_lengths_to_the_standard_deviation(tracks: TrackSet, wander_m: float) -> None:
    fit = solved(tracks, lens_prior='kannala_brandt', wander_m=wander_m)
    error = abs(np.log(fit.state.camera.focal_px / TRUE_FOCAL_PX))
    widened = widen_by_focal_profile(fit, tracks)
    # two roads at any angle leave a lens between the two families: the start decides where the solution ends
    assert error > 2.0 * fit.focal_sigma
    assert 0.5 * error < widened.focal_sigma < error
    assert widened.state == fit.state


def test_a_focal_length_that_is_certain_costs_no_profile(tracks: TrackSet) -> None:
    fit = solved(tracks, np.pi / 2)
    assert fit.focal_sigma < QUADRATIC_FOCAL_SIGMA
    assert widen_by_focal_profile(fit, tracks) is fit


def test_a_quadratic_cost_keeps_its_standard_deviation(tracks: TrackSet) -> None:
    # a single road under the narrow prior of k1, with a quarter of the tracks: uncertain, and not flat
    fit = solved(tracks)
    road = tracks.subset(np.flatnonzero(fit.labels == 0)[::2])
    alone = adjust(AdjustmentState(fit.state.camera, fit.state.rotation, np.zeros(1)), road, fit.problem.config)
    assert alone.focal_sigma > QUADRATIC_FOCAL_SIGMA
    assert widen_by_focal_profile(alone, road).focal_sigma == pytest.approx(alone.focal_sigma, rel=0.3)
