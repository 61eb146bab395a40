"""Repeated images made on purpose, and the benchmark that applies faults to recordings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy, paste
from many_cases import one_and_exhaustive

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.cli import main
from autocalib_ros.config import Options
from autocalib_ros.errors import UsageError
from autocalib_ros.offline.benchmark import streams
from autocalib_ros.offline.benchmark.repeating_source import RepeatingSource
from autocalib_ros.offline.benchmark.streams import (
    COMPARED_WITH,
    StreamRun,
    expand_kinds,
    format_run,
    run_stream,
    run_streams,
)
from autocalib_ros.offline.recordings.sources import Frame, StoredImage, TimeWindow
from autocalib_ros.offline.simulate.repeat_faults import REPEAT_FAULTS, jpeg, skipping
from autocalib_ros.offline.simulate.stamp_faults import MESSAGE_FAULTS, STAMP_FAULTS
from autocalib_ros.perception.frame_clock import FrameClock
from synthetic_results import refusal

pytestmark = pytest.mark.render

INTERVAL_NS = 50_000_000
SIZE = (180, 320)


def texture(seed: int, shape: tuple[int, int]) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, shape), (0, 0), 1.5)
    return np.clip(110 + 45 * noise / noise.std(), 0, 255)


class Road:
    """A minimal `Source`: three cars on a still road, one fast and near, one small and slow."""

    name, topic, image_type, camera_frame, is_live = 'road', '', '', '', False
    pixel_aspect, window = 0.0, TimeWindow()

    def __init__(self, total: int) -> None:
        self.total, self.duration_s = total, total * INTERVAL_NS * 1e-9
        self._road = texture(0, SIZE) * 0.4 + 60
        self._cars = [(texture(1, (40, 60)), 125, 4.5), (texture(2, (24, 36)), 80, -2.5), (texture(3, (14, 20)), 40, 1)]

    def frames(self):
        for index in range(self.total):
            image = self._road.copy()
            for number, (car, row, step) in enumerate(self._cars):
                column = (step * index + 150 * number) % (SIZE[1] + 70) - 65
                paste(image, car, column, row)
            yield Frame(index * INTERVAL_NS, noisy(image, 1.5, index))

    def stored(self):
        return (StoredImage(index * INTERVAL_NS, index * INTERVAL_NS, '') for index in range(self.total))


@pytest.mark.parametrize('kind', REPEAT_FAULTS)
def test_a_fault_repeats_images_in_order_at_an_even_rate(kind: str) -> None:
    source = RepeatingSource(Road(40), REPEAT_FAULTS[kind])
    stamps = [frame.stamp_ns for frame in source.frames()]
    assert stamps == [stored.stamp_ns for stored in source.stored()]
    assert len(stamps) == source.total == len(source.order)
    assert (np.diff(stamps) > 0).all() and stamps[-1] <= 40 * INTERVAL_NS
    assert set(np.diff(source.order).tolist()) <= {0, 1, 2} and source.order[0] == 0
    assert source.order.max() <= 39
    if kind != 'frozen_jpeg':  # the first freeze comes later
        assert 0.1 < np.mean(np.diff(source.order) == 0) < 0.7


def test_a_recorder_of_30_shows_every_fifth_image_of_25_twice() -> None:
    source = RepeatingSource(Road(25), REPEAT_FAULTS['repeated_25_in_30'])
    assert source.order.tolist()[:12] == [0, 0, 1, 2, 3, 4, 5, 5, 6, 7, 8, 9]
    assert [frame.stamp_ns for frame in source.frames()][12] == 10 * INTERVAL_NS


@pytest.mark.parametrize('new_codec', [jpeg, skipping])
def test_a_repeat_through_a_codec_differs_somewhere_and_hardly_on_average(new_codec) -> None:
    code, (first, second) = new_codec(), [frame.image for frame in Road(62).frames()][60:]
    once, twice, new = code(first, 0), code(first, 0), code(second, 1)
    moving = (slice(125, 165), slice(200, 280))  # where the fast car is
    assert cv2.absdiff(once, twice)[moving].mean() < 0.5 * cv2.absdiff(twice, new)[moving].mean()
    if new_codec is jpeg:
        assert cv2.absdiff(once, twice).max() > 4


@pytest.mark.parametrize('kind', ['repeated_25_in_30_jpeg', 'repeated_in_bursts_jpeg', 'frozen_jpeg'])
def test_through_jpeg_an_image_is_shown_first_as_in_the_stream_without_repeats(kind: str) -> None:
    source = RepeatingSource(Road(40), REPEAT_FAULTS[kind])
    alone = [frame.image for frame in streams._without_fault(Road(40), 'even_jpeg').frames()]
    same = [
        np.array_equal(frame.image, alone[index]) for index, frame in zip(source.order, source.frames(), strict=True)
    ]
    repeats = np.diff(source.order, prepend=-1) == 0
    assert all(np.array(same)[~repeats])
    assert not any(np.array(same)[np.flatnonzero(repeats & ~np.roll(repeats, 1))])  # the first repeat of each


@pytest.fixture(scope='module')
def unsolved() -> Iterator[None]:
    """Let every solution be a refusal, which takes no time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streams, 'solve', lambda evidence, options: refusal(evidence))
        yield


