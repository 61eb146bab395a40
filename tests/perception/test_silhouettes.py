"""Outlines: where what moves reaches farthest, in pixels of the full image, and their gaps."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autocalib_ros.config import MotionOptions, Options
from autocalib_ros.evidence.tables import OUTLINE_COLUMNS
from autocalib_ros.perception.motion_mask import MotionMask, Region
from autocalib_ros.perception.observer import Observer
from autocalib_ros.perception.silhouettes import outlines_of

SHAPE = (360, 640)


def region(x: int, y: int, width: int, height: int) -> Region:
    return Region(x, y, np.full((height, width), 255, np.uint8))


def test_a_rectangle_has_its_four_sides_and_corners() -> None:
    ends = outlines_of([region(100, 50, 40, 20)], (0.0, 0.0), SHAPE, 1.0)[0]
    # its first and last pixels are columns 100 and 139, rows 50 and 69: it reaches half a pixel beyond their centres
    np.testing.assert_allclose(ends[:8], [99.5, 49.5, 139.5, 69.5, 99.5, 69.5, 139.5, 49.5])
    np.testing.assert_allclose(ends[8:16], [99.5, 59.5, 139.5, 59.5, 119.5, 49.5, 119.5, 69.5])
    assert ends[16] == 50.0


def test_the_corners_of_a_disc_are_cut_off() -> None:
    mask = np.zeros((61, 61), np.uint8)
    cv2.circle(mask, (30, 30), 30, 255, -1)
    ends = outlines_of([Region(200, 100, mask)], (0.0, 0.0), SHAPE, 1.0)[0]
    from_centre = ends[:16].reshape(8, 2) - (230, 130)
    np.testing.assert_allclose(np.hypot(*from_centre.T), 30.5, atol=1)
    turn = np.degrees(np.arctan2(*from_centre.T[::-1]))
    np.testing.assert_allclose(turn % 360, [225, 45, 135, 315, 180, 0, 270, 90], atol=2)


def test_a_larger_image_has_larger_outlines() -> None:
    small, large = (outlines_of([region(100, 50, 40, 20)], (0.0, 0.0), SHAPE, reduction)[0] for reduction in (1.0, 3.0))
    corner = np.append(np.full(16, 0.5), 0.0)  # of the image, from where it is enlarged
    np.testing.assert_allclose(large + corner, 3.0 * (small + corner))


def test_gaps_are_to_the_nearest_region_or_border() -> None:
    regions = [region(100, 50, 40, 20), region(160, 50, 40, 20), region(400, 300, 40, 50)]
    np.testing.assert_allclose(outlines_of(regions, (0.0, 0.0), SHAPE, 1.0)[:, -1], [20, 20, 10])


def test_a_silhouette_next_to_an_ignored_region_has_no_gap() -> None:
    ignored = np.zeros(SHAPE, np.uint8)
    ignored[60:, :105] = 255
    regions = [region(100, 50, 40, 20), region(160, 50, 40, 20)]
    np.testing.assert_allclose(outlines_of(regions, (0.0, 0.0), SHAPE, 1.0, ignored)[:, -1], [0, 20])


def test_an_image_without_motion_has_no_outlines() -> None:
    assert outlines_of([], (0.0, 0.0), SHAPE, 1.0).shape == (0, OUTLINE_COLUMNS)


def scene(time_s: float) -> np.ndarray:
    """A bright block of 60 x 90 pixels that crosses a dark road at 45 px/s, after two seconds."""
    image = np.full(SHAPE, 60, np.uint8)
    if time_s >= 2.0:
        left = round(100 + 45 * (time_s - 2.0))
        image[120:210, left : left + 60] = 200
    return image


def test_the_outline_of_a_moving_block_is_its_own_to_a_pixel_of_the_mask() -> None:
    motion = MotionMask(MotionOptions())
    for index in range(50):
        motion.update(scene(0.1 * index), 0.1 * index)
    [ends] = outlines_of(motion.regions(), motion.dilation_px, SHAPE, 1.0)
    left = round(100 + 45 * 2.9)
    assert motion.dilation_px == (2.0, 2.0)
    np.testing.assert_allclose(ends[:4], [left, 120, left + 60, 210], atol=3)


@pytest.mark.parametrize('reduced_width', [640, 320])
def test_silhouettes_are_in_pixels_of_the_full_image(reduced_width: int) -> None:
    observer = Observer(Options(max_image_width=reduced_width), (SHAPE[1], SHAPE[0]))
    noise = np.random.default_rng(0).integers(-3, 4, (8, *SHAPE))
    found = []
    for index in range(62):
        image = np.clip(scene(0.1 * index) + noise[index % 8], 0, 255).astype(np.uint8)
        outlines = observer.observe(image, 0.1 * index).outlines
        found += [] if outlines is None or outlines.time_s < 2.5 else [outlines]
    assert len(found) >= 4
    for outlines in found:
        left = round(100 + 45 * (outlines.time_s - 2.0))
        np.testing.assert_allclose(outlines.ends_px[:, :4], [[left, 120, left + 60, 210]], atol=5)
