"""Bounded buffer of observations; when it is full, the least novel vehicles are evicted."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from autocalib_ros.config import BufferOptions
from autocalib_ros.evidence.picture import Picture
from autocalib_ros.evidence.retention import RetentionIndex
from autocalib_ros.evidence.snapshot import Edges, Evidence, Outlines, Segments, Track, track_arrays
from autocalib_ros.evidence.stillness import Stillness
from autocalib_ros.evidence.tables import EDGES, OUTLINES, SEGMENTS, ObservationTable, merged


class _LineTable:
    """Preallocated arrays of one kind of observation; the least novel vehicles are evicted when they are full."""

    def __init__(self, table: ObservationTable, limit: int, dtype: type = float) -> None:
        self._table = table
        self._ends_px: np.ndarray = np.zeros((limit, table.columns), dtype)
        self._vehicles = np.zeros(limit, int)
        self.retention = RetentionIndex(limit)

    def add(self, lines: Segments | Edges | Outlines) -> None:
        """Add the observations of one image; evict the least novel vehicles if there is no room."""
        limit = len(self._ends_px)
        ends, vehicles = lines.ends_px[:limit], lines.vehicles[:limit]
        if not len(ends):
            return
        if self.retention.count + len(ends) > limit:
            self.keep(self.retention.rows_after_eviction(len(ends)))
        part = slice(self.retention.count, self.retention.count + len(ends))
        self._ends_px[part], self._vehicles[part] = ends, vehicles
        first, last = ends[:, :2], ends[:, 2:4]
        self.retention.add(vehicles, 0.5 * (first + last), last - first, lines.time_s)

    def keep(self, rows: np.ndarray) -> None:
        """Keep only these rows, by rising index."""
        if len(rows) < self.retention.count:
            self.retention.keep(rows)
            self._ends_px[: len(rows)], self._vehicles[: len(rows)] = self._ends_px[rows], self._vehicles[rows]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays by their names in `Evidence`."""
        count, table = self.retention.count, self._table
        columns = (self._ends_px[:count].copy(), self._vehicles[:count].copy(), self.retention.times_s.copy())
        return dict(zip((table.values, table.vehicles, table.times), columns, strict=True))


class EvidenceBuffer:
    """Finished tracks, segments, edges and outlines, bounded in number; eviction removes whole vehicles.

    Memory: a track takes up to `tracking.max_samples` points of 24 bytes plus 0.4 kB, a segment or an edge 80 bytes,
    an outline 120 bytes; at most 26 MB with the default options, independent of the running time.
    """

    def __init__(self, options: BufferOptions) -> None:
        self._tracks: list[Track] = []
        self._track_retention = RetentionIndex(options.max_tracks)
        self._max_tracks = options.max_tracks
        self._segments = _LineTable(SEGMENTS, options.max_segments)
        self._edges = _LineTable(EDGES, options.max_edges)
        self._outlines = _LineTable(OUTLINES, options.max_outlines, np.float32)
        self._line_tables = (self._segments, self._edges, self._outlines)

    def add(
        self, tracks: Iterable[Track], segments: Segments | None, edges: Edges | None, outlines: Outlines | None
    ) -> None:
        """Add the observations of one image: the tracks that ended with it, and lines of each kind that it has."""
        for track in tracks:
            self.add_track(track)
        for table, lines in zip(self._line_tables, (segments, edges, outlines), strict=True):
            if lines is not None:
                table.add(lines)

    def add_track(self, track: Track) -> None:
        """Add a finished track; evict the least novel vehicles if there is no room."""
        if self._track_retention.count == self._max_tracks:
            self._keep_tracks(self._track_retention.rows_after_eviction(1))
        points = track.points_px
        self._track_retention.add(
            np.array([track.vehicle]), points[len(points) // 2], (points[-1] - points[0])[None], track.times_s[-1]
        )
        self._tracks.append(track)

    def add_segments(self, segments: Segments) -> None:
        """Add the segments of one pair of frames."""
        self._segments.add(segments)

    def add_edges(self, edges: Edges) -> None:
        """Add the edges of one image."""
        self._edges.add(edges)

    def add_outlines(self, outlines: Outlines) -> None:
        """Add the outlines of one image."""
        self._outlines.add(outlines)

    def forget_replaced(self, time_s: float) -> None:
        """Drop vehicles last seen before `time_s` that enough newer ones replace."""
        self._keep_tracks(self._track_retention.rows_not_replaced(time_s))
        for lines in self._line_tables:
            lines.keep(lines.retention.rows_not_replaced(time_s))

    def _keep_tracks(self, rows: np.ndarray) -> None:
        if len(rows) < len(self._tracks):
            self._track_retention.keep(rows)
            self._tracks = [self._tracks[row] for row in rows]

    @property
    def track_count(self) -> int:
        """Number of finished tracks in the buffer."""
        return len(self._tracks)

    @property
    def oldest_s(self) -> float:
        """End time of the oldest observation; infinite if there is none."""
        return min(
            retention.oldest_s
            for retention in (self._track_retention, *(lines.retention for lines in self._line_tables))
        )

    def snapshot(
        self,
        *,
        image_size: tuple[int, int],
        first_stamp_ns: int,
        newest_stamp_ns: int,
        frames: int,
        drift_px: float,
        unfinished: list[Track],
        picture: Picture | None = None,
        stillness: Stillness | None = None,
    ) -> Evidence:
        """Return the observations so far, with the tracks that are still being followed."""
        return Evidence(
            image_size=image_size,
            first_stamp_ns=first_stamp_ns,
            newest_stamp_ns=newest_stamp_ns,
            frames=frames,
            drift_px=drift_px,
            picture=picture or Picture.whole(image_size),
            stillness=stillness or Stillness(),
            **merged([lines.arrays() for lines in self._line_tables]),
            **track_arrays([*self._tracks, *unfinished]),
        )
