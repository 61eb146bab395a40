"""The search of moving regions, spread over the images that follow."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autocalib_ros.config import TrackingOptions
from autocalib_ros.perception import segments
from autocalib_ros.perception.klt_tracker import PointTracker
from autocalib_ros.perception.motion_mask import Region
from autocalib_ros.perception.segments import KeypointSearch
from autocalib_ros.perception.vehicle_search import MaskedFrame, VehicleSearch

STEP_PX = 7
"""Motion of the texture from one masked frame to the next."""


def texture() -> np.ndarray:
    noise = np.random.default_rng(3).uniform(0, 255, (200, 400)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def regions() -> list[Region]:
    sizes = [(20, 20, 90, 60), (140, 30, 80, 50), (250, 40, 60, 60), (30, 120, 40, 40), (150, 120, 30, 30)]
    return [Region(x, y, np.full((height, width), 255, np.uint8)) for x, y, width, height in sizes]


def frame(index: int) -> MaskedFrame:
    grey = np.roll(texture(), STEP_PX * index, axis=1)
    return MaskedFrame(grey, float(index), regions(), np.arange(5), np.zeros(5, bool))


def test_keypoints_in_two_steps_are_those_of_all_regions_in_their_order() -> None:
    sift = cv2.SIFT_create(contrastThreshold=0.03)
    search = KeypointSearch(texture(), regions(), sift)
    search.step()
    both = search.keypoints()
    for index, region in enumerate(regions()):
        alone = KeypointSearch(texture(), [region], sift).keypoints()
        np.testing.assert_array_equal(both.points_px[both.regions == index], alone.points_px)
    assert (np.diff(both.regions) >= 0).all() and len(np.unique(both.regions)) == 5


def test_the_two_steps_search_about_as_many_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[float] = []
    monkeypatch.setattr(
        segments,
        '_region_keypoints',
        lambda grey, region, sift: (
            searched.append(segments._searched_pixels(region)) or (np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128)))
        ),
    )
    search = KeypointSearch(texture(), regions(), cv2.SIFT_create())
    search.step()
    first = sum(searched)
    search.keypoints()
    assert len(searched) == 5
    assert 0.35 < first / sum(searched) < 0.65


def test_tracks_start_at_the_next_image_in_the_image_of_the_regions() -> None:
    search, tracker = VehicleSearch(), PointTracker(TrackingOptions())
    tracker.follow(frame(0).grey, 0.0)
    search.begin(frame(0))
    assert not len(tracker.positions()[0])
    search.go_on(tracker)
    points, vehicles = tracker.positions()
    assert len(points) > 20 and set(vehicles) == set(range(5))
    tracker.follow(frame(1).grey, 0.1)
    moved, _ = tracker.positions()
    assert np.median(moved[:, 0]) - np.median(points[:, 0]) == pytest.approx(STEP_PX, abs=1)


def test_segments_and_edges_are_of_the_frame_that_was_searched() -> None:
    search, tracker = VehicleSearch(), PointTracker(TrackingOptions())
    found = []
    for index in range(4):
        search.begin(frame(index))
        found += [search.go_on(tracker) for _ in range(3)]
    with_segments = [one for one, _ in found if one is not None]
    assert [one.time_s for one in with_segments] == [1.0, 2.0, 3.0]
    steps = with_segments[0].ends_px[:, 2:] - with_segments[0].ends_px[:, :2]
    np.testing.assert_allclose(np.median(steps, axis=0), [STEP_PX, 0], atol=0.5)
    assert [edges.time_s for _, edges in found if edges is not None] == [1.0, 3.0]


def test_nothing_is_left_out_where_every_image_is_searched() -> None:
    search, tracker = VehicleSearch(), PointTracker(TrackingOptions())
    times: list[float] = []
    for index in range(6):
        segments_of_last, edges = search.go_on(tracker)
        edges = search.begin(frame(index)) or edges
        times += [] if edges is None else [edges.time_s]
        assert (segments_of_last is not None) == (index > 1)
    assert times == [1.0, 3.0]


def test_a_restart_forgets_what_was_not_finished() -> None:
    search, tracker = VehicleSearch(), PointTracker(TrackingOptions())
    search.begin(frame(0))
    search.restart()
    assert search.go_on(tracker) == (None, None) and not len(tracker.positions()[0])
