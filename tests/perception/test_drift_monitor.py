"""A camera that stands is told from one that moves, by day and night, in jams and wind; what happens to the view."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy

from autocalib_ros.evidence.stillness import Stillness, ViewChangeKind
from autocalib_ros.perception.drift_monitor import DriftLimits, DriftMonitor, ImagePose
from autocalib_ros.perception.still_view import warped

pytestmark = pytest.mark.render

WIDTH, HEIGHT = 640, 360
LIMITS = DriftLimits(drift_px=1.5, sway_px=4.5, least_sway_px=0.25)
"""Those of this width."""
RATE_HZ = 10.0
Scene = Callable[[float], np.ndarray]


def street(seed: int, patches: int = 160) -> np.ndarray:
    """Markings, kerbs and windows, grey (H, W)."""
    generator = np.random.default_rng(seed)
    image = np.full((HEIGHT, WIDTH), 90.0, np.float32)
    for _ in range(patches):
        x, y = generator.integers(0, (WIDTH - 30, HEIGHT - 20))
        image[y : y + generator.integers(4, 20), x : x + generator.integers(6, 40)] += generator.uniform(-50, 50)
    return cv2.GaussianBlur(np.clip(image, 0, 255), (0, 0), 0.8)


ROAD, OTHER = street(0), street(1)
BODIES = [street(10 + number)[40:85, 40:110] for number in range(4)]


def shifted(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """Move an image by whole pixels, and by the rest along each axis: a seventh of the time of a warp."""
    right, down = int(np.floor(x)), int(np.floor(y))
    part = cv2.sepFilter2D(image, -1, cubic(x - right), cubic(y - down), anchor=(2, 2), borderType=cv2.BORDER_REFLECT)
    pad = max(abs(right), abs(down))
    wide = cv2.copyMakeBorder(part, pad, pad, pad, pad, cv2.BORDER_REFLECT)
    return np.ascontiguousarray(wide[pad - down : pad - down + HEIGHT, pad - right : pad - right + WIDTH])


def cubic(part: float) -> np.ndarray:
    """Return the weights (4,) of cubic convolution from two pixels before to one after, for a shift of 0 to 1."""
    far, near, own, after = (np.abs(place + part) for place in (-2, -1, 0, 1))
    inner = [1.25 * each**3 - 2.25 * each**2 + 1 for each in (near, own)]
    outer = [-0.75 * (each**3 - 5 * each**2 + 8 * each - 4) for each in (far, after)]
    return np.array([outer[0], *inner, outer[1]])


def moved(image: np.ndarray, x: float = 0.0, y: float = 0.0, zoom: float = 1.0, roll_deg: float = 0.0) -> np.ndarray:
    if (x, y, zoom, roll_deg) == (0.0, 0.0, 1.0, 0.0):
        return image
    if (zoom, roll_deg) == (1.0, 0.0):
        return shifted(image, x, y)
    matrix = cv2.getRotationMatrix2D(((WIDTH - 1) / 2, (HEIGHT - 1) / 2), roll_deg, zoom)
    matrix[:, 2] += (x, y)
    return cv2.warpAffine(image, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def watched(scene: Scene, seconds: float, noise: float = 2.0) -> tuple[list[ImagePose], DriftMonitor]:
    monitor, poses = DriftMonitor(LIMITS), []
    for index, time_s in enumerate(np.arange(0.0, seconds, 1 / RATE_HZ)):
        poses.append(monitor.update(noisy(scene(float(time_s)), noise, index), float(time_s)))
    return poses, monitor


def stillness_of(monitor: DriftMonitor) -> Stillness:
    return monitor.stillness(list(monitor.views)[-1])[1]


def vehicles(image: np.ndarray, places: list[tuple[float, float]]) -> np.ndarray:
    """Draw textured vehicles with their upper left corners at `places`."""
    image = image.copy()
    for number, (x, y) in enumerate(places):
        body = BODIES[number % len(BODIES)]
        left, top = round(x) % (WIDTH - body.shape[1]), round(y) % (HEIGHT - body.shape[0])
        image[top : top + body.shape[0], left : left + body.shape[1]] = body
    return image


def test_a_still_camera_is_neither_moved_nor_compensated() -> None:
    poses, monitor = watched(lambda time_s: vehicles(ROAD, [(40 * time_s, 100), (600 - 30 * time_s, 200)]), 15.0)
    assert all(pose.is_usable and pose.view == 0 and not pose.is_compensated for pose in poses)
    assert monitor.drift_px < 0.1 and stillness_of(monitor).sway_px == 0.0


def test_a_jam_that_covers_the_road_and_creeps_on_is_no_motion_of_the_camera() -> None:
    # two thirds of the picture are vehicles in all, which stand for a second, creep for the next
    def jam(time_s: float) -> np.ndarray:
        crept = 6.0 * (time_s // 2 + max(0.0, time_s % 2 - 1))
        places = [
            (80.0 * column + crept * (1 + 0.2 * row), 30.0 + 60.0 * row) for row in range(5) for column in range(7)
        ]
        return vehicles(ROAD, places)

    poses, monitor = watched(jam, 20.0)
    assert monitor.drift_px < 0.2 and not stillness_of(monitor).changes
    assert np.mean([pose.is_usable for pose in poses]) > 0.8


@pytest.mark.parametrize('seed', [0, 1])
def test_corners_that_compression_scatters_do_not_move_the_camera(seed: int) -> None:
    # blocks of 8 pixels, each displaced by 0.8 px (one sigma) in each image
    generator = np.random.default_rng(seed)

    def compressed(_: float) -> np.ndarray:
        shape = (HEIGHT // 8, WIDTH // 8)
        shifts = [np.kron(generator.normal(0, 0.8, shape), np.ones((8, 8))).astype(np.float32) for _ in range(2)]
        columns, rows = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
        return cv2.remap(ROAD, columns + shifts[0], rows + shifts[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)

    poses, monitor = watched(compressed, 14.0)
    assert monitor.drift_px < 0.3 and not stillness_of(monitor).changes
    assert all(pose.is_usable for pose in poses)


def night(time_s: float) -> np.ndarray:
    """A street none of which is brighter than a fifth of a lamp, where queues of lamps creep on."""
    scene = 0.2 * ROAD
    for lane in range(4):
        for place in range(4):
            x = int((place * 160 + 40 * (lane % 3) + (0.8 + 0.3 * lane) * time_s) % WIDTH)
            cv2.circle(scene, (x, 120 + 50 * lane), 3, 255.0, -1, cv2.LINE_AA)
    return scene


def test_shadows_that_wander_for_minutes_do_not_take_the_picture_along() -> None:
    """Each reference is placed by the oldest that recognises it: from one to the next shadows would add up to 2 px."""
    generator, size = np.random.default_rng(0), (180, 320)
    road = cv2.GaussianBlur(generator.normal(size=size).astype(np.float32), (0, 0), 1.5)
    wide = cv2.GaussianBlur(generator.normal(size=(size[0], 2 * size[1])).astype(np.float32), (0, 0), 6.0)
    shadows = (wide > 0.3 * wide.std()).astype(np.float32)
    monitor = DriftMonitor()
    for second in range(600):
        by_px = np.array([[1.0, 0.0, -0.05 * second], [0.0, 1.0, 0.0]])
        shade = cv2.GaussianBlur(cv2.warpAffine(shadows, by_px, size[::-1]), (0, 0), 0.8)
        scene = (130.0 + 24.0 * road / road.std()) * (1.0 - 0.45 * shade)
        monitor.update(noisy(scene, 1.5, second), float(second))
    assert monitor._view is not None and monitor._view.number == 0
    assert abs(monitor._view.base.shift) < 0.3


def test_lamps_that_creep_on_by_night_are_no_motion_of_the_camera() -> None:
    poses, monitor = watched(night, 20.0, noise=1.5)
    assert all(pose.is_usable for pose in poses) and monitor.drift_px < 0.3


def test_a_camera_that_turns_by_night_is_found_out() -> None:
    _, monitor = watched(lambda time_s: moved(night(time_s), 6.0 * (time_s > 12)), 18.0, noise=1.5)
    (change,) = stillness_of(monitor).changes
    assert change.kind is ViewChangeKind.TURN
    assert (change.amount, change.start_s) == (pytest.approx(6.0, abs=0.7), pytest.approx(12.1, abs=0.3))


@pytest.mark.parametrize('sway_px', [1.0, 2.0, 3.0])
@pytest.mark.parametrize('rate_hz', [0.2, 0.7, 2.3])
def test_sway_about_a_rest_position_is_compensated_and_told(sway_px: float, rate_hz: float) -> None:
    def swaying(time_s: float) -> tuple[float, float]:
        phase = 2 * np.pi * rate_hz * time_s + 0.3
        return sway_px * np.sin(phase), 0.4 * sway_px * np.sin(1.3 * phase)

    poses, monitor = watched(lambda time_s: moved(ROAD, *swaying(time_s)), 16.0)
    shifts = np.array([pose.motion.shift for pose in poses])[20:]
    truth = np.array([complex(*swaying(index / RATE_HZ)) for index in range(len(poses))])[20:]
    assert all(pose.is_usable and pose.view == 0 for pose in poses)
    assert np.std(shifts - truth) < 0.08  # the pose of the evidence is any one within the sway, the same all the time
    assert monitor.drift_px < 0.6
    assert stillness_of(monitor).sway_px == pytest.approx(sway_px, abs=0.15 + 0.2 * sway_px)


def test_roll_is_compensated() -> None:
    def roll_deg(time_s: float) -> float:
        return 0.2 * np.sin(4.4 * time_s)

    poses, _ = watched(lambda time_s: moved(ROAD, roll_deg=roll_deg(time_s)), 8.0)
    # positive angles of OpenCV turn counter-clockwise, those of a complex number with y downwards clockwise
    found = np.degrees([-np.angle(pose.motion.scale) for pose in poses])[20:]
    truth = np.array([roll_deg(index / RATE_HZ) for index in range(len(poses))])[20:]
    assert np.std(found - truth) < 0.03


def test_an_image_is_moved_back_by_what_it_shows() -> None:
    poses, _ = watched(lambda time_s: moved(ROAD, 2.0 * np.sin(4.4 * time_s)), 4.0, noise=0.5)
    stills = [warped(moved(ROAD, 2.0 * np.sin(4.4 * index / RATE_HZ)), poses[index].motion) for index in (30, 33, 36)]
    inner = (slice(8, -8), slice(8, -8))
    apart = np.abs(moved(ROAD, 2.0)[inner] - moved(ROAD, -2.0)[inner]).mean()  # grey levels
    assert max(np.abs(still[inner] - stills[0][inner]).mean() for still in stills) < 0.2 * apart


def test_a_bump_begins_another_view() -> None:
    poses, monitor = watched(lambda time_s: moved(ROAD, 5.0 * (time_s > 12), 3.0 * (time_s > 12)), 20.0)
    (change,) = stillness_of(monitor).changes
    assert change.kind is ViewChangeKind.TURN and change.amount == pytest.approx(np.hypot(5, 3), abs=0.3)
    assert [pose.view for pose in poses[:120]] == [0] * 120 and poses[-1].view == 1 and poses[-1].is_usable
    assert list(monitor.views) == [0, 1] and monitor.drift_px < 0.1


def test_a_bump_within_the_sway_is_found_when_the_rest_position_has_moved() -> None:
    _, monitor = watched(lambda time_s: moved(ROAD, 2.0 * (time_s > 12)), 26.0)
    (change,) = stillness_of(monitor).changes
    assert change.kind is ViewChangeKind.TURN
    assert (change.amount, change.start_s) == (pytest.approx(2.0, abs=0.2), pytest.approx(12.0, abs=0.3))


def test_slow_drift_beyond_the_limit_begins_another_view() -> None:
    _, monitor = watched(lambda time_s: moved(ROAD, 2.5 * time_s / 40), 40.0)
    (change,) = stillness_of(monitor).changes
    assert change.kind is ViewChangeKind.DRIFT and 1.4 < change.amount < 2.5


@pytest.mark.parametrize('zooming_s', [0.0, 2.0])
def test_a_zoom_is_called_a_zoom(zooming_s: float) -> None:
    def scene(time_s: float) -> np.ndarray:
        return moved(ROAD, zoom=1.0 + 0.3 * np.clip((time_s - 6.05) / max(zooming_s, 0.01), 0, 1))

    poses, monitor = watched(scene, 12.0)
    (change,) = stillness_of(monitor).changes
    assert change.kind is ViewChangeKind.ZOOM and change.amount == pytest.approx(1.3, abs=0.01)
    assert change.start_s == pytest.approx(6.1, abs=0.1 + 0.2 * zooming_s)
    assert not any(pose.is_usable for pose in poses[75:78])


@pytest.mark.parametrize('fading_s', [0.0, 1.0])
def test_a_cut_or_a_fade_leads_to_another_view(fading_s: float) -> None:
    def scene(time_s: float) -> np.ndarray:
        share = np.clip((time_s - 4.05) / max(fading_s, 0.01), 0, 1)
        return (1 - share) * OTHER + share * ROAD

    poses, monitor = watched(scene, 12.0)
    assert [change.kind for change in stillness_of(monitor).changes] == [ViewChangeKind.CUT]
    assert poses[-1].view == 1 and poses[-1].is_usable
    assert monitor.views[1] > monitor.views[0] > 3.0


def test_a_covered_lens_is_no_other_view() -> None:
    poses, monitor = watched(lambda time_s: np.full_like(ROAD, 60.0) if 8 < time_s < 14 else ROAD, 18.0)
    assert list(monitor.views) == [0] and not stillness_of(monitor).changes
    assert not any(pose.is_usable for pose in poses[90:135]) and poses[-1].is_usable


def test_the_view_comes_back_in_other_light() -> None:
    def scene(time_s: float) -> np.ndarray:
        return ROAD if time_s < 8 else np.full_like(ROAD, 60.0) if time_s < 12 else 0.5 * ROAD + 20

    poses, monitor = watched(scene, 18.0)
    assert list(monitor.views) == [0] and poses[-1].is_usable and poses[-1].view == 0


def test_an_earlier_view_that_comes_back_goes_on() -> None:
    poses, monitor = watched(lambda time_s: OTHER if 8 < time_s < 14 else ROAD, 18.0)
    assert poses[120].view == 1
    assert poses[-1].view == 0 and monitor.views[0] == pytest.approx(12.0, abs=1.0)
    assert [change.kind for change in stillness_of(monitor).changes] == [ViewChangeKind.CUT] * 2


def test_a_camera_that_pans_all_the_time_has_no_still_view() -> None:
    poses, monitor = watched(lambda time_s: moved(ROAD, 12.0 * time_s), 14.0)
    (change,) = stillness_of(monitor).changes
    assert change.kind is ViewChangeKind.MOTION and change.amount > 100.0
    assert not any(pose.is_usable for pose in poses[20:])


def test_a_hand_does_not_hold_a_camera_still() -> None:
    walk = np.cumsum(np.random.default_rng(3).normal(0, 1.2, (400, 2)), axis=0)
    _, monitor = watched(lambda time_s: moved(ROAD, *walk[round(time_s * RATE_HZ)]), 20.0)
    assert stillness_of(monitor).changes and max(monitor.views.values()) < 10.0


def test_memory_does_not_grow_with_the_views() -> None:
    def scene(time_s: float) -> np.ndarray:
        return (ROAD, OTHER, ROAD[::-1], OTHER[::-1], ROAD[:, ::-1])[int(time_s // 4) % 5]

    _, monitor = watched(scene, 20.0)
    assert len(monitor.views) == 2 and len(stillness_of(monitor).changes) == 4


@pytest.mark.parametrize('level', [0.0, 70.0])
def test_where_nothing_is_seen_nothing_is_said_against_the_camera(level: float) -> None:
    poses, monitor = watched(lambda _: np.full_like(ROAD, level), 6.0)
    assert all(pose.is_usable and not pose.is_compensated for pose in poses) and monitor.drift_px == 0.0