@pytest.fixture(scope='module')
def even(unsolved: None) -> StreamRun:
    return run_stream('even', Road(100), Options())


TRACKED = ['repeated_in_bursts', 'repeated_25_in_30_jpeg', 'repeated_15_in_30_skipping', 'repeated_at_random']


@pytest.mark.parametrize('kind', one_and_exhaustive(TRACKED))
def test_repeats_are_left_out_and_cost_few_tracks(kind: str, even: StreamRun) -> None:
    source = RepeatingSource(Road(100), REPEAT_FAULTS[kind])
    run = run_stream(kind, source, Options())
    repeats = int((np.diff(source.order) == 0).sum())
    assert even.repeated == 0 and even.tracks > 15
    assert 0.9 * repeats - 2 <= run.repeated <= repeats
    assert run.tracks >= 0.8 * even.tracks


@pytest.mark.parametrize(
    'kind', one_and_exhaustive(['ntp_forward_0.1', 'utc_to_tai', 'ntp_back_0.1', 'dropped_2', 'pause'])
)
def test_the_traffic_tells_a_clock_that_is_set_from_lost_images(kind: str, even: StreamRun) -> None:
    calibrator = AutoCalibrator(Options())
    for frame in streams._with_fault(Road(100), kind).frames():
        calibrator.add_image(frame.stamp_ns, frame.image)
    was_set = kind not in ('dropped_2', 'pause')
    assert calibrator.clock().steps == int(was_set)
    assert calibrator.clock().lost == (2 if kind == 'dropped_2' else 0)
    if was_set:
        assert calibrator.snapshot().track_count == even.tracks


EVEN = StreamRun('even', 'full', 100, 300, 0, 500.0, 10.0)


@pytest.mark.parametrize(
    ('run', 'faults'),
    [
        (StreamRun('x', 'full', 80, 300, 0, 509.0, 10.0), []),
        (StreamRun('x', 'full', 79, 300, 0, 511.0, 10.0), ['focal length', 'tracks']),
        (StreamRun('dropped_half', 'full', 40, 150, 0, 509.0, 10.0), []),
        (StreamRun('dropped_half', 'full', 39, 150, 0, 511.0, 10.0), ['focal length', 'tracks']),
        (StreamRun('x', 'assumed', 200, 300, 0, 500.0, 10.0), ['verdict']),
        (StreamRun('x', 'no_motion', 100, 300, 0), ['verdict']),
    ],
)
def test_faults_are_another_verdict_a_far_focal_length_and_few_tracks(run: StreamRun, faults: list[str]) -> None:
    assert run.faults(EVEN) == faults


def test_two_refusals_are_one_verdict() -> None:
    refused = [StreamRun('x', code, 90, 300, 0) for code in ('no_agreement', 'too_little_curvature')]
    assert refused[0].faults(refused[1]) == []


def test_a_row_names_focal_length_sigmas_and_tracks() -> None:
    row = format_run(StreamRun('jitter_30', 'full', 90, 300, 7, 505.0, 11.0), EVEN)
    assert row.split() == ['jitter_30', 'full', '505.0', '11.0', '+0.50', '90', '90', '7', 'even', 'ok']
    refused = format_run(StreamRun('jitter_30', 'no_motion', 3, 300, 0), EVEN)
    assert refused.split() == ['jitter_30', 'no_motion', '-', '-', '-', '3', '3', '0', 'even', 'verdict,', 'tracks']


