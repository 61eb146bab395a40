"""One vehicle has one heading: tracks that move as one body are judged together.

A tracked point drifts, so that one track hardly tells a straight drive from a slight turn; the tracks of one vehicle
together do. What moves together is seen on the ground, where bodies have a size in metres.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from autocalib_ros.estimation.observations.track_set import TrackSet

MAX_NEIGHBOUR_M = 4.0
"""Points of one body lie within this of a neighbour; a car is as long."""
MAX_PATH_DIFFERENCE, MAX_PATH_DIFFERENCE_M = 0.3, 0.2
"""Points of one body move alike to this share and so many metres: points higher up seem to go farther."""
MIN_OVERLAP_S = 0.4
"""Two tracks have to be seen together for this long to tell whether they move alike."""
TRACKS_PER_BLOCK = 64
"""So many tracks are compared with all others at once."""
MIN_CORROBORATING_TRACKS = 3
"""So many tracks corroborate each other; fewer say little of their vehicle."""
SINGLE_TRACK_WEIGHT = 0.25
"""Influence of a track that nothing corroborates."""
MIN_HEADING_SPREAD_DEG = 0.15
"""Least spread of headings: lanes are marked no better than that."""
HEADING_NOISE_DEG = 0.3
"""What the heading of a single short track is off by at least: its point drifts on the body."""
GEMAN_MCCLURE_SCALE = 2.0
"""A vehicle has a quarter of its influence left when its heading is so many spreads off."""
RIDGE = 1e-9
"""Share of its trace by which a matrix is lifted that points at one place leave singular."""
MIN_VEHICLES_FOR_SPREAD = 10
"""So many corroborated vehicles tell the spread of headings; with fewer no vehicle is judged by it."""


def group_into_bodies(tracks: TrackSet, ground_m: np.ndarray) -> np.ndarray:
    """Number the bodies that tracks belong to, shape (tracks,).

    `ground_m` (tracks, samples, 2) are positions on the road. Two tracks are of one body when they are near each
    other at the first and the last time that both are seen, and went the same way between.
    """
    times = tracks.sample_times_s
    edges = np.zeros((2, 0), int)
    for ones, others in _overlapping_pairs(times[:, 0], times[:, -1]):
        until = np.minimum(times[ones, -1], times[others, -1])
        begin_one, begin_other = _interpolate(times, ground_m, ones, times[others, 0]), ground_m[others, 0]
        end_one, end_other = (_interpolate(times, ground_m, rows, until) for rows in (ones, others))
        moved_one, moved_other = end_one - begin_one, end_other - begin_other
        far = np.maximum(np.hypot(*moved_one.T), np.hypot(*moved_other.T))
        alike = (
            (np.hypot(*(begin_other - begin_one).T) < MAX_NEIGHBOUR_M)
            & (np.hypot(*(end_other - end_one).T) < MAX_NEIGHBOUR_M)
            & (np.hypot(*(moved_other - moved_one).T) < MAX_PATH_DIFFERENCE * far + MAX_PATH_DIFFERENCE_M)
        )
        edges = np.hstack([edges, [ones[alike], others[alike]]])
    graph = coo_matrix((np.ones(edges.shape[1]), edges), shape=(len(tracks), len(tracks)))
    return connected_components(graph, directed=False)[1]


def _overlapping_pairs(first: np.ndarray, last: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield all pairs of tracks, seen from `first` to `last` (tracks,), by blocks: one (n,) and one that begins later.

    The pairs of a few tracks at a time: those of all would not fit into memory where traffic is dense.
    """
    order = np.argsort(first, kind='stable')
    places = np.arange(len(order))
    ends = np.searchsorted(first[order], last[order] - MIN_OVERLAP_S, side='right')
    for begin in range(0, len(order), TRACKS_PER_BLOCK):
        block = places[begin : begin + TRACKS_PER_BLOCK]
        ones, others = np.nonzero((places > block[:, None]) & (places < ends[block, None]))
        ones, others = order[block[ones]], order[others]
        long = np.minimum(last[ones], last[others]) - first[others] >= MIN_OVERLAP_S
        yield ones[long], others[long]


