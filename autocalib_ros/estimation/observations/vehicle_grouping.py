"""Group tracks into vehicles on the ground, and weight them by how well each vehicle follows its road.

A tracked point drifts, so a single track hardly tells a straight path from a slight turn; the tracks of one vehicle
together do. Grouping is done on the ground, where vehicles have a size in metres.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from autocalib_ros.estimation.observations.grouping import component_labels
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.geometry.robust_kernels import MAD_TO_SIGMA, geman_mcclure_weight

MAX_NEIGHBOUR_M = 4.0
"""Largest distance between neighbouring points of one body: the length of a car."""
MAX_PATH_DIFFERENCE, MAX_PATH_DIFFERENCE_M = 0.3, 0.2
"""Displacements of points of one body differ by less than this fraction plus this many metres: points higher up seem to
move farther. Judgement."""
MIN_OVERLAP_S = 0.4
"""Time for which two tracks must be seen together to compare their motion."""
TRACKS_PER_BLOCK = 64
"""Tracks compared with all others at once, to bound the memory."""
MIN_CORROBORATING_TRACKS = 3
"""Tracks of a vehicle that corroborate each other; fewer say little about it. Judgement."""
SINGLE_TRACK_WEIGHT = 0.25
"""Weight of a track that is not corroborated. Judgement."""
MIN_HEADING_SPREAD_DEG = 0.15
"""Smallest spread of headings: lanes are no straighter than that."""
HEADING_NOISE_DEG = 0.3
"""Standard deviation of the heading of a single short track, from drift of its point on the body."""
GEMAN_MCCLURE_SCALE = 2.0
"""Spreads at which the heading error of a vehicle leaves it a quarter of its weight (Geman-McClure). Judgement."""
RIDGE = 1e-9
"""Regularisation, as a fraction of the trace, of matrices that are singular for points at one place."""
MIN_VEHICLES_FOR_SPREAD = 10
"""Corroborated vehicles needed to estimate the spread of headings; with fewer all weights are 1. Judgement."""


def group_into_bodies(tracks: TrackSet, ground_m: np.ndarray) -> np.ndarray:
    """Number the bodies that tracks belong to, shape (tracks,).

    `ground_m` (tracks, samples, 2) are positions on the road. Two tracks are of one body if they are near each other
    at the first and at the last time at which both are seen, and moved alike in between.
    """
    times = tracks.sample_times_s
    edges = np.zeros((2, 0), int)
    for ones, others in _overlapping_pairs(times[:, 0], times[:, -1]):
        until = np.minimum(times[ones, -1], times[others, -1])
        begin_one, begin_other = _interpolate(times, ground_m, ones, times[others, 0]), ground_m[others, 0]
        end_one, end_other = (_interpolate(times, ground_m, rows, until) for rows in (ones, others))
        moved_one, moved_other = end_one - begin_one, end_other - begin_other
        length = np.maximum(np.hypot(*moved_one.T), np.hypot(*moved_other.T))
        alike = (
            (np.hypot(*(begin_other - begin_one).T) < MAX_NEIGHBOUR_M)
            & (np.hypot(*(end_other - end_one).T) < MAX_NEIGHBOUR_M)
            & (np.hypot(*(moved_other - moved_one).T) < MAX_PATH_DIFFERENCE * length + MAX_PATH_DIFFERENCE_M)
        )
        edges = np.hstack([edges, [ones[alike], others[alike]]])
    return component_labels(edges, len(tracks))


def _overlapping_pairs(first: np.ndarray, last: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield all pairs of tracks that overlap, seen from `first` to `last` (tracks,): one (n,) and a later one (n,).

    In blocks of a few tracks: all pairs would not fit into memory in dense traffic.
    """
    order = np.argsort(first, kind='stable')
    positions = np.arange(len(order))
    ends = np.searchsorted(first[order], last[order] - MIN_OVERLAP_S, side='right')
    for begin in range(0, len(order), TRACKS_PER_BLOCK):
        block = positions[begin : begin + TRACKS_PER_BLOCK]
        ones, others = np.nonzero((positions > block[:, None]) & (positions < ends[block, None]))
        ones, others = order[block[ones]], order[others]
        long = np.minimum(last[ones], last[others]) - first[others] >= MIN_OVERLAP_S
        yield ones[long], others[long]


def _interpolate(times: np.ndarray, positions: np.ndarray, rows: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Interpolate rows (n,) of places (tracks, samples, 2) at times (tracks, samples) to `when` (n,): (n, 2)."""
    after = np.clip((times[rows] <= when[:, None]).sum(axis=1), 1, times.shape[1] - 1)
    t0, t1 = times[rows, after - 1], times[rows, after]
    fraction = np.clip((when - t0) / np.maximum(t1 - t0, 1e-9), 0.0, 1.0)[:, None]
    return positions[rows, after - 1] * (1 - fraction) + positions[rows, after] * fraction


def heading_error_deg(
    distance_px: np.ndarray, px_per_m: np.ndarray, along_m: np.ndarray, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Heading of each track relative to its road, and its error for a pixel of noise, both in degrees, (tracks,).

    The linear term of a parabola fitted to the distances (tracks, samples) from the road direction.
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
    """Weight (tracks,) by how well the vehicle of each track keeps to its road, all tracks on it together."""
    groups, inverse, counts = np.unique(
        np.column_stack([vehicles, roads]), axis=0, return_inverse=True, return_counts=True
    )
    inverse = inverse.ravel()
    median = _weighted_medians(off_deg, 1.0 / (error_deg**2 + HEADING_NOISE_DEG**2), inverse, len(groups))
    corroborated = counts >= MIN_CORROBORATING_TRACKS
    if corroborated.sum() < MIN_VEHICLES_FOR_SPREAD:
        return np.ones(len(off_deg))
    spread = max(MIN_HEADING_SPREAD_DEG, MAD_TO_SIGMA * float(np.median(np.abs(median[corroborated]))))
    weight = geman_mcclure_weight((median / (GEMAN_MCCLURE_SCALE * spread)) ** 2, 1.0)
    return (weight * np.where(corroborated, 1.0, SINGLE_TRACK_WEIGHT))[inverse]


def _weighted_medians(values: np.ndarray, weights: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    """Weighted median of the values (n,) of each group, shape (count,)."""
    order = np.lexsort((values, groups))
    sorted_groups, cumulative = groups[order], np.cumsum(weights[order])
    starts = np.searchsorted(sorted_groups, np.arange(count))
    ends = np.searchsorted(sorted_groups, np.arange(count), side='right')
    before = np.concatenate([[0.0], cumulative])[starts]
    half = before + 0.5 * (cumulative[ends - 1] - before)
    middle = np.clip(np.searchsorted(cumulative, half), starts, ends - 1)
    return values[order][middle]
