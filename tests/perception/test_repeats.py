"""Repeated images, through codecs or not, against new images of busy and of empty roads."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy, paste

from autocalib_ros.config import Options
from autocalib_ros.perception.frame_gate import FrameGate, FrameStatus
from autocalib_ros.perception.observer import Observer
from autocalib_ros.perception.repeats import MAX_REPEAT_S, RepeatDetector

SIZE = (180, 320)
INTERVAL_S = 1 / 30


def texture(seed: int, shape: tuple[int, int], sigma: float = 1.5) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, shape), (0, 0), sigma)
    return np.clip(110 + 40 * noise / noise.std(), 0, 255)


ROAD = texture(0, SIZE) * 0.4 + 60
CARS = (texture(1, (24, 40)), texture(2, (30, 50)), texture(3, (10, 14)))
PLACES = ((40, 20.0, 2.5), (110, 250.0, -4.0), (20, 60.0, 0.8))
"""Row, first column, and pixels per image of each car."""


def drawn(index: int, cars: int, noise: float = 0.0, first: int = 0) -> np.ndarray:
    """Cars that pass on a still road, over and over, grey uint8."""
    image = ROAD.copy()
    for car, (row, start, step) in list(zip(CARS, PLACES, strict=True))[first:cars]:
        column = (start + step * index + 60) % (SIZE[1] + 120) - 60
        paste(image, car, column, row)
    return noisy(image, noise, index)


def encoded(image: np.ndarray, quality: int) -> np.ndarray:
    """What a codec makes of an image; the quality of a repeat differs from that of the image itself."""
    return cv2.imdecode(cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE)


def skipped(images: list[np.ndarray], threshold: float) -> list[np.ndarray]:
    """Leave out, as a codec does, the macroblocks that change by less than `threshold` levels."""
    sent = [images[0]]
    for image in images[1:]:
        change = cv2.blur(cv2.absdiff(image, sent[-1]), (16, 16))[8::16, 8::16]
        keep = cv2.resize((change < threshold).astype(np.uint8), SIZE[::-1], interpolation=cv2.INTER_NEAREST)
        sent.append(np.where(keep[: SIZE[0], : SIZE[1]] > 0, sent[-1], image))
    return sent


def judged(images: list[np.ndarray]) -> list[bool]:
    """Return for each image whether it is called a repeat."""
    gate = FrameGate(RepeatDetector(), 6.0)
    return [gate.classify(image, INTERVAL_S * index) is FrameStatus.REPEATED for index, image in enumerate(images)]


PATTERNS = {
    '25 in 30': [index - index // 6 for index in range(120)],
    '15 in 30': [index // 2 for index in range(120)],
    'three new, three repeats': [index // 6 * 3 + min(index % 6, 2) for index in range(120)],
    'at random': np.cumsum(np.random.default_rng(0).integers(0, 2, 120)).tolist(),
}


@pytest.mark.parametrize('noise', [0.0, 4.0])
@pytest.mark.parametrize('pattern', PATTERNS)
def test_repeats_through_a_codec_are_found_and_new_images_are_not(pattern: str, noise: float) -> None:
    order = PATTERNS[pattern]
    # each image comes through the codec at another quality: repeats differ by several levels
    images = [encoded(drawn(number, 3, noise), 80 - 7 * (index % 3)) for index, number in enumerate(order)]
    repeats = np.diff(order, prepend=-1) == 0
    found = np.array(judged(images))
    assert not found[~repeats].any()
    assert found[repeats][3:].mean() > 0.95  # the first are needed to learn what moves


def test_every_image_is_new_where_none_repeats() -> None:
    for noise in (0.0, 1.5, 8.0):
        assert not any(judged([drawn(index, 3, noise) for index in range(100)]))


def test_images_of_which_a_codec_sends_the_traffic_only_are_new() -> None:
    assert not any(judged(skipped([drawn(index, 3, 1.5) for index in range(120)], threshold=4.0)))


@pytest.mark.parametrize('noise', [0.5, 1.5, 6.0])
def test_an_empty_road_is_no_repeat(noise: float) -> None:
    road = [drawn(index, 0, noise) for index in range(150)]
    assert not any(judged(road))


def test_an_empty_road_behind_a_codec_that_sends_nothing_is_new_after_two_seconds() -> None:
    found = judged(120 * [drawn(0, 0)])
    assert not any(found[int(MAX_REPEAT_S / INTERVAL_S) + 2 :])


def test_the_road_after_its_last_vehicle_left_is_no_repeat() -> None:
    images = skipped([drawn(index, 1, 1.0) for index in range(190)], threshold=4.0)
    assert not any(judged(images))  # the car leaves at the right edge and enters at the left again


def test_a_single_small_vehicle_is_enough_to_tell() -> None:
    small = [drawn(index, 3, first=2) for index in range(120)]  # 14 pixels long, 0.8 pixels per image
    assert not any(judged(small))
    twice = np.array(judged([image for image in small for _ in range(2)]))
    assert twice[7::2].all() and not twice[::2].any()


def test_a_keyframe_is_neither_a_repeat_nor_ends_one() -> None:
    # every twentieth image is encoded anew, which changes the whole picture
    order = [index // 2 for index in range(160)]
    images = [encoded(drawn(number, 3), 40 if index % 20 == 0 else 90) for index, number in enumerate(order)]
    found = np.array(judged(images))
    assert not found[::2].any() and found[7::2].mean() > 0.9


def test_a_frozen_stream_is_followed_again() -> None:
    order = [*range(40), *(15 * [39]), *range(60, 100)]  # half a second
    found = judged([encoded(drawn(number, 3, 2.0), 70 + index % 2) for index, number in enumerate(order)])
    assert found == [40 <= index < 55 for index in range(len(order))]


def test_repeats_refined_by_a_codec_end_no_track() -> None:
    """Half of each new image comes with its repeat, so that the picture cannot tell; the points stand still."""

    def fine_and_coarse(number: int) -> tuple[np.ndarray, np.ndarray]:
        image = cv2.resize(drawn(number, 2), (640, 360), interpolation=cv2.INTER_CUBIC)
        return image, encoded(image, 15)

    once, twice = (Observer(Options(), (640, 360)) for _ in range(2))
    for number in range(60):
        fine, coarse = fine_and_coarse(number)
        once.observe(fine, number * 2 * INTERVAL_S)
        twice.observe(coarse, number * 2 * INTERVAL_S)
        twice.observe(fine, (number * 2 + 1) * INTERVAL_S)
    lengths = [sorted(len(track.times_s) for track in observer.unfinished()) for observer in (once, twice)]
    assert len(lengths[1]) > 0.8 * len(lengths[0]) > 5
    assert twice.repeated > 45
