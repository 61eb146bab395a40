"""The traffic of a recording again and again, as observations of vehicles that are new each time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from autocalib_ros.evidence.snapshot import Edges, Evidence, Outlines, Segments, Track
from autocalib_ros.perception.observer import FrameObservations

JITTER_PX = 0.2
"""Standard deviation by which the paths of a vehicle differ from those of the recorded one, pixels: no two are the
same, and the traffic of hours would otherwise count as one hour of it."""
FIRST_VEHICLE = 1_000_000
"""Vehicle ids from here on; the perception counts from 1."""


class RepeatedTraffic:
    """Observations of stored evidence, repeated without end; times are seconds since the first image."""

    def __init__(self, evidence: Evidence, seed: int = 0) -> None:
        self._evidence, self._generator = evidence, np.random.default_rng(seed)
        self.period_s = max(evidence.seconds, 1.0)
        self._tracks = sorted(evidence.tracks(), key=lambda track: float(track.times_s[-1]))
        self._ends_s = np.array([track.times_s[-1] for track in self._tracks])
        vehicles = [evidence.track_vehicles, evidence.segment_vehicles, evidence.edge_vehicles]
        self._ids = 1 + max((int(ids.max()) for ids in (*vehicles, evidence.outline_vehicles) if len(ids)), default=0)

    def between(self, start_s: float, end_s: float) -> FrameObservations:
        """Return what is observed from a time until before another: tracks by their end, and lines by their time.

        Lines of several images come as those of one, at `start_s`.
        """
        tracks: list[Track] = []
        lines: dict[str, list[np.ndarray]] = {}
        for period, begin_s, until_s in self._parts(start_s, end_s):
            first = FIRST_VEHICLE + period * self._ids
            chosen = slice(*np.searchsorted(self._ends_s, (begin_s, until_s)))
            tracks += [self._again(track, first, period * self.period_s) for track in self._tracks[chosen]]
            for kind in ('segment', 'edge', 'outline'):
                times_s = getattr(self._evidence, f'{kind}_times_s')
                rows = (times_s >= begin_s) & (times_s < until_s)
                lines.setdefault(f'{kind}s', []).append(getattr(self._evidence, f'{kind}s_px')[rows])
                lines.setdefault(kind, []).append(first + getattr(self._evidence, f'{kind}_vehicles')[rows])
        joined = {name: np.concatenate(parts) for name, parts in lines.items()}
        return FrameObservations(
            tracks,
            Segments(start_s, joined['segment'], joined['segments']),
            Edges(start_s, joined['edge'], joined['edges']),
            Outlines(start_s, joined['outline'], joined['outlines']),
        )

    def _parts(self, start_s: float, end_s: float) -> Iterator[tuple[int, float, float]]:
        """Yield number of the period, begin and end within it, of each period that an interval touches."""
        period = int(start_s // self.period_s)
        while period * self.period_s < end_s:
            begin_s = max(0.0, start_s - period * self.period_s)
            yield period, begin_s, min(self.period_s, end_s - period * self.period_s)
            period += 1

    def _again(self, track: Track, first: int, later_s: float) -> Track:
        """Return a track as that of another vehicle, later."""
        shift = self._generator.normal(scale=JITTER_PX, size=2)
        return Track(first + track.vehicle, track.times_s + later_s, track.points_px + shift, track.kind)
