"""Retention policy of the evidence buffer: which observations to evict when memory is full.

Observations are interchangeable with those of another vehicle that drove in the same direction through the same part of
the image. They are binned by image cell and heading; the novelty of a vehicle falls with the number of newer vehicles
in its bins.
"""

from __future__ import annotations

import numpy as np

CELLS_PER_SIDE = 8
"""Square cells along the longer side of the bounding box of the traffic: a distant road fills few pixels. Judgement."""
HEADING_BINS = 8
"""Bins of 45 degrees, centred on the image axes. Judgement."""
CORROBORATING_TRACKS = 3
"""Rows of a vehicle that corroborate each other; fewer scale its novelty down: it may be a shadow or a leaf."""
REPLACING_VEHICLES = 25
"""Newer vehicles of a bin that replace an older one: random errors have fallen to 1/sqrt(25), a fifth."""
EVICTION_FRACTION = 0.1
"""Fraction of the buffer that one eviction frees: choosing takes milliseconds, adding microseconds."""
MAX_VEHICLE_FRACTION = 0.125
"""Fraction of the buffer after which a vehicle id counts as a new passage, so that one id cannot fill the buffer."""


def headings(displacements_px: np.ndarray) -> np.ndarray:
    """Return the heading bin (n,) of displacements (n, 2); bins are centred on the image axes, as roads are."""
    turns = np.arctan2(displacements_px[:, 1], displacements_px[:, 0]) * (HEADING_BINS / (2 * np.pi))
    return np.floor(turns + 0.5) % HEADING_BINS


def cell_heading_bins(midpoints_px: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Return the joint bin (n,) of image cell and heading, for midpoints (n, 2) and headings (n,)."""
    corner = midpoints_px.min(axis=0)
    side = max(float((midpoints_px.max(axis=0) - corner).max()), 1e-9) / CELLS_PER_SIDE
    column, row = np.minimum((midpoints_px - corner) / side, CELLS_PER_SIDE - 1).astype(int).T
    return (row * CELLS_PER_SIDE + column) * HEADING_BINS + heading.astype(int)


def novelty(vehicles: np.ndarray, newest_s: np.ndarray, bins: np.ndarray) -> np.ndarray:
    """Return the mean novelty of the rows of each vehicle, 0 to 1, shape (max(vehicles) + 1,).

    `vehicles` (n,) are the vehicle indices of the rows, from 0; `newest_s` (vehicles,) the last time of each vehicle;
    `bins` (n,) the bins of the rows. The novelty of a row is 1 / (1 + newer vehicles in its bin).
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
    """Vehicle, place, heading and time of each row of a bounded table: at most `limit` rows, in order of arrival."""

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
        self._midpoints_px[part], self._times_s[part] = midpoints_px, time_s
        self._headings[part] = headings(displacements_px)
        self._passage_ids[part] = [self._passage_id(vehicle) for vehicle in vehicles.tolist()]
        self.count += len(vehicles)

    def _passage_id(self, vehicle: int) -> int:
        """Return the passage id of a vehicle id: an id that passes from car to car in a queue is not one vehicle."""
        passage_id, rows = self._passages.get(vehicle, (-1, 0))
        if passage_id < 0 or rows >= self._limit * MAX_VEHICLE_FRACTION:
            passage_id, rows, self._next_passage_id = self._next_passage_id, 0, self._next_passage_id + 1
        self._passages[vehicle] = passage_id, rows + 1
        return passage_id

    def rows_after_eviction(self, wanted: int) -> np.ndarray:
        """Return the rows to keep so that `wanted` more fit; a batch of the least novel vehicles is evicted whole."""
        vehicles, newest_s, added = self._novelty()
        goal = min(self._limit * (1.0 - EVICTION_FRACTION), self._limit - wanted)
        order = np.lexsort((newest_s, added))
        left = self.count - np.cumsum(np.bincount(vehicles)[order])
        going = order[: int(np.argmax(left <= goal)) + 1]
        return np.flatnonzero(~np.isin(vehicles, going))

    def rows_not_replaced(self, time_s: float) -> np.ndarray:
        """Return the rows of vehicles seen since `time_s`, and of older ones that too few newer ones replace."""
        if not self.count or self.oldest_s >= time_s:
            return np.arange(self.count)
        vehicles, newest_s, added = self._novelty()
        return np.flatnonzero(((newest_s >= time_s) | (added > 1.0 / (1.0 + REPLACING_VEHICLES)))[vehicles])

    def _novelty(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the vehicle index of each row (n,), and the last time and novelty of each vehicle."""
        held = slice(self.count)
        _, vehicles = np.unique(self._passage_ids[held], return_inverse=True)
        newest_s = np.full(vehicles.max() + 1, -np.inf)
        np.maximum.at(newest_s, vehicles, self._times_s[held])
        bins = cell_heading_bins(self._midpoints_px[held], self._headings[held])
        return vehicles, newest_s, novelty(vehicles, newest_s, bins)

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
        """Time of the oldest row; infinite if there is none."""
        return float(self.times_s.min(initial=np.inf))
