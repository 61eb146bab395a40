"""The published method from evidence to ground plane."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import Options, PaperOptions
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import solve_once

pytestmark = pytest.mark.solve

OPTIONS = Options(camera_height=8.0, method='paper', paper=PaperOptions(window_s=3.0, vote_sigmas=0.0))
CLEAN = Junction(turning_fraction=0.0, wander_m=0.0, noise_px=0.2, camera_from_ground=pose(32.0, 1.0, 40.0))


@pytest.fixture(scope='module')
def result() -> Calibration:
    found = solve_once(synthetic_evidence(CLEAN, np.random.default_rng(0)), OPTIONS)
    assert isinstance(found, Calibration)
    return found


def test_the_lens_is_equidistant_and_centred(result: Calibration) -> None:
    assert result.camera.k == (0.0, 0.0, 0.0, 0.0)
    assert result.camera.principal_point_px == (639.5, 359.5)


def test_the_ground_normal_is_found(result: Calibration) -> None:
    assert result.ground is not None
    error = np.degrees(np.arccos(result.ground.normal_in_camera @ CLEAN.normal_in_camera))
    assert error < 3.0  # the method's own weakness, not noise: orientation clusters cut the roads in half


def test_published_quantities_are_reported(result: Calibration) -> None:
    assert result.paper is not None
    assert result.paper.focal_from_vanishing_points_px is not None
    assert result.paper.translation_m is not None
    assert result.paper.translation_m[2] > 8.0


def test_no_uncertainty_is_given(result: Calibration) -> None:
    assert result.stddev.focal_px is None
    assert 'paper_uncertainty' in [statement.kind for statement in result.assumptions]


def test_without_long_tracks_it_refuses() -> None:
    options = Options(camera_height=8.0, method='paper', paper=PaperOptions(window_s=300.0))
    found = solve_once(synthetic_evidence(CLEAN, np.random.default_rng(0)), options)
    assert isinstance(found, Refusal) and found.code == 'too_few_tracks'
