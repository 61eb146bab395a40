"""The benchmark of moves turns images by what it says, and judges runs by what the watch has to do."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.moves import MoveRun, _Disturbances, format_move
from autocalib_ros.perception.view_registration import ViewPose, ViewReference, normalised
from autocalib_ros.results.camera_move import CameraMove, MoveKind

GOOD = MoveRun(
    'S1/video',
    'pan 1',
    (1.0, 0.0, 0.0),
    1.0,
    6.5,
    CameraMove(MoveKind.BUMP, 60.0, 1.02, 0.01, 0.0, sigma_deg=(0.01, 0.01, 0.01)),
    0.01,
    0,
)


def test_images_are_turned_by_what_the_row_says() -> None:
    generator, camera = np.random.default_rng(0), Camera.equidistant(480, 270, 240.0)
    street = np.full((270, 480), 90.0, np.float32)
    for _ in range(160):
        x, y = generator.integers(0, (450, 250))
        street[y : y + generator.integers(4, 20), x : x + generator.integers(6, 40)] += generator.uniform(-50, 50)
    image = cv2.GaussianBlur(np.clip(street, 0, 255), (0, 0), 0.8).astype(np.uint8)
    disturbed = _Disturbances([image], camera)
    seen = normalised(disturbed.image(0.0, (1.0, -0.5, 0.0), 1.0))  # at time 0 the sway is 0
    pose = ViewReference(image, camera).near(seen, ViewPose.identity())
    assert pose is not None
    np.testing.assert_allclose(np.degrees(pose.turn_rad), [1.0, -0.5, 0.0], atol=0.05)


def test_run_is_good_if_it_was_told_in_time_and_measured() -> None:
    assert GOOD.is_good
    assert not replace(GOOD, told_after_s=None).is_good
    assert not replace(GOOD, told_after_s=31.0).is_good
    assert not replace(GOOD, turn_deg=(1.4, 0.0, 0.0)).is_good
    assert not replace(GOOD, false_flags=1).is_good
    assert '+1.02 +0.01 +0.00' in format_move(GOOD)
    assert 'never' in format_move(replace(GOOD, told_after_s=None, measured=None))
