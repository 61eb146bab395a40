"""Two-frame windows: several points of one vehicle, observed at the same two instants.

In between the vehicle has moved as a rigid body on the road. Points that are near each other and move alike are
grouped as one body. Grouping errors occur; consumers must be robust to outlier points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_matrix

from autocalib_ros.estimation.observations.grouping import component_labels, farthest_points, group_indices, round_robin
from autocalib_ros.estimation.observations.track_set import SAMPLES_PER_TRACK, kish_weight
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.cubic_curves import cubic_through

RESAMPLING_INTERVAL_S = 0.4
"""Tracks are resampled at whole multiples of this; windows begin, end and have their middle there."""
WINDOW_LENGTHS = (2, 4)
"""Even numbers of intervals: long enough to turn by several degrees, short enough to keep the same points in view."""
MIN_POINTS = 5
"""The motion of a window has two unknowns; with fewer points little information is left."""
MAX_NEIGHBOUR_DISTANCE = 0.06
"""Largest distance of a point of a body from its nearest neighbour, as a fraction of the image width. Judgement."""
MIN_WINDOW_DISPLACEMENT = 0.01
"""Smallest displacement within a window, as a fraction of the image width; below, noise dominates. Judgement."""
MAX_MOTION_DIFFERENCE, MAX_MOTION_DIFFERENCE_PX = 0.25, 2.0
"""Displacements of neighbours on one body differ by less than this fraction plus this many pixels: the body turns, and
points that are nearer or higher move farther in the image. Judgement."""
MIN_SHARED_TRACKS = 3
"""Windows with this many tracks in common belong to the same body. Judgement."""
MAX_TIME_DIFFERENCE_S = 0.6
"""Segments belong to a body of tracks that is seen at the same place within this time."""


@dataclass(frozen=True)
class TwoFrameWindows:
    """Windows as padded arrays; a window has a point where `mask` is true."""

    first_px: np.ndarray
    """Observed pixels at the first instant, shape (windows, SAMPLES_PER_TRACK, 2)."""
    second_px: np.ndarray
    """The same points at the second instant, shape (windows, SAMPLES_PER_TRACK, 2)."""
    middle_px: np.ndarray
    """The same points halfway in time, nan for segments, shape (windows, SAMPLES_PER_TRACK, 2)."""
    mask: np.ndarray
    """Shape (windows, SAMPLES_PER_TRACK)."""
    bodies: np.ndarray
    """Number of the body of each window, shape (windows,)."""
    times_s: np.ndarray
    """Time of the middle of each window, shape (windows,)."""
    duration_s: np.ndarray
    """Duration of each window, nan for segments, shape (windows,)."""
    tracks: np.ndarray
    """Index in the evidence of each point's track, -1 for segments, shape (windows, SAMPLES_PER_TRACK)."""

    def __len__(self) -> int:
        return len(self.bodies)

    def subset(self, keep: np.ndarray) -> TwoFrameWindows:
        """Return the windows that `keep`, a mask or indices, selects."""
        return TwoFrameWindows(
            self.first_px[keep],
            self.second_px[keep],
            self.middle_px[keep],
            self.mask[keep],
            self.bodies[keep],
            self.times_s[keep],
            self.duration_s[keep],
            self.tracks[keep],
        )

    @cached_property
    def ends_px(self) -> np.ndarray:
        """Observed pixels at both instants, shape (2, windows, SAMPLES_PER_TRACK, 2)."""
        return np.stack([self.first_px, self.second_px])

    @cached_property
    def lengths_px(self) -> np.ndarray:
        """Displacement of each point, shape (windows, SAMPLES_PER_TRACK)."""
        return np.hypot(*np.moveaxis(self.second_px - self.first_px, -1, 0))

    @property
    def from_segments(self) -> np.ndarray:
        """Mask of the windows that come from segments, shape (windows,)."""
        return ~np.isfinite(self.middle_px[:, 0, 0])

    @property
    def body_weights(self) -> np.ndarray:
        """One over the number of windows of the same body, shape (windows,)."""
        return kish_weight(self.bodies, 1.0)

    def balanced_subset(self, limit: int) -> TwoFrameWindows:
        """Return at most `limit` windows, bodies in turn; first those with most points and largest motion."""
        length = self.lengths_px.mean(axis=1)
        best_first = np.lexsort((-length, -self.mask.sum(axis=1)))
        return self.subset(np.sort(round_robin(self.bodies, best_first)[:limit]))


def no_windows() -> TwoFrameWindows:
    """Return an empty set of windows."""
    return _stack([], 0)


def find_windows(evidence: Evidence, resampled: ResampledTracks | None = None) -> TwoFrameWindows:
    """Group the points of tracks, and of segments, into bodies at two instants."""
    width = evidence.image_size[0]
    groups = [*_track_groups(evidence, resampled or ResampledTracks(evidence)), *_segment_groups(evidence)]
    return _stack(_split_into_bodies(groups, width), width)


