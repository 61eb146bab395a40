"""Optical flow on the parts of the images around the points."""

import cv2
import numpy as np
import pytest

from autocalib_ros.perception import sparse_flow
from autocalib_ros.perception.sparse_flow import follow_points

SHAPE = (360, 640)
STEP = np.array([5.3, -2.2])
"""Motion from one image to the next, pixels."""


@pytest.fixture(scope='module')
def images() -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(0).uniform(0, 255, SHAPE).astype(np.float32)
    before = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    shift = np.array([[1, 0, STEP[0]], [0, 1, STEP[1]]])
    return before, cv2.warpAffine(before, shift, SHAPE[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def groups_of_points() -> np.ndarray:
    random = np.random.default_rng(1)
    centres = np.array([[60.0, 60], [320, 180], [600, 330], [100, 300]])
    return np.concatenate([centre + random.uniform(-25, 25, (20, 2)) for centre in centres])


def test_points_of_several_groups_are_found_where_they_moved(images: tuple[np.ndarray, np.ndarray]) -> None:
    start = groups_of_points()
    found, round_trip_px, tracked = follow_points(*images, start, start, window_px=11, levels=3)
    assert tracked.mean() > 0.95  # but a few that leave the picture
    assert np.abs(found - start - STEP)[tracked].max() < 0.1  # pixels: interpolation and noise
    assert np.median(round_trip_px[tracked]) < 0.05


def test_parts_of_the_images_give_what_whole_images_give(
    images: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    start = groups_of_points()
    parts = follow_points(*images, start, start, window_px=11, levels=3)
    monkeypatch.setattr(
        sparse_flow, '_part', lambda ends, shape, window_px: ((slice(None), slice(None)), np.zeros(2, np.float32))
    )
    whole = follow_points(*images, start, start, window_px=11, levels=3)
    np.testing.assert_array_equal(parts[2], whole[2])
    np.testing.assert_allclose(parts[0][whole[2]], whole[0][whole[2]], atol=0.02)  # pixels, at which the search ends


def test_only_the_surroundings_of_the_points_are_searched(
    images: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    shapes = []
    flow = cv2.calcOpticalFlowPyrLK
    monkeypatch.setattr(
        cv2, 'calcOpticalFlowPyrLK', lambda *args, **more: shapes.append(args[0].shape) or flow(*args, **more)
    )
    start = groups_of_points()
    follow_points(*images, start, start, window_px=11, levels=3)
    forwards = sum(height * width for height, width in shapes[::2])
    assert len(shapes) == 2 * 4 and forwards < 0.4 * SHAPE[0] * SHAPE[1]


def test_no_points_give_no_positions(images: tuple[np.ndarray, np.ndarray]) -> None:
    found, round_trip_px, tracked = follow_points(*images, np.zeros((0, 2)), np.zeros((0, 2)), window_px=11, levels=3)
    assert found.shape == (0, 2) and len(round_trip_px) == len(tracked) == 0


def test_a_point_outside_of_the_image_is_not_found(images: tuple[np.ndarray, np.ndarray]) -> None:
    start = np.array([[-80.0, 100.0], [700.0, 400.0]])
    assert not follow_points(*images, start, start, window_px=11, levels=3)[2].any()
