"""Bright bars of the static scene: where they are drawn, with their ends."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.perception.background import MIN_SAMPLES
from autocalib_ros.perception.stripe_detector import StripeDetector, find_stripes

WIDTH, HEIGHT, FINE = 640, 360, 8


def road(bars: np.ndarray, thickness_px: float, level: int = 200) -> np.ndarray:
    """Grey asphalt (H, W) with bars (n, 4) of a thickness, each pixel the mean of its area."""
    image = np.full((HEIGHT * FINE, WIDTH * FINE), 90, np.uint8)
    for x0, y0, x1, y1 in bars:
        way = np.array([x1 - x0, y1 - y0])
        side = 0.5 * thickness_px * np.array([-way[1], way[0]]) / np.hypot(*way)
        corners = np.array([[x0, y0] + side, [x1, y1] + side, [x1, y1] - side, [x0, y0] - side])
        cv2.fillConvexPoly(image, np.round((corners + 0.5) * FINE - 0.5).astype(np.int32), level)
    return cv2.GaussianBlur(cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), (0, 0), 0.7)


def apart(found: np.ndarray, bars: np.ndarray) -> np.ndarray:
    """Distance (n,) of the farther end of the nearest bar found from each bar."""
    both = np.stack([bars, bars[:, [2, 3, 0, 1]]])
    ends = (both[:, :, None] - found[:, :4]).reshape(2, len(bars), len(found), 2, 2)
    return np.hypot(ends[..., 0], ends[..., 1]).max(axis=-1).min(axis=(0, 2))


DASHES = np.array([[100.3, 300.0, 130.0, 250.4], [150.0, 220.0, 166.0, 192.0], [400.0, 180.0, 402.5, 172.0]])


@pytest.mark.parametrize(('thickness', 'level'), [(3.0, 200), (2.0, 130), (4.0, 240)])
def test_a_bar_has_its_ends_whatever_its_contrast(thickness: float, level: int) -> None:
    found = find_stripes(road(DASHES, thickness, level))
    # an end in an image that is soft over a pixel
    assert (apart(found, DASHES) < 0.75).all()
    assert len(found) == len(DASHES)


def test_neither_wide_areas_nor_dark_bars_are_bars() -> None:
    wide, dark = road(np.array([[100.0, 180.0, 300.0, 180.0]]), 60.0), road(DASHES, 3.0, level=30)
    assert not len(find_stripes(wide)) and not len(find_stripes(dark))


def test_bars_under_the_mask_are_left_out() -> None:
    ignored = np.zeros((HEIGHT, WIDTH), np.uint8)
    ignored[:, 380:] = 1
    found = find_stripes(road(DASHES, 3.0), ignored)
    assert len(found) == 2 and (found[:, [0, 2]] < 380).all()


def test_bars_belong_to_the_images_of_their_background() -> None:
    detector = StripeDetector(None)
    assert not detector.is_current((0.0, 1.0)) and detector.stripes_px.shape == (0, 5)
    detector.find(road(DASHES, 3.0), (0.0, 1.0))
    assert detector.is_current((0.0, 1.0)) and not detector.is_current((0.0, 1.0, 2.0))
    assert len(detector.stripes_px) == 3 and not len(detector.fresh().stripes_px)
    detector.find(None, ())
    assert detector.stripes_px.shape == (0, 5)


def test_the_snapshot_brings_the_bars_of_a_reduced_image_in_full_size() -> None:
    calibrator = AutoCalibrator(Options(max_image_width=WIDTH))
    image = cv2.resize(road(DASHES, 3.0), None, fx=2.0, fy=2.0, interpolation=cv2.INTER_LINEAR)
    for index in range(MIN_SAMPLES):
        calibrator.add_image(10**9 * index, noisy(image, 2.0, index))
    found = calibrator.snapshot().stripes_px
    assert (apart(found, 2.0 * DASHES + 0.5) < 2.0).all()  # a pixel of the reduced image
