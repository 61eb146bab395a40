"""Hours without a move: what the watch of the view and the perception tell although the camera stands.

The images are those of `long_stream`: a recording in the light and weather of days, with sway, jams and noise.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.offline.benchmark.long_stream import (
    MAX_RECORDED,
    LongStream,
    ShortRecording,
    read_short_recording,
)
from autocalib_ros.perception.view_registration import registered_image
from autocalib_ros.perception.view_watch import KnownView, ViewCondition, ViewWatch

PERCEPTION_HZ = 5.0
"""Rate of the images in the hours with perception: vehicles are followed, at a third of the cost of video."""
ALLOWED_FALSE_FLAGS = 1
"""False flags of all hours together that are accepted."""
STILL_HEADER = (
    f'{"recording":<28}{"hour":>5}{"daylight":>9}{"registered":>11}{"seen":>7}{"rest, degrees":>14}{"flags":>6}'
    f'{"images":>8}{"views":>6}{"drift, px":>10}{"s of CPU":>9}'
)


@dataclass(frozen=True)
class StillHour:
    """One simulated hour of a camera that stands."""

    recording: str
    hour: int
    daylight: float
    """Mean share of daylight, 0 to 1."""
    registered: int
    """Images that the watch looked at."""
    seen: float
    """Fraction of them in which the view was recognised."""
    rest_deg: float
    """Largest lasting turn that the watch measured, degrees: its error, since the camera stands."""
    flags: tuple[str, ...]
    """Moves and faults that were told."""
    images: int
    """Images that went through the perception."""
    views: int
    """Further views of the camera that the perception found."""
    drift_px: float
    processor_s: float

    @property
    def false_flags(self) -> int:
        """Number of moves, faults and further views that were told."""
        return len(self.flags) + self.views


def measure_still_hours(
    recordings: Sequence[Path], hours: float, *, perception_hours: float, day_hours: float, width: int
) -> Iterator[StillHour]:
    """Yield each hour of each recording; all hours and `perception_hours` at first are divided among them."""
    for path in recordings:
        recording = read_short_recording(path, width, PERCEPTION_HZ, MAX_RECORDED)
        share = 1.0 / len(recordings)
        yield from _watched(recording, hours * share, perception_hours * share, 3600.0 * day_hours)


@dataclass
class _Tally:
    began: float = field(default_factory=time.process_time)
    daylight: list[float] = field(default_factory=list)
    registered: int = 0
    seen: int = 0
    rest_deg: float = 0.0
    flags: list[str] = field(default_factory=list)
    images: int = 0
    views: int = 0


def _watched(recording: ShortRecording, hours: float, perception_hours: float, day_s: float) -> Iterator[StillHour]:
    stream, watch = LongStream(recording, day_s), ViewWatch()
    watch.begin([KnownView(registered_image(stream.background))], recording.camera)
    calibrator = AutoCalibrator(Options(camera_height=8.0))
    hour, tally, changes, drift_px = 0, _Tally(), 0, 0.0
    for number in range(int(3600.0 * hours * PERCEPTION_HZ)):
        time_s = number / PERCEPTION_HZ
        perceived = time_s < 3600.0 * perception_hours
        if perceived or watch.is_due(time_s):
            image = stream.image(time_s)
            if perceived:
                calibrator.add_image(1_000_000_000 + round(time_s * 1e9), image)
                tally.images += 1
            if watch.is_due(time_s):
                _look(watch, image, time_s, tally)
                tally.daylight.append(stream.daylight(time_s))
        if time_s + 1.0 / PERCEPTION_HZ >= 3600.0 * min(hour + 1, hours):
            evidence = calibrator.snapshot(with_segments=False) if tally.images else None
            if evidence is not None:
                drift_px = evidence.drift_px
                tally.views, changes = len(evidence.stillness.changes) - changes, len(evidence.stillness.changes)
            yield _hour(recording.name, hour, tally, drift_px if tally.images else 0.0)
            hour, tally = hour + 1, _Tally()


def _look(watch: ViewWatch, image: np.ndarray, time_s: float, tally: _Tally) -> None:
    """Show an image to the watch, and note what it tells."""
    before, report = watch.report, watch.update(image, time_s)
    tally.registered += 1
    tally.seen += report.checked_s == time_s
    lasting = watch.lasting_turn_deg()
    if lasting is not None:
        tally.rest_deg = max(tally.rest_deg, float(np.linalg.norm(lasting)))
    told = report.condition in (ViewCondition.MOVED, ViewCondition.BLIND)
    if told and (report.condition, report.fault) != (before.condition, before.fault):
        tally.flags.append(f'{time_s:.0f} s: {report}')


def _hour(recording: str, hour: int, tally: _Tally, drift_px: float) -> StillHour:
    return StillHour(
        recording,
        hour,
        float(np.mean(tally.daylight or [0.0])),
        tally.registered,
        tally.seen / max(1, tally.registered),
        tally.rest_deg,
        tuple(tally.flags),
        tally.images,
        tally.views,
        drift_px,
        time.process_time() - tally.began,
    )


def format_still_hour(each: StillHour) -> str:
    """Return one line of the table, and one for each flag."""
    row = (
        f'{each.recording[-27:]:<28}{each.hour:>5}{each.daylight:>9.2f}{each.registered:>11}{each.seen:>7.1%}'
        f'{each.rest_deg:>14.3f}{len(each.flags):>6}{each.images:>8}{each.views:>6}{each.drift_px:>10.2f}'
        f'{each.processor_s:>9.0f}'
    )
    return '\n'.join([row, *(f'    {flag}' for flag in each.flags)])


def format_still_summary(hours: Sequence[StillHour]) -> str:
    """Return the last line of the table."""
    registered, images = sum(each.registered for each in hours), sum(each.images for each in hours)
    flags = sum(each.false_flags for each in hours)
    return (
        f'{registered} registrations and {images} images through the perception in {len(hours)} hours: '
        f'{flags} false flags, at most {max(each.rest_deg for each in hours):.3f} degrees off at rest'
    )