@dataclass(frozen=True)
class _PointGroup:
    """Points (n, 2) at both instants and halfway, their tracks (n,), middle and duration of the window."""

    first: np.ndarray
    second: np.ndarray
    middle: np.ndarray
    tracks: np.ndarray
    time_s: float
    duration_s: float = np.nan

    def subset(self, keep: np.ndarray) -> _PointGroup:
        """Return the points with these indices."""
        return _PointGroup(
            self.first[keep], self.second[keep], self.middle[keep], self.tracks[keep], self.time_s, self.duration_s
        )


def _track_groups(evidence: Evidence, resampled: ResampledTracks) -> Iterator[_PointGroup]:
    """Group points of tracks by the vehicle label under which they were tracked."""
    first_of_all = resampled.begin.min(initial=0)
    for length in WINDOW_LENGTHS:
        half = length // 2
        # visit only instants with tracks: a quiet road has thousands without
        steps, ranges = _expand_ranges(
            -((first_of_all - resampled.begin) // half), (resampled.end - length - first_of_all) // half
        )
        for together in group_indices(steps, MIN_POINTS):
            begin, seen = first_of_all + steps[together[0]] * half, ranges[together]
            for members in group_indices(evidence.track_vehicles[seen], MIN_POINTS):
                tracks = seen[members]
                first, middle, second = (resampled.positions_at(tracks, begin + step) for step in (0, half, length))
                yield _PointGroup(
                    first,
                    second,
                    middle,
                    tracks,
                    (begin + half) * RESAMPLING_INTERVAL_S,
                    length * RESAMPLING_INTERVAL_S,
                )


def _expand_ranges(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List the integers from `first` to `last` (ranges,), inclusive: the integers (n,) and their ranges (n,)."""
    counts = np.maximum(last - first + 1, 0)
    ranges = np.repeat(np.arange(len(counts)), counts)
    return np.arange(len(ranges)) + np.repeat(first - np.cumsum(counts) + counts, counts), ranges


def _segment_groups(evidence: Evidence) -> Iterator[_PointGroup]:
    """Group the segments of one vehicle between the same two masked frames."""
    _, instant = np.unique(evidence.segment_times_s, return_inverse=True)
    labels = instant.ravel() * (evidence.segment_vehicles.max(initial=0) + 1) + evidence.segment_vehicles
    for members in group_indices(labels, MIN_POINTS):
        first, second = evidence.segments_px[members, :2], evidence.segments_px[members, 2:]
        yield _PointGroup(
            first,
            second,
            np.full(first.shape, np.nan),
            np.full(len(members), -1),
            float(evidence.segment_times_s[members[0]]),
        )


class ResampledTracks:
    """Positions of the tracks at multiples of `RESAMPLING_INTERVAL_S`."""

    def __init__(self, evidence: Evidence) -> None:
        starts, ends = evidence.track_starts[:-1], evidence.track_starts[1:]
        self.begin = np.ceil(evidence.times_s[starts] / RESAMPLING_INTERVAL_S - 1e-9).astype(int)
        last = np.floor(evidence.times_s[ends - 1] / RESAMPLING_INTERVAL_S + 1e-9).astype(int)
        self.end = np.where(ends - starts > 1, last, self.begin - 1)  # a single point has no path
        counts = np.maximum(self.end - self.begin + 1, 0)
        self._offset = np.concatenate([[0], np.cumsum(counts)])
        track = np.repeat(np.arange(len(counts)), counts)
        wanted = (self.begin[track] + np.arange(len(track)) - self._offset[track]) * RESAMPLING_INTERVAL_S
        # one spline through all tracks, with a gap of 1 s between two
        steps = np.diff(evidence.times_s)
        steps[starts[1:] - 1] = 1.0
        along = np.concatenate([[0.0], np.cumsum(steps)])
        # not linear: chords cut the curve of a turning vehicle by several pixels
        places = evidence.points_px
        if len(track):
            velocities = _velocities(along, places, starts, ends)
            shifted = along[starts[track]] + wanted - evidence.times_s[starts[track]]
            places = cubic_through(along, places, velocities, shifted)
        self._places = places[: len(track)].reshape(-1, 2)

    def positions_at(self, tracks: np.ndarray, instant: int) -> np.ndarray:
        """Positions (n, 2) of tracks (n,) at one multiple of the interval."""
        return self._places[self._offset[tracks] + instant - self.begin[tracks]]

    def all_positions(self) -> tuple[np.ndarray, np.ndarray]:
        """All positions (n, 2), track after track, and the offset of each track in them, with the end (tracks + 1,)."""
        return self._places, self._offset


def _velocities(times: np.ndarray, positions: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Velocity (n, 2) at each position (n, 2): from the parabola through it and its neighbours in the track.

    A point is recorded again only after it has moved: during a long step it stood still, so velocity is limited to
    three times that of the chord, with which a cubic stays monotonic (Fritsch & Carlson 1980).
    """
    track = np.repeat(np.arange(len(starts)), ends - starts)
    middle = np.clip(np.arange(len(times)), starts[track] + 1, np.maximum(ends[track] - 2, starts[track] + 1))
    middle = np.minimum(middle, len(times) - 1)
    slopes = np.diff(positions, axis=0) / np.diff(times)[:, None]
    # a track of two points has only the slope of its chord
    after = np.where((ends - starts)[track] < 3, middle - 1, np.minimum(middle, len(slopes) - 1))
    curvature = (slopes[after] - slopes[middle - 1]) / (times[after + 1] - times[middle - 1])[:, None]
    speeds = slopes[middle - 1] + curvature * (2.0 * times - times[middle - 1] - times[middle])[:, None]
    max_speed = 3.0 * np.minimum(np.hypot(*slopes[middle - 1].T), np.hypot(*slopes[after].T))
    return speeds * np.minimum(1.0, max_speed / np.maximum(np.hypot(*speeds.T), 1e-9))[:, None]


def _split_into_bodies(groups: list[_PointGroup], width: int) -> list[_PointGroup]:
    """Split groups into bodies: connected points that are near each other at both instants and move alike."""
    edges, start = [np.zeros((2, 0), int)], 0
    for group in groups:
        displacements = group.second - group.first
        length = np.hypot(displacements[:, 0], displacements[:, 1])
        moving = length > MIN_WINDOW_DISPLACEMENT * width
        together = (
            (_pairwise_distances(group.first) < MAX_NEIGHBOUR_DISTANCE * width)
            & (_pairwise_distances(group.second) < MAX_NEIGHBOUR_DISTANCE * width)
            & (
                _pairwise_distances(displacements)
                < MAX_MOTION_DIFFERENCE * np.maximum(length[:, None], length) + MAX_MOTION_DIFFERENCE_PX
            )
            & moving[:, None]
            & moving
        )
        edges.append(np.array(np.nonzero(together)) + start)
        start += len(length)
    labels = component_labels(np.concatenate(edges, axis=1), start)
    starts = np.cumsum([0, *(len(group.tracks) for group in groups)])
    return [
        group.subset(farthest_points(body, group.first, SAMPLES_PER_TRACK))
        for number, group in enumerate(groups)
        for body in group_indices(labels[starts[number] : starts[number + 1]], MIN_POINTS)
    ]


def _pairwise_distances(positions: np.ndarray) -> np.ndarray:
    """Distances (n, n) between positions (n, 2)."""
    return np.hypot(positions[:, None, 0] - positions[:, 0], positions[:, None, 1] - positions[:, 1])


def _stack(groups: list[_PointGroup], width: int) -> TwoFrameWindows:
    """Pad groups of at most `SAMPLES_PER_TRACK` points into arrays, and number their bodies."""
    count = len(groups)
    first, second, middle = (np.zeros((count, SAMPLES_PER_TRACK, 2)) for _ in range(3))
    mask, tracks = np.zeros((count, SAMPLES_PER_TRACK), bool), np.full((count, SAMPLES_PER_TRACK), -1)
    for row, group in enumerate(groups):
        points = len(group.tracks)
        for array, positions in ((first, group.first), (second, group.second), (middle, group.middle)):
            array[row], array[row, :points] = positions[0], positions
        mask[row, :points], tracks[row, :points] = True, group.tracks
    times = np.array([group.time_s for group in groups])
    return TwoFrameWindows(
        first,
        second,
        middle,
        mask,
        _body_ids(tracks, times, first[:, 0], MAX_NEIGHBOUR_DISTANCE * width),
        times,
        np.array([group.duration_s for group in groups]),
        tracks,
    )


def _body_ids(tracks: np.ndarray, times: np.ndarray, positions: np.ndarray, max_distance: float) -> np.ndarray:
    """Number the bodies: windows of tracks by shared tracks, windows of segments by time and place."""
    rows, columns = np.nonzero(tracks >= 0)
    members = coo_matrix(
        (np.ones(len(rows)), (rows, tracks[rows, columns])), shape=(len(tracks), int(tracks.max(initial=-1)) + 1)
    ).tocsr()
    common = (members @ members.T).tocoo()
    same = common.data >= MIN_SHARED_TRACKS
    labels = component_labels(np.stack([common.row[same], common.col[same]]), len(tracks))
    of_tracks = np.flatnonzero(tracks[:, 0] >= 0)
    for row in np.flatnonzero(tracks[:, 0] < 0):
        near = of_tracks[np.abs(times[of_tracks] - times[row]) <= MAX_TIME_DIFFERENCE_S]
        distance = np.hypot(*(positions[near] - positions[row]).T)
        if distance.min(initial=np.inf) < max_distance:
            labels[row] = labels[near[np.argmin(distance)]]
    return labels
