"""The comparison of the demonstration with the ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.offline.demonstration import compare_with_truth, options_from_truth, write_picture
from autocalib_ros.offline.ground_truth import beside_truth, read_truth
from autocalib_ros.pictures.views import ground_to_image


@pytest.fixture
def truth(full):
    """Return the ground truth of the hand-built calibration."""
    camera, ground = full.result.camera, full.result.ground
    x, y = np.meshgrid(np.linspace(2, 20, 6), np.linspace(2, 20, 6))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(36)], axis=1)
    rows = np.concatenate([points[:, :2] + [5, -3], ground_to_image(camera, ground, points)], axis=1)
    return {
        'lens': {'f': 140.0},
        'ground_points': {'rows': rows.tolist()},
        'camera': {'R_world_from_camera': ground.rotation.tolist(), 'height': 8.0, 'position': [5, -3, 8]},
    }


def test_the_truth_itself_has_no_error(full, truth):
    comparison = compare_with_truth(full.result, truth)
    assert comparison.within_tolerance
    assert comparison.focal_error_percent == pytest.approx(0)
    assert comparison.normal_deg == pytest.approx(0, abs=1e-6)
    assert comparison.distance_error_percent == pytest.approx(0, abs=1e-6)
    assert 'within 3 %' in comparison.table()


def test_a_wrong_scale_shows_in_height_and_distances(full, truth):
    ground = GroundPlane(full.result.ground.rotation, 8.8)
    comparison = compare_with_truth(replace(full.result, ground=ground), truth)
    assert comparison.height_m == pytest.approx(0.8)
    assert comparison.distance_error_percent == pytest.approx(10)


def test_somebody_who_knows_a_distance_or_a_speed_is_given_the_truth(truth):
    assert options_from_truth(truth, 'height') == Options(camera_height=8.0)
    by_distance = options_from_truth(truth, 'distance')
    (u, v), _ = by_distance.scale.pixels
    assert min(np.hypot(u - row[2], v - row[3]) for row in truth['ground_points']['rows']) < 0.1
    assert 0 < by_distance.scale.distance_m <= 18 * np.sqrt(2) + 1e-9
    along = [[0.2 * step, 2.0 * step, 0.1, 0.0, 10.0, 0, 0] for step in range(20)]
    waiting = [[10 + 0.2 * step, 40.0, 0.1, 0.0, 0.0, 0, 0] for step in range(20)]
    turning = [[20.0, 12 * np.cos(angle), 12 * np.sin(angle), angle, 5.0, 0, 0] for angle in np.linspace(0, 2, 20)]
    truth |= {
        'road_directions': [[1, 0, 0], [0, 1, 0]],
        'vehicles': {'tracks': [{'rows': along + waiting}, {'rows': turning}, {'rows': along}]},
    }
    # waiting takes no way, and a loop on the way does not see it
    assert options_from_truth(truth, 'speed').scale.speed_km_h == pytest.approx(36.0)


def test_a_tilted_ground_is_not_good(full, truth):
    angle = np.radians(1.5)
    tilt = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    comparison = compare_with_truth(
        replace(full.result, ground=GroundPlane(tilt @ full.result.ground.rotation, 8.0)), truth
    )
    assert comparison.normal_deg == pytest.approx(1.5)
    assert not comparison.within_tolerance


def test_a_wrong_focal_length_is_not_good(full, truth):
    truth['lens']['f'] = 130.0
    assert not compare_with_truth(full.result, truth).within_tolerance


def test_a_lens_without_ground_is_not_good_and_a_refusal_is_nothing(lens_only, refused, truth):
    assert not compare_with_truth(lens_only.result, truth).within_tolerance
    assert compare_with_truth(refused.result, truth) is None


@pytest.mark.parametrize('text', [None, '{'])
def test_a_truth_that_cannot_be_read_is_one_line(tmp_path, text):
    path = tmp_path / 'truth.json'
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=r'truth\.json'):
        read_truth(path)


def test_the_report_sets_the_result_beside_the_truth(full):
    camera, ground = full.result.camera, full.result.ground
    truth = {
        'width': camera.width,
        'height': camera.height,
        'lens': {'model': 'kannala_brandt', 'f': 137.0, 'cx': 0.0, 'cy': 0.0, 'k': [0.0, 0.0, 0.0, 0.0]},
        'camera': {'R_world_from_camera': ground.rotation.tolist(), 'height': 8.0},
    }
    rows = {row.name: row for row in beside_truth(full.result, truth)}
    assert rows['focal length'].true == '137.0 px' and rows['focal length'].error == '+3.0 px'
    assert rows['focal length'].sigmas == pytest.approx(3.0 / full.result.stddev.focal_px)
    assert rows['tilt'].sigmas == pytest.approx(0.0, abs=1e-6) and rows['camera height'].error == '+0.00 m'


def test_the_picture_shows_a_road_or_is_left_out(full, lens_only, tmp_path):
    image = np.full((full.result.camera.height, full.result.camera.width, 3), 90, np.uint8)
    assert (
        write_picture(tmp_path / 'picture.jpg', full.result, image) and (tmp_path / 'picture.jpg').stat().st_size > 1000
    )
    assert not write_picture(tmp_path / 'none.jpg', lens_only.result, image)
