"""The median of a few images: exact, free of what passes, and bounded in memory."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autocalib_ros.perception.background import MAX_INTERVAL_S, MAX_SAMPLES, MIN_SAMPLES, Background, median

JPEG = 3
"""Levels by which flat grey comes back otherwise."""


def flat(level: int) -> np.ndarray:
    return np.full((24, 32), level, np.uint8)


@pytest.mark.parametrize('count', range(1, 12))
def test_the_median_is_that_of_sorting(count: int) -> None:
    images = np.random.default_rng(count).integers(0, 256, (count, 7, 5), np.uint8)
    before = images.copy()
    # of an even number the upper one: the middle of the two would be a level that no image has
    np.testing.assert_array_equal(median(list(images)), np.sort(images, axis=0)[count // 2])
    np.testing.assert_array_equal(images, before)


def test_colours_have_medians_of_their_own() -> None:
    images = np.random.default_rng(0).integers(0, 256, (5, 6, 4, 3), np.uint8)
    np.testing.assert_array_equal(median(list(images)), np.sort(images, axis=0)[2])


@pytest.mark.parametrize(('count', 'there'), [(MIN_SAMPLES - 1, False), (MIN_SAMPLES, True)])
def test_there_is_no_grey_before_traffic_is_outvoted(count: int, there: bool) -> None:
    background = Background()
    assert not background.grey_samples((32, 24)) and background.image() is None
    for index in range(count):
        # something dark covers the road in the first two
        background.update(flat(30 if index < 2 else 150), float(index))
    assert bool(background.grey_samples((32, 24))) == there
    assert background.image().shape == (24, 32, 3)
    if there:
        assert np.abs(median(background.grey_samples((32, 24))).astype(int) - 150).max() <= JPEG


def test_images_between_the_intervals_are_not_kept() -> None:
    background = Background()
    for index in range(31):
        background.update(flat(100), 0.1 * index)
    np.testing.assert_allclose(background.times_s, np.arange(7) / 2)


@pytest.mark.parametrize('lost_s', [(2.0, 2.4), (6.9, 9.2), (30.0, 41.0)])
def test_lost_images_change_no_sample_but_those_of_their_time(lost_s: tuple[float, float]) -> None:
    whole, holed = Background(), Background()
    for index in range(900):
        time_s = index / 15
        whole.update(flat(100), time_s)
        if not lost_s[0] <= time_s < lost_s[1]:
            holed.update(flat(100), time_s)
    changed = set(whole.times_s) ^ set(holed.times_s)
    assert all(lost_s[0] <= time_s <= lost_s[1] + 0.1 for time_s in changed)


@pytest.mark.parametrize('rate_hz', [15.0, 25.0, 30.0])
def test_noise_of_the_times_changes_no_sample(rate_hz: float) -> None:
    even, noisy, random = Background(), Background(), np.random.default_rng(2)
    for index in range(900):
        even.update(flat(100), index / rate_hz)
        noisy.update(flat(100), index / rate_hz + random.uniform(-0.005, 0.005))
    assert np.round(np.array(noisy.times_s) * rate_hz).tolist() == np.round(np.array(even.times_s) * rate_hz).tolist()


def test_where_vehicles_stand_for_a_third_of_the_time_the_road_is_seen_at_any_time() -> None:
    random, background, shares = np.random.default_rng(1), Background(), []
    for second in range(120):
        covered = cv2.resize((random.random((30, 40)) < 1 / 3).astype(np.uint8), (320, 240), interpolation=0)
        background.update(np.where(covered > 0, np.uint8(30), np.uint8(150)), float(second))
        samples = background.grey_samples((320, 240))
        seen = median(samples) if samples else None
        shares += [float((seen[4::8, 4::8] < 90).mean())] if seen is not None else []
    # binomial: 21 % of the places from five images, 14 % from nine, 8 % from 17
    assert max(shares[MAX_SAMPLES:]) < 0.18
    assert np.median(shares[MAX_SAMPLES:]) < 0.12


def test_the_interval_grows_until_the_longest_and_no_more_images_are_held() -> None:
    background, image, gaps = Background(), flat(90), []
    step_s, seconds = 8.0, 6 * MAX_SAMPLES * MAX_INTERVAL_S
    for time_s in np.arange(0.0, seconds, step_s):
        background.update(image, float(time_s))
        assert len(background.times_s) <= MAX_SAMPLES
        gaps.append(np.diff(background.times_s).max(initial=0.0))
    # it has doubled from half a second, and doubles no more where that would be longer than the longest
    assert gaps[-1] > MAX_INTERVAL_S / 2
    assert max(gaps) <= MAX_INTERVAL_S
    assert len(background.times_s) == MAX_SAMPLES
    # nothing is left of what the road looked like long ago
    assert background.times_s[0] > seconds - (MAX_SAMPLES + 1) * MAX_INTERVAL_S
    assert background.times_s[-1] > seconds - MAX_INTERVAL_S - step_s


def test_strips_of_an_image_are_put_together_again() -> None:
    rows, columns = np.mgrid[:1100, :1900].astype(np.float32)
    image = np.dstack([columns / 8, rows / 5, 255 - (rows + columns) / 13]).astype(np.uint8)
    background = Background()
    for index in range(MIN_SAMPLES):
        background.update(image, float(index))
    assert np.abs(background.image().astype(int) - image).max() <= 2 * JPEG  # colours have half the resolution
    grey = median(background.grey_samples((1900, 1100)))
    assert np.abs(grey.astype(int) - cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)).max() <= JPEG
    assert median(background.grey_samples((950, 550))).shape == (550, 950)


@pytest.mark.parametrize(
    ('size', 'reduced'), [((3840, 2160), (960, 540)), ((1280, 720), (640, 360)), ((854, 480),) * 2]
)
def test_reduced_samples_are_halved_until_they_are_small(size: tuple[int, int], reduced: tuple[int, int]) -> None:
    background = Background()
    background.update(np.full((size[1], size[0]), 77, np.uint8), 0.0)
    (sample,) = background.reduced_samples()
    assert sample.shape == (reduced[1], reduced[0], 3) and (sample == 77).all()
