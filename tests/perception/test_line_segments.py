"""Line segments of the static scene: where they are drawn, and nowhere else."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.perception.background import MIN_SAMPLES
from autocalib_ros.perception.line_segments import MAX_LINES, MIN_LINE_LENGTH, LineSegmentDetector
from autocalib_ros.perception.observer import Observer

WIDTH, HEIGHT = 640, 360
FINE = 8
"""Supersampling factor of the drawing."""
STRIPES = (
    np.array(
        [[[60 + 50 * n, 240], [80 + 50 * n, 240], [100 + 50 * n, 330], [76 + 50 * n, 330]] for n in range(6)], float
    )
    + 0.3
)
"""Corners (6, 4, 2) of white stripes."""
CAR_ROWS = (100, 170)
"""Rows that a rectangle passes, away from the stripes."""
WITHIN_PX = 0.5


@cache
def street(shift: float, factor: int) -> np.ndarray:
    """Stripes on a grey road that a camera moved by `shift` sees elsewhere, (H, W), each pixel the mean of its area."""
    fine = FINE * factor
    image = np.full((HEIGHT * fine, WIDTH * fine), 90, np.uint8)
    for stripe in STRIPES:
        corners = (stripe + [shift, 0.0] + 0.5) * fine - 0.5
        cv2.fillConvexPoly(image, np.round(corners).astype(np.int32), 220)
    reduced = cv2.resize(image, (WIDTH * factor, HEIGHT * factor), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(reduced, (0, 0), 0.7 * factor)


def picture(shift: float = 0.0, car_x: float | None = None, seed: int = 0, factor: int = 1) -> np.ndarray:
    """The street, with a bright rectangle where `car_x` is not None, as a camera sees it: grey uint8."""
    image = street(shift, factor).copy()
    if car_x is not None:
        left, right = (int(np.clip(x, 0, WIDTH)) * factor for x in (car_x, car_x + 90))
        image[CAR_ROWS[0] * factor : CAR_ROWS[1] * factor, left:right] = 240
    return noisy(image, 2.0, seed)


def edges(shift: float = 0.0) -> np.ndarray:
    """Ends (24, 2, 2) of the edges of all stripes."""
    corners = STRIPES + [shift, 0.0]
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def misses(lines: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Distance of lines (n, 4), both ends, from the nearest of edges (m, 2, 2), shape (n,)."""
    step = of[:, 1] - of[:, 0]
    length = np.hypot(*step.T)
    along = step / length[:, None]
    from_start = lines.reshape(-1, 1, 2, 2) - of[:, 0][None, :, None]
    across = np.abs(from_start[..., 0] * along[:, None, 1] - from_start[..., 1] * along[:, None, 0])
    at = (from_start * along[:, None]).sum(axis=-1)
    beyond = np.maximum(np.maximum(-at, at - length[:, None]) - 3.0, 0.0)  # corners are blurred
    return np.hypot(across, beyond).max(axis=2).min(axis=1, initial=np.inf)


def watched(options: Options, factor: int = 1) -> Observer:
    """Let a rectangle pass the stripes for ten seconds."""
    observer = Observer(options, (WIDTH * factor, HEIGHT * factor))
    for index in range(11):
        observer.observe(picture(car_x=-80.0 + 70 * index, seed=index, factor=factor), float(index))
    return observer


def test_every_stripe_is_found_and_passing_traffic_is_not() -> None:
    lines = watched(Options()).still_segments()[0]
    assert misses(lines, edges()).max() < WITHIN_PX
    sides = edges()[1::2]  # the long ones
    found = np.array([misses(lines, side[None]).min() for side in sides])
    assert len(sides) == 12 and (found < WITHIN_PX).sum() >= 10  # OpenCV 4.6 leaves out one
    # the rectangle alone has edges there, as the single image shows
    finder = LineSegmentDetector(None)
    finder.find(picture(car_x=300.0), (0.0,))
    alone = finder.lines_px[:, 1::2].mean(axis=1)
    assert (alone < CAR_ROWS[1] + 5).any()
    assert (lines[:, 1::2] > CAR_ROWS[1] + 5).all()


def test_the_longest_come_first_and_short_ones_not_at_all() -> None:
    lines = watched(Options()).still_segments()[0]
    length = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
    assert (np.diff(length) <= 1e-9).all()
    assert length.min() >= MIN_LINE_LENGTH * WIDTH


def test_no_line_touches_an_ignored_region() -> None:
    right = 220
    lines = watched(Options(ignore_regions=f'{right} 200 639 200 639 359 {right} 359')).still_segments()[0]
    assert len(lines) and lines[:, ::2].max() < right
    assert misses(lines, edges()).max() < WITHIN_PX  # none along its border, which is static
    everywhere = watched(Options()).still_segments()[0]
    assert everywhere[:, ::2].max() > right + 50


def test_a_mask_leaves_out_lines_that_only_cross_it() -> None:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[280:290] = 255
    finder = LineSegmentDetector(mask)
    finder.find(picture(), (0.0,))
    assert (
        len(finder.lines_px)
        and not ((finder.lines_px[:, 1::2].min(axis=1) < 280) & (finder.lines_px[:, 1::2].max(axis=1) > 290)).any()
    )


def test_wide_images_are_reduced_and_lines_come_in_pixels_of_the_full_size() -> None:
    lines = watched(Options(max_image_width=WIDTH), factor=2).still_segments()[0]
    assert misses((lines + 0.5) / 2 - 0.5, edges()).max() < WITHIN_PX
    assert lines[:, ::2].max() > 1.7 * edges()[..., 0].max()


