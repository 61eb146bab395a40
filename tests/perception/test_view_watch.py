"""A view is registered through the lens in degrees; the watch tells moves from sway, and pictures that say nothing."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy

from autocalib_ros.lens.camera import Camera
from autocalib_ros.perception.picture_faults import PictureFault
from autocalib_ros.perception.view_registration import ViewPose, ViewReference, normalised, zoomed
from autocalib_ros.perception.view_watch import KnownView, ViewCondition, ViewReport, ViewWatch
from autocalib_ros.results.camera_move import CameraMove, MoveKind, rotation_from_turn, turn_of_rotation

WIDTH, HEIGHT = 480, 270
CAMERA = Camera.equidistant(WIDTH, HEIGHT, 240.0)
"""Half the width: 115 degrees across."""
GRID = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2).astype(float)
NONE = (0.0, 0.0, 0.0)


def street(seed: int) -> np.ndarray:
    """Markings, kerbs and windows, grey (H, W)."""
    generator = np.random.default_rng(seed)
    image = np.full((HEIGHT, WIDTH), 90.0, np.float32)
    for _ in range(160):
        x, y = generator.integers(0, (WIDTH - 30, HEIGHT - 20))
        image[y : y + generator.integers(4, 20), x : x + generator.integers(6, 40)] += generator.uniform(-50, 50)
    return cv2.GaussianBlur(np.clip(image, 0, 255), (0, 0), 0.8).astype(np.uint8)


ROAD, OTHER = street(0), street(1)
SEEN: dict[tuple, np.ndarray] = {}


def seen(turn_deg: tuple[float, float, float], zoom: float = 1.0) -> np.ndarray:
    """Return the road after the camera has turned right, down and clockwise by degrees, and zoomed."""
    if (turn_deg, zoom) not in SEEN:
        bearings, _ = zoomed(CAMERA, float(np.log(zoom))).unproject(GRID)
        places, _ = CAMERA.project(bearings @ rotation_from_turn(np.radians(turn_deg)))  # as before the turn
        u, v = places.astype(np.float32).reshape(HEIGHT, WIDTH, 2).transpose(2, 0, 1)
        SEEN[turn_deg, zoom] = cv2.remap(ROAD, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return SEEN[turn_deg, zoom]


def watching() -> ViewWatch:
    watch = ViewWatch()
    watch.begin([KnownView(ROAD)], CAMERA)
    return watch


def played(watch: ViewWatch, scene: Callable[[float], np.ndarray], start_s: float, end_s: float) -> list[ViewReport]:
    """Return the reports of a stream of 5 Hz."""
    reports = []
    for number in range(round(5 * start_s), round(5 * end_s)):
        time_s = number / 5.0
        if watch.is_due(time_s):
            reports.append(watch.update(noisy(scene(time_s), 2.0, number), time_s))
    return reports


def test_turns_are_right_down_and_clockwise() -> None:
    ahead = np.array([0.0, 0.0, 1.0])
    right, down = (
        rotation_from_turn(np.array([0.1, 0.0, 0.0])) @ ahead,
        rotation_from_turn(np.array([0, 0.1, 0])) @ ahead,
    )
    assert right[0] < 0  # what was ahead is on the left after a pan to the right
    assert down[1] < 0  # and above the centre after a tilt
    clockwise = rotation_from_turn(np.array([0.0, 0.0, 0.1])) @ np.array([1.0, 0.0, 0.0])
    assert clockwise[1] < 0  # what was on the right is higher after a roll
    turn = np.array([0.3, -0.2, 1.1])
    np.testing.assert_allclose(turn_of_rotation(rotation_from_turn(turn)), turn, atol=1e-12)


@pytest.mark.parametrize('turn_deg', [(0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 0.3), (1.0, -1.0, 1.0), (3.0, 0, 0)])
def test_small_turns_are_measured_near_the_last_pose(turn_deg: tuple[float, float, float]) -> None:
    pose = ViewReference(ROAD, CAMERA).near(normalised(noisy(seen(turn_deg), 2.0, 0)), ViewPose.identity())
    assert pose is not None
    # a tenth of the least move that is told
    np.testing.assert_allclose(np.degrees(pose.turn_rad), turn_deg, atol=0.02)
    assert abs(pose.log_zoom) < 0.001


@pytest.mark.parametrize(('turn_deg', 'zoom'), [((25.0, 0.0, 0.0), 1.0), (NONE, 1.3), ((5.0, -8.0, 4.0), 0.8)])
def test_large_turns_and_zooms_are_found_anywhere(turn_deg: tuple[float, float, float], zoom: float) -> None:
    pose = ViewReference(ROAD, CAMERA).anywhere(normalised(noisy(seen(turn_deg, zoom), 2.0, 0)))
    assert pose is not None
    np.testing.assert_allclose(np.degrees(pose.turn_rad), turn_deg, atol=0.1)
    assert np.exp(pose.log_zoom) == pytest.approx(zoom, rel=0.005)


def test_another_view_is_not_recognised() -> None:
    reference = ViewReference(ROAD, CAMERA)
    assert reference.near(normalised(OTHER), ViewPose.identity()) is None
    assert reference.anywhere(normalised(OTHER)) is None


def test_bright_and_dark_may_change_places() -> None:
    reference, negative = ViewReference(ROAD, CAMERA), 255 - ROAD
    assert reference.near(normalised(negative), ViewPose.identity()) is None
    pose = reference.near_by_outlines(normalised(negative), ViewPose.identity())
    assert pose is not None
    np.testing.assert_allclose(np.degrees(pose.turn_rad), 0.0, atol=0.05)


def test_jam_over_half_of_the_picture_is_no_move() -> None:
    jam = ROAD.copy()
    jam[HEIGHT // 3 :, WIDTH // 4 :] = OTHER[HEIGHT // 3 :, WIDTH // 4 :]
    pose = ViewReference(ROAD, CAMERA).near(normalised(jam), ViewPose.identity())
    assert pose is not None
    np.testing.assert_allclose(np.degrees(pose.turn_rad), 0.0, atol=0.02)


@pytest.mark.parametrize('turn_deg', [(0.0, 0.3, 0.0), (1.0, 0.0, 0.0), (0.0, 25.0, 0.0)])
def test_bump_is_told_in_degrees_and_mended(turn_deg: tuple[float, float, float]) -> None:
    watch = watching()
    assert played(watch, lambda _: ROAD, 0, 5)[-1].condition is ViewCondition.STILL
    moved = next(
        report
        for report in played(watch, lambda _: seen(turn_deg), 5, 30)
        if report.move is not None and report.move.is_measured
    )
    assert moved.move is not None
    assert moved.move.keeps_lens
    assert moved.move.time_s == pytest.approx(5.0, abs=2.0)
    # keypoints of a view of which half is new are worse than corners that are followed
    tolerance = 0.03 if max(turn_deg) < 5 else 0.15
    measured = [moved.move.pan_deg, moved.move.tilt_deg, moved.move.roll_deg]
    np.testing.assert_allclose(measured, turn_deg, atol=tolerance)
    watch.rebase(moved.move)
    assert {report.condition for report in played(watch, lambda _: seen(turn_deg), 30, 36)} <= {
        ViewCondition.STILL,
        ViewCondition.SWAYING,
    }


def test_sway_is_no_move() -> None:
    watch = watching()
    # a mast at 0.7 Hz, 0.3 degrees to both sides
    reports = played(watch, lambda time_s: seen((round(0.3 * np.sin(4.4 * time_s), 1), 0.0, 0.0)), 0, 30)
    assert reports[-1].condition is ViewCondition.SWAYING
    assert reports[-1].sway_deg == pytest.approx(0.3, rel=0.5)
    assert all(report.condition is not ViewCondition.MOVED for report in reports)


def test_zoom_drops_the_lens() -> None:
    watch = watching()
    played(watch, lambda _: ROAD, 0, 5)
    report = played(watch, lambda _: seen(NONE, 1.05), 5, 20)[-1]
    assert report.condition is ViewCondition.MOVED
    assert report.move is not None
    assert report.move.kind is MoveKind.ZOOM
    assert report.move.zoom == pytest.approx(1.05, abs=0.003)
    assert not report.move.keeps_lens


def test_another_view_is_told_and_the_way_back() -> None:
    watch = watching()
    played(watch, lambda _: ROAD, 0, 5)
    report = played(watch, lambda _: OTHER, 5, 16)[-1]
    assert report.move == CameraMove(MoveKind.OTHER_VIEW, report.since_s)
    assert played(watch, lambda _: ROAD, 16, 26)[-1].condition is ViewCondition.STILL


@pytest.mark.parametrize(
    ('fault', 'picture'),
    [
        (PictureFault.BLACK, np.full_like(ROAD, 6)),
        (PictureFault.COVERED, np.full_like(ROAD, 110)),
        (PictureFault.OVEREXPOSED, np.full_like(ROAD, 255)),
        (PictureFault.BLURRED, cv2.GaussianBlur(ROAD, (0, 0), 3.0)),
    ],
)
def test_picture_that_says_nothing_is_told_within_ten_seconds(fault: PictureFault, picture: np.ndarray) -> None:
    watch = watching()
    played(watch, lambda _: ROAD, 0, 6)
    report = played(watch, lambda _: picture, 6, 16)[-1]
    assert (report.condition, report.fault) == (ViewCondition.BLIND, fault)
    assert played(watch, lambda _: ROAD, 16, 23)[-1].condition is ViewCondition.STILL


def test_frozen_picture_is_told_even_without_a_calibration() -> None:
    watch = ViewWatch()
    reports = [watch.update(ROAD, float(time_s)) for time_s in range(12)]
    assert reports[5].condition is ViewCondition.UNKNOWN
    assert reports[9].fault is PictureFault.FROZEN


def test_view_is_verified_from_what_an_earlier_run_stored() -> None:
    earlier = watching()
    played(earlier, lambda _: ROAD, 0, 5)
    watch = ViewWatch()
    watch.begin(earlier.views, CAMERA)
    assert watch.report.condition is ViewCondition.UNKNOWN
    assert played(watch, lambda _: ROAD, 0, 5)[-1].condition is ViewCondition.STILL
    turned = ViewWatch()
    turned.begin(earlier.views, CAMERA)
    report = played(turned, lambda _: seen((1.0, -1.0, 1.0)), 0, 25)[-1]
    assert report.move is not None
    assert report.move.pan_deg == pytest.approx(1.0, abs=0.03)


def test_clock_that_is_set_back_is_no_move() -> None:
    watch = watching()
    played(watch, lambda _: ROAD, 100, 110)
    assert played(watch, lambda _: ROAD, 0, 10)[-1].condition is ViewCondition.STILL


def test_light_that_changes_gets_a_reference_of_its_own() -> None:
    watch = watching()
    played(watch, lambda _: ROAD, 0, 10)
    shadow = np.where(np.arange(WIDTH) > 0.35 * WIDTH, OTHER, ROAD)  # two thirds look otherwise
    played(watch, lambda _: shadow, 10, 50)
    assert len(watch.views) == 2
    np.testing.assert_allclose(np.degrees(watch.views[0].pose.turn_rad), 0.0, atol=0.05)


def test_ignored_regions_are_black_in_the_views_that_are_added() -> None:
    """They are stored, and private places are nobody else's."""
    watch = watching()
    watch.ignore((((100.0, 60.0), (180.0, 60.0), (180.0, 120.0), (100.0, 120.0)),))
    played(watch, lambda _: ROAD, 0, 10)
    shadow = np.where(np.arange(WIDTH) > 0.35 * WIDTH, OTHER, ROAD)
    played(watch, lambda _: shadow, 10, 50)
    assert len(watch.views) == 2
    added = watch.views[0]
    assert added.ignored is not None and added.ignored[60:120, 100:180].all()
    assert not added.image[60:120, 100:180].any() and added.image[60:120, 200:280].all()
    shown = watch.newest_view(30.0)
    assert shown is not None and not shown.image[60:120, 100:180].any()