def _interpolate(times: np.ndarray, places: np.ndarray, rows: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Interpolate rows (n,) of places (tracks, samples, 2), seen at times (tracks, samples), at `when` (n,): (n, 2)."""
    after = np.clip((times[rows] <= when[:, None]).sum(axis=1), 1, times.shape[1] - 1)
    t0, t1 = times[rows, after - 1], times[rows, after]
    part = np.clip((when - t0) / np.maximum(t1 - t0, 1e-9), 0.0, 1.0)[:, None]
    return places[rows, after - 1] * (1 - part) + places[rows, after] * part


def heading_error_deg(
    distance_px: np.ndarray, px_per_m: np.ndarray, along_m: np.ndarray, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How far each track's heading is off its road's, in degrees, and its error for a pixel of noise; (tracks,) each.

    From the line in a parabola through the distances (tracks, samples) along the road.
    """
    weight = mask * px_per_m**2
    count = np.maximum(mask.sum(axis=1, keepdims=True), 1)
    centred = along_m - (along_m * mask).sum(axis=1, keepdims=True) / count
    length = np.maximum(np.ptp(np.where(mask, centred, 0.0), axis=1), 0.3)
    x = centred / length[:, None]
    basis = np.stack([np.ones_like(x), x, x * x - 1 / 12], axis=-1)
    weighted = (basis * weight[..., None]).transpose(0, 2, 1)
    matrix = weighted @ basis
    ridge = RIDGE * np.maximum(np.trace(matrix, axis1=1, axis2=2), 1.0)
    inverse = np.linalg.inv(matrix + ridge[:, None, None] * np.eye(3))
    offset_m = distance_px / np.maximum(px_per_m, 1e-3)
    fitted = (inverse @ (weighted @ offset_m[..., None]))[..., 0]
    return np.degrees(fitted[:, 1] / length), np.degrees(np.sqrt(inverse[:, 1, 1]) / length)


def corroboration_weights(
    off_deg: np.ndarray, error_deg: np.ndarray, vehicles: np.ndarray, roads: np.ndarray
) -> np.ndarray:
    """Influence (tracks,) by whether each track's vehicle, all its tracks on one road together, keeps to the road."""
    groups, inverse, counts = np.unique(
        np.column_stack([vehicles, roads]), axis=0, return_inverse=True, return_counts=True
    )
    inverse = inverse.ravel()
    median = _weighted_medians(off_deg, 1.0 / (error_deg**2 + HEADING_NOISE_DEG**2), inverse, len(groups))
    sure = counts >= MIN_CORROBORATING_TRACKS
    if sure.sum() < MIN_VEHICLES_FOR_SPREAD:
        return np.ones(len(off_deg))
    spread = max(MIN_HEADING_SPREAD_DEG, 1.4826 * float(np.median(np.abs(median[sure]))))
    weight = 1.0 / (1.0 + (median / (GEMAN_MCCLURE_SCALE * spread)) ** 2) ** 2
    return (weight * np.where(sure, 1.0, SINGLE_TRACK_WEIGHT))[inverse]


def _weighted_medians(values: np.ndarray, weights: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    order = np.lexsort((values, groups))
    sorted_groups, cumulative = groups[order], np.cumsum(weights[order])
    starts = np.searchsorted(sorted_groups, np.arange(count))
    ends = np.searchsorted(sorted_groups, np.arange(count), side='right')
    before = np.concatenate([[0.0], cumulative])[starts]
    half = before + 0.5 * (cumulative[ends - 1] - before)
    middle = np.clip(np.searchsorted(cumulative, half), starts, ends - 1)
    return values[order][middle]
