"""What the traffic has shown: a bounded buffer of what adds most, and the frozen values that estimators read."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path

import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.results.calibration import EvidenceSummary

FORMAT = 1
COVERAGE_CELLS = (16, 9)
"""Columns and rows of the grid in which coverage of the image is counted."""


class TrackKind(IntEnum):
    """What a track is of, by the class that a detector saw."""

    UNKNOWN = 0
    VEHICLE = 1
    PERSON = 2
    """On foot or on a bicycle."""


@dataclass(frozen=True)
class Track:
    """One point of one vehicle over time, in observed pixels of the full image."""

    vehicle: int
    times_s: np.ndarray
    """Seconds since the first image, shape (n,), increasing."""
    points_px: np.ndarray
    """Shape (n, 2)."""
    kind: TrackKind = TrackKind.UNKNOWN


@dataclass(frozen=True)
class Segments:
    """Matches between two masked frames: where keypoints of vehicles were and where they went."""

    time_s: float
    vehicles: np.ndarray
    """Vehicle of each segment, shape (n,)."""
    ends_px: np.ndarray
    """x0, y0, x1, y1 in observed pixels, shape (n, 4)."""


@dataclass(frozen=True)
class Edges:
    """Straight edges seen on vehicles in one image: bumpers, windscreens, pillars."""

    time_s: float
    vehicles: np.ndarray
    """Vehicle of each edge, shape (n,)."""
    ends_px: np.ndarray
    """x0, y0, x1, y1 in observed pixels, shape (n, 4)."""


OUTLINE_COLUMNS = 17


@dataclass(frozen=True)
class Outlines:
    """Outlines of what moves in one image, eight points of each, and how far it is from what may hide a part of it."""

    time_s: float
    vehicles: np.ndarray
    """Vehicle of each outline, shape (n,)."""
    ends_px: np.ndarray
    """Where each reaches farthest up left, down right, down left, up right, left, right, up and down, x and y of each,
    and its gap to the nearest other outline, ignored place or border, observed pixels, shape (n, OUTLINE_COLUMNS)."""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """A snapshot of the buffer: every estimator can be run on it again without images."""

    image_size: tuple[int, int]
    first_stamp_ns: int
    newest_stamp_ns: int
    frames: int
    track_starts: np.ndarray
    """Where each track begins in `points_px`, with the total at the end, shape (tracks + 1,)."""
    points_px: np.ndarray
    """Shape (points, 2)."""
    times_s: np.ndarray
    """Seconds since the first image, shape (points,)."""
    track_vehicles: np.ndarray
    """Vehicle of each track, shape (tracks,)."""
    segments_px: np.ndarray
    """x0, y0, x1, y1, shape (segments, 4)."""
    segment_vehicles: np.ndarray
    """Shape (segments,)."""
    segment_times_s: np.ndarray
    """Shape (segments,)."""
    drift_px: float
    """How far the still background has moved at most, pixels of the full image; 0 for a fixed camera."""
    edges_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    """Straight edges on vehicles, x0, y0, x1, y1, shape (edges, 4)."""
    edge_vehicles: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Shape (edges,)."""
    edge_times_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Shape (edges,)."""
    outlines_px: np.ndarray = field(default_factory=lambda: np.zeros((0, OUTLINE_COLUMNS), np.float32))
    """Outlines of what moves, as `Outlines.ends_px`, float32, shape (outlines, OUTLINE_COLUMNS)."""
    outline_vehicles: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Shape (outlines,)."""
    outline_times_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Shape (outlines,)."""
    still_lines_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    """Straight lines of the road and around it, without the traffic, x0, y0, x1, y1, shape (lines, 4)."""
    track_kinds: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint8))
    """`TrackKind` of each track, uint8, shape (tracks,); all unknown where it is not given."""

    def __post_init__(self) -> None:
        if not len(self.track_kinds):
            object.__setattr__(self, 'track_kinds', np.zeros(len(self.track_vehicles), np.uint8))

    @property
    def track_count(self) -> int:
        """Number of tracks."""
        return len(self.track_vehicles)

    @property
    def seconds(self) -> float:
        """Recording time covered."""
        return (self.newest_stamp_ns - self.first_stamp_ns) * 1e-9

    def track(self, index: int) -> Track:
        """Return one track."""
        part = slice(self.track_starts[index], self.track_starts[index + 1])
        return Track(
            int(self.track_vehicles[index]),
            self.times_s[part],
            self.points_px[part],
            TrackKind(self.track_kinds[index]),
        )

    def tracks(self) -> Iterator[Track]:
        """Iterate over all tracks."""
        return (self.track(index) for index in range(self.track_count))

    @property
    def coverage(self) -> float:
        """Share of the image's cells that tracks have crossed, 0 to 1."""
        if not len(self.points_px):
            return 0.0
        cells = np.floor(self.points_px / self.image_size * COVERAGE_CELLS).astype(int)
        cells = np.clip(cells, 0, np.array(COVERAGE_CELLS) - 1)
        return len(np.unique(cells @ [1, COVERAGE_CELLS[0]])) / (COVERAGE_CELLS[0] * COVERAGE_CELLS[1])

    def summary(self) -> EvidenceSummary:
        """Return the counts that a result carries."""
        people = self.track_kinds == TrackKind.PERSON
        return EvidenceSummary(
            image_size=self.image_size,
            seconds=self.seconds,
            frames=self.frames,
            tracks=self.track_count,
            segments=len(self.segments_px),
            coverage=self.coverage,
            vehicles=len(np.unique(self.track_vehicles[~people])),
            people=len(np.unique(self.track_vehicles[people])),
        )

    def select_tracks(self, keep: np.ndarray) -> Evidence:
        """Return the evidence with only the tracks whose indices are in `keep`; segments and edges unchanged."""
        return replace(self, **_track_arrays([self.track(index) for index in keep]))

    def without_vehicles(self, vehicles: np.ndarray) -> Evidence:
        """Return the evidence without all that is of these vehicles (n,)."""
        tracks, segments, edges, outlines = (
            ~np.isin(vehicle_ids, vehicles)
            for vehicle_ids in (self.track_vehicles, self.segment_vehicles, self.edge_vehicles, self.outline_vehicles)
        )
        return replace(
            self.select_tracks(np.flatnonzero(tracks)),
            segments_px=self.segments_px[segments],
            segment_vehicles=self.segment_vehicles[segments],
            segment_times_s=self.segment_times_s[segments],
            edges_px=self.edges_px[edges],
            edge_vehicles=self.edge_vehicles[edges],
            edge_times_s=self.edge_times_s[edges],
            outlines_px=self.outlines_px[outlines],
            outline_vehicles=self.outline_vehicles[outlines],
            outline_times_s=self.outline_times_s[outlines],
        )

    def save(self, path: Path) -> None:
        """Write the snapshot as .npz."""
        arrays = {name: getattr(self, name) for name in (*ARRAYS, *EDGE_ARRAYS)}
        if len(self.outlines_px):
            arrays |= {name: getattr(self, name) for name in OUTLINE_ARRAYS}
        if len(self.still_lines_px):
            arrays[STILL_LINES_PX] = self.still_lines_px
        if self.track_kinds.any():
            arrays[TRACK_KINDS] = self.track_kinds
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open('wb') as stream:
                np.savez_compressed(
                    stream,
                    format=FORMAT,
                    image_size=self.image_size,
                    drift_px=self.drift_px,
                    frames=self.frames,
                    stamps_ns=np.array([self.first_stamp_ns, self.newest_stamp_ns], np.int64),
                    **arrays,
                )
        except OSError as error:
            raise InputError(f'cannot write {path}: {error.strerror or error}') from error

    @classmethod
    def load(cls, path: Path) -> Evidence:
        """Read what `save` wrote, or raise InputError."""
        path = Path(path)
        try:
            with path.open('rb') as stream, np.load(stream, allow_pickle=False) as data:
                if int(data['format']) != FORMAT:
                    raise InputError(f'{path} holds evidence of format {int(data["format"])}, not {FORMAT}')
                first, newest = (int(stamp) for stamp in data['stamps_ns'])
                width, height = (int(value) for value in data['image_size'])
                evidence = cls(
                    image_size=(width, height),
                    first_stamp_ns=first,
                    newest_stamp_ns=newest,
                    frames=int(data['frames']),
                    drift_px=float(data['drift_px']),
                    **{name: data[name] for name in ARRAYS},
                    **{
                        name: data[name]
                        for name in (*EDGE_ARRAYS, *OUTLINE_ARRAYS, STILL_LINES_PX, TRACK_KINDS)
                        if name in data
                    },
                )
            _require_consistent(evidence)
        except LOAD_ERRORS as error:
            reason = ' '.join(str(error).split())
            raise InputError(f'{path} is not a file of saved evidence (.npz): {reason}') from error
        return evidence