def with_near_part(far: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return a picture whose lower half is near: a shifted camera sees it turned otherwise."""
    return np.vstack([far[: HEIGHT // 2], near[HEIGHT // 2 :]])


@pytest.mark.parametrize('turn_deg', [(1.0, 0.5, 0.0), (0.0, -2.0, 1.0)])
def test_near_and_far_turn_alike_where_the_camera_turned_about_its_centre(
    turn_deg: tuple[float, float, float],
) -> None:
    report = played(calm(), lambda _: seen(turn_deg), 20, 50)[-1]
    assert report.move is not None and report.move.is_measured
    assert report.move.parallax_deg == 0.0


def test_a_camera_that_was_shifted_as_well_is_told_by_near_and_far() -> None:
    """Half a degree between what is near and what is far: 10 cm at 12 m."""
    far, near = (1.0, 0.0, 0.0), (1.5, 0.0, 0.0)
    scene = with_near_part(seen(far), seen(near))
    report = played(calm(), lambda _: scene, 20, 50)[-1]
    assert report.move is not None
    assert report.move.parallax_deg == pytest.approx(0.5, abs=0.1)
    assert report.move.sigma_deg is not None and min(report.move.sigma_deg) > 0.4
    assert 'shifted' in str(report.move)


def calm() -> ViewWatch:
    """Return a watch that saw the road for 20 s."""
    watch = watching()
    played(watch, lambda _: ROAD, 0, 20)
    return watch
