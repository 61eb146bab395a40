"""The one object that live node and replay share."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from many_cases import one_and_exhaustive

from autocalib_ros.calibrator import AutoCalibrator, CalibrationProgress, ImageIntake
from autocalib_ros.config import BufferOptions, GateOptions, Options
from autocalib_ros.errors import InputError
from autocalib_ros.evidence.solution_schedule import SolutionSchedule
from autocalib_ros.evidence.stillness import ViewChangeKind
from autocalib_ros.offline.simulate.stamp_faults import STAMP_FAULTS

pytestmark = pytest.mark.render

DAY_NS = 24 * 3600 * 10**9
OPTIONS = Options(first_solve_s=2.0, solve_interval_s=1.0, gate=GateOptions(min_tracks=4))


@cache
def road_and_block(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(5)
    road = generator.integers(60, 120, size).astype(np.uint8)
    return road, np.kron(generator.integers(0, 255, (8, 12)), np.ones((5, 5))).astype(np.uint8)


def image(index: int, size: tuple[int, int] = (180, 320)) -> np.ndarray:
    """A textured block that crosses a still road."""
    road, block = road_and_block(size)
    picture, left = road.copy(), 6 * (index % 40)
    picture[60:100, left : left + 60] = block[:, : max(0, min(60, size[1] - left))]
    return picture


def fed(count: int, interval_ns: int = 100_000_000) -> AutoCalibrator:
    calibrator = AutoCalibrator(OPTIONS)
    for index in range(count):
        calibrator.add_image(index * interval_ns, image(index))
    return calibrator


def test_nothing_is_known_before_the_first_image() -> None:
    calibrator = AutoCalibrator(OPTIONS)
    assert calibrator.snapshot() is None and calibrator.snapshot_if_due() is None and calibrator.background() is None
    assert calibrator.progress().percent == 0.0


def test_the_snapshot_counts_images_and_time() -> None:
    evidence = fed(30).snapshot()
    assert evidence is not None
    assert (evidence.frames, evidence.seconds, evidence.image_size) == (30, pytest.approx(2.9), (320, 180))


def test_moving_things_become_tracks() -> None:
    evidence = fed(60).snapshot()
    assert evidence is not None and evidence.track_count > 4


def test_the_same_images_give_the_same_evidence_to_the_last_bit() -> None:
    first, second = fed(60).snapshot(), fed(60).snapshot()
    assert first is not None and second is not None
    for name in vars(first):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


@pytest.mark.parametrize('colour', [False, True])
def test_the_image_given_is_not_changed(colour: bool) -> None:
    picture = np.repeat(image(0)[..., None], 3, axis=2) if colour else image(0)
    before = picture.copy()
    calibrator = AutoCalibrator(OPTIONS)
    calibrator.add_image(0, picture)
    picture[:] = 0  # nor kept: a caller may use its buffer again
    calibrator.add_image(1, before)
    np.testing.assert_array_equal(before, np.repeat(image(0)[..., None], 3, axis=2) if colour else image(0))


def test_stamps_that_start_again_restart_the_evidence() -> None:
    calibrator = fed(30)
    intakes = [calibrator.add_image(index * 100_000_000, image(index)) for index in range(3)]
    assert intakes == [ImageIntake.LATE, ImageIntake.TIME_JUMPED, ImageIntake.USED]
    evidence = calibrator.snapshot()
    assert evidence is not None and (evidence.frames, round(evidence.seconds, 1)) == (3, 0.2)


@pytest.mark.parametrize('odd_ns', [0, -5 * 10**9, 600 * 10**9, 2 * DAY_NS])
def test_one_odd_stamp_is_one_image_and_restarts_nothing(odd_ns: int) -> None:
    calibrator, start_ns = AutoCalibrator(OPTIONS), 10**18
    stamps = [start_ns + index * 100_000_000 for index in range(40)]
    stamps[20] = stamps[20] + odd_ns if odd_ns else 0
    intakes = [calibrator.add_image(stamp_ns, image(index)) for index, stamp_ns in enumerate(stamps)]
    assert ImageIntake.TIME_JUMPED not in intakes
    evidence = calibrator.snapshot()
    assert evidence is not None
    assert (evidence.frames, evidence.first_stamp_ns, evidence.newest_stamp_ns) == (40, start_ns, stamps[-1])
    assert calibrator.clock().odd == 1


@cache
def tracks_with_stamps(fault: str) -> int:
    """Number of tracks from images whose stamps have a fault."""
    calibrator, exposures_ns = AutoCalibrator(OPTIONS), 10**18 + np.arange(160) * 100_000_000
    stamps = STAMP_FAULTS[fault](exposures_ns, np.random.default_rng(2)).stamps_ns
    for index, stamp_ns in enumerate(stamps.tolist()):
        calibrator.add_image(stamp_ns, image(index))
    evidence = calibrator.snapshot()
    assert evidence is not None
    return evidence.track_count


@pytest.mark.parametrize(
    'fault', one_and_exhaustive(['jitter_30', 'early_doublets', 'alternating', 'rare_bursts_of_10', 'wrapped'])
)
def test_uneven_stamps_give_the_tracks_of_even_ones(fault: str) -> None:
    assert tracks_with_stamps(fault) >= 0.8 * tracks_with_stamps('even') > 8


def test_a_clock_set_back_goes_on_with_the_evidence_by_the_new_clock() -> None:
    calibrator, start_ns = AutoCalibrator(OPTIONS), 10**18
    stamps = [start_ns + index * 100_000_000 - (37 * 10**9 if index >= 20 else 0) for index in range(40)]
    intakes = [calibrator.add_image(stamp_ns, image(index)) for index, stamp_ns in enumerate(stamps)]
    assert ImageIntake.TIME_JUMPED not in intakes
    evidence = calibrator.snapshot()
    assert evidence is not None
    assert (evidence.frames, evidence.newest_stamp_ns, round(evidence.seconds, 3)) == (40, stamps[-1], 3.9)
    assert calibrator.clock().steps == 1


def test_an_image_that_waits_for_the_next_is_neither_lost_nor_the_buffer_of_the_caller() -> None:
    calibrator, held = fed(10), image(12)
    assert calibrator.add_image(1_200_000_000, held) is ImageIntake.USED  # two images lost before it, or late itself
    evidence = calibrator.snapshot()
    assert evidence is not None and evidence.frames == 10
    held[:] = 0
    calibrator.add_image(1_300_000_000, image(13))
    evidence = calibrator.snapshot()
    assert evidence is not None and (evidence.frames, evidence.newest_stamp_ns) == (12, 1_300_000_000)
    assert calibrator.clock().lost == 2


def test_a_new_size_restarts_the_evidence() -> None:
    calibrator = fed(30)
    intakes = [calibrator.add_image((30 + 10 * i) * 100_000_000, image(i, (240, 320))) for i in range(6)]
    assert intakes == [*4 * [ImageIntake.ODD_SIZE], ImageIntake.RESIZED, ImageIntake.USED]
    evidence = calibrator.snapshot()
    assert evidence is not None and evidence.image_size == (320, 240)


@pytest.mark.parametrize('size', [(1, 1), (90, 160), (2160, 3840)])
def test_odd_images_leave_the_evidence_alone(size: tuple[int, int]) -> None:
    calibrator = fed(10)
    for index in range(10, 20):
        assert calibrator.add_image(index * 100_000_000, np.zeros(size, np.uint8)) is ImageIntake.ODD_SIZE
    assert calibrator.add_image(2_000_000_000, image(20)) is ImageIntake.USED
    evidence = calibrator.snapshot()
    assert evidence is not None and evidence.image_size == (320, 180)
    assert evidence.frames >= 10  # the newest one may be held for its time


@pytest.mark.parametrize('stamp_ns', [900_000_000, 850_000_000])
def test_a_repeated_or_late_stamp_is_left_out(stamp_ns: int) -> None:
    calibrator = fed(10)
    calibrator.add_image(stamp_ns, image(30))
    evidence = calibrator.snapshot()
    assert evidence is not None and evidence.frames == 10


@pytest.mark.parametrize(
    ('stamp_ns', 'size', 'expected'),
    [
        (1_000_000_000, (180, 320), ImageIntake.USED),
        (900_000_000, (180, 320), ImageIntake.LATE),  # the stamp of the image before
        (1, (180, 320), ImageIntake.LATE),
        (-100_000_000, (180, 320), ImageIntake.LATE),  # the next image tells whether the stamps start again
        (DAY_NS, (180, 320), ImageIntake.USED),  # held: the next image tells whether the clock was set
        (1_000_000_000, (240, 320), ImageIntake.ODD_SIZE),
    ],
)
def test_what_became_of_an_image_is_reported(stamp_ns: int, size: tuple[int, int], expected: ImageIntake) -> None:
    assert fed(10).add_image(stamp_ns, image(30, size)) is expected


def test_first_image_is_reported() -> None:
    assert AutoCalibrator(OPTIONS).add_image(0, image(0)) is ImageIntake.FIRST


def test_clock_that_was_set_does_not_count_as_time_watched() -> None:
    calibrator = fed(10)
    for index in range(5):
        calibrator.add_image(50 * 365 * DAY_NS + index * 100_000_000, image(index))
    evidence = calibrator.snapshot()
    assert evidence is not None and (evidence.frames, round(evidence.seconds, 1)) == (5, 0.4)


def test_other_options_make_a_solution_due() -> None:
    calibrator = fed(150)
    assert calibrator.snapshot_if_due() is not None
    assert calibrator.snapshot_if_due() is None
    calibrator.change(replace(OPTIONS, camera_height=9.0))
    assert calibrator.snapshot_if_due() is not None


def test_the_schedule_learns_what_was_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    calibrator, told = fed(20), []
    monkeypatch.setattr(SolutionSchedule, 'accepted', lambda _self, part, tracks: told.append((part.frames, tracks)))
    calibrator.accepted(7)
    assert told == [(20, 7)]


@pytest.mark.parametrize(
    'picture', [np.zeros((10, 10), np.uint16), np.zeros((10, 10, 4), np.uint8), np.zeros(10, np.uint8)]
)
def test_another_kind_of_array_is_refused(picture: np.ndarray) -> None:
    with pytest.raises(InputError, match='8 bits'):
        AutoCalibrator(OPTIONS).add_image(0, picture)


def test_a_solution_is_due_when_there_are_time_and_tracks() -> None:
    calibrator = AutoCalibrator(OPTIONS)
    due = []
    for index in range(150):
        calibrator.add_image(index * 100_000_000, image(index))
        if calibrator.snapshot_if_due() is not None:
            due.append(index)
    assert due and due[0] >= 20  # first_solve_s
    assert all(later - earlier >= 10 for earlier, later in itertools.pairwise(due))  # solve_interval_s


def test_progress_says_what_is_missing() -> None:
    progress = fed(5).progress()
    assert progress.percent < 100 and progress.missing


def watched(seconds: float, moved_at_s: float = np.inf, gone_at_s: float = np.inf) -> AutoCalibrator:
    """Feed one vehicle in the first minute, and then a road without traffic, at one image/s.

    The camera is bumped at one time, or turned to another scene.
    """
    calibrator = AutoCalibrator(Options(buffer=BufferOptions(seconds=120.0)))
    road = cv2.GaussianBlur(np.random.default_rng(1).uniform(0, 255, (180, 320)), (0, 0), 2.0)
    road = cv2.normalize(road, None, 40, 200, cv2.NORM_MINMAX).astype(np.uint8)
    block = np.random.default_rng(2).integers(0, 255, (30, 40)).astype(np.uint8)
    block = cv2.resize(block, (60, 45), interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(3).integers(0, 9, (2, 180, 320)).astype(np.uint8)  # else pictures are repeated ones
    for index in range(int(seconds)):
        picture = road if index < gone_at_s else road[::-1, ::-1]
        if index >= moved_at_s:
            picture = np.roll(picture, (4, 7), axis=(0, 1))
        picture = picture.copy()
        if 20 <= index < 60:
            picture[60:105, 6 * (index - 20) : 6 * (index - 20) + 60] = block
        calibrator.add_image(index * 1_000_000_000, cv2.add(picture, noise[index % 2]))
    return calibrator


def held(calibrator: AutoCalibrator) -> int:
    evidence = calibrator.snapshot()
    assert evidence is not None
    return evidence.track_count


def test_a_lone_vehicle_is_kept_as_long_as_nothing_replaces_it() -> None:
    calibrator = watched(400.0)
    assert held(calibrator) > 0
    assert calibrator.progress().outlook == 'no traffic in the last 6 min'


def test_evidence_begins_anew_after_a_bump() -> None:
    calibrator = watched(200.0, moved_at_s=150.0)
    assert held(calibrator) == 0
    evidence = calibrator.snapshot()
    assert evidence is not None and evidence.drift_px < 0.5
    assert evidence.seconds == pytest.approx(46.0, abs=3.0)
    (change,) = evidence.stillness.changes
    assert change.kind is ViewChangeKind.TURN and change.amount == pytest.approx(np.hypot(4, 7), abs=0.5)


def test_a_bump_is_reported_until_the_camera_has_stood_again() -> None:
    progress = watched(156.0, moved_at_s=150.0).progress()
    assert 'the camera was moved at 150.0 s: the picture was displaced by 8.1 px' in str(progress)
    assert not progress.outlook


def test_evidence_begins_anew_when_the_camera_looks_elsewhere() -> None:
    calibrator = watched(200.0, gone_at_s=150.0)
    assert held(calibrator) == 0
    evidence = calibrator.snapshot()
    assert evidence is not None
    (change,) = evidence.stillness.changes  # the picture upside down
    assert change.kind is ViewChangeKind.TURN and change.amount > 100


def test_the_longest_still_part_is_there_at_the_end_of_a_recording() -> None:
    calibrator = watched(200.0, gone_at_s=150.0)
    longest = calibrator.snapshot(longest_part=True)
    assert longest is not None and longest.track_count > 0
    assert (longest.first_stamp_ns, round(longest.seconds)) == (0, 149)
    background = calibrator.background(longest_part=True)
    assert background is not None and calibrator.background() is not None
    assert np.abs(background.astype(int) - calibrator.background()[::-1, ::-1]).mean() < 6  # grey levels, of JPEG


def test_progress_reads_as_one_line() -> None:
    assert str(CalibrationProgress(42.4, ('17 of 40 tracks',), 'about 6 min more at this rate')) == (
        '42 %: 17 of 40 tracks, about 6 min more at this rate'
    )
    assert str(CalibrationProgress(100.0, ())) == '100 %'
