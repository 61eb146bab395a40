"""Lives: points of one vehicle over several instants, the longer view of what windows show between two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.observations.track_set import SAMPLES_PER_TRACK, kish_weight
from autocalib_ros.estimation.observations.two_frame_windows import (
    MIN_POINTS,
    RESAMPLING_INTERVAL_S,
    ResampledTracks,
    TwoFrameWindows,
    farthest_points,
    group_indices,
    round_robin,
)

MAX_INSTANTS = 9
"""Most instants of a life: as long as a turn at a junction takes; a longer one goes on as another."""
TRACKLET_CORRELATION = 0.3
"""How much the errors of lives of one body correlate, 0 to 1."""
MIN_INSTANTS = 3
"""Instants that a point, and points that an instant, needs to add more than its own unknowns."""


@dataclass(frozen=True)
class Tracklets:
    """Points of vehicles at instants, in arrays of equal shape."""

    pixels: np.ndarray
    """Observed pixels, shape (lives, SAMPLES, INSTANTS, 2); 0 where a point was not seen."""
    mask: np.ndarray
    """Where it was, shape (lives, SAMPLES, INSTANTS)."""
    bodies: np.ndarray
    """Which lives are of one body, shape (lives,)."""
    times_s: np.ndarray
    """Time of the middle of each life, shape (lives,)."""

    def __len__(self) -> int:
        return len(self.bodies)

    def subset(self, keep: np.ndarray) -> Tracklets:
        """Return the lives that `keep`, a mask or indices, selects."""
        return Tracklets(self.pixels[keep], self.mask[keep], self.bodies[keep], self.times_s[keep])

    @property
    def body_weights(self) -> np.ndarray:
        """Weight of each life among those of the same body, shape (lives,)."""
        return kish_weight(self.bodies, TRACKLET_CORRELATION)


def no_tracklets() -> Tracklets:
    """Return none at all."""
    return Tracklets(
        np.zeros((0, SAMPLES_PER_TRACK, MAX_INSTANTS, 2)),
        np.zeros((0, SAMPLES_PER_TRACK, MAX_INSTANTS), bool),
        np.zeros(0, int),
        np.zeros(0),
    )


def find_tracklets(windows: TwoFrameWindows, instants: ResampledTracks, limit: int) -> Tracklets:
    """Follow the bodies of windows of tracks from instant to instant; at most `limit` lives, bodies in turn."""
    of_tracks = np.flatnonzero(~windows.from_segments)
    found: list[tuple[int, np.ndarray, np.ndarray, float]] = []
    for members in (of_tracks[part] for part in group_indices(windows.bodies[of_tracks])):
        tracks = np.unique(windows.tracks[members][windows.tracks[members] >= 0])
        middles = np.round(windows.times_s[members] / RESAMPLING_INTERVAL_S).astype(int)
        for begin in range(middles.min() - 1, middles.max() + 1, MAX_INSTANTS - 1):
            tracklet = _tracklet(tracks, np.arange(begin, min(begin + MAX_INSTANTS, middles.max() + 2)), instants)
            if tracklet is not None:
                found.append(
                    (int(windows.bodies[members[0]]), *tracklet, (begin + 0.5 * MAX_INSTANTS) * RESAMPLING_INTERVAL_S)
                )
    if not found:
        return no_tracklets()
    bodies, pixels, mask, times = (np.array(column) for column in zip(*found, strict=True))
    lives = Tracklets(pixels, mask, bodies, times)
    fullest_first = np.argsort(-mask.sum(axis=(1, 2)), kind='stable')
    return lives.subset(round_robin(bodies, fullest_first)[:limit])


def _tracklet(tracks: np.ndarray, when: np.ndarray, instants: ResampledTracks) -> tuple[np.ndarray, np.ndarray] | None:
    """Pixels and mask of one life, None where too little of it is seen."""
    seen = (instants.begin[tracks][:, None] <= when) & (instants.end[tracks][:, None] >= when)
    if len(when) < MIN_INSTANTS or not seen.any():
        return None
    often = np.flatnonzero(seen.sum(axis=1) >= MIN_INSTANTS)
    if len(often) < MIN_POINTS:
        return None
    middle = int(np.argmax(seen[often].sum(axis=0)))
    here = often[seen[often, middle]]
    if len(here) < MIN_POINTS:
        return None
    chosen = here[farthest_points(np.arange(len(here)), instants.at(tracks[here], int(when[middle])))]
    when_seen = seen[chosen].sum(axis=0) >= MIN_INSTANTS
    seen = seen & when_seen
    if when_seen.sum() < MIN_INSTANTS or (seen[chosen].sum(axis=1) < MIN_INSTANTS).any():
        return None
    pixels, mask = np.zeros((SAMPLES_PER_TRACK, MAX_INSTANTS, 2)), np.zeros((SAMPLES_PER_TRACK, MAX_INSTANTS), bool)
    for place in np.flatnonzero(when_seen):
        points = np.flatnonzero(seen[chosen, place])
        pixels[points, place] = instants.at(tracks[chosen[points]], int(when[place]))
        mask[points, place] = True
    return pixels, mask
