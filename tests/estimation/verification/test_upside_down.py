"""Pictures that are upside down, and roads that would make them so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.synthetic.junction import Junction
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import ONE_FAMILY, evidence_once, solve_once

pytestmark = pytest.mark.solve


def turned_over(evidence: Evidence) -> Evidence:
    """Return evidence as of images turned by 180 degrees."""
    last = np.array(evidence.image_size) - 1.0

    def turned(coordinates: np.ndarray) -> np.ndarray:
        return (last - coordinates.reshape(-1, 2)).reshape(coordinates.shape)

    return replace(
        evidence,
        points_px=turned(evidence.points_px),
        segments_px=turned(evidence.segments_px),
        edges_px=turned(evidence.edges_px),
    )


def test_a_picture_that_is_upside_down_is_refused_in_words() -> None:
    options = Options(camera_height=8.0, joint=ONE_FAMILY)
    upright = evidence_once(Junction(vehicles=40, points_per_vehicle=3))
    assert isinstance(solve_once(upright, options), Calibration)
    refused = solve_once(turned_over(upright), options)
    assert isinstance(refused, Refusal) and refused.code == 'horizon'
    assert 'upside down (roll 17' in refused.message or 'upside down (roll 18' in refused.message
