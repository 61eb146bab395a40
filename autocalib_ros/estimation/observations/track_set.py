"""Tracks selected from the evidence, resampled to arrays of equal length, and their weights by vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.great_circles import Rays, circle_scatter, unproject_rays
from autocalib_ros.lens.camera import Camera

SAMPLES_PER_TRACK = 10
"""Points of a track in a fit; more points of one path add correlated noise, not information."""
MIN_DISPLACEMENT_DIAGONALS = 0.04
"""Shortest displacement of a track that constrains the lens, fraction of the image diagonal. Judgement."""
MAX_PATH_RATIO = 1.3
"""Largest ratio of path length to displacement of a track that may be straight, with lens curvature and noise."""
SELECTION_CELLS = (8, 5)
"""Columns and rows of the image grid over which selected tracks are spread."""


@dataclass(frozen=True)
class TrackSet:
    """Tracks resampled to `SAMPLES_PER_TRACK` points each."""

    pixels: np.ndarray
    """Shape (tracks, samples, 2)."""
    weights: np.ndarray
    """Weight of each point: equal, 0 for the repeated points of a short track, sum 1 per track, (tracks, samples)."""
    vehicles: np.ndarray
    """Vehicle id of each track, shape (tracks,)."""
    sample_times_s: np.ndarray
    """Time of each point, shape (tracks, samples)."""
    indices: np.ndarray
    """Index of each track in the evidence, shape (tracks,)."""

    def __len__(self) -> int:
        return len(self.vehicles)

    def subset(self, keep: np.ndarray) -> TrackSet:
        """Return the tracks of a mask or of indices `keep`."""
        return TrackSet(
            self.pixels[keep], self.weights[keep], self.vehicles[keep], self.sample_times_s[keep], self.indices[keep]
        )

    def at_most(self, limit: int) -> TrackSet:
        """Return at most `limit` of the tracks, evenly spaced in their list."""
        return self.subset(evenly_spaced(len(self), limit))

    @cached_property
    def unprojected(self) -> dict[Camera, UnprojectedTracks]:
        """The tracks through one lens: adjustments ask for the same again after a step, and where the lens is fixed."""
        return {}

    @property
    def times_s(self) -> np.ndarray:
        """Mean time of each track, shape (tracks,)."""
        return self.sample_times_s.mean(axis=1)

    @property
    def vehicle_weight(self) -> np.ndarray:
        """Weight of each track that gives every vehicle a sum of 1, shape (tracks,)."""
        return self.kish_weight(1.0)

    def kish_weight(self, correlation: float) -> np.ndarray:
        """Return weights (tracks,) for errors with a correlation, 0 to 1, within a vehicle."""
        return _kish_weight_of(self._vehicle_sizes, correlation)

    @cached_property
    def _vehicle_sizes(self) -> np.ndarray:
        """Number of tracks of the vehicle of each track, shape (tracks,)."""
        return _group_sizes(self.vehicles)


def kish_weight(vehicle_ids: np.ndarray, correlation: float) -> np.ndarray:
    """Return weights (n,) of observations of vehicles (n,) whose errors have a correlation, 0 to 1, within a vehicle.

    One over the design effect of Kish (1965); with a correlation of 1 all observations of a vehicle count as one.
    """
    return _kish_weight_of(_group_sizes(vehicle_ids), correlation)


def _group_sizes(vehicle_ids: np.ndarray) -> np.ndarray:
    """Return the number of observations (n,) of the vehicle of each."""
    _, inverse, counts = np.unique(vehicle_ids, return_inverse=True, return_counts=True)
    return counts[inverse]


def _kish_weight_of(sizes: np.ndarray, correlation: float) -> np.ndarray:
    return 1.0 / (1.0 + (sizes - 1.0) * correlation)


def select_tracks(evidence: Evidence, limit: int) -> TrackSet:
    """Select at most `limit` long, possibly straight tracks, spread over image cells, headings and vehicles."""
    starts, points = evidence.track_starts, evidence.points_px
    way, displacement = _displacements(evidence)
    straight = path_lengths(points, starts) <= MAX_PATH_RATIO * displacement
    candidates = np.flatnonzero(_long_enough(evidence, displacement) & straight)
    candidates = candidates[np.argsort(-displacement[candidates], kind='stable')]
    return _track_set(evidence, np.sort(candidates[_selection_order(evidence, candidates, way[candidates])[:limit]]))


def long_tracks(evidence: Evidence) -> TrackSet:
    """Return all tracks of sufficient displacement, straight or not."""
    _, displacement = _displacements(evidence)
    return _track_set(evidence, np.flatnonzero(_long_enough(evidence, displacement)))


def _displacements(evidence: Evidence) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement of each track in pixels, as vectors (tracks, 2) and lengths (tracks,)."""
    way = evidence.points_px[evidence.track_starts[1:] - 1] - evidence.points_px[evidence.track_starts[:-1]]
    return way, np.hypot(way[:, 0], way[:, 1])


