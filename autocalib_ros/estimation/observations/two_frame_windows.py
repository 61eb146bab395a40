"""Windows: several points of one vehicle seen at the same two instants.

Between the two a vehicle has moved as a rigid body on the road. Points that are near each other and move alike make
up a body; what is grouped wrongly has to be borne by whoever uses a window.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from autocalib_ros.estimation.observations.track_set import SAMPLES_PER_TRACK, count_earlier, kish_weight
from autocalib_ros.evidence.snapshot import Evidence

RESAMPLING_INTERVAL_S = 0.4
"""Windows begin, end and have their middle at whole multiples of this."""
WINDOW_LENGTHS = (2, 4)
"""In intervals, even: long enough that a vehicle turns by degrees, short enough that the same points are still seen."""
MIN_POINTS = 5
"""A window's own motion takes two unknowns; fewer points say too little beyond."""
MAX_NEIGHBOUR_DISTANCE = 0.06
"""Points of one body lie within this of a neighbour, share of the image width."""
MIN_WINDOW_DISPLACEMENT = 0.01
"""Shortest displacement in a window, share of the image width; below it is more noise than motion."""
MAX_MOTION_DIFFERENCE, MAX_MOTION_DIFFERENCE_PX = 0.25, 2.0
"""Displacements of neighbours on one body differ by less than this share and so many pixels: it turns, and what is
nearer or higher moves farther in the image."""
MIN_SHARED_TRACKS = 3
"""Two windows with so many tracks in common are of one body."""
MAX_TIME_DIFFERENCE_S = 0.6
"""Segments belong to a body of tracks that is seen at their place within so long."""


@dataclass(frozen=True)
class TwoFrameWindows:
    """Windows in arrays of equal width; a window has a point where `mask` is true."""

    first_px: np.ndarray
    """Observed pixels at the first instant, shape (windows, SAMPLES, 2)."""
    second_px: np.ndarray
    """The same points at the second instant, shape (windows, SAMPLES, 2)."""
    middle_px: np.ndarray
    """The same points halfway in time, nan for segments, shape (windows, SAMPLES, 2)."""
    mask: np.ndarray
    """Shape (windows, SAMPLES)."""
    bodies: np.ndarray
    """Which windows are of one body, shape (windows,)."""
    times_s: np.ndarray
    """Time of the middle of each window, shape (windows,)."""
    duration_s: np.ndarray
    """Length of each window, nan for segments, shape (windows,)."""
    tracks: np.ndarray
    """Index in the evidence of each point's track, -1 for segments, shape (windows, SAMPLES)."""

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

    @property
    def from_segments(self) -> np.ndarray:
        """Which windows are of segments, shape (windows,)."""
        return ~np.isfinite(self.middle_px[:, 0, 0])

    @property
    def body_weights(self) -> np.ndarray:
        """One over the number of windows of the same body, shape (windows,)."""
        return kish_weight(self.bodies, 1.0)

    def balanced_subset(self, limit: int) -> TwoFrameWindows:
        """Return at most `limit` windows, bodies in turn, those of most points and farthest motion first."""
        way = np.hypot(*np.moveaxis(self.second_px - self.first_px, -1, 0)).mean(axis=1)
        best_first = np.lexsort((-way, -self.mask.sum(axis=1)))
        return self.subset(np.sort(round_robin(self.bodies, best_first)[:limit]))


def round_robin(owners: np.ndarray, best_first: np.ndarray) -> np.ndarray:
    """Order (n,) in which owners (n,) take turns, each with its best first; `best_first` is the order of merit (n,)."""
    rank = np.empty(len(owners), int)
    rank[best_first] = count_earlier(owners[best_first])
    return np.argsort(rank, kind='stable')


def no_windows() -> TwoFrameWindows:
    """Return none at all."""
    return _stack([], 0)


def find_windows(evidence: Evidence, instants: ResampledTracks | None = None) -> TwoFrameWindows:
    """Group the points of tracks, and the segments, into bodies at two instants."""
    width = evidence.image_size[0]
    groups = [*_track_groups(evidence, instants or ResampledTracks(evidence)), *_segment_groups(evidence)]
    return _stack(_split_into_bodies(groups, width), width)


@dataclass(frozen=True)
class _PointGroup:
    """Points (n, 2) at two instants and halfway, with their tracks (n,), and the middle of the window."""

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


