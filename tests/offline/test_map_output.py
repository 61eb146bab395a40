"""Control points on the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from autocalib_ros.commands.map_output import distance_options, place_result, placement_lines, write_map
from autocalib_ros.config import Options
from autocalib_ros.ground import Ground
from autocalib_ros.offline.parameter_file import override_options
from autocalib_ros.results.control_points import ControlPoints


@pytest.fixture
def points(full):
    """Return three points that the small calibration sees, in a map that is shifted by 100 and 200 m."""
    places = np.array([[6.0, 2.0], [14.0, 10.0], [9.0, 12.0]])
    pixels, seen = Ground.of(full.result).pixels(places)
    assert seen.all()
    return ControlPoints(('a', 'b', 'c'), pixels, places + [100.0, 200.0])


def test_distances_between_control_points_are_known_lengths(points):
    given = {'scale.distances': '10 20 300 20 5.0', 'camera_height': 8.0}
    options = override_options(Options(), given | distance_options(points, given))
    lengths = [distance.metres for distance in options.scale.known_distances]
    assert lengths == pytest.approx([5.0, np.hypot(8, 8), np.hypot(3, 10)], abs=1e-3)
    assert options.scale.distance_sigma_m == pytest.approx(0.1414)
    assert 'scale.distance_sigma_m' not in distance_options(points, {'scale.distance_sigma_m': 0.02})


def test_a_result_is_placed_written_and_told(points, full, tmp_path):
    placement = place_result(full.result, points)
    assert placement.translation_m == pytest.approx((100.0, 200.0), abs=1e-3)
    assert write_map(tmp_path, placement, points) == 'map.json'
    assert json.loads((tmp_path / 'map.json').read_text())['crs'] == 'local'
    first, second = placement_lines(placement, points)
    assert 'the camera stands at 100.00, 200.00 m' in first and '0.00 m off (median)' in second


def test_what_was_found_by_a_refusal_without_a_plane_is_not_placed(points, refused, lens_only):
    assert place_result(refused.result, points) is None
    assert place_result(lens_only.result, points) is None
