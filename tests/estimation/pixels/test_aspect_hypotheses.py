"""What the size of an image lets expect of its pixels."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.estimation.pixels.aspect_hypotheses import AspectHypotheses


@pytest.mark.parametrize(
    ('size', 'expected'),
    [
        ((720, 576), {'4:3': 16 / 15, '16:9': 64 / 45}),
        ((720, 480), {'4:3': 8 / 9, '16:9': 32 / 27}),
        ((704, 480), {'4:3': 10 / 11, '16:9': 40 / 33}),
        ((704, 576), {'4:3': 12 / 11, '16:9': 16 / 11}),
        ((352, 288), {'4:3': 12 / 11, '16:9': 16 / 11}),
        ((960, 1080), {'4:3': 3 / 2, '16:9': 2.0}),
    ],
)
def test_television_and_recorders_squeeze_by_the_shape_of_their_pictures(
    size: tuple[int, int], expected: dict[str, float]
) -> None:
    hypotheses = AspectHypotheses.of(size)
    assert hypotheses.others == pytest.approx(expected)
    assert hypotheses.doubtful
    assert hypotheses.near_sigma == 0.0


@pytest.mark.parametrize(
    ('size', 'other'),
    [
        ((640, 360), {'4:3': 0.75}),
        ((1920, 1080), {'4:3': 0.75}),
        ((854, 480), {'4:3': 0.75}),
        ((640, 480), {'16:9': 4 / 3}),
        ((1440, 1080), {'16:9': 4 / 3}),
        ((640, 512), {'4:3': 16 / 15, '16:9': 64 / 45}),
    ],
)
def test_sizes_of_sensors_are_square_unless_shown_otherwise(size: tuple[int, int], other: dict[str, float]) -> None:
    hypotheses = AspectHypotheses.of(size)
    assert hypotheses.others == pytest.approx(other, rel=1e-3)  # 854 is 853.3 columns, rounded
    assert not hypotheses.doubtful
    assert hypotheses.near_sigma == 0.0


@pytest.mark.parametrize(
    ('size', 'squeeze'), [((640, 352), 352 / 360), ((1920, 1088), 1088 / 1080), ((848, 480), 853.33 / 848)]
)
def test_a_size_that_an_encoder_may_have_rounded_has_uncertain_pixels(size: tuple[int, int], squeeze: float) -> None:
    hypotheses = AspectHypotheses.of(size)
    assert hypotheses.near_sigma == pytest.approx(abs(np.log(squeeze)), rel=1e-3)
    assert squeeze not in hypotheses.others.values()


def test_a_cropped_image_is_taken_as_square() -> None:
    hypotheses = AspectHypotheses.of((1280, 600))
    assert (hypotheses.near_sigma, hypotheses.doubtful, hypotheses.expected) == (0.0, False, 1.0)


def test_what_a_recording_says_is_expected_and_square_pixels_are_another_hypothesis() -> None:
    told = AspectHypotheses.of((720, 576)).expecting(64 / 45)
    assert told.expected == 64 / 45
    assert not told.doubtful
    assert told.others == pytest.approx({'4:3': 16 / 15, 'square pixels': 1.0})
