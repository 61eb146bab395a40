"""Tracklets: points of one vehicle over several instants, where a window has two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.observations.grouping import farthest_points, group_indices, round_robin
from autocalib_ros.estimation.observations.track_set import SAMPLES_PER_TRACK, kish_weight
from autocalib_ros.estimation.observations.two_frame_windows import (
    MIN_POINTS,
    RESAMPLING_INTERVAL_S,
    ResampledTracks,
    TwoFrameWindows,
)

MAX_INSTANTS = 9
"""Most instants of a tracklet: the time of a turn at a junction. Longer observations make several tracklets."""
TRACKLET_CORRELATION = 0.3
"""Correlation of the errors of tracklets of one body, 0 to 1. Judgement."""
MIN_INSTANTS = 3
"""Fewest instants of a point, and points of an instant: fewer add no more than their own unknowns."""


@dataclass(frozen=True)
class Tracklets:
    """Points of vehicles at instants, as padded arrays."""

    pixels: np.ndarray
    """Observed pixels, shape (tracklets, points, instants, 2); 0 where a point was not seen."""
    mask: np.ndarray
    """Where a point was seen, shape (tracklets, points, instants)."""
    bodies: np.ndarray
    """Number of the body of each tracklet, shape (tracklets,)."""
    times_s: np.ndarray
    """Time of the middle of each tracklet, shape (tracklets,)."""

    def __len__(self) -> int:
        return len(self.bodies)

    def subset(self, keep: np.ndarray) -> Tracklets:
        """Return the tracklets that `keep`, a mask or indices, selects."""
        return Tracklets(self.pixels[keep], self.mask[keep], self.bodies[keep], self.times_s[keep])

    @property
    def body_weights(self) -> np.ndarray:
        """Weight of each tracklet among those of the same body, shape (tracklets,)."""
        return kish_weight(self.bodies, TRACKLET_CORRELATION)


def no_tracklets() -> Tracklets:
    """Return an empty set of tracklets."""
    return Tracklets(
        np.zeros((0, SAMPLES_PER_TRACK, MAX_INSTANTS, 2)),
        np.zeros((0, SAMPLES_PER_TRACK, MAX_INSTANTS), bool),
        np.zeros(0, int),
        np.zeros(0),
    )


def find_tracklets(windows: TwoFrameWindows, resampled: ResampledTracks, limit: int) -> Tracklets:
    """Follow the bodies of windows of tracks through all instants; return at most `limit` tracklets, bodies in turn."""
    of_tracks = np.flatnonzero(~windows.from_segments)
    found: list[tuple[int, np.ndarray, np.ndarray, float]] = []
    for members in (of_tracks[part] for part in group_indices(windows.bodies[of_tracks])):
        tracks = np.unique(windows.tracks[members][windows.tracks[members] >= 0])
        middles = np.round(windows.times_s[members] / RESAMPLING_INTERVAL_S).astype(int)
        for begin in range(middles.min() - 1, middles.max() + 1, MAX_INSTANTS - 1):
            tracklet = _tracklet(tracks, np.arange(begin, min(begin + MAX_INSTANTS, middles.max() + 2)), resampled)
            if tracklet is not None:
                found.append(
                    (int(windows.bodies[members[0]]), *tracklet, (begin + 0.5 * MAX_INSTANTS) * RESAMPLING_INTERVAL_S)
                )
    if not found:
        return no_tracklets()
    bodies, pixels, mask, times = (np.array(column) for column in zip(*found, strict=True))
    tracklets = Tracklets(pixels, mask, bodies, times)
    fullest_first = np.argsort(-mask.sum(axis=(1, 2)), kind='stable')
    return tracklets.subset(round_robin(bodies, fullest_first)[:limit])


def _tracklet(
    tracks: np.ndarray, instants: np.ndarray, resampled: ResampledTracks
) -> tuple[np.ndarray, np.ndarray] | None:
    """Pixels and mask of one tracklet; None if too little of it is seen."""
    seen = (resampled.begin[tracks][:, None] <= instants) & (resampled.end[tracks][:, None] >= instants)
    if len(instants) < MIN_INSTANTS or not seen.any():
        return None
    candidates = np.flatnonzero(seen.sum(axis=1) >= MIN_INSTANTS)
    if len(candidates) < MIN_POINTS:
        return None
    middle = int(np.argmax(seen[candidates].sum(axis=0)))
    present = candidates[seen[candidates, middle]]
    if len(present) < MIN_POINTS:
        return None
    chosen = present[
        farthest_points(
            np.arange(len(present)), resampled.positions_at(tracks[present], int(instants[middle])), SAMPLES_PER_TRACK
        )
    ]
    when_seen = seen[chosen].sum(axis=0) >= MIN_INSTANTS
    seen = seen & when_seen
    if when_seen.sum() < MIN_INSTANTS or (seen[chosen].sum(axis=1) < MIN_INSTANTS).any():
        return None
    pixels, mask = np.zeros((SAMPLES_PER_TRACK, MAX_INSTANTS, 2)), np.zeros((SAMPLES_PER_TRACK, MAX_INSTANTS), bool)
    for index in np.flatnonzero(when_seen):
        points = np.flatnonzero(seen[chosen, index])
        pixels[points, index] = resampled.positions_at(tracks[chosen[points]], int(instants[index]))
        mask[points, index] = True
    return pixels, mask
