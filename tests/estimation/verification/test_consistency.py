"""Comparison of two halves of the traffic: focal length and rotation of the camera together."""

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.offline.benchmark.monte_carlo import draw_evidence
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import solve_once

pytestmark = pytest.mark.solve


@pytest.mark.parametrize(('run', 'number'), [(8, 'earlier'), (10, 'later'), (28, 'turned_deg')])
def test_a_camera_that_turned_in_between_is_noticed_by_its_traffic(run: int, number: str) -> None:
    junction, evidence = draw_evidence('mixed_views', 0, run)
    result = solve_once(evidence, Options(camera_height=junction.height_m))
    assert isinstance(result, Refusal) and result.code == 'halves_disagree'
    assert result.values['sigmas'] > result.values['limit'] and number in result.values


def test_halves_of_one_view_agree() -> None:
    junction, evidence = draw_evidence('many', 0, 0)
    result = solve_once(evidence, Options(camera_height=junction.height_m))
    assert isinstance(result, Calibration)
    rows = {row.kind: row for row in result.verification}
    assert rows['halves_pose'].passed and rows['halves_share'].passed
    assert np.isfinite(rows['halves_pose'].limit) and rows['halves_pose'].limit > 4.0
