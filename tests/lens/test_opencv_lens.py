"""OpenCV's distortion, forwards and back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autocalib_ros.lens.opencv_lens import distort, undistort

LENSES = [
    (0.0,) * 8,
    (-0.3, 0.1, 0.0, 0.0, -0.02, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.003, -0.001, 0.0, 0.0, 0.0, 0.0),
    (-0.3, 0.1, -0.002, 0.004, -0.02, 0.0, 0.0, 0.0),
    (1.2, 0.3, 0.001, 0.0005, 0.01, 1.5, 0.5, 0.03),
]


@pytest.fixture
def normalised() -> np.ndarray:
    """Return normalised coordinates of bearings up to 40 degrees from the axis, shape (n, 2)."""
    generator = np.random.default_rng(0)
    around, length = 2 * np.pi * generator.random(500), 0.84 * np.sqrt(generator.random(500))
    return np.stack([length * np.cos(around), length * np.sin(around)], axis=1)


@pytest.mark.parametrize('coefficients', LENSES)
def test_distortion_is_that_of_opencv(normalised, coefficients):
    still = np.zeros(3)
    expected, _ = cv2.projectPoints(
        np.column_stack([normalised, np.ones(len(normalised))]), still, still, np.eye(3), np.array(coefficients)
    )
    np.testing.assert_allclose(distort(normalised, coefficients), expected[:, 0], atol=1e-12)


@pytest.mark.parametrize('coefficients', LENSES)
def test_distortion_is_undone(normalised, coefficients):
    # the table of radii is read between its entries: 1e-5 is a hundredth of a pixel at a focal length of 1000 px
    np.testing.assert_allclose(undistort(distort(normalised, coefficients), coefficients), normalised, atol=1e-5)


def test_what_lies_beyond_the_fold_is_not_taken_for_reached():
    # x (1 - 0.5 r^2) is largest, 0.544, at r = 0.816: nothing is imaged at 0.7
    found = undistort(np.array([[0.7, 0.0]]), (-0.5, *[0.0] * 7))
    assert distort(found, (-0.5, *[0.0] * 7))[0, 0] == pytest.approx(0.544, abs=1e-3)