def test_kinds_are_names_or_groups() -> None:
    assert expand_kinds(['repeats', 'jitter_20', 'jitter_20']) == (*REPEAT_FAULTS, 'jitter_20')
    assert set(expand_kinds([])) == {*STAMP_FAULTS, *REPEAT_FAULTS} - {'even'}
    with pytest.raises(UsageError, match=r'no such fault: jiter; there are stamps, repeats, even, jitter_20'):
        expand_kinds(['jiter'])


def test_a_stream_is_compared_with_an_even_one_of_its_codec_and_its_traffic(monkeypatch) -> None:
    seen = {}

    def run(kind, source, options):
        seen[kind] = [frame.stamp_ns // INTERVAL_NS for frame in source.frames()]
        return StreamRun(kind, 'full', 9, 30, 0)

    monkeypatch.setattr(streams, 'run_stream', run)
    kinds = ['repeated_25_in_30', 'repeated_25_in_30_jpeg', 'frozen_jpeg', 'jitter_30', *COMPARED_WITH]
    pairs = [(run.kind, even.kind) for run, even in run_streams(Road(9), kinds, Options())]
    assert pairs == [
        ('even', 'even'),
        ('repeated_25_in_30', 'even'),
        ('even_jpeg', 'even_jpeg'),
        ('repeated_25_in_30_jpeg', 'even_jpeg'),
        ('frozen_jpeg', 'even_jpeg'),
        ('jitter_30', 'even'),
        ('second_half', 'second_half'),
        ('started_again', 'second_half'),
        ('cut', 'cut'),
        ('pause', 'cut'),
    ]
    assert seen['even'] == seen['even_jpeg'] == list(range(9))
    assert seen['second_half'] == [4, 5, 6, 7, 8]
    assert seen['cut'] == [0, 1, 2, 3, 4]


def test_a_recording_without_the_images_of_a_pause_has_even_stamps() -> None:
    paused, cut = streams._with_fault(Road(300), 'pause'), streams._without_fault(Road(300), 'cut')
    assert paused.arrived.images.tolist() == cut.arrived.images.tolist()
    assert np.diff(paused.arrived.stamps_ns).max() == 100 * INTERVAL_NS
    assert set(np.diff(cut.arrived.stamps_ns).tolist()) == {INTERVAL_NS} and len(cut.arrived.images) == 201


@pytest.mark.parametrize('kind', MESSAGE_FAULTS)
def test_faults_that_only_messages_tell_come_as_from_messages(kind: str) -> None:
    clock, times = FrameClock(), {}
    for number, frame in enumerate(streams._with_fault(Road(300), kind).frames()):
        times.update({timed.image: timed.time_ns for timed in clock.add(frame.stamp_ns).timed})
        assert number < 300
    errors = np.diff([times[image] for image in sorted(times)]) / INTERVAL_NS - np.diff(sorted(times))
    # the receipt is late by a third of a frame on average, which the clock evens out after a second or two
    assert len(times) >= 296 and np.quantile(np.abs(errors[70:]), 0.8) < 0.1


@pytest.mark.parametrize(('verdict', 'status'), [('full', 0), ('no_motion', 3)])
def test_the_command_prints_a_row_a_kind_and_fails_by_its_exit_status(verdict, status, monkeypatch, capsys, tmp_path):
    asked = []

    def runs(source, kinds, options):
        asked.append((source, kinds, options.camera_height))
        faulty = StreamRun('frozen_jpeg', verdict, 90, 300, 30, *([500.0, 10.0] if status == 0 else []))
        return [(EVEN, EVEN), (faulty, EVEN)]

    monkeypatch.setattr(streams, 'run_streams', runs)
    monkeypatch.setattr(streams, 'open_source', lambda path, **window: (path, window))
    arguments = ['a', 'b', '--kinds', 'frozen_jpeg', '--duration', '30', '--camera-height', '7.5']
    assert main(['benchmark', 'streams', *arguments]) == status
    window = {'start_s': 0.0, 'duration_s': 30.0}
    assert asked == [((Path(name), window), ('frozen_jpeg',), 7.5) for name in 'ab']
    rows = capsys.readouterr().out.splitlines()
    assert [row.split()[0] for row in rows] == ['a', 'kind', 'even', 'frozen_jpeg', 'b', 'kind', 'even', 'frozen_jpeg']
