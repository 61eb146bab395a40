"""Images to observations: regions, vehicles, segments, stillness and the background."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy, paste

from autocalib_ros.config import MotionOptions, Options
from autocalib_ros.perception.background import MAX_SAMPLES, Background
from autocalib_ros.perception.motion_mask import MotionMask
from autocalib_ros.perception.observer import Observer

pytestmark = pytest.mark.render

SIZE = (360, 640)


def texture(seed: int, shape: tuple[int, int], sigma: float = 1.5) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1, shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), sigma)
    return np.clip(128 + 60 * smooth / smooth.std(), 0, 255)


ROAD = texture(0, SIZE) * 0.5 + 40
CARS = (texture(1, (60, 90)), texture(2, (50, 80)))


def scene(time_s: float, cars: int = 2) -> np.ndarray:
    """Two textured cars on a still road, one to the right and one to the left, grey uint8."""
    image = ROAD.copy()
    for index, (car, row, start, speed) in enumerate(zip(CARS, (80, 220), (20, 540), (45.0, -40.0), strict=True)):
        if index < cars:
            paste(image, car, start + speed * time_s, row)
    return noisy(image, 1.5, int(time_s * 1000))


def test_moving_cars_are_regions_and_the_road_is_not() -> None:
    motion = MotionMask(MotionOptions())
    for index in range(30):
        motion.update(scene(0.1 * index, cars=0 if index < 20 else 2), 0.1 * index)
    regions = motion.regions()
    assert len(regions) == 2
    rows = sorted(region.y + region.mask.shape[0] / 2 for region in regions)
    np.testing.assert_allclose(rows, (110, 245), atol=10)  # a few pixels of the reduced mask


def test_a_still_scene_has_no_regions() -> None:
    motion = MotionMask(MotionOptions())
    for index in range(30):
        motion.update(scene(0.1 * index, cars=0), 0.1 * index)
    assert not motion.regions()


@pytest.fixture(scope='module')
def watched() -> tuple[list, list, Observer]:
    observer = Observer(Options(), (SIZE[1], SIZE[0]))
    tracks, segments = [], []
    for index in range(80):
        observed = observer.observe(scene(max(0.0, 0.1 * (index - 10)), cars=2 if index > 10 else 0), 0.1 * index)
        tracks += observed.tracks
        segments += [observed.segments] if observed.segments is not None else []
    return tracks + observer.unfinished(), segments, observer


def test_tracks_go_the_way_of_their_cars(watched: tuple[list, list, Observer]) -> None:
    tracks, _, _ = watched
    speeds = [
        (track.points_px[-1] - track.points_px[0]) / (track.times_s[-1] - track.times_s[0])
        for track in tracks
        if track.times_s[-1] - track.times_s[0] > 1.0
    ]
    assert len(speeds) > 10
    right = [abs(y) < 1.0 and min(abs(x - 45.0), abs(x + 40.0)) < 1.0 for x, y in speeds]  # px/s
    assert np.mean(right) > 0.9  # the rest slid along an outline, which a later stage has to bear


def test_cars_are_different_vehicles(watched: tuple[list, list, Observer]) -> None:
    tracks, _, _ = watched
    upper = {track.vehicle for track in tracks if track.points_px[:, 1].mean() < 180}
    lower = {track.vehicle for track in tracks if track.points_px[:, 1].mean() > 180}
    assert upper and lower and not upper & lower


def test_segments_point_along_the_motion(watched: tuple[list, list, Observer]) -> None:
    _, segments, _ = watched
    ends = np.concatenate([item.ends_px for item in segments])
    step = ends[:, 2:] - ends[:, :2]
    assert len(step) > 50
    assert np.median(np.abs(step[:, 1])) < 1.0  # px; the cars move along rows
    assert np.percentile(np.abs(np.abs(step[:, 0]) - 0.6 * 42.5), 80) < 3.0  # six images of 0.1 s at 40 to 45 px/s


def test_a_wide_image_is_tracked_reduced_and_reported_in_full_pixels() -> None:
    wide = Observer(Options(max_image_width=320), (SIZE[1], SIZE[0]))
    tracks = []
    for index in range(80):
        tracks += wide.observe(scene(max(0.0, 0.1 * (index - 10)), cars=2 if index > 10 else 0), 0.1 * index).tracks
    tracks += wide.unfinished()
    assert max(track.points_px[:, 0].max() for track in tracks) > 330
    speeds = [
        np.diff(track.points_px[[0, -1], 0])[0] / (track.times_s[-1] - track.times_s[0])
        for track in tracks
        if track.times_s[-1] - track.times_s[0] > 1.0
    ]
    assert np.median(np.abs(np.abs(speeds) - 42.5)) < 4.0
    newest = wide.followed(16)[:, -1]
    ends = np.array([track.points_px[-1] for track in wide.unfinished()])
    assert len(ends) and (np.abs(newest[:, None] - ends).max(axis=2).min(axis=0) < 1e-9).all()


def test_lost_images_do_not_delay_detections() -> None:
    whole, half = Observer(Options(), (SIZE[1], SIZE[0])), Observer(Options(), (SIZE[1], SIZE[0]))
    detected: tuple[list[float], list[float]] = [], []
    for index in range(60):
        time_s = 0.1 * index
        image = scene(time_s)
        seen = [whole.observe(image, time_s)]
        seen += [half.observe(image, time_s, lost=int(index > 0))] if index % 2 == 0 else []
        for times, observed in zip(detected, seen, strict=False):
            times += [] if observed.segments is None else [observed.segments.time_s]
    assert len(detected[0]) > 5 and detected[1] == detected[0]


def test_passing_cars_are_not_drift(watched: tuple[list, list, Observer]) -> None:
    assert watched[2].drift_px < 0.5


def test_the_background_shows_the_road_without_cars() -> None:
    background = Background()
    for index in range(200):
        background.update(scene((0.05 * index) % 10.0), 0.05 * index)
    image = background.image()
    assert image is not None and image.shape == (*SIZE, 3)
    assert np.median(np.abs(image[:, :, 0] - ROAD)) < 6  # grey levels, of which JPEG takes two or three


def test_the_background_keeps_few_images() -> None:
    background = Background()
    for index in range(2000):
        background.update(np.zeros((36, 64), np.uint8), float(index))
    assert len(background._samples) <= MAX_SAMPLES


def test_repeated_pictures_change_nothing() -> None:
    once, twice = (Observer(Options(), (SIZE[1], SIZE[0])) for _ in range(2))
    tracks: tuple[list, list] = ([], [])
    for index in range(60):
        picture = scene(max(0.0, 0.1 * (index - 10)), cars=2 if index > 10 else 0)
        tracks[0].extend(once.observe(picture, 0.1 * index).tracks)
        tracks[1].extend(twice.observe(picture, 0.1 * index).tracks)
        tracks[1].extend(twice.observe(picture, 0.1 * index + 0.05).tracks)
    first, second = [*tracks[0], *once.unfinished()], [*tracks[1], *twice.unfinished()]
    assert len(first) == len(second) > 10
    assert once.repeated == 10 and twice.repeated == 70  # the first eleven pictures are one
    # the search begins elsewhere, so the same place is found to the accuracy at which it ends; a point that slips along
    # an edge, one in twenty, ends anywhere on it
    same = [
        bool(np.abs(one.points_px[[0, -1]] - other.points_px[[0, -1]]).max() < 0.05)
        and np.array_equal(one.times_s[[0, -1]], other.times_s[[0, -1]])
        for one, other in zip(first, second, strict=True)
    ]
    assert np.mean(same) > 0.95


def stamped(time_s: float) -> np.ndarray:
    """A still scene with a clock that runs, ten pixels high, near the lower border."""
    image = cv2.cvtColor(scene(time_s, cars=0), cv2.COLOR_GRAY2BGR)
    cv2.rectangle(image, (440, 328), (630, 352), (0, 0, 0), -1)
    text = f'CAM 3  12:04:{int(time_s * 7) % 60:02d}'
    cv2.putText(image, text, (446, 346), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
    return image


def test_a_running_clock_is_no_vehicle_and_no_corner_of_the_background() -> None:
    observer = Observer(Options(), SIZE[::-1])
    late = []
    for index in range(60):
        observed = observer.observe(stamped(0.1 * index), 0.1 * index)
        late += [observed.segments] if index > 30 and observed.segments is not None else []
    assert late and not any(len(segments.ends_px) for segments in late)
    view = observer._drift_monitor._view
    assert view is not None
    corners = view.reference.corners_px * observer._drift_monitor._factor
    assert len(corners) and not ((corners[:, 0] > 440) & (corners[:, 1] > 325)).any()


def test_text_stays_masked_when_the_camera_has_moved() -> None:
    """Its corners do not move with the camera: in the view that has just begun they would hold the picture still."""
    observer = Observer(Options(), SIZE[::-1])
    index = 0
    while observer.view == 0 and index < 120:
        image = stamped(0.1 * index)
        if index >= 40:  # the scene moves, the clock does not
            turned = np.roll(image, 40, axis=1)
            turned[325:355, 438:632] = image[325:355, 438:632]
            image = turned
        observer.observe(image, 0.1 * index)
        index += 1
    assert observer.view == 1
    begun = observer.known_view(1)
    assert begun is not None and begun.ignored is not None
    assert begun.ignored[330:350, 450:600].all()
    assert not begun.ignored[:200].any()


def swaying(time_s: float) -> tuple[float, float]:
    return 2.0 * np.sin(4.4 * time_s), 0.8 * np.sin(7.0 * time_s)


@pytest.fixture(scope='module')
def watched_in_wind() -> tuple[list, Observer]:
    observer, tracks = Observer(Options(), (SIZE[1], SIZE[0])), []
    for index in range(80):
        time_s = 0.1 * index
        still = scene(max(0.0, time_s - 1.0), cars=2 if index > 10 else 0)
        x, y = swaying(time_s)
        moved = cv2.warpAffine(
            still,
            np.array([[1.0, 0, x], [0, 1.0, y]]),
            SIZE[::-1],
            flags=cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REFLECT,
        )
        tracks += observer.observe(moved, time_s).tracks
    return tracks + observer.unfinished(), observer


def test_tracks_do_not_sway_with_the_camera(watched_in_wind: tuple[list, Observer]) -> None:
    tracks, observer = watched_in_wind
    long = [track for track in tracks if np.ptp(track.times_s) > 1.5 and track.times_s[0] > 1.5]
    assert len(long) > 10
    # the cars move along rows: without compensation their tracks wave by 0.8 px
    waves = [np.std(track.points_px[:, 1]) for track in long]
    assert np.median(waves) < 0.15
    assert observer.stillness(0)[1].sway_px == pytest.approx(2.0, abs=0.5) and observer.drift_px < 1.0


def test_edges_of_the_background_do_not_move_in_the_wind(watched_in_wind: tuple[list, Observer]) -> None:
    tracks, _ = watched_in_wind
    rows = np.concatenate([track.points_px[:, 1] for track in tracks])
    on_a_car = ((rows > 70) & (rows < 150)) | ((rows > 210) & (rows < 280))
    assert on_a_car.mean() > 0.97


def test_lines_that_are_searched_later_are_those_of_the_moment_of_the_question() -> None:
    """Another thread searches while further images change the background."""
    observer = Observer(Options(), (SIZE[1], SIZE[0]))
    striped, plain = ROAD.copy(), ROAD.copy()
    striped[100:106, 40:600] += 90
    for index in range(12):
        observer.observe(noisy(striped, 1.5, index), 0.5 * index)
    search = observer.search_for_segments()
    expected, expected_stripes = observer.still_segments()
    for index in range(12, 60):
        observer.observe(noisy(plain, 1.5, index), 0.5 * index)
    assert len(expected) and len(expected_stripes)
    lines, stripes = search()
    np.testing.assert_array_equal(lines, expected)
    np.testing.assert_array_equal(stripes, expected_stripes)
    assert not np.array_equal(observer.still_segments()[0], expected)