def test_colour_is_as_good_as_grey() -> None:
    observer = Observer(Options(), (WIDTH, HEIGHT))
    for index in range(MIN_SAMPLES):
        observer.observe(cv2.cvtColor(picture(seed=index), cv2.COLOR_GRAY2BGR), float(index))
    lines = observer.still_segments()[0]
    assert len(lines) >= 12 and misses(lines, edges()).max() < WITHIN_PX


@pytest.mark.parametrize('count', [0, 1, MIN_SAMPLES - 1])
def test_there_are_no_lines_of_too_few_images(count: int) -> None:
    observer = Observer(Options(), (WIDTH, HEIGHT))
    for index in range(count):
        observer.observe(picture(seed=index), float(index))
    assert observer.still_segments()[0].shape == (0, 4)


def test_a_flat_image_has_no_lines() -> None:
    finder = LineSegmentDetector(None)
    finder.find(np.full((HEIGHT, WIDTH), 90, np.uint8), (0.0,))
    assert finder.lines_px.shape == (0, 4) and finder.is_current((0.0,))


def test_lines_are_looked_for_anew_only_where_the_background_has_changed() -> None:
    finder = LineSegmentDetector(None)
    assert not finder.is_current(())
    finder.find(picture(), (0.0, 1.0))
    assert finder.is_current((0.0, 1.0)) and not finder.is_current((0.0, 2.0))
    before = finder.lines_px
    finder.find(None, (0.0, 2.0))
    assert len(before) and finder.lines_px.shape == (0, 4)


def test_no_more_lines_are_held_than_allowed() -> None:
    finder, rows = LineSegmentDetector(None), np.zeros((1000, 1000), np.uint8)
    for y in range(0, 1000, 12):
        for x in range(0, 1000, 40):
            rows[y : y + 6, x : x + 28] = 200
    finder.find(rows, (0.0,))
    assert len(finder.lines_px) == MAX_LINES


@pytest.fixture(scope='module')
def bumped() -> AutoCalibrator:
    """Who saw the stripes for 20 s, then 8 px beside for 20 s."""
    calibrator = AutoCalibrator(Options())
    for index in range(80):
        calibrator.add_image(
            int(0.5e9 * index), picture(shift=0.0 if index < 40 else 8.0, car_x=20.0 * index - 90.0, seed=index)
        )
    return calibrator


def test_after_a_bump_the_old_lines_are_gone(bumped: AutoCalibrator) -> None:
    lines = bumped.snapshot().still_lines_px
    assert len(lines) >= 10
    assert misses(lines, edges(8.0)).max() < WITHIN_PX
    assert misses(lines, edges(0.0)).max() > 5.0


def test_the_snapshot_brings_the_lines() -> None:
    calibrator = AutoCalibrator(Options())
    for index in range(MIN_SAMPLES):
        assert calibrator.snapshot() is None or calibrator.snapshot().still_lines_px.shape == (0, 4)
        calibrator.add_image(10**9 * index, picture(seed=index))
    lines = calibrator.snapshot().still_lines_px
    assert lines.dtype == float and misses(lines, edges()).max() < WITHIN_PX
    np.testing.assert_array_equal(calibrator.snapshot().still_lines_px, lines)


def test_lines_are_there_two_seconds_after_the_first_image() -> None:
    observer = Observer(Options(), (WIDTH, HEIGHT))
    for index in range(22):  # 10 images a second
        observer.observe(picture(car_x=-80.0 + 30 * index, seed=index), 0.1 * index)
    lines = observer.still_segments()[0]
    assert len(lines) >= 12 and misses(lines, edges()).max() < WITHIN_PX


def test_lines_along_a_bar_are_dropped_and_those_that_end_at_it_are_kept() -> None:
    bar = 300  # ends within the stripes
    observer = Observer(Options(), (WIDTH, HEIGHT))
    for index in range(MIN_SAMPLES):
        image = picture(seed=index)
        image[bar:] = 0
        observer.observe(image, float(index))
    lines = observer.still_segments()[0]
    assert observer.picture(observer.view).rectangle == (0.0, 0.0, WIDTH, bar)
    assert (lines[:, 1::2].min(axis=1) < bar - 10).all()  # none along the border
    long = misses(lines, edges()[1::2])
    assert (long < WITHIN_PX).sum() >= 8  # the sides of the stripes, which the bar cuts


def test_lines_along_the_image_border_are_dropped() -> None:
    image = picture()
    image[-1], image[:, 0] = 30, 30
    finder = LineSegmentDetector(None)
    finder.find(image, (0.0,))
    assert len(finder.lines_px) and misses(finder.lines_px, edges()).max() < WITHIN_PX


def test_edges_that_half_of_the_samples_do_not_show_are_dropped() -> None:
    # the median of rectangles that each cover a part of the road in three images of five has edges of its own
    samples = [picture(car_x=x, seed=seed) for seed, x in enumerate((100.0, 130.0, 160.0, 400.0, 430.0))]
    median = np.median(np.stack(samples), axis=0).astype(np.uint8)
    finder = LineSegmentDetector(None)
    finder.find(median, (0.0,))
    assert (finder.lines_px[:, 1::2].max(axis=1) < CAR_ROWS[1] + 5).any()
    finder.find(median, (1.0,), samples=samples)
    upright = np.abs(np.diff(finder.lines_px[:, ::2])) < 3
    assert not ((finder.lines_px[:, 1::2].max(axis=1) < CAR_ROWS[1] + 5) & upright[:, 0]).any()
