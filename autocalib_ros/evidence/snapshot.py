"""Observed traffic as a value: `Evidence`, the snapshot that estimators read, and the observations it is made of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.evidence.landmarks import DESCRIPTOR_BYTES, Landmarks
from autocalib_ros.evidence.npz import evidence_file, write_evidence_file
from autocalib_ros.evidence.picture import Picture
from autocalib_ros.evidence.read_recording import ReadRecording, recording_arrays, recordings_of_arrays
from autocalib_ros.evidence.stillness import Stillness
from autocalib_ros.evidence.tables import OUTLINE_COLUMNS, STRIPE_COLUMNS, TABLES, merged, require_array
from autocalib_ros.results.calibration import EvidenceSummary

COVERAGE_CELLS = (16, 9)
"""Columns and rows of the grid of image cells over which coverage is counted."""
TRACK_ARRAYS = ('track_starts', 'points_px', 'times_s', 'track_vehicles')
STILLNESS = 'stillness'
"""Saved only if there was sway, or another view."""
TRACK_KINDS = 'track_kinds'
"""Saved only if a detector classified the tracks."""
PICTURE = 'picture'
"""Saved only if the picture does not fill the images."""
PIXEL_ASPECT = 'pixel_aspect'
"""Saved only if the recording says it."""
LANDMARK_ARRAYS = ('landmarks_px', 'landmark_descriptors')
RECORDING_ARRAYS = ('recording_names', 'recording_read_s')
"""Saved only by a replay, as the landmarks."""


class TrackKind(IntEnum):
    """Class of the tracked object, if a detector recognised it."""

    UNKNOWN = 0
    VEHICLE = 1
    PERSON = 2
    """Pedestrian or cyclist."""


@dataclass(frozen=True)
class Track:
    """Trajectory of one image point of one vehicle, in observed pixels of the full image."""

    vehicle: int
    times_s: np.ndarray
    """Seconds since the first image, shape (n,), increasing."""
    points_px: np.ndarray
    """Shape (n, 2)."""
    kind: TrackKind = TrackKind.UNKNOWN


@dataclass(frozen=True)
class Segments:
    """Keypoint matches on vehicles between two masked frames: start and end points."""

    time_s: float
    vehicles: np.ndarray
    """Vehicle id of each segment, shape (n,)."""
    ends_px: np.ndarray
    """x0, y0, x1, y1 in observed pixels, shape (n, 4)."""


@dataclass(frozen=True)
class Edges:
    """Straight edges on vehicles in one image: bumpers, windscreens, pillars."""

    time_s: float
    vehicles: np.ndarray
    """Vehicle id of each edge, shape (n,)."""
    ends_px: np.ndarray
    """x0, y0, x1, y1 in observed pixels, shape (n, 4)."""


@dataclass(frozen=True)
class Outlines:
    """Silhouettes of moving objects in one image: eight extreme points each, and the gap to possible occluders."""

    time_s: float
    vehicles: np.ndarray
    """Vehicle id of each outline, shape (n,)."""
    ends_px: np.ndarray
    """Observed pixels, shape (n, OUTLINE_COLUMNS): x and y of the extreme points up left, down right, down left,
    up right, left, right, up and down, then the gap to the nearest other outline, ignored region or image border."""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Immutable snapshot of all observations; every estimator can be rerun on it without images."""

    image_size: tuple[int, int]
    first_stamp_ns: int
    newest_stamp_ns: int
    frames: int
    track_starts: np.ndarray
    """Index in `points_px` at which each track starts, then the number of points, shape (tracks + 1,)."""
    points_px: np.ndarray
    """Observed pixels of the full image, shape (points, 2)."""
    times_s: np.ndarray
    """Seconds since the first image, shape (points,)."""
    track_vehicles: np.ndarray
    """Vehicle id of each track, shape (tracks,)."""
    segments_px: np.ndarray
    """As `Segments.ends_px`, shape (segments, 4)."""
    segment_vehicles: np.ndarray
    """Shape (segments,)."""
    segment_times_s: np.ndarray
    """Shape (segments,)."""
    drift_px: float
    """Largest lasting displacement of the background, pixels of the full image; 0 for a fixed camera."""
    edges_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    """As `Edges.ends_px`, shape (edges, 4)."""
    edge_vehicles: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Shape (edges,)."""
    edge_times_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Shape (edges,)."""
    outlines_px: np.ndarray = field(default_factory=lambda: np.zeros((0, OUTLINE_COLUMNS), np.float32))
    """As `Outlines.ends_px`, float32, shape (outlines, OUTLINE_COLUMNS)."""
    outline_vehicles: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Shape (outlines,)."""
    outline_times_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Shape (outlines,)."""
    still_lines_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    """Line segments of the static scene, x0, y0, x1, y1, shape (lines, 4)."""
    stripes_px: np.ndarray = field(default_factory=lambda: np.zeros((0, STRIPE_COLUMNS)))
    """Bright bars of the static scene, such as dashes of lane lines: x0, y0, x1, y1 of the centre line, and the
    contrast in grey levels, shape (stripes, STRIPE_COLUMNS)."""
    track_kinds: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint8))
    """`TrackKind` of each track, uint8, shape (tracks,); all unknown by default."""
    picture: Picture = None  # type: ignore[assignment]  # never None after construction
    """The picture inside the images; by default it fills them. It is scaled with `image_size`."""

    stillness: Stillness = field(default_factory=Stillness)
    """Sway, which is compensated, and the still part of the recording that the evidence is from."""
    pixel_aspect: float = 0.0
    """Width of a pixel over its height as the recording says; 0 if it says nothing."""
    landmarks_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """As `Landmarks.points_px`, by which other recordings of the view are recognised; only a replay looks for them."""
    landmark_descriptors: np.ndarray = field(default_factory=lambda: np.zeros((0, DESCRIPTOR_BYTES), np.uint8))
    """As `Landmarks.descriptors`."""
    recordings: tuple[ReadRecording, ...] = ()
    """The recordings of a replay, and how far they were read."""

    def __post_init__(self) -> None:
        if not len(self.track_kinds):
            object.__setattr__(self, 'track_kinds', np.zeros(len(self.track_vehicles), np.uint8))
        if min(self.image_size) < 1:
            return  # `require_consistent` says so
        if self.picture is None:
            object.__setattr__(self, 'picture', Picture.whole(self.image_size))
        elif self.picture.image_size != self.image_size:
            object.__setattr__(self, 'picture', self.picture.in_images_of(self.image_size))

    @property
    def landmarks(self) -> Landmarks:
        """Landmarks of the still scene."""
        return Landmarks(self.landmarks_px, self.landmark_descriptors)

    def with_landmarks(self, landmarks: Landmarks) -> Evidence:
        """Return the evidence with these landmarks."""
        return replace(self, landmarks_px=landmarks.points_px, landmark_descriptors=landmarks.descriptors)

    @property
    def track_count(self) -> int:
        """Number of tracks."""
        return len(self.track_vehicles)

    @property
    def seconds(self) -> float:
        """Time between the first and the newest image."""
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
        """Fraction of the cells of the picture that tracks cross, 0 to 1."""
        if not len(self.points_px):
            return 0.0
        from_corner = self.points_px - self.picture.rectangle[:2]
        cells = np.floor(from_corner / self.picture.size * COVERAGE_CELLS).astype(int)
        cells = np.clip(cells, 0, np.array(COVERAGE_CELLS) - 1)
        return len(np.unique(cells @ [1, COVERAGE_CELLS[0]])) / (COVERAGE_CELLS[0] * COVERAGE_CELLS[1])

    def summary(self) -> EvidenceSummary:
        """Return the counts that a result reports."""
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

    def since(self, start_s: float) -> Evidence:
        """Return the evidence with times that count from `start_s`, before which there is none."""
        if start_s <= 0.0:
            return self
        names = ('times_s', *(table.times for table in TABLES if table.times))
        times = {name: getattr(self, name) - start_s for name in names}
        return replace(self, first_stamp_ns=self.first_stamp_ns + round(start_s * 1e9), **times)

    def select_tracks(self, keep: np.ndarray) -> Evidence:
        """Return the evidence with only the tracks of indices `keep` (n,); the other observations are unchanged."""
        return replace(self, **track_arrays([self.track(index) for index in keep]))

    def without_vehicles(self, vehicles: np.ndarray) -> Evidence:
        """Return the evidence without all observations of vehicles with these ids (n,)."""
        tracks = np.flatnonzero(~np.isin(self.track_vehicles, vehicles))
        others = merged([table.without_vehicles(self, vehicles) for table in TABLES])
        return replace(self.select_tracks(tracks), **others)

    def save(self, path: Path) -> None:
        """Write the snapshot as .npz; InputError if that fails."""
        arrays = {name: getattr(self, name) for name in TRACK_ARRAYS}
        arrays |= merged([table.arrays(self) for table in TABLES if table.is_saved(self)])
        if self.track_kinds.any():
            arrays[TRACK_KINDS] = self.track_kinds
        if not self.picture.fills_image:
            arrays[PICTURE] = self.picture.numbers
        if self.stillness.is_notable:
            arrays[STILLNESS] = self.stillness.as_array()
        if self.pixel_aspect:
            arrays[PIXEL_ASPECT] = np.array(self.pixel_aspect)
        if len(self.landmarks):
            arrays |= {name: getattr(self, name) for name in LANDMARK_ARRAYS}
        if self.recordings:
            arrays |= recording_arrays(self.recordings)
        write_evidence_file(
            path,
            arrays,
            image_size=self.image_size,
            stamps_ns=(self.first_stamp_ns, self.newest_stamp_ns),
            frames=self.frames,
            drift_px=self.drift_px,
        )

    @classmethod
    def load(cls, path: Path) -> Evidence:
        """Read a file that `save` wrote, also with an earlier version; InputError if it is unreadable."""
        required = (*TRACK_ARRAYS, *(name for table in TABLES if table.required for name in table.names))
        optional = (
            *(name for table in TABLES if not table.required for name in table.names),
            TRACK_KINDS,
            PICTURE,
            STILLNESS,
            PIXEL_ASPECT,
            *LANDMARK_ARRAYS,
            *RECORDING_ARRAYS,
        )
        with evidence_file(path, required, optional) as fields:
            if PICTURE in fields:
                fields[PICTURE] = Picture.of_numbers(fields['image_size'], fields[PICTURE])
            if STILLNESS in fields:
                fields[STILLNESS] = Stillness.from_array(fields[STILLNESS])
            recordings = [fields.pop(name) for name in RECORDING_ARRAYS if name in fields]
            evidence = cls(
                **{**fields, PIXEL_ASPECT: float(fields.get(PIXEL_ASPECT, 0.0))},
                recordings=recordings_of_arrays(*recordings) if recordings else (),
            )
            evidence.require_consistent()
        return evidence

    def require_consistent(self) -> None:
        """Raise ValueError unless shapes, types and values are those of a snapshot."""
        points, tracks, starts = len(self.points_px), self.track_count, self.track_starts
        require_array('track_starts', starts, (tracks + 1,), integer=True)
        require_array('points_px', self.points_px, (points, 2), integer=False)
        require_array('times_s', self.times_s, (points,), integer=False)
        require_array('track_vehicles', self.track_vehicles, (tracks,), integer=True)
        require_array(TRACK_KINDS, self.track_kinds, (tracks,), integer=True)
        for table in TABLES:
            table.require_consistent(self)
        self.landmarks.require_consistent()
        if not np.isin(self.track_kinds, list(TrackKind)).all():
            known = ', '.join(f'{kind:d} ({kind.name})' for kind in TrackKind)
            raise ValueError(f'{TRACK_KINDS} holds other values than {known}')
        if starts[0] != 0 or starts[-1] != points or (np.diff(starts) < 1).any():
            raise ValueError('track_starts does not divide points_px into tracks')
        if (np.delete(np.diff(self.times_s), starts[1:-1] - 1) <= 0).any():
            raise ValueError('times_s does not increase along each track')
        if min(self.image_size) < 1 or self.newest_stamp_ns < self.first_stamp_ns or self.frames < 0:
            raise ValueError(f'an image size of {self.image_size}, {self.frames} frames in {self.seconds} s')
        if not self.drift_px >= 0:
            raise ValueError(f'a drift of {self.drift_px} px')
        if not 0.0 <= self.pixel_aspect < np.inf:
            raise ValueError(f'a pixel aspect of {self.pixel_aspect}')


def track_arrays(tracks: list[Track]) -> dict[str, Any]:
    """Return tracks as the arrays of `Evidence`, by name."""
    lengths = np.array([len(track.times_s) for track in tracks], int)
    return {
        'track_starts': np.concatenate([[0], np.cumsum(lengths)]).astype(int),
        'points_px': np.concatenate([t.points_px for t in tracks] or [np.zeros((0, 2))]).astype(float),
        'times_s': np.concatenate([t.times_s for t in tracks] or [np.zeros(0)]).astype(float),
        'track_vehicles': np.array([track.vehicle for track in tracks], int),
        'track_kinds': np.array([track.kind for track in tracks], np.uint8),
    }
