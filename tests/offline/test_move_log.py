"""Moves in a recording are found without a lens and measured through the one that was solved."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.move_log import MoveLog
from autocalib_ros.results.camera_move import MoveKind

pytestmark = pytest.mark.render

WIDTH, HEIGHT, SHIFT_PX = 320, 180, 8
LENS = Camera.equidistant(WIDTH, HEIGHT, 160.0)


def test_bump_is_found_and_measured_through_the_lens_of_the_result() -> None:
    generator = np.random.default_rng(0)
    street = np.full((HEIGHT, WIDTH + SHIFT_PX), 90.0, np.float32)
    for _ in range(120):
        x, y = generator.integers(0, (WIDTH - 30, HEIGHT - 20))
        street[y : y + generator.integers(4, 20), x : x + generator.integers(6, 40)] += generator.uniform(-50, 50)
    street = cv2.GaussianBlur(np.clip(street, 0, 255), (0, 0), 0.8)
    log, calibrator = MoveLog(), AutoCalibrator(Options())
    for number in range(90):
        stamp_ns = number * 400_000_000
        view = street[:, :-SHIFT_PX] if number < 45 else street[:, SHIFT_PX:]
        image = noisy(np.ascontiguousarray(view), 2.0, number)
        calibrator.add_image(stamp_ns, image)
        log.add(stamp_ns, image, calibrator)
    (move,) = log.moves(LENS)
    assert move.kind is MoveKind.BUMP
    assert move.time_s == pytest.approx(18.0, abs=2.0)
    # a shift of the picture is a pan near its centre, which the lens of 115 degrees is not everywhere
    assert move.pan_deg == pytest.approx(np.degrees(SHIFT_PX / LENS.focal_px), abs=0.4)
    (unmeasured,) = log.moves(None)
    assert not unmeasured.is_measured
    evidence = calibrator.snapshot()
    assert evidence is not None and evidence.first_stamp_ns >= 17 * 10**9  # of the view after the move
