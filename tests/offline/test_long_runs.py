"""Hours of a camera that stands, and a node that runs for a day: images, traffic, and how they are judged."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.long_stream import LongStream, ShortRecording
from autocalib_ros.offline.benchmark.repeated_traffic import FIRST_VEHICLE, RepeatedTraffic
from autocalib_ros.offline.benchmark.soak import SoakPlan, SoakSample, read_samples, soak, soak_checks, write_samples
from autocalib_ros.offline.benchmark.soak_figure import write_soak_figure
from autocalib_ros.offline.benchmark.still_hours import _watched
from autocalib_ros.perception.view_registration import ViewPose, ViewReference, normalised
from synthetic_results import junction_evidence

SIZE = (320, 180)
CAMERA = Camera.equidistant(*SIZE, 160.0)
DAY_S = 3600.0


def recording() -> ShortRecording:
    """A street with one vehicle that drives to and fro."""
    generator = np.random.default_rng(0)
    street = np.full((SIZE[1], SIZE[0]), 110.0, np.float32)
    for _ in range(160):
        x, y = generator.integers(0, (SIZE[0] - 20, SIZE[1] - 12))
        street[y : y + generator.integers(4, 14), x : x + generator.integers(4, 26)] += generator.uniform(-60, 60)
    street = cv2.GaussianBlur(np.clip(street, 0, 255), (0, 0), 0.8).astype(np.uint8)
    images = []
    for step in range(20):
        image = street.copy()
        image[120:140, 20 + 12 * step : 60 + 12 * step] = 230
        images.append(image)
    return ShortRecording('street', images, 5.0, CAMERA)


RECORDING = recording()


def sample(hour: float, **changes) -> SoakSample:
    calm = SoakSample(
        hour=hour, daylight=1.0, real_s=hour, memory_mb=200.0, solver_mb=150.0, descriptors=23, threads=21, log_lines=8,
        files_kb=150.0, ms_per_image=9.0, images=1800, lost=0, state='calibrated', view='still', focal_px=300.0,
        focal_sigma_px=2.0, tilt_deg=30.0, tilt_sigma_deg=0.1, tracks=400,
    )  # fmt: skip
    return replace(calm, **changes)


def test_the_camera_of_long_streams_sways_by_what_they_say() -> None:
    stream, reference = LongStream(RECORDING, DAY_S), ViewReference(RECORDING.images[0], CAMERA)
    time_s = next(time_s for time_s in np.arange(300.0, 400.0, 0.2) if np.linalg.norm(stream.sway_deg(time_s)) > 0.04)
    pose = reference.near(normalised(stream.image(time_s)), ViewPose.identity())
    assert pose is not None
    # an image so small shows a hundredth of a degree at best; a turn to the other side would be twice as far off
    np.testing.assert_allclose(np.degrees(pose.turn_rad), stream.sway_deg(time_s), atol=0.03)


def test_nights_are_dark_and_days_are_not() -> None:
    stream = LongStream(RECORDING, DAY_S)
    by_day, by_night = (float(stream.image(part * DAY_S).mean()) for part in (0.9, 0.4))
    assert stream.daylight(0.9 * DAY_S) == 1.0
    assert stream.daylight(0.4 * DAY_S) == 0.0
    assert by_night < 0.8 * by_day  # street lamps and noise are not dark


def test_vehicles_stand_in_a_jam_and_drive_otherwise() -> None:
    stream = LongStream(RECORDING, DAY_S)
    assert stream.is_jammed(10.0)
    assert not stream.is_jammed(300.0)
    standing, driving = (
        float(np.abs(stream.image(time_s).astype(float) - stream.image(time_s + 1.0)).max(axis=0)[20:300].mean())
        for time_s in (10.0, 300.0)
    )
    assert driving > 1.5 * standing


def test_repeated_traffic_is_that_of_other_vehicles_later() -> None:
    evidence = junction_evidence()
    traffic = RepeatedTraffic(evidence)
    first, third = (traffic.between(number * traffic.period_s, (number + 1) * traffic.period_s) for number in (0, 2))
    assert len(first.tracks) == len(third.tracks) == evidence.track_count
    for one, other in zip(first.tracks, third.tracks, strict=True):
        np.testing.assert_allclose(other.times_s - one.times_s, 2 * traffic.period_s)
        np.testing.assert_allclose(other.points_px, one.points_px, atol=2.0)  # ten times the jitter
    vehicles = [{track.vehicle for track in observed.tracks} for observed in (first, third)]
    assert min(map(min, vehicles)) >= FIRST_VEHICLE
    assert not vehicles[0] & vehicles[1]


def test_parts_of_repeated_traffic_are_the_whole() -> None:
    traffic = RepeatedTraffic(junction_evidence())
    edges_s = np.linspace(0.0, 2.0 * traffic.period_s, 12)
    parts = [traffic.between(*part) for part in itertools.pairwise(edges_s)]
    assert sum(len(part.tracks) for part in parts) == 2 * junction_evidence().track_count


def test_minutes_of_a_camera_that_stands_give_no_flag() -> None:
    hour = next(iter(_watched(RECORDING, 90.0 / 3600.0, 20.0 / 3600.0, DAY_S)))
    assert hour.false_flags == 0
    assert hour.images == 100
    assert hour.registered > 60
    assert hour.seen > 0.9


def test_growth_after_the_warm_up_is_not_flat() -> None:
    hours = np.arange(0.5, 24.1, 0.5)
    assert all(check.is_flat for check in soak_checks([sample(hour) for hour in hours]))
    leaks = {'memory_mb': lambda hour: 200.0 + hour, 'descriptors': lambda hour: int(20 + hour / 4)}
    for key, value in leaks.items():
        failed = [one for one in soak_checks([sample(hour, **{key: value(hour)}) for hour in hours]) if not one.is_flat]
        assert len(failed) == 1
    talks = soak_checks([sample(hour, log_lines=int(20 * hour)) for hour in hours])
    assert [one.name for one in talks if not one.is_flat] == ['lines of log an hour']


def test_a_soak_without_an_answer_is_not_flat() -> None:
    checks = soak_checks([sample(hour, focal_px=np.nan, focal_sigma_px=np.nan) for hour in range(1, 9)])
    assert [one.name for one in checks if not one.is_flat] == ['focal length, px']


def test_samples_are_read_as_they_were_written(tmp_path: Path) -> None:
    samples = [sample(1.0), sample(2.0, state='none', view='sway 0.05 degrees, at dusk')]
    write_samples(tmp_path / 'samples.csv', samples)
    assert read_samples(tmp_path / 'samples.csv') == samples
    write_soak_figure(tmp_path / 'soak.svg', samples)
    assert '<svg' in (tmp_path / 'soak.svg').read_text(encoding='utf-8')


@pytest.mark.dds
def test_a_minute_of_a_soak_runs_the_node(tmp_path: Path) -> None:
    pytest.importorskip('rclpy')
    plan = SoakPlan(hours=60.0 / 3600.0, image_hours=20.0 / 3600.0, day_hours=24.0, camera_height_m=8.0)
    (last,) = soak(RECORDING, plan, tmp_path / 'soak.log')
    log = (tmp_path / 'soak.log').read_text(encoding='utf-8')
    assert 'Traceback' not in log
    assert last.images > 80, log  # 100 with traffic, and 20 without; the frame clock may hold some
    assert last.lost == 0
    assert last.memory_mb > 50.0
    assert last.threads > 3
