"""DOCSTRING."""

from __future__ import annotations

import numpy as np

from autocalib_ros.config import BufferOptions
from autocalib_ros.evidence.retention import RetentionIndex
from autocalib_ros.evidence.snapshot import OUTLINE_COLUMNS, Edges, Evidence, Outlines, Segments, Track, _track_arrays


class _LineTable:
    """Lines of vehicles, or outlines of them, in arrays: what adds least goes when there is no room."""

    def __init__(self, limit: int, columns: int = 4, dtype: type = float) -> None:
        self._ends_px = np.zeros((limit, columns), dtype)
        self._vehicles = np.zeros(limit, int)
        self.retention = RetentionIndex(limit)

    def add(self, lines: Segments | Edges | Outlines) -> None:
        """Take the lines of one time; where there is no room, vehicles that add least make some."""
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
        """Keep the lines of these rows."""
        if len(rows) < self.retention.count:
            self.retention.keep(rows)
            self._ends_px[: len(rows)], self._vehicles[: len(rows)] = self._ends_px[rows], self._vehicles[rows]

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ends (lines, columns), vehicles (lines,) and times (lines,) of all that is held."""
        count = self.retention.count
        return self._ends_px[:count].copy(), self._vehicles[:count].copy(), self.retention.times_s.copy()


class EvidenceBuffer:
    """Finished tracks, segments, edges and outlines, bounded in number: what adds least goes first, by whole vehicles.

    A track holds at most `tracking.max_samples` points of 24 bytes and 0.4 kB of its own, a segment or an
    edge 80 bytes, an outline 120: with the default options no more than 26 MB are held, however long it runs.
    """

    def __init__(self, options: BufferOptions) -> None:
        self._tracks: list[Track] = []
        self._track_retention = RetentionIndex(options.max_tracks)
        self._max_tracks = options.max_tracks
        self._segments = _LineTable(options.max_segments)
        self._edges = _LineTable(options.max_edges)
        self._outlines = _LineTable(options.max_outlines, OUTLINE_COLUMNS, np.float32)
        self._line_tables = (self._segments, self._edges, self._outlines)

    def add_track(self, track: Track) -> None:
        """Take a finished track; where there is no room, vehicles that add least make some."""
        if self._track_retention.count == self._max_tracks:
            self._keep_tracks(self._track_retention.rows_after_eviction(1))
        points = track.points_px
        self._track_retention.add(
            np.array([track.vehicle]), points[len(points) // 2], (points[-1] - points[0])[None], track.times_s[-1]
        )
        self._tracks.append(track)

    def add_segments(self, segments: Segments) -> None:
        """Take the segments of one pair of frames."""
        self._segments.add(segments)

    def add_edges(self, edges: Edges) -> None:
        """Take the edges of one image."""
        self._edges.add(edges)

    def add_outlines(self, outlines: Outlines) -> None:
        """Take the outlines of one image."""
        self._outlines.add(outlines)

    def forget_replaced(self, time_s: float) -> None:
        """Drop the vehicles last seen before `time_s` in whose place there are enough newer ones."""
        self._keep_tracks(self._track_retention.rows_not_replaced(time_s))
        for lines in self._line_tables:
            lines.keep(lines.retention.rows_not_replaced(time_s))

    def forget_before(self, time_s: float) -> None:
        """Drop all that ended before `time_s`: the camera may have stood otherwise then."""
        self._keep_tracks(self._track_retention.rows_since(time_s))
        for lines in self._line_tables:
            lines.keep(lines.retention.rows_since(time_s))

    def _keep_tracks(self, rows: np.ndarray) -> None:
        if len(rows) < len(self._tracks):
            self._track_retention.keep(rows)
            self._tracks = [self._tracks[row] for row in rows]

    @property
    def track_count(self) -> int:
        """Number of finished tracks held."""
        return len(self._tracks)

    @property
    def oldest_s(self) -> float:
        """When the oldest of what is held ended; infinite where there is nothing."""
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
    ) -> Evidence:
        """Freeze what is held, with the tracks that are still being followed."""
        segments_px, segment_vehicles, segment_times_s = self._segments.arrays()
        edges_px, edge_vehicles, edge_times_s = self._edges.arrays()
        outlines_px, outline_vehicles, outline_times_s = self._outlines.arrays()
        return Evidence(
            image_size=image_size,
            first_stamp_ns=first_stamp_ns,
            newest_stamp_ns=newest_stamp_ns,
            frames=frames,
            drift_px=drift_px,
            segments_px=segments_px,
            segment_vehicles=segment_vehicles,
            segment_times_s=segment_times_s,
            edges_px=edges_px,
            edge_vehicles=edge_vehicles,
            edge_times_s=edge_times_s,
            outlines_px=outlines_px,
            outline_vehicles=outline_vehicles,
            outline_times_s=outline_times_s,
            **_track_arrays([*self._tracks, *unfinished]),
        )
