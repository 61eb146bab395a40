"""A stationary camera is recognised by day and night, and camera motion is detected."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autocalib_ros.perception.drift_monitor import DriftMonitor

pytestmark = pytest.mark.render

WIDTH, HEIGHT = 640, 360
LIMIT_PX = 1.5
"""What passes for standing still at this width."""


def _street(generator: np.random.Generator) -> np.ndarray:
    """A street at night (H, W): faint markings, kerbs and windows, none brighter than a fifth of a lamp."""
    street = np.full((HEIGHT, WIDTH), 22.0, np.float32)
    for _ in range(120):
        x, y = generator.integers(0, (WIDTH - 40, HEIGHT - 20))
        street[y : y + generator.integers(4, 20), x : x + generator.integers(6, 40)] += generator.uniform(-8, 18)
    return cv2.GaussianBlur(street, (0, 0), 0.8)


def _night(seconds: float, turned_px: float = 0.0) -> float:
    """Drift in pixels found in a street where queues of lamps creep on, the camera turned at half time."""
    generator = np.random.default_rng(0)
    street, stillness = _street(generator), DriftMonitor(600.0)
    for time_s in np.arange(0.0, seconds, 0.5):
        shift = turned_px * (time_s > seconds / 2)
        scene = cv2.warpAffine(
            street, np.float32([[1, 0, shift], [0, 1, 0]]), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT
        )
        for lane in range(4):
            y = 120 + 50 * lane
            for place in range(4):
                x = int((place * 160 + 40 * (lane % 3) + (0.8 + 0.3 * lane) * time_s) % WIDTH)
                cv2.circle(scene, (x, y), 3, 255.0, -1, cv2.LINE_AA)
        noise = generator.normal(0, 1.5, scene.shape)
        stillness.update(np.clip(scene + noise, 0, 255).astype(np.uint8), float(time_s))
    return stillness.drift_px


def test_lamps_that_creep_on_by_night_are_no_motion_of_the_camera():
    assert _night(40.0) < LIMIT_PX / 3


def test_a_camera_that_turns_by_night_is_found_out():
    assert _night(40.0, turned_px=6.0) == pytest.approx(6.0, abs=1.0)
