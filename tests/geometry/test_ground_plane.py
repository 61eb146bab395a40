"""Pose from road directions and height, ray-ground intersection, and the paper's equations."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.geometry.ground_plane import (
    ahead_direction,
    depression_sine,
    focal_from_vanishing_points,
    ground_plane,
    ground_points,
    intersect_ground,
    orient_upward,
    paper_translation,
    rotation_from_vanishing_points,
    tilt_and_roll_deg,
)
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import pose

POSE = pose(32.0, -2.0, 35.0)


def vanishing_point(direction: np.ndarray, focal: float) -> np.ndarray:
    return focal * direction[:2] / direction[2]


def test_focal_length_of_perpendicular_vanishing_points() -> None:
    points = [vanishing_point(POSE[:, column], 640.0) for column in (0, 1)]
    assert focal_from_vanishing_points(*points) == pytest.approx(640.0)


def test_no_focal_length_fits_vanishing_points_on_one_side() -> None:
    assert focal_from_vanishing_points(np.array([300.0, -200.0]), np.array([500.0, -100.0])) is None


def test_rotation_of_vanishing_points_is_the_pose() -> None:
    points = [vanishing_point(POSE[:, column], 640.0) for column in (0, 1)]
    rotation = rotation_from_vanishing_points(*points, 640.0)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert abs(rotation[:, 2] @ POSE[:, 2]) == pytest.approx(1.0)


def test_rotation_stays_a_rotation_when_directions_are_not_perpendicular() -> None:
    rotation = rotation_from_vanishing_points(np.array([900.0, -300.0]), np.array([-500.0, -310.0]), 640.0)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_translation_is_the_height_along_the_optical_axis() -> None:
    _, _, depth = paper_translation(POSE, 8.0)
    assert depth == pytest.approx(8.0 / np.sin(np.radians(32.0)) * 1.0, rel=2e-3)  # a roll of 2 degrees apart


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_the_normal_points_away_from_what_moves(sign: float) -> None:
    on_road = np.array([[5.0, 3.0, -8.0], [10.0, -4.0, -8.0], [20.0, 2.0, -7.0]]) @ POSE.T
    normal, below = orient_upward(sign * POSE[:, 2], on_road)
    np.testing.assert_allclose(normal, POSE[:, 2])
    assert below == 1.0


@pytest.mark.parametrize('way', [1.0, -1.0])
def test_the_ground_frame_is_right_handed_with_x_ahead(way: float) -> None:
    plane = ground_plane(POSE[:, 2], way * POSE[:, 0], 8.0, metric=True)
    np.testing.assert_allclose(plane.rotation, POSE.T, atol=1e-12)
    np.testing.assert_allclose(plane.translation_m, (0, 0, 8.0))


def test_tilt_and_roll_of_a_known_pose() -> None:
    np.testing.assert_allclose(tilt_and_roll_deg(pose(32.0, 0.0, 120.0)[:, 2]), (32.0, 0.0), atol=1e-9)
    tilt, roll = tilt_and_roll_deg(pose(0.0, 5.0, 0.0)[:, 2])
    assert (tilt, abs(roll)) == (pytest.approx(0.0), pytest.approx(5.0))


def test_rays_meet_the_ground_where_it_is() -> None:
    generator = np.random.default_rng(0)
    places = np.column_stack([generator.uniform(5.0, 60.0, 50), generator.uniform(-20.0, 20.0, 50), np.full(50, -8.0)])
    points = places @ POSE.T
    distances = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(intersect_ground(points / distances[:, None], POSE[:, 2], 8.0), distances)


def test_rays_at_the_horizon_and_above_it_are_clamped() -> None:
    bearings = np.stack([ahead_direction(POSE[:, 2]), POSE[:, 2]])
    np.testing.assert_allclose(depression_sine(bearings, POSE[:, 2], 0.02), 0.02)
    np.testing.assert_allclose(intersect_ground(bearings, POSE[:, 2], 8.0, 0.02), 400.0)


def test_the_optical_axis_meets_the_ground_straight_ahead() -> None:
    camera = Camera(1280, 720, 560.0, (639.5, 359.5))
    ahead, left = ground_points(camera, POSE[:, 2], 8.0, np.array([camera.principal_point_px]))[0]
    tilt_deg, _ = tilt_and_roll_deg(POSE[:, 2])
    assert ahead == pytest.approx(8.0 / np.tan(np.radians(tilt_deg)))
    assert left == pytest.approx(0.0, abs=1e-9)
