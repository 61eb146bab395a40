"""What evidence adds to what is newer, and so what may go when memory is full.

Evidence is about as good as the next of its kind: another vehicle that went the same way through the same part of the
image. Its kind is an image cell with a heading, and what counts is how many newer vehicles there are of that kind.
"""

from __future__ import annotations

import numpy as np

CELLS = 8
"""Cells along the longer side of the box that holds the traffic; they are square. A road far away fills few pixels."""
HEADINGS = 8
WITNESSES = 3
"""So many tracks of a vehicle corroborate each other; a lone one may be a shadow or a leaf, and is worth its share."""
ENOUGH_NEWER = 25
"""So many newer vehicles of its kind replace one: random errors are then down to a fifth of one vehicle's."""
BATCH_SHARE = 0.1
"""Share of the buffer that is emptied at once when it is full: choosing costs milliseconds, adding microseconds."""
MAX_VEHICLE_SHARE = 0.125
"""A label that more of the buffer comes from goes on as another vehicle, so that one alone cannot fill it."""


def headings(ways_px: np.ndarray) -> np.ndarray:
    """Number the heading (n,) of displacements (n, 2); a road along an axis of the image is not split by noise."""
    turns = np.arctan2(ways_px[:, 1], ways_px[:, 0]) * (HEADINGS / (2 * np.pi))
    return np.floor(turns + 0.5) % HEADINGS


def kinds(middles_px: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Number the kind (n,) of what passed `middles_px` (n, 2) under a heading (n,)."""
    corner = middles_px.min(axis=0)
    side = max(float((middles_px.max(axis=0) - corner).max()), 1e-9) / CELLS
    column, row = np.minimum((middles_px - corner) / side, CELLS - 1).astype(int).T
    return (row * CELLS + column) * HEADINGS + heading.astype(int)


def worth(vehicles: np.ndarray, newest_s: np.ndarray, of_kind: np.ndarray) -> np.ndarray:
    """Return what each vehicle adds per row, 0 to 1, shape (max(vehicles) + 1,).

    `vehicles` (n,) are the rows' owners, numbered from 0, `newest_s` (vehicles,) their last times and `of_kind` (n,)
    the rows' kinds. A row is worth one over one more than the newer vehicles of its kind.
    """
    count = len(newest_s)
    age = np.empty(count, int)
    age[np.lexsort((-np.arange(count), -newest_s))] = np.arange(count)
    pairs, of_row = np.unique(of_kind * count + age[vehicles], return_inverse=True)
    kind = pairs // count
    newer = np.arange(len(pairs)) - np.searchsorted(kind, kind)
    rows = np.bincount(vehicles, minlength=count)
    total = np.bincount(vehicles, 1.0 / (1.0 + newer[of_row.ravel()]), minlength=count)
    return total / np.maximum(rows, 1) * np.minimum(rows / WITNESSES, 1.0)


class Holdings:
    """Who left each row that is held, where and when: at most `limit` rows, in the order in which they came."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._middles_px = np.zeros((limit, 2))
        self._headings = np.zeros(limit)
        self._times_s = np.zeros(limit)
        self._owners = np.zeros(limit, int)
        self._passages: dict[int, tuple[int, int]] = {}
        self._next_owner = 0
        self.count = 0

    def add(self, vehicles: np.ndarray, middles_px: np.ndarray, ways_px: np.ndarray, time_s: float) -> None:
        """Enter rows of vehicles (n,) that passed `middles_px` (n, 2), went `ways_px` (n, 2) and ended at `time_s`.

        There has to be room for them.
        """
        part = slice(self.count, self.count + len(vehicles))
        self._middles_px[part], self._headings[part], self._times_s[part] = middles_px, headings(ways_px), time_s
        self._owners[part] = [self._owner(vehicle) for vehicle in vehicles.tolist()]
        self.count += len(vehicles)

    def _owner(self, vehicle: int) -> int:
        """Number the passage of a vehicle: a label that a queue hands on for ever is not one vehicle."""
        owner, rows = self._passages.get(vehicle, (-1, 0))
        if owner < 0 or rows >= self._limit * MAX_VEHICLE_SHARE:
            owner, rows, self._next_owner = self._next_owner, 0, self._next_owner + 1
        self._passages[vehicle] = owner, rows + 1
        return owner

    def with_room(self, wanted: int) -> np.ndarray:
        """Return the rows to keep so that `wanted` more fit: a batch of vehicles that add least goes, whole."""
        vehicles, newest_s, added = self._worth()
        goal = min(self._limit * (1.0 - BATCH_SHARE), self._limit - wanted)
        order = np.lexsort((newest_s, added))
        left = self.count - np.cumsum(np.bincount(vehicles)[order])
        going = order[:int(np.argmax(left <= goal)) + 1]
        return np.flatnonzero(~np.isin(vehicles, going))

    def not_replaced(self, time_s: float) -> np.ndarray:
        """Return the rows of vehicles seen since `time_s`, and of older ones that newer ones do not yet replace."""
        if not self.count or self.oldest_s >= time_s:
            return np.arange(self.count)
        vehicles, newest_s, added = self._worth()
        return np.flatnonzero(((newest_s >= time_s) | (added > 1.0 / (1.0 + ENOUGH_NEWER)))[vehicles])

    def since(self, time_s: float) -> np.ndarray:
        """Return the rows not older than `time_s`."""
        return np.flatnonzero(self._times_s[:self.count] >= time_s)

    def _worth(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vehicle of each row (n,), numbered in the order they came; last time and worth of each vehicle."""
        held = slice(self.count)
        _, vehicles = np.unique(self._owners[held], return_inverse=True)
        newest_s = np.full(vehicles.max() + 1, -np.inf)
        np.maximum.at(newest_s, vehicles, self._times_s[held])
        return vehicles, newest_s, worth(vehicles, newest_s, kinds(self._middles_px[held], self._headings[held]))

    def keep(self, rows: np.ndarray) -> None:
        """Keep only these rows (n,), by rising index."""
        self.count = len(rows)
        for column in (self._middles_px, self._headings, self._times_s, self._owners):
            column[:self.count] = column[rows]
        held = set(self._owners[:self.count].tolist())
        self._passages = {vehicle: passage for vehicle, passage in self._passages.items() if passage[0] in held}

    @property
    def times_s(self) -> np.ndarray:
        """Time of each row, shape (count,)."""
        return self._times_s[:self.count]

    @property
    def oldest_s(self) -> float:
        """Time of the oldest row; infinite where there is none."""
        return float(self.times_s.min(initial=np.inf))
