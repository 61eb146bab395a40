"""Join the evidence of several recordings of one view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autocalib_ros.evidence.snapshot import TRACK_ARRAYS, Evidence
from autocalib_ros.evidence.stillness import Stillness
from autocalib_ros.evidence.tables import STILL_LINES, STRIPES, TABLES, ObservationTable, merged

JOINT_GAP_S = 2.0
"""Seconds between two recordings in joined evidence, whatever lay between them: longer than any track has gaps."""


def moved(evidence: Evidence, matrix: np.ndarray) -> Evidence:
    """Return evidence with all its pixels taken by a similarity (2, 3) to those of another recording."""
    values = {table.values: _moved_rows(table, getattr(evidence, table.values), matrix) for table in TABLES}
    return replace(
        evidence,
        points_px=evidence.points_px @ matrix[:, :2].T + matrix[:, 2],
        **merged([{name: value for name, value in values.items() if len(value)}]),
    )


def _moved_rows(table: ObservationTable, rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the points x0, y0, x1, y1, ... of each row (n, columns) moved; a last odd column is no point."""
    columns = rows.shape[1] // 2 * 2
    pairs = rows[:, :columns].reshape(-1, 2) @ matrix[:, :2].T + matrix[:, 2]
    last = rows[:, columns:] * (np.hypot(*matrix[:, 0]) if table.ends_with_length else 1.0)
    return np.hstack([pairs.reshape(len(rows), columns), last]).astype(rows.dtype)


def joined(parts: Sequence[Evidence]) -> Evidence:
    """Return the evidence of all parts, which are of one view and registered to each other, one after the other.

    Landmarks and picture are those of the first; lines and bars of the still scene those of the part with most of them,
    since each shows the same ones. Vehicles of different parts are different vehicles. Stamps end with the newest of
    all.
    """
    first, *others = parts
    if not others:
        return first
    offset_s, last_vehicle, shifted = 0.0, -1, []
    for part in parts:
        shifted.append(_placed(part, offset_s, last_vehicle + 1))
        offset_s += part.seconds + JOINT_GAP_S
        last_vehicle = max([last_vehicle, *(int(ids.max()) for ids in _vehicle_arrays(shifted[-1]) if len(ids))])
    seconds = offset_s - JOINT_GAP_S
    newest_ns = max(part.newest_stamp_ns for part in parts)
    still = [table.arrays(max(parts, key=table.rows)) for table in (STILL_LINES, STRIPES)]
    tables = [table for table in TABLES if table not in (STILL_LINES, STRIPES)]
    names = [name for table in tables for name in table.names]
    rows = {name: np.concatenate([getattr(part, name) for part in shifted]) for name in (*TRACK_ARRAYS[1:], *names)}
    starts = np.cumsum([0, *(len(part.points_px) for part in parts)])
    return replace(
        first,
        first_stamp_ns=newest_ns - round(seconds * 1e9),
        newest_stamp_ns=newest_ns,
        frames=sum(part.frames for part in parts),
        drift_px=max(part.drift_px for part in parts),
        stillness=_joined_stillness(parts, seconds),
        recordings=tuple(recording for part in parts for recording in part.recordings),
        track_kinds=np.concatenate([part.track_kinds for part in parts]),
        track_starts=np.concatenate(
            [[0], *(part.track_starts[1:] + start for part, start in zip(parts, starts, strict=False))]
        ).astype(int),
        **merged([rows, *still]),
    )


def _placed(part: Evidence, offset_s: float, first_vehicle: int) -> Evidence:
    """Return a part with its times after an offset and vehicle ids from a number on."""
    times = {
        name: getattr(part, name) + offset_s for name in ('times_s', *(table.times for table in TABLES if table.times))
    }
    names = ('track_vehicles', *(table.vehicles for table in TABLES if table.vehicles))
    lowest = min((int(ids.min()) for ids in _vehicle_arrays(part) if len(ids)), default=0)
    vehicles = {name: getattr(part, name) - lowest + first_vehicle for name in names}
    return replace(part, **merged([times, vehicles]))


def _vehicle_arrays(part: Evidence) -> list[np.ndarray]:
    return [part.track_vehicles, *(getattr(part, table.vehicles) for table in TABLES if table.vehicles)]


def _joined_stillness(parts: Sequence[Evidence], seconds: float) -> Stillness:
    """Return one still part; what was left out of each recording was told when it was read."""
    sway, travel = (max(getattr(part.stillness, name) for part in parts) for name in ('sway_px', 'travel_px'))
    return Stillness(end_s=seconds, recorded_s=seconds, sway_px=sway, travel_px=travel)
