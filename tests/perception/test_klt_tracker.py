"""Point tracking on drawn traffic whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autocalib_ros.config import TrackingOptions
from autocalib_ros.evidence.snapshot import Track
from autocalib_ros.perception.klt_tracker import PointTracker, _is_discontinuous

SIZE = (160, 320)


def texture(seed: int, shape: tuple[int, int]) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, shape)
    return cv2.GaussianBlur(noise, (0, 0), 1.5) * 3 % 256


ROAD = texture(0, SIZE) * 0.2 + 100
CAR = texture(1, (40, 60))


def scene(offset: tuple[float, float] | None) -> np.ndarray:
    """A still road with a textured car at a sub-pixel offset, uint8 (160, 320)."""
    image = ROAD.copy()
    if offset is not None:
        moved = cv2.warpAffine(CAR, np.array([[1.0, 0, offset[0]], [0, 1.0, offset[1]]]), SIZE[::-1])
        mask = cv2.warpAffine(np.ones_like(CAR), np.array([[1.0, 0, offset[0]], [0, 1.0, offset[1]]]), SIZE[::-1])
        image = image * (1 - mask) + moved * mask
    return image.astype(np.uint8)


def follow(offsets: list[tuple[float, float] | None], interval_s: float = 0.1) -> tuple[PointTracker, list[Track]]:
    tracker, finished = PointTracker(TrackingOptions()), []
    for index, offset in enumerate(offsets):
        finished += tracker.follow(scene(offset), index * interval_s)
        if index == 0:
            inside = np.array([(20.0, 20.0), (35.0, 15.0), (45.0, 28.0)]) + (offset or (0.0, 0.0))
            tracker.add_points(inside, np.array([7, 7, 7]))
    return tracker, finished


def test_points_follow_sub_pixel_motion() -> None:
    path = [(20 + 3.3 * index, 40 + 0.7 * index) for index in range(20)]
    tracker, _ = follow(path)
    tracks = tracker.unfinished()
    assert len(tracks) == 3
    for track in tracks:
        step = track.points_px[-1] - track.points_px[0]
        np.testing.assert_allclose(step, (3.3 * 19, 0.7 * 19), atol=0.3)  # KLT's own accuracy over 19 steps


def test_a_track_keeps_its_vehicle_and_times() -> None:
    tracker, _ = follow([(20 + 3.0 * index, 40) for index in range(15)])
    track = tracker.unfinished()[0]
    assert track.vehicle == 7
    assert track.times_s[0] == 0.0 and track.times_s[-1] == pytest.approx(1.4)
    assert (np.diff(track.times_s) > 0).all()


def test_a_point_that_vanishes_ends_its_track() -> None:
    tracker, finished = follow([(20 + 3.0 * index, 40) for index in range(12)] + [None, None])
    assert len(finished) == 3 and not tracker.unfinished()


def test_a_point_that_stops_ends_its_track() -> None:
    moving = [(20 + 3.0 * index, 40.0) for index in range(12)]
    _, finished = follow(moving + 20 * [moving[-1]])
    assert len(finished) == 3


def test_still_points_never_become_tracks() -> None:
    tracker, finished = follow(30 * [(20.0, 40.0)])
    assert not finished and not tracker.unfinished()


def test_a_gap_in_time_ends_all_tracks() -> None:
    tracker, _ = follow([(20 + 3.0 * index, 40) for index in range(12)])
    finished = tracker.follow(scene((53.0, 40)), 60.0)
    assert len(finished) == 3 and not tracker.unfinished()


def test_points_keep_their_distance() -> None:
    tracker = PointTracker(TrackingOptions(min_spacing_px=10.0))
    tracker.follow(scene((20, 40)), 0.0)
    tracker.add_points(np.array([(41.0, 61.0), (43.0, 63.0), (75.0, 61.0)]), np.zeros(3, int))
    points, _ = tracker.positions()
    assert points.tolist() == [[41.0, 61.0], [75.0, 61.0]]


def test_no_more_points_than_allowed() -> None:
    tracker = PointTracker(TrackingOptions(max_points=20))
    tracker.follow(scene(None), 0.0)
    grid = np.stack(np.meshgrid(np.arange(15, 300, 12.0), np.arange(15, 150, 12.0)), -1).reshape(-1, 2)
    tracker.add_points(grid, np.zeros(len(grid), int))
    assert len(tracker.positions()[0]) == 20


def test_a_track_has_no_more_samples_than_allowed() -> None:
    tracker, _ = follow([(20 + 1.7 * index, 40) for index in range(100)])
    assert max(len(track.times_s) for track in tracker.unfinished()) <= TrackingOptions().max_samples


def test_uneven_steps_along_one_line_are_followed() -> None:
    # a recorder that drops and delays images: steps of 5, 10 and 3 px
    along = np.cumsum([0, 5, 5, 10, 5, 5, 3, 5, 10, 5, 5, 10])
    tracker, finished = follow([(20.0 + step, 40.0) for step in along])
    assert not finished and len(tracker.unfinished()) == 3


GRID = np.stack(np.meshgrid(np.arange(9.0, 55.0, 11.0), np.arange(9.0, 35.0, 11.0)), -1).reshape(-1, 2)
"""Fifteen points on the car."""


def follow_all(steps: list[float], *, told: bool) -> PointTracker:
    """Follow 15 points through steps along the road; a step of zero is a repeat through a codec."""
    tracker, place = PointTracker(TrackingOptions()), 20.0
    for index, step in enumerate([0.0, *steps]):
        place += step
        image = scene((place, 40.0))
        if step == 0:
            image = cv2.imdecode(cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], cv2.IMREAD_GRAYSCALE)
        if told and step == 0 and index:
            tracker.skip_repeat()
        else:
            assert not tracker.follow(image, 0.04 * index)
        if index == 0:
            tracker.add_points(GRID + (place, 40.0), np.zeros(len(GRID), int))
    return tracker


@pytest.mark.parametrize('told', [True, False])
@pytest.mark.parametrize(
    'steps',
    [
        [5, 5, 5, 0, 5, 5, 5, 0, 5, 5, 5, 0, 5, 5],  # a camera slower than its recorder
        [5, 5, 5, 0, 10, 5, 5, 0, 10, 5, 5, 0, 10, 5],  # stalls
        [5, 5, 5, 0, 0, 0, 10, 5, 5, 0, 0, 0, 10, 5, 5],  # as recorded by a network camera
        [5, 0, 5, 0, 5, 0, 5, 0, 5, 0, 5, 0, 5],
        [*(8 * [5, 5, 0, 5, 0]), 5],  # the usual interval is that of the images, repeats among them
    ],
)
def test_a_step_of_zero_ends_no_point(steps: list[float], told: bool) -> None:
    tracks = follow_all(steps, told=told).unfinished()
    assert len(tracks) == len(GRID)
    for track in tracks:
        place = 20.0 + np.cumsum([0.0, *steps])
        expected = place[np.round(track.times_s / 0.04).astype(int)]
        np.testing.assert_allclose(track.points_px[:, 0] - track.points_px[0, 0], expected - 20.0, atol=0.5)
        assert (np.diff(expected) > 0).all()  # repeats give no sample


def test_a_point_that_sticks_while_others_go_on_ends() -> None:
    tracker = PointTracker(TrackingOptions())
    post = scene(None)[40:120, 140:152]
    for index in range(20):
        image = scene((20.0 + 5 * index, 40.0))
        image[40:120, 140:152] = post  # in front of the car
        ended = tracker.follow(image, 0.04 * index)
        if index == 0:
            tracker.add_points(GRID + (20.0, 40.0), np.zeros(len(GRID), int))
        if ended:
            assert 100 < ended[0].points_px[-1, 0] < 152
            return
    pytest.fail('no point has ended at the post')


@pytest.mark.parametrize('lost', [(8,), (8, 9), (8, 9, 10, 11), (4, 6, 7, 9, 10, 11, 13)])
def test_lost_images_end_no_track(lost: tuple[int, ...]) -> None:
    tracker, finished = PointTracker(TrackingOptions()), []
    for index in range(20):
        if index in lost:
            continue
        offset = (20.0 + 6.0 * index, 40.0)
        finished += tracker.follow(scene(offset), 0.1 * index)
        if index == 0:
            tracker.add_points(np.array([(40.0, 60.0), (55.0, 55.0), (65.0, 68.0)]), np.array([7, 7, 7]))
    assert not finished
    for track in tracker.unfinished():
        np.testing.assert_allclose(np.diff(track.points_px[:, 0]) / np.diff(track.times_s), 60.0, atol=3.0)


def test_single_frames_between_losses_are_taken_for_single_ones() -> None:
    # three of every five images are lost: the upper quartile of the intervals is four frames, one frame is no odd stamp
    tracker, finished = PointTracker(TrackingOptions()), []
    for index in sorted([*range(0, 40, 5), *range(1, 40, 5)]):
        finished += tracker.follow(scene((15.0 + 5.5 * index, 40.0)), 0.1 * index)
        if index == 0:
            tracker.add_points(GRID + (15.0, 40.0), np.zeros(len(GRID), int))
    assert not finished and len(tracker.unfinished()) == len(GRID)
    for track in tracker.unfinished():
        np.testing.assert_allclose(np.diff(track.points_px[:, 0]) / np.diff(track.times_s), 55.0, atol=4.0)


def test_one_short_interval_ends_no_track() -> None:
    # the stamp of one image 1 ms after the one before: the interval after it is no gap, nor is any later one
    tracker, finished = PointTracker(TrackingOptions()), []
    for index in range(20):
        finished += tracker.follow(scene((20.0 + 6.0 * index, 40.0)), 0.1 * index - (0.099 if index == 8 else 0.0))
        if index == 0:
            tracker.add_points(np.array([(40.0, 60.0), (55.0, 55.0), (65.0, 68.0)]), np.array([7, 7, 7]))
        if index == 12:  # a new one is taken as before
            tracker.add_points(np.array([(20.0 + 6.0 * index + 8.0, 70.0)]), np.array([8]))
    assert not finished and len(tracker.unfinished()) == 4


def test_a_point_thrown_off_its_line_is_given_up() -> None:
    before = np.array([[10.0, 0.0]] * 6)
    now = np.array([[12.0, 1.0], [5.0, 0.0], [20.0, 1.0], [0.0, 0.0], [8.0, 9.0], [-8.0, 0.0]])
    assert _is_discontinuous(before, now).tolist() == [False, False, False, True, True, True]


def test_tails_are_where_points_were_of_late_newest_last() -> None:
    tracker, _ = follow([(20 + 3.0 * index, 40.0) for index in range(15)])
    tails = tracker.tails(6)
    assert tails.shape == (3, 6, 2)
    np.testing.assert_array_equal(tails[:, -1], tracker.positions()[0])
    np.testing.assert_allclose(np.diff(tails, axis=1), np.broadcast_to((3.0, 0.0), (3, 5, 2)), atol=0.3)


def test_tails_of_points_that_are_new_begin_where_the_points_did() -> None:
    tracker, _ = follow([(20.0, 40.0), (23.0, 40.0)])
    tails = tracker.tails(6)
    np.testing.assert_array_equal(tails[:, :5], np.repeat(tails[:, :1], 5, axis=1))
    assert PointTracker(TrackingOptions()).tails(6).shape == (0, 6, 2)


@pytest.mark.parametrize(
    ('offset', 'expected'),
    [
        ((20 + 3.0 * 10, 40), True),
        ((20 + 3.0 * 11, 40), False),  # two steps: an image was lost
        ((20 + 3.0 * 9, 40), False),
        ((20 + 3.0 * 30, 40), False),  # a pause
        (None, False),
    ],
)
def test_traffic_tells_whether_an_image_follows_at_the_usual_interval(offset, expected) -> None:
    tracker = PointTracker(TrackingOptions())
    for index in range(10):
        tracker.follow(scene((20 + 3.0 * index, 40)), 0.1 * index)
        if index == 0:
            inside = np.array([(40.0, 60), (55, 55), (65, 68), (48, 70), (60, 78), (70, 50)])
            tracker.add_points(inside, np.zeros(6, int))
    assert len(tracker.positions()[0]) >= 5
    assert tracker.moved_one_step(scene(offset)) is expected


def test_a_still_road_does_not_tell_whether_images_were_lost() -> None:
    tracker, _ = follow([None] * 5)
    assert not tracker.moved_one_step(scene(None))
