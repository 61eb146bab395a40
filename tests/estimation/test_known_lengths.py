"""Several known lengths together: they agree, or they contradict each other."""

from dataclasses import replace

import numpy as np
import pytest
from pinhole_road import PINHOLE, ROAD

from autocalib_ros.config import GateOptions, LensOptions, Options, ScaleOptions
from autocalib_ros.offline.synthetic.junction import synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from solved_once import solve_once

pytestmark = pytest.mark.solve

ALONG, ACROSS = ((14.0, 1.0), (26.0, 1.0)), ((18.0, -5.0), (18.0, 2.0))
"""Ends of two lengths on the road, metres."""


def distance(ends: tuple[tuple[float, float], ...], factor: float = 1.0) -> str:
    relative = np.array([[x, y, -ROAD.height_m] for x, y in ends])
    pixels, _ = PINHOLE.project(relative @ ROAD.camera_from_ground.T)
    return ' '.join(f'{value:.3f}' for value in (*pixels.ravel(), factor * np.hypot(*np.subtract(*ends))))


def found(*distances: str, height: float = 0.0) -> Calibration:
    scale = ScaleOptions(distances='; '.join(distances), distance_sigma_m=0.1)
    gate = GateOptions(least_grade='assumed')
    options = Options(camera_height=height, scale=scale, lens=LensOptions(pixel_aspect=1.0), gate=gate)
    return solve_once(synthetic_evidence(ROAD, np.random.default_rng(0)), options).candidate


def test_a_length_along_and_one_across_make_the_other_lengths_certain() -> None:
    alone, both = found(height=ROAD.height_m), found(distance(ALONG), distance(ACROSS))
    assert both.stddev.ground.worst < 0.6 * alone.stddev.ground.worst
    assert both.stddev.focal_px / both.camera.focal_px < alone.stddev.focal_px / alone.camera.focal_px
    error = np.log(both.camera.focal_px / PINHOLE.focal_px)
    assert abs(error) < 2.5 * both.stddev.focal_px / both.camera.focal_px
    assert both.ground.height_m == pytest.approx(ROAD.height_m, abs=2.5 * both.stddev.height_m)
    assert [statement.kind for statement in both.assumptions if statement.kind.startswith('scale')] == [
        'scale_distance',
        'scale_distance',
        'scale_combined',
    ]


def test_lengths_that_contradict_each_other_are_named() -> None:
    right, wrong = (found(distance(ALONG), distance(((16.0, 1.0), (22.0, 1.0)), factor)) for factor in (1.0, 1.5))
    rows = [next(row for row in each.verification if row.kind == 'known_lengths') for each in (right, wrong)]
    assert rows[0].passed and not rows[1].passed and rows[1].contradicts
    assert 'known lengths against each other' in str(rows[1])


def test_a_height_and_a_length_that_agree_leave_the_height() -> None:
    result = found(distance(ALONG), height=ROAD.height_m)
    assert result.ground.height_m == pytest.approx(ROAD.height_m, rel=0.01)
    without = replace(result, verification=())
    assert without.ground == result.ground and any(row.kind == 'known_lengths' for row in result.verification)
