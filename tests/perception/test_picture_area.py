"""Tests of bars, image circles and burnt-in text in synthetic images of a street."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from autocalib_ros.perception.background import Background, median
from autocalib_ros.perception.ignore_regions import black_out
from autocalib_ros.perception.overlay_boxes import find_boxes
from autocalib_ros.perception.overlay_text import find_text
from autocalib_ros.perception.picture_area import PictureArea
from autocalib_ros.perception.picture_borders import _least_squares_circle, find_circle, find_rectangle

WIDTH, HEIGHT = 320, 240
JPEG_QUALITY = 60
"""Rings by ten levels at hard edges, as video at a low bit rate does."""


def street(index: int, gain: float = 1.0) -> np.ndarray:
    """Return a noisy street, BGR (H, W, 3), with sky, buildings, road, kerbs, dashes and a vehicle that moves."""
    return _street(index, gain).copy()


@cache
def _street(index: int, gain: float) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    image[:70] = (220, 205, 190)
    for left, top, right in ((10, 30, 90), (110, 45, 170), (230, 20, 318)):
        cv2.rectangle(image, (left, top), (right, 95), (70, 80, 110), -1)
        for x in range(left + 6, right - 8, 16):
            for y in range(top + 6, 90, 18):
                cv2.rectangle(image, (x, y), (x + 7, y + 10), (30, 30, 35), -1)
    cv2.line(image, (0, 200), (200, 95), (150, 150, 150), 3)
    cv2.line(image, (319, 190), (190, 95), (150, 150, 150), 3)
    for share in np.linspace(0.1, 0.9, 6):
        x, y = int(250 - 60 * share), int(235 - 140 * share)
        cv2.line(image, (x, y), (x - 4, y - 10), (235, 235, 235), 2)
    cv2.rectangle(image, (20 + 25 * index, 140), (60 + 25 * index, 165), (40, 40, 160), -1)
    noise = np.random.default_rng(index).normal(0.0, 2.0, image.shape)
    return np.clip(gain * image + noise, 0, 255).astype(np.uint8)


def night(index: int, sky: int = 14) -> np.ndarray:
    """Return a dark street with lamps under a sky of some level."""
    image = street(index, 0.12)
    image[:70] = np.where(image[:70] > 18, sky, image[:70])
    for x, y in ((40, 60), (140, 50), (260, 66)):
        cv2.circle(image, (x, y), 4, (180, 220, 240), -1)
    return image


def through_codec(image: np.ndarray) -> np.ndarray:
    return cv2.imdecode(cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1], cv2.IMREAD_COLOR)


def padded(image: np.ndarray, bars: tuple[int, int, int, int], colour: int = 0) -> np.ndarray:
    """Return an image with bars left, above, right and below."""
    left, above, right, below = bars
    return cv2.copyMakeBorder(image, above, below, left, right, cv2.BORDER_CONSTANT, value=(colour,) * 3)


def grey(images: list[np.ndarray]) -> np.ndarray:
    return np.stack([cv2.cvtColor(through_codec(image), cv2.COLOR_BGR2GRAY) for image in images])


def in_circle(image: np.ndarray, x: float, y: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.where((np.hypot(columns - x, rows - y) <= radius)[..., None], image, 0).astype(np.uint8)


BARS = [(0, 0, 0, 60), (0, 60, 0, 0), (50, 0, 0, 0), (0, 0, 50, 0), (0, 40, 0, 40), (40, 0, 40, 0), (30, 20, 30, 40)]


@pytest.mark.parametrize('scene', [street, night])
@pytest.mark.parametrize('bars', BARS)
def test_bars_are_found_to_the_pixel(scene, bars: tuple[int, int, int, int]) -> None:  # type: ignore[no-untyped-def]
    left, above, *_ = bars
    found = find_rectangle(grey([padded(scene(index), bars) for index in range(5)]))
    assert found == pytest.approx((left, above, left + WIDTH, above + HEIGHT), abs=1)


def test_a_grey_bar_is_found_too() -> None:
    found = find_rectangle(grey([padded(street(index), (0, 0, 0, 40), 70) for index in range(5)]))
    assert found == pytest.approx((0, 0, WIDTH, HEIGHT), abs=1)


def test_a_data_strip_with_text_and_clock_is_a_bar() -> None:
    images = [padded(street(index), (0, 24, 0, 0)) for index in range(5)]
    for index, image in enumerate(images):
        cv2.putText(image, f'CAM 7 12:04:0{index}', (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255,) * 3, 1)
    assert find_rectangle(grey(images)) == pytest.approx((0, 24, WIDTH, HEIGHT + 24), abs=1)


@pytest.mark.parametrize('scene', [street, night])
def test_a_scene_without_bars_fills_the_image(scene) -> None:  # type: ignore[no-untyped-def]
    samples = grey([scene(index) for index in range(5)])
    assert find_rectangle(samples) == (0, 0, WIDTH, HEIGHT) and find_circle(samples) is None


def test_a_black_sky_above_a_level_horizon_is_no_bar() -> None:
    images = [street(index, 0.12) for index in range(5)]
    for image in images:  # light fades above the horizon over twenty rows, as haze does
        image[:60] = 0
        image[60:90] = (np.arange(30)[:, None, None] * 1.5).astype(np.uint8)
    assert find_rectangle(grey(images)) == (0, 0, WIDTH, HEIGHT)


def test_a_black_sky_with_lamps_above_roofs_is_no_bar() -> None:
    assert find_rectangle(grey([night(index, sky=0) for index in range(5)])) == (0, 0, WIDTH, HEIGHT)


def test_a_white_sky_above_roofs_is_no_bar() -> None:
    images = [street(index) for index in range(5)]
    for image in images:
        image[:70] = np.where(image[:70] > 170, 255, image[:70])
    assert find_rectangle(grey(images)) == (0, 0, WIDTH, HEIGHT)


def test_a_bar_is_found_although_one_image_is_torn() -> None:
    images = [padded(street(index), (0, 0, 0, 60)) for index in range(5)]
    images[2][:] = 128
    assert find_rectangle(grey(images)) == pytest.approx((0, 0, WIDTH, HEIGHT), abs=1)


@pytest.mark.parametrize('circle', [(159.5, 119.5, 118.0), (170.0, 112.0, 100.0), (150.0, 125.0, 160.0)])
@pytest.mark.parametrize('scene', [street, night])
def test_the_image_circle_is_found(scene, circle: tuple[float, float, float]) -> None:  # type: ignore[no-untyped-def]
    found = find_circle(grey([in_circle(scene(index), *circle) for index in range(5)]))
    # half a pixel of the mask, and compression
    np.testing.assert_allclose(found, circle, atol=1.0)


def test_a_pool_of_light_at_night_is_no_image_circle() -> None:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    light = np.exp(-((columns - 160) ** 2 / 70.0**2 + (rows - 130) ** 2 / 45.0**2))
    samples = grey([(street(index) * 0.6 * light[..., None]).astype(np.uint8) for index in range(5)])
    assert find_circle(samples) is None


def stamped(index: int, text: str, x: int, y: int, colour: tuple[int, int, int] = (255, 255, 255)) -> np.ndarray:
    image = street(index)
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
    return image


@pytest.mark.parametrize('colour', [(255, 255, 255), (0, 255, 255)])
@pytest.mark.parametrize(('x', 'y'), [(6, 232), (120, 225)])
def test_text_is_found(x: int, y: int, colour: tuple[int, int, int]) -> None:
    boxes = find_text([through_codec(stamped(index, 'North St 4821', x, y, colour)) for index in range(5)])
    assert len(boxes) == 1
    box, width = boxes[0], cv2.getTextSize('North St 4821', cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0]
    # windows of three letter heights reach beyond the text; the margin of the mask covers half a letter
    assert x - 24 <= box.x0 <= x + 4 and x + width - 4 <= box.x1 <= x + width + 24 and abs(box.y1 - y) <= 4


def test_a_running_clock_is_found_with_its_digits() -> None:
    boxes = find_text([through_codec(stamped(index, f'12:04:{11 * index + 5:02d}', 200, 230)) for index in range(5)])
    assert len(boxes) == 1 and boxes[0].x1 >= 255


def test_windows_dashes_and_kerbs_are_no_text() -> None:
    assert find_text([through_codec(street(index)) for index in range(5)]) == []


def test_a_crosswalk_is_no_text() -> None:
    images = [street(index) for index in range(5)]
    for image in images:
        for x in range(60, 260, 12):
            cv2.rectangle(image, (x, 200), (x + 5, 220), (235, 235, 235), -1)
    assert find_text([through_codec(image) for image in images]) == []


def test_a_logo_on_an_opaque_box_is_found_and_windows_and_signs_are_not() -> None:
    images = [street(index) for index in range(5)]
    for image in images:
        cv2.rectangle(image, (262, 195), (312, 230), (150, 60, 20), -1)
        cv2.circle(image, (287, 212), 12, (255, 255, 255), 3)
        cv2.fillConvexPoly(image, np.array([[100, 185], [150, 187], [149, 221], [101, 222]]), (40, 160, 60))
    boxes = find_boxes(median([cv2.cvtColor(through_codec(image), cv2.COLOR_BGR2GRAY) for image in images])[100:])
    assert len(boxes) == 1
    np.testing.assert_allclose(boxes[0], (262, 95, 312, 130), atol=2.5)


def area_after(images: list[np.ndarray], interval_s: float = 0.5) -> PictureArea:
    background, size = Background(), (images[0].shape[1], images[0].shape[0])
    area = PictureArea(size, size)
    for index, image in enumerate(images):
        background.update(image, index * interval_s)
        area.update(background)
    return area


def test_the_mask_covers_bar_and_text_and_leaves_the_picture() -> None:
    images = [padded(stamped(index, 'Cam 12', 10, 230), (0, 0, 0, 40)) for index in range(4)]
    area = area_after(images)
    assert area.picture.rectangle == (0.0, 0.0, WIDTH, HEIGHT)
    assert area.mask is not None
    assert area.mask[HEIGHT:].all() and area.mask[222:230, 12:60].all()
    assert not area.mask[:200].any()


def test_an_ignored_region_along_a_side_is_no_bar() -> None:
    polygon = ((0.0, 0.0), (WIDTH - 1.0, 0.0), (WIDTH - 1.0, 60.0), (0.0, 60.0))
    background, area = Background(), PictureArea((WIDTH, HEIGHT), (WIDTH, HEIGHT), (polygon,))
    for index in range(5):
        background.update(black_out(street(index), (polygon,)), 0.5 * index)
        area.update(background)
    assert area.picture.fills_image and area.mask is None


def test_nothing_is_masked_before_three_images_and_in_a_plain_scene() -> None:
    assert area_after([padded(street(index), (0, 0, 0, 40)) for index in range(2)]).mask is None
    assert area_after([street(index) for index in range(5)]).mask is None


def test_a_view_that_begins_late_is_looked_at_as_often_as_the_first() -> None:
    """A day into the stream, half of its time would be twelve hours."""
    size = (WIDTH, HEIGHT)
    background, area, found = Background(), PictureArea(size, size), []
    for index in range(70):
        image = stamped(index, 'Cam 12', 10, 230) if index > 2 else street(index)
        background.update(image, 86_400.0 + 0.5 * index)
        area.update(background)
        found.append(area.mask is not None)
    assert not any(found[:3])
    assert found[-1]


@pytest.mark.parametrize('count', [0, 2])
def test_no_circle_goes_through_fewer_than_three_points(count: int) -> None:
    """By night the rim of what is lit may lie on no circle at all."""
    assert _least_squares_circle(np.zeros((count, 2))) is None