def _long_enough(evidence: Evidence, displacement: np.ndarray) -> np.ndarray:
    return displacement >= MIN_DISPLACEMENT_DIAGONALS * np.hypot(*evidence.image_size)


def path_lengths(points: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the lengths (paths,) of consecutive paths in `points` (n, 2).

    `starts` (paths + 1,) are the indices of the first points, followed by n.
    """
    steps = np.zeros(len(points) + 1)
    steps[1:-1] = np.hypot(*np.diff(points, axis=0).T)
    steps[starts] = 0.0
    return np.diff(np.cumsum(steps)[starts])


def _selection_order(evidence: Evidence, candidates: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Return the order of selection (n,) of candidates with displacements `way` (n, 2), longest first.

    Round robin over image cells and headings, and over vehicles within a cell.
    """
    starts, vehicles = evidence.track_starts, evidence.track_vehicles[candidates]
    middle = evidence.points_px[(starts[candidates] + starts[candidates + 1]) // 2]
    column, row = np.floor(middle / evidence.image_size * SELECTION_CELLS).astype(int).T
    heading = np.arctan2(way[:, 1], way[:, 0]) // (np.pi / 4)
    rank = count_earlier(column, row, heading) + 4 * count_earlier(vehicles, column + SELECTION_CELLS[0] * row)
    return np.argsort(rank, kind='stable')


def evenly_spaced(count: int, limit: int) -> np.ndarray:
    """Return at most `limit` evenly spaced indices out of `count`."""
    return np.linspace(0, max(count - 1, 0), min(limit, count)).astype(int)


def count_earlier(*keys: np.ndarray) -> np.ndarray:
    """Return for each element the number of earlier elements with the same keys (n,)."""
    _, group, counts = np.unique(np.column_stack(keys), axis=0, return_inverse=True, return_counts=True)
    earlier = np.empty(len(group), int)
    earlier[np.argsort(group, kind='stable', axis=None)] = np.arange(len(group)) - np.repeat(
        np.cumsum(counts) - counts, counts
    )
    return earlier


def _track_set(evidence: Evidence, indices: np.ndarray) -> TrackSet:
    starts, ends = evidence.track_starts[indices], evidence.track_starts[indices + 1]
    chosen = np.round(np.linspace(0, ends - starts - 1, SAMPLES_PER_TRACK, axis=1)).astype(int)
    first = np.diff(chosen, axis=1, prepend=-1) > 0
    points = starts[:, None] + chosen
    return TrackSet(
        evidence.points_px[points],
        first / first.sum(axis=1, keepdims=True),
        evidence.track_vehicles[indices].astype(int),
        evidence.times_s[points],
        indices,
    )


@dataclass(frozen=True)
class UnprojectedTracks:
    """Tracks unprojected by one camera."""

    rays: Rays
    """Of shape (tracks, samples)."""
    weights: np.ndarray
    """As those of the tracks, shape (tracks, samples)."""

    @classmethod
    def through(cls, camera: Camera, tracks: TrackSet) -> UnprojectedTracks:
        """Unproject tracks; through the camera that was asked for last, return the same again."""
        if camera not in tracks.unprojected:
            tracks.unprojected.clear()
            tracks.unprojected[camera] = cls(unproject_rays(camera, tracks.pixels), tracks.weights)
        return tracks.unprojected[camera]

    @cached_property
    def matrix(self) -> np.ndarray:
        """Scatter matrix of each track, shape (tracks, 3, 3)."""
        return circle_scatter(self.rays, self.weights) if len(self.weights) else np.zeros((0, 3, 3))

    def subset(self, keep: np.ndarray) -> UnprojectedTracks:
        """Return the tracks of a mask or of indices `keep`."""
        part = UnprojectedTracks(self.rays.subset(keep), self.weights[keep])
        vars(part)['matrix'] = self.matrix[keep]  # known already
        return part
