"""Smaller versions of one image."""

import cv2
import numpy as np
import pytest

from autocalib_ros.perception.reductions import Reductions


def noise(width: int, height: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width), np.uint8)


@pytest.mark.parametrize(
    ('of', 'to'),
    [((1280, 720), (640, 360)), ((1280, 720), (320, 180)), ((854, 480), (320, 179)), ((352, 288), (320, 261))],
)
def test_a_reduction_is_the_average_over_the_pixels(of: tuple[int, int], to: tuple[int, int]) -> None:
    image = noise(*of)
    expected = cv2.resize(image, to, interpolation=cv2.INTER_AREA).astype(int)
    # each halving rounds once
    assert np.abs(Reductions(image).at(to) - expected).max() <= 1


def test_each_size_is_made_once_and_the_whole_size_is_the_image_itself() -> None:
    image = noise(640, 480)
    reductions = Reductions(image)
    assert reductions.at((320, 240)) is reductions.at((320, 240))
    assert reductions.at((640, 480)) is image
