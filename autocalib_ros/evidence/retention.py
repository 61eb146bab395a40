"""What evidence adds to what is newer, and so what may go when memory is full.

Evidence is about as good as the next of its kind: another vehicle that went the same way through the same part of the
image. Its kind is an image cell with a heading, and what counts is how many newer vehicles there are of that kind.
"""

from __future__ import annotations

import numpy as np

CELLS_PER_SIDE = 8
"""Cells along the longer side of the box that holds the traffic; they are square. A road far away fills few pixels."""
HEADING_BINS = 8
CORROBORATING_TRACKS = 3
"""So many tracks of a vehicle corroborate each other; a lone one may be a shadow or a leaf, and is worth its share."""
REPLACING_VEHICLES = 25
"""So many newer vehicles of its kind replace one: random errors are then down to a fifth of one vehicle's."""
EVICTION_FRACTION = 0.1
"""Share of the buffer that is emptied at once when it is full: choosing costs milliseconds, adding microseconds."""
MAX_VEHICLE_FRACTION = 0.125
"""A label that more of the buffer comes from goes on as another vehicle, so that one alone cannot fill it."""


def headings(displacements_px: np.ndarray) -> np.ndarray:
    """Number the heading (n,) of displacements (n, 2); a road along an axis of the image is not split by noise."""
    turns = np.arctan2(displacements_px[:, 1], displacements_px[:, 0]) * (HEADING_BINS / (2 * np.pi))
    return np.floor(turns + 0.5) % HEADING_BINS


def cell_heading_bins(midpoints_px: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Number the kind (n,) of what passed `midpoints_px` (n, 2) under a heading (n,)."""
    corner = midpoints_px.min(axis=0)
    side = max(float((midpoints_px.max(axis=0) - corner).max()), 1e-9) / CELLS_PER_SIDE
    column, row = np.minimum((midpoints_px - corner) / side, CELLS_PER_SIDE - 1).astype(int).T
    return (row * CELLS_PER_SIDE + column) * HEADING_BINS + heading.astype(int)


def novelty(vehicles: np.ndarray, newest_s: np.ndarray, bins: np.ndarray) -> np.ndarray:
    """Return what each vehicle adds per row, 0 to 1, shape (max(vehicles) + 1,).

    `vehicles` (n,) are the rows' owners, numbered from 0, `newest_s` (vehicles,) their last times and `bins` (n,)
    the rows' kinds. A row is worth one over one more than the newer vehicles of its kind.
    """
    count = len(newest_s)
    age = np.empty(count, int)
    age[np.lexsort((-np.arange(count), -newest_s))] = np.arange(count)
    pairs, of_row = np.unique(bins * count + age[vehicles], return_inverse=True)
    kind = pairs // count
    newer = np.arange(len(pairs)) - np.searchsorted(kind, kind)
    rows = np.bincount(vehicles, minlength=count)
    total = np.bincount(vehicles, 1.0 / (1.0 + newer[of_row.ravel()]), minlength=count)
    return total / np.maximum(rows, 1) * np.minimum(rows / CORROBORATING_TRACKS, 1.0)


class RetentionIndex:
    """Who left each row that is held, where and when: at most `limit` rows, in the order in which they came."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._midpoints_px = np.zeros((limit, 2))
        self._headings = np.zeros(limit)
        self._times_s = np.zeros(limit)
        self._passage_ids = np.zeros(limit, int)
        self._passages: dict[int, tuple[int, int]] = {}
        self._next_passage_id = 0
        self.count = 0

    def add(self, vehicles: np.ndarray, midpoints_px: np.ndarray, displacements_px: np.ndarray, time_s: float) -> None:
        """Add rows of vehicles (n,) at midpoints (n, 2) with displacements (n, 2) that ended at `time_s`.

        The caller makes room for them first.
        """
        part = slice(self.count, self.count + len(vehicles))
        self._midpoints_px[part], self._headings[part], self._times_s[part] = (
            midpoints_px,
            headings(displacements_px),
            time_s,
        )
        self._passage_ids[part] = [self._passage_id(vehicle) for vehicle in vehicles.tolist()]
        self.count += len(vehicles)

    def _passage_id(self, vehicle: int) -> int:
        """Number the passage of a vehicle: a label that a queue hands on for ever is not one vehicle."""
        passage_id, rows = self._passages.get(vehicle, (-1, 0))
        if passage_id < 0 or rows >= self._limit * MAX_VEHICLE_FRACTION:
            passage_id, rows, self._next_passage_id = self._next_passage_id, 0, self._next_passage_id + 1
        self._passages[vehicle] = passage_id, rows + 1
        return passage_id

    def rows_after_eviction(self, wanted: int) -> np.ndarray:
        """Return the rows to keep so that `wanted` more fit: a batch of vehicles that add least goes, whole."""
        vehicles, newest_s, added = self._novelty()
        goal = min(self._limit * (1.0 - EVICTION_FRACTION), self._limit - wanted)
        order = np.lexsort((newest_s, added))
        left = self.count - np.cumsum(np.bincount(vehicles)[order])
        going = order[: int(np.argmax(left <= goal)) + 1]
        return np.flatnonzero(~np.isin(vehicles, going))

    def rows_not_replaced(self, time_s: float) -> np.ndarray:
        """Return the rows of vehicles seen since `time_s`, and of older ones that newer ones do not yet replace."""
        if not self.count or self.oldest_s >= time_s:
            return np.arange(self.count)
        vehicles, newest_s, added = self._novelty()
        return np.flatnonzero(((newest_s >= time_s) | (added > 1.0 / (1.0 + REPLACING_VEHICLES)))[vehicles])

    def rows_since(self, time_s: float) -> np.ndarray:
        """Return the rows not older than `time_s`."""
        return np.flatnonzero(self._times_s[: self.count] >= time_s)

    def _novelty(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vehicle of each row (n,), numbered in the order they came; last time and worth of each vehicle."""
        held = slice(self.count)
        _, vehicles = np.unique(self._passage_ids[held], return_inverse=True)
        newest_s = np.full(vehicles.max() + 1, -np.inf)
        np.maximum.at(newest_s, vehicles, self._times_s[held])
        return (
            vehicles,
            newest_s,
            novelty(vehicles, newest_s, cell_heading_bins(self._midpoints_px[held], self._headings[held])),
        )

    def keep(self, rows: np.ndarray) -> None:
        """Keep only these rows (n,), by rising index."""
        self.count = len(rows)
        for column in (self._midpoints_px, self._headings, self._times_s, self._passage_ids):
            column[: self.count] = column[rows]
        held = set(self._passage_ids[: self.count].tolist())
        self._passages = {vehicle: passage for vehicle, passage in self._passages.items() if passage[0] in held}

    @property
    def times_s(self) -> np.ndarray:
        """Time of each row, shape (count,)."""
        return self._times_s[: self.count]

    @property
    def oldest_s(self) -> float:
        """Time of the oldest row; infinite where there is none."""
        return float(self.times_s.min(initial=np.inf))