ARRAYS = (
    'track_starts',
    'points_px',
    'times_s',
    'track_vehicles',
    'segments_px',
    'segment_vehicles',
    'segment_times_s',
)
EDGE_ARRAYS = ('edges_px', 'edge_vehicles', 'edge_times_s')
"""Files written before edges were gathered have none of them."""
OUTLINE_ARRAYS = ('outlines_px', 'outline_vehicles', 'outline_times_s')
"""Only in files of evidence that was gathered without a detector; older ones have none of them."""
STILL_LINES_PX = 'still_lines_px'
"""Files of little evidence, and those written before they were looked for, have none."""
TRACK_KINDS = 'track_kinds'
"""Only in files of evidence that was gathered with a detector."""


LOAD_ERRORS = (
    OSError,
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    EOFError,
    OverflowError,
    MemoryError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What NumPy and zipfile raise at files that are damaged, encrypted, or of another kind."""


def _require_consistent(evidence: Evidence) -> None:
    """Raise ValueError unless shapes, kinds and numbers are those that a snapshot has."""
    points, tracks = len(evidence.points_px), len(evidence.track_vehicles)
    shapes = {
        'track_starts': (tracks + 1,),
        'points_px': (points, 2),
        'times_s': (points,),
        'track_vehicles': (tracks,),
        'segments_px': (len(evidence.segments_px), 4),
        'segment_vehicles': (len(evidence.segments_px),),
        'segment_times_s': (len(evidence.segments_px),),
        'edges_px': (len(evidence.edges_px), 4),
        'edge_vehicles': (len(evidence.edges_px),),
        'edge_times_s': (len(evidence.edges_px),),
        STILL_LINES_PX: (len(evidence.still_lines_px), 4),
        'outlines_px': (len(evidence.outlines_px), OUTLINE_COLUMNS),
        TRACK_KINDS: (tracks,),
        'outline_vehicles': (len(evidence.outlines_px),),
        'outline_times_s': (len(evidence.outlines_px),),
    }
    for name, shape in shapes.items():
        array = getattr(evidence, name)
        kinds = 'iu' if name in ('track_starts', TRACK_KINDS) or name.endswith('vehicles') else 'f'
        if array.shape != shape or array.dtype.kind not in kinds or not np.isfinite(array).all():
            raise ValueError(f'{name} of {array.dtype} {array.shape} does not fit the rest')
    if not np.isin(evidence.track_kinds, list(TrackKind)).all():
        raise ValueError(
            f'{TRACK_KINDS} holds other kinds than {", ".join(f"{kind:d} ({kind.name})" for kind in TrackKind)}'
        )
    starts = evidence.track_starts
    if starts[0] != 0 or starts[-1] != points or (np.diff(starts) < 1).any():
        raise ValueError('track_starts does not divide points_px into tracks')
    if (np.delete(np.diff(evidence.times_s), starts[1:-1] - 1) <= 0).any():
        raise ValueError('times_s does not increase along each track')
    if min(evidence.image_size) < 1 or evidence.newest_stamp_ns < evidence.first_stamp_ns or evidence.frames < 0:
        raise ValueError(f'an image size of {evidence.image_size}, {evidence.frames} frames in {evidence.seconds} s')
    if not evidence.drift_px >= 0:
        raise ValueError(f'a drift of {evidence.drift_px} px')


def _track_arrays(tracks: list[Track]) -> dict[str, np.ndarray]:
    lengths = np.array([len(track.times_s) for track in tracks], int)
    return {
        'track_starts': np.concatenate([[0], np.cumsum(lengths)]).astype(int),
        'points_px': np.concatenate([t.points_px for t in tracks] or [np.zeros((0, 2))]).astype(float),
        'times_s': np.concatenate([t.times_s for t in tracks] or [np.zeros(0)]).astype(float),
        'track_vehicles': np.array([track.vehicle for track in tracks], int),
        'track_kinds': np.array([track.kind for track in tracks], np.uint8),
    }
