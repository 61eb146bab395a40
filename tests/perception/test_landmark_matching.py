"""Landmarks of a background, and where one picture lies in another."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autocalib_ros.perception.landmark_matching import find_landmarks, register

SIZE = (320, 240)


def texture(seed: int) -> np.ndarray:
    """Return a grey picture of smooth blobs."""
    coarse = np.random.default_rng(seed).integers(30, 220, (24, 32)).astype(np.uint8)
    return cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC)


def shifted(image: np.ndarray, x: float, y: float) -> np.ndarray:
    return cv2.warpAffine(image, np.array([[1.0, 0.0, x], [0.0, 1.0, y]]), SIZE, borderMode=cv2.BORDER_REPLICATE)


@pytest.mark.parametrize(('x', 'y'), [(0.0, 0.0), (1.3, -0.7), (-4.0, 2.5), (30.0, 0.0)])
def test_a_displacement_is_found_to_a_tenth_of_a_pixel_in_other_light(x, y):
    road = texture(1)
    later = np.clip(0.6 * shifted(road, x, y) + 20, 0, 255).astype(np.uint8)
    found = register(find_landmarks(later, None), find_landmarks(road, None), SIZE)
    # takes pixels of the later picture back to those of the first
    moved = found.matrix @ [160.0, 120.0, 1.0]
    assert moved == pytest.approx([160 - x, 120 - y], abs=0.1)
    assert found.displacement_px == pytest.approx(np.hypot(x, y), abs=0.2)


def test_another_view_is_not_registered():
    assert register(find_landmarks(texture(2), None), find_landmarks(texture(1), None), SIZE) is None


def test_a_picture_without_texture_is_not_registered():
    flat = find_landmarks(np.full(SIZE[::-1], 90, np.uint8), None)
    assert len(flat) == 0
    assert register(flat, find_landmarks(texture(1), None), SIZE) is None


def test_what_stays_in_a_corner_only_is_no_view():
    """A burnt-in text or a parked lorry is the same in two views."""
    one, other = texture(1), texture(2)
    other[:60, :110] = one[:60, :110]
    assert register(find_landmarks(other, None), find_landmarks(one, None), SIZE) is None


def test_landmarks_keep_out_of_the_mask_and_are_spread():
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[:, :160] = 1
    found = find_landmarks(texture(1), mask)
    assert len(found) > 50 and found.points_px[:, 0].min() >= 159