def _track_groups(evidence: Evidence, grid: ResampledTracks) -> Iterator[_PointGroup]:
    """Points of what may be one vehicle, by the label that it was seen under."""
    first_of_all = grid.begin.min(initial=0)
    for length in WINDOW_LENGTHS:
        half = length // 2
        # only instants that hold tracks: between two vehicles of a quiet road lie thousands that do not
        steps, owners = _expand_ranges(
            -((first_of_all - grid.begin) // half), (grid.end - length - first_of_all) // half
        )
        for together in group_indices(steps, MIN_POINTS):
            begin, seen = first_of_all + steps[together[0]] * half, owners[together]
            for members in group_indices(evidence.track_vehicles[seen], MIN_POINTS):
                tracks = seen[members]
                first, middle, second = (grid.at(tracks, begin + step) for step in (0, half, length))
                yield _PointGroup(
                    first,
                    second,
                    middle,
                    tracks,
                    (begin + half) * RESAMPLING_INTERVAL_S,
                    length * RESAMPLING_INTERVAL_S,
                )


def _expand_ranges(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List the numbers from `first` to `last` (owners,), both included, as numbers (n,) and their owners (n,)."""
    counts = np.maximum(last - first + 1, 0)
    owners = np.repeat(np.arange(len(counts)), counts)
    return np.arange(len(owners)) + np.repeat(first - np.cumsum(counts) + counts, counts), owners


def _segment_groups(evidence: Evidence) -> Iterator[_PointGroup]:
    """Segments of one vehicle between the same two masked frames."""
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


def group_indices(labels: np.ndarray, least: int = 1) -> list[np.ndarray]:
    """Indices of the members of each label (n,) that has at least so many, by rising label."""
    order = np.argsort(labels, kind='stable')
    parts = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    return [part for part in parts if len(part) >= least]


class ResampledTracks:
    """Where tracks were at multiples of the interval."""

    def __init__(self, evidence: Evidence) -> None:
        starts, ends = evidence.track_starts[:-1], evidence.track_starts[1:]
        self.begin = np.ceil(evidence.times_s[starts] / RESAMPLING_INTERVAL_S - 1e-9).astype(int)
        last = np.floor(evidence.times_s[ends - 1] / RESAMPLING_INTERVAL_S + 1e-9).astype(int)
        self.end = np.where(ends - starts > 1, last, self.begin - 1)  # a single point is no way
        counts = np.maximum(self.end - self.begin + 1, 0)
        self._offset = np.concatenate([[0], np.cumsum(counts)])
        track = np.repeat(np.arange(len(counts)), counts)
        wanted = (self.begin[track] + np.arange(len(track)) - self._offset[track]) * RESAMPLING_INTERVAL_S
        # one curve through all tracks, a second between one and the next
        steps = np.diff(evidence.times_s)
        steps[starts[1:] - 1] = 1.0
        along = np.concatenate([[0.0], np.cumsum(steps)])
        # not along chords: a turning vehicle's lie inside its way by several pixels
        way = (
            CubicHermiteSpline(along, evidence.points_px, _velocities(along, evidence.points_px, starts, ends))
            if (len(track))
            else np.zeros_like
        )
        self._places = way(along[starts[track]] + wanted - evidence.times_s[starts[track]]).reshape(-1, 2)

    def at(self, tracks: np.ndarray, instant: int) -> np.ndarray:
        """Positions (n, 2) of tracks (n,) at a multiple of the interval."""
        return self._places[self._offset[tracks] + instant - self.begin[tracks]]

    def all(self) -> tuple[np.ndarray, np.ndarray]:
        """All positions (n, 2), track after track, and where each track begins there, with the end, (tracks + 1,)."""
        return self._places, self._offset


def _velocities(times: np.ndarray, places: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Velocity (n, 2) at each place (n, 2) of tracks: of the parabola through it and its neighbours in its track.

    A point is not noted again until it has moved on: a long step is one of standing, into which speed is not carried
    (three times the chord's is what a cubic bears without turning back, Fritsch & Carlson 1980).
    """
    track = np.repeat(np.arange(len(starts)), ends - starts)
    middle = np.clip(np.arange(len(times)), starts[track] + 1, np.maximum(ends[track] - 2, starts[track] + 1))
    middle = np.minimum(middle, len(times) - 1)
    slopes = np.diff(places, axis=0) / np.diff(times)[:, None]
    after = np.where((ends - starts)[track] < 3, middle - 1, np.minimum(middle, len(slopes) - 1))  # of two: the chord
    bend = (slopes[after] - slopes[middle - 1]) / (times[after + 1] - times[middle - 1])[:, None]
    speeds = slopes[middle - 1] + bend * (2.0 * times - times[middle - 1] - times[middle])[:, None]
    slowest = 3.0 * np.minimum(np.hypot(*slopes[middle - 1].T), np.hypot(*slopes[after].T))
    return speeds * np.minimum(1.0, slowest / np.maximum(np.hypot(*speeds.T), 1e-9))[:, None]


def _split_into_bodies(groups: list[_PointGroup], width: int) -> list[_PointGroup]:
    """Take groups apart into bodies: points near each other, at both instants, that move alike."""
    edges, start = [np.zeros((2, 0), int)], 0
    for group in groups:
        moves = group.second - group.first
        far = np.hypot(moves[:, 0], moves[:, 1])
        moving = far > MIN_WINDOW_DISPLACEMENT * width
        together = (
            (_pairwise_distances(group.first) < MAX_NEIGHBOUR_DISTANCE * width)
            & (_pairwise_distances(group.second) < MAX_NEIGHBOUR_DISTANCE * width)
            & (
                _pairwise_distances(moves)
                < MAX_MOTION_DIFFERENCE * np.maximum(far[:, None], far) + MAX_MOTION_DIFFERENCE_PX
            )
            & moving[:, None]
            & moving
        )
        edges.append(np.array(np.nonzero(together)) + start)
        start += len(far)
    pairs = np.concatenate(edges, axis=1)
    graph = coo_matrix((np.ones(pairs.shape[1], bool), pairs), shape=(start, start))
    _, labels = connected_components(graph, directed=False)
    starts = np.cumsum([0, *(len(group.tracks) for group in groups)])
    return [
        group.subset(farthest_points(body, group.first))
        for number, group in enumerate(groups)
        for body in group_indices(labels[starts[number] : starts[number + 1]], MIN_POINTS)
    ]


def _pairwise_distances(places: np.ndarray) -> np.ndarray:
    """Distances (n, n) between places (n, 2)."""
    return np.hypot(places[:, None, 0] - places[:, 0], places[:, None, 1] - places[:, 1])


def farthest_points(body: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Choose at most SAMPLES points of a body, each as far from those before as can be."""
    if len(body) <= SAMPLES_PER_TRACK:
        return body
    chosen = [0]
    distance = np.hypot(*(places[body] - places[body[0]]).T)
    while len(chosen) < SAMPLES_PER_TRACK:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.hypot(*(places[body] - places[body[chosen[-1]]]).T))
    return body[np.sort(chosen)]


def _stack(groups: list[_PointGroup], width: int) -> TwoFrameWindows:
    count = len(groups)
    first, second, middle = (np.zeros((count, SAMPLES_PER_TRACK, 2)) for _ in range(3))
    mask, tracks = np.zeros((count, SAMPLES_PER_TRACK), bool), np.full((count, SAMPLES_PER_TRACK), -1)
    for row, group in enumerate(groups):
        points = len(group.tracks)
        for array, places in ((first, group.first), (second, group.second), (middle, group.middle)):
            array[row], array[row, :points] = places[0], places
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


def _body_ids(tracks: np.ndarray, times: np.ndarray, places: np.ndarray, reach: float) -> np.ndarray:
    """Number the bodies: windows of tracks by the tracks that they share, those of segments by time and place."""
    rows, columns = np.nonzero(tracks >= 0)
    members = coo_matrix(
        (np.ones(len(rows)), (rows, tracks[rows, columns])), shape=(len(tracks), int(tracks.max(initial=-1)) + 1)
    ).tocsr()
    common = (members @ members.T).tocoo()
    same = common.data >= MIN_SHARED_TRACKS
    graph = coo_matrix((np.ones(same.sum()), (common.row[same], common.col[same])), shape=(len(tracks), len(tracks)))
    _, labels = connected_components(graph, directed=False)
    of_tracks = np.flatnonzero(tracks[:, 0] >= 0)
    for row in np.flatnonzero(tracks[:, 0] < 0):
        near = of_tracks[np.abs(times[of_tracks] - times[row]) <= MAX_TIME_DIFFERENCE_S]
        distance = np.hypot(*(places[near] - places[row]).T)
        if distance.min(initial=np.inf) < reach:
            labels[row] = labels[near[np.argmin(distance)]]
    return labels
