"""Vehicle tracks on the road in metres, with speeds and standard deviations, as CSV or Parquet."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.evidence.snapshot import Evidence, TrackKind
from autocalib_ros.ground import Ground
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.util.files import write_atomically

ROW_S = 0.1
"""Interval of the rows of a vehicle, seconds."""
SLOPE_S = 0.5
"""Duration over which a speed is fitted: noise of a pixel hardly changes it, a bend hardly bends within it."""
MIN_VEHICLE_S = 1.0
"""Least duration of a vehicle that is written: shorter ones have two independent speeds at the most."""
TRACK_SUFFIXES = ('.csv', '.parquet')


@dataclass(frozen=True)
class GroundTracks:
    """Rows of vehicles, ordered by vehicle and time; all arrays have the shape (rows,)."""

    time_s: np.ndarray
    """Since the first image."""
    stamp_ns: np.ndarray
    vehicle_id: np.ndarray
    kind: np.ndarray
    """'unknown', 'vehicle' or 'person', as far as a detector told it."""
    x_m: np.ndarray
    """Centre of the points that were followed on the vehicle, in the ground frame."""
    y_m: np.ndarray
    sigma_m: np.ndarray
    """Standard deviation of the place: of the calibration, and of the height of the points above the road."""
    speed_m_s: np.ndarray
    speed_sigma_m_s: np.ndarray
    direction_deg: np.ndarray
    """Counter-clockwise from the x axis of the ground frame."""
    points: np.ndarray
    """Points that were followed at this time."""


@dataclass(frozen=True)
class _Samples:
    """Followed points of one vehicle in bins of time."""

    bins: np.ndarray
    places_m: np.ndarray
    velocities_m_s: np.ndarray
    sigmas_m: np.ndarray


def ground_tracks(evidence: Evidence, result: Calibration, options: Options) -> GroundTracks:
    """Return the vehicles of evidence on the road; UsageError without a ground plane in metres.

    Evidence is bounded: of long recordings it keeps the most different vehicles, not all.
    """
    if result.ground is None or not result.ground.metric:
        raise UsageError('tracks in metres need a ground plane in metres: give the camera height or another length')
    ground = Ground.of(result)
    height_m = min(options.scale.point_height_m, 0.5 * result.ground.height_m)
    found = ground.points(evidence.points_px, height_m=height_m)
    reach = np.hypot(*(found.points_m[:, :2] - ground.camera_m[:2]).T)
    by_height = reach * options.scale.point_height_sigma_m / (result.ground.height_m - height_m)
    by_lens = np.zeros(len(reach)) if found.sigma_m is None else found.sigma_m
    sigmas = np.hypot(by_height, by_lens)
    relative = _relative_speed_sigma(result, options, height_m)
    rows: list[tuple[np.ndarray, ...]] = []
    for vehicle in np.unique(evidence.track_vehicles):
        own = np.flatnonzero(evidence.track_vehicles == vehicle)
        samples = _samples(evidence, own, found.points_m[:, :2], found.valid, sigmas)
        if samples is not None:
            rows += _rows(samples, int(vehicle), TrackKind(evidence.track_kinds[own[0]]), relative)
    columns = [np.concatenate(column) for column in zip(*rows, strict=True)] if rows else [np.zeros(0)] * 10
    stamps = evidence.first_stamp_ns + np.rint(columns[0] * 1e9).astype(np.int64)
    return GroundTracks(columns[0], stamps, *columns[1:])


def _relative_speed_sigma(result: Calibration, options: Options, height_m: float) -> float:
    """Return the relative standard deviation that all speeds share: of lengths on the road, and of the point height."""
    sigma = result.stddev.ground
    lengths = 0.0 if sigma is None else max(sigma.along, sigma.across)
    ground_height_m = result.ground.height_m if result.ground else np.inf
    return float(np.hypot(lengths, options.scale.point_height_sigma_m / (ground_height_m - height_m)))


def _samples(
    evidence: Evidence, tracks: np.ndarray, places: np.ndarray, valid: np.ndarray, sigmas: np.ndarray
) -> _Samples | None:
    """Return places and velocities of the points of a vehicle at multiples of `ROW_S`; None if it is too short."""
    bins, found, velocities, spread = [], [], [], []
    for track in tracks:
        part = slice(evidence.track_starts[track], evidence.track_starts[track + 1])
        times, on_road = evidence.times_s[part], valid[part]
        if not on_road.all() or times[-1] - times[0] < SLOPE_S:
            continue
        at = np.arange(np.ceil(times[0] / ROW_S), np.floor(times[-1] / ROW_S) + 1)
        low = np.clip(at * ROW_S - SLOPE_S / 2, times[0], times[-1] - SLOPE_S)
        ends = [_interpolated(low + shift, times, places[part]) for shift in (0.0, SLOPE_S)]
        bins.append(at.astype(int))
        found.append(_interpolated(at * ROW_S, times, places[part]))
        velocities.append((ends[1] - ends[0]) / SLOPE_S)
        spread.append(np.interp(at * ROW_S, times, sigmas[part]))
    if not bins:
        return None
    samples = _Samples(np.concatenate(bins), np.concatenate(found), np.concatenate(velocities), np.concatenate(spread))
    return samples if (samples.bins.max() - samples.bins.min()) * ROW_S >= MIN_VEHICLE_S else None


def _interpolated(at: np.ndarray, times: np.ndarray, places: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(at, times, places[:, axis]) for axis in range(2)])


def _rows(samples: _Samples, vehicle: int, kind: TrackKind, relative: float) -> list[tuple[np.ndarray, ...]]:
    """Return the rows of each stretch of time in which the vehicle was followed without a gap."""
    every = np.unique(samples.bins)
    stretches = np.split(every, np.flatnonzero(np.diff(every) > 1) + 1)
    return [
        _stretch(samples, stretch, vehicle, kind, relative)
        for stretch in stretches
        if (len(stretch) - 1) * ROW_S >= MIN_VEHICLE_S
    ]


def _stretch(
    samples: _Samples, bins: np.ndarray, vehicle: int, kind: TrackKind, relative: float
) -> tuple[np.ndarray, ...]:
    """Return the columns of one stretch.

    The path integrates the mean velocity of the points, so that it does not jump where points come and go, and is
    shifted to the mean of their places.
    """
    inside = np.isin(samples.bins, bins)
    row = np.searchsorted(bins, samples.bins[inside])
    counts = np.bincount(row, minlength=len(bins))

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(row, values[inside], len(bins)) / counts

    velocity = np.column_stack([mean(samples.velocities_m_s[:, axis]) for axis in range(2)])
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * (np.diff(bins) * ROW_S)[:, None]
    path = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    path += (samples.places_m[inside] - path[row]).mean(axis=0)
    speed = np.hypot(*velocity.T)
    between = np.hypot(*(samples.velocities_m_s[inside] - velocity[row]).T) ** 2
    scatter = np.sqrt(np.bincount(row, between, len(bins)) / np.maximum(counts - 1, 1) / counts)
    return (
        bins * ROW_S,
        np.full(len(bins), vehicle),
        np.full(len(bins), kind.name.lower()),
        path[:, 0],
        path[:, 1],
        mean(samples.sigmas_m),
        speed,
        np.hypot(relative * speed, scatter),
        np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0])),
        counts,
    )


def require_tracks_path(path: Path) -> None:
    """Raise UsageError unless tracks can be written to this file."""
    if path.suffix not in TRACK_SUFFIXES:
        raise UsageError(f'{path}: tracks are written as {" or ".join(TRACK_SUFFIXES)}')
    if path.suffix == '.parquet':
        try:
            import pandas  # noqa: F401
        except ImportError as error:
            raise UsageError(f'{path} needs pandas and pyarrow: pip install pandas pyarrow, or write .csv') from error


def write_tracks(path: Path, tracks: GroundTracks) -> None:
    """Write tracks as CSV or Parquet by the suffix; InputError if that fails."""
    columns = {item.name: getattr(tracks, item.name) for item in fields(tracks)}
    if path.suffix == '.parquet':
        import pandas

        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            pandas.DataFrame(columns).to_parquet(path, index=False)
        except (OSError, ImportError) as error:
            raise InputError(f'cannot write {path}: {error}') from error
        return
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator='\n')
    writer.writerow(columns)
    texts = [
        [f'{value:.3f}' for value in column] if column.dtype.kind == 'f' else column.tolist()
        for column in columns.values()
    ]
    writer.writerows(zip(*texts, strict=True))
    write_atomically(path, stream.getvalue())
