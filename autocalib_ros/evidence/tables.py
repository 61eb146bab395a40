"""The kinds of observation in `Evidence` besides tracks: which arrays each has, and how they are cut and checked.

Each kind is a group of arrays with one row per observation. A new kind takes its fields in `Evidence` and one
`ObservationTable` in `TABLES`; subsets, files and checks follow from that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

OUTLINE_COLUMNS = 17
"""Coordinates of eight extreme points, and the gap."""
STRIPE_COLUMNS = 5
"""Coordinates of both ends, and the contrast."""


@dataclass(frozen=True)
class ObservationTable:
    """Names and layout of the arrays of one kind of observation; `source` is any object with these attributes."""

    values: str
    """Array of shape (n, columns), floating point."""
    columns: int = 4
    vehicles: str = ''
    """Array of vehicle ids, shape (n,), integer; '' if observations belong to no vehicle."""
    times: str = ''
    """Array of times in seconds since the first image, shape (n,), floating point; '' if they have no time."""
    required: bool = False
    """Every evidence file has these arrays; files written before a kind was introduced lack the others."""
    saved_if_empty: bool = True
    ends_with_length: bool = False
    """Whether the last column is a length in pixels."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays, in the order in which files hold them."""
        return tuple(name for name in (self.values, self.vehicles, self.times) if name)

    def rows(self, source: object) -> int:
        """Return the number of observations."""
        return len(getattr(source, self.values))

    def arrays(self, source: object) -> dict[str, np.ndarray]:
        """Return the arrays by name."""
        return {name: getattr(source, name) for name in self.names}

    def subset(self, source: object, keep: np.ndarray) -> dict[str, np.ndarray]:
        """Return the arrays by name, restricted to the rows that `keep`, a mask or indices (n,), selects."""
        return {name: array[keep] for name, array in self.arrays(source).items()}

    def without_vehicles(self, source: object, vehicles: np.ndarray) -> dict[str, np.ndarray]:
        """Return the arrays by name without the rows of vehicles (m,); all rows if the kind has no vehicles."""
        if not self.vehicles:
            return self.arrays(source)
        return self.subset(source, ~np.isin(getattr(source, self.vehicles), vehicles))

    def is_saved(self, source: object) -> bool:
        """Whether a file of `source` holds this kind."""
        return self.saved_if_empty or self.rows(source) > 0

    def require_consistent(self, source: object) -> None:
        """Raise ValueError unless all arrays have one length, finite values and the expected type."""
        rows = self.rows(source)
        for name, array in self.arrays(source).items():
            shape = (rows, self.columns) if name == self.values else (rows,)
            require_array(name, array, shape, integer=name == self.vehicles)


SEGMENTS = ObservationTable('segments_px', vehicles='segment_vehicles', times='segment_times_s', required=True)
EDGES = ObservationTable('edges_px', vehicles='edge_vehicles', times='edge_times_s')
OUTLINES = ObservationTable(
    'outlines_px',
    OUTLINE_COLUMNS,
    vehicles='outline_vehicles',
    times='outline_times_s',
    saved_if_empty=False,
    ends_with_length=True,
)
"""Collected only without a detector, which recognises cyclists by itself."""
STILL_LINES = ObservationTable('still_lines_px', saved_if_empty=False)
STRIPES = ObservationTable('stripes_px', STRIPE_COLUMNS, saved_if_empty=False)
TABLES = (SEGMENTS, EDGES, OUTLINES, STILL_LINES, STRIPES)


def require_array(name: str, array: np.ndarray, shape: tuple[int, ...], *, integer: bool) -> None:
    """Raise ValueError unless an array has this shape, finite values and an integer or floating-point type."""
    if array.shape != shape or array.dtype.kind not in ('iu' if integer else 'f') or not np.isfinite(array).all():
        raise ValueError(f'{name} of {array.dtype} {array.shape} does not fit the other arrays')


def merged(parts: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the union of mappings of arrays."""
    return {name: array for part in parts for name, array in part.items()}
