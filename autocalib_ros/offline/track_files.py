"""Evidence from the tracks of another program: CSV with a header, or the format of the MOT Challenge.

A CSV file has the columns `time_s`, `vehicle_id`, `track_id`, `x_px` and `y_px`: points that keep their place on a
vehicle. A MOT file has no header and lines of frame, id, left, top, width and height of a box, and more; the middle of
the lower side of a box is its point, as it is nearest to the road.
"""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from autocalib_ros.config import BufferOptions
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence, Track
from autocalib_ros.util.documents import read_text
from autocalib_ros.util.input_limits import MAX_TABLE_BYTES

COLUMNS = ('time_s', 'vehicle_id', 'track_id', 'x_px', 'y_px')
MOT_COLUMNS = 6
"""Fewest numbers in a line of a MOT file: frame, id, left, top, width, height."""
SUFFIXES = ('.csv', '.txt')
MIN_READ_POINTS = 3
"""Fewest points of a track; shorter ones have no direction that could be checked."""
MAX_ID = 2**53
"""Largest vehicle or track number that a float holds exactly."""


class _Point(NamedTuple):
    """One line of a file."""

    time_s: float
    vehicle: int
    track: int
    x_px: float
    y_px: float


def evidence_from_file(path: Path, image_size: tuple[int, int], fps: float | None, buffer: BufferOptions) -> Evidence:
    """Read a file of tracks as evidence; `fps` is the frame rate, needed for a MOT file alone.

    InputError if the file cannot be read as tracks, or holds none inside the image; UsageError if `fps` is missing.
    """
    by_track: dict[tuple[int, int], list[_Point]] = defaultdict(list)
    for point in _points(path, fps):
        by_track[point.vehicle, point.track].append(point)
    tracks = [track for points in by_track.values() if (track := _track(points)) is not None]
    if not tracks:
        raise InputError(f'{path} has no track of at least {MIN_READ_POINTS} points')
    _require_inside(path, tracks, image_size)
    collected = EvidenceBuffer(buffer)
    for track in sorted(tracks, key=lambda each: float(each.times_s[-1])):
        collected.add_track(track)
    times = np.unique(np.concatenate([track.times_s for track in tracks]))
    return collected.snapshot(
        image_size=image_size,
        first_stamp_ns=0,
        newest_stamp_ns=round(float(times[-1]) * 1e9),
        frames=len(times),
        drift_px=0.0,
        unfinished=[],
    )


def _points(path: Path, fps: float | None) -> Iterator[_Point]:
    """Read the points of a file, times counted from the first one; InputError with the line that cannot be read."""
    try:
        lines = list(csv.reader(io.StringIO(read_text(path, 'file of tracks', MAX_TABLE_BYTES), newline='')))
    except csv.Error as error:
        raise InputError(f'cannot read {path}: {error}') from error
    header = [cell.strip() for cell in lines[0]] if lines else []
    if set(COLUMNS) <= set(header):
        order = [header.index(name) for name in COLUMNS]
        points = [_csv_point(path, number, line, order) for number, line in enumerate(lines[1:], 2) if line]
    elif len(header) >= MOT_COLUMNS and _is_number(header[0]):
        if fps is None:
            raise UsageError(f'{path} counts frames, as MOT files do: give the frame rate with --fps')
        points = [_mot_point(path, number, line, fps) for number, line in enumerate(lines, 1) if line]
    else:
        raise InputError(
            f'{path} is no file of tracks: the first line has to name the columns {", ".join(COLUMNS)}, or every line '
            'has to hold frame, id, left, top, width and height, as MOT files do'
        )
    begin_s = min((point.time_s for point in points), default=0.0)
    return (point._replace(time_s=point.time_s - begin_s) for point in points)


def _csv_point(path: Path, number: int, line: list[str], order: list[int]) -> _Point:
    time_s, vehicle, track, x_px, y_px = _numbers(path, number, line, order)
    return _Point(time_s, int(vehicle), int(track), x_px, y_px)


def _mot_point(path: Path, number: int, line: list[str], fps: float) -> _Point:
    frame, vehicle, left, top, width, height = _numbers(path, number, line, list(range(MOT_COLUMNS)))
    return _Point(frame / fps, int(vehicle), 0, left + width / 2, top + height)


def _numbers(path: Path, number: int, line: list[str], order: list[int]) -> list[float]:
    try:
        found = [float(line[index]) for index in order]
    except (IndexError, ValueError):
        found = []
    if not found or not all(abs(value) <= MAX_ID for value in found):
        raise InputError(f'{path}, line {number}: {len(order)} finite numbers were expected, got {",".join(line)!r}')
    return found


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _track(points: list[_Point]) -> Track | None:
    """Return the track of points in the order of their times; None if there are too few, of different times."""
    times, first = np.unique([point.time_s for point in points], return_index=True)
    if len(times) < MIN_READ_POINTS:
        return None
    places = np.array([(points[index].x_px, points[index].y_px) for index in first])
    return Track(points[0].vehicle, times, places)


def _require_inside(path: Path, tracks: list[Track], image_size: tuple[int, int]) -> None:
    """Raise InputError if most points lie outside the image: the size is that of another image."""
    places = np.concatenate([track.points_px for track in tracks])
    inside = ((places >= -0.5) & (places <= np.subtract(image_size, 0.5))).all(axis=1)
    if inside.mean() < 0.5:
        width, height = image_size
        raise InputError(
            f'{path}: {100 * (1 - inside.mean()):.0f} % of the points lie outside the image of {width}x{height} '
            'pixels: give the size of the images in which they were tracked with --image-size'
        )
