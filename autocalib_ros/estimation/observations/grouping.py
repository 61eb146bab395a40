"""Grouping and balanced selection of observations: connected components, round robin, farthest points."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from autocalib_ros.estimation.observations.track_set import count_earlier


def component_labels(edges: np.ndarray, count: int) -> np.ndarray:
    """Label the connected components of a graph of `count` nodes with edges (2, n), shape (count,)."""
    graph = coo_matrix((np.ones(edges.shape[1], bool), edges), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def group_indices(labels: np.ndarray, min_size: int = 1) -> list[np.ndarray]:
    """Indices of the members of each label (n,) that has at least `min_size`, by ascending label."""
    order = np.argsort(labels, kind='stable')
    bounds = [0, *(np.flatnonzero(np.diff(labels[order])) + 1).tolist(), len(order)]
    return [order[begin:end] for begin, end in pairwise(bounds) if end - begin >= min_size]


def round_robin(groups: np.ndarray, best_first: np.ndarray) -> np.ndarray:
    """Order (n,) that takes groups (n,) in turn, each with its best first; `best_first` (n,) is the order by merit."""
    rank = np.empty(len(groups), int)
    rank[best_first] = count_earlier(groups[best_first])
    return np.argsort(rank, kind='stable')


def farthest_points(indices: np.ndarray, positions: np.ndarray, limit: int) -> np.ndarray:
    """Choose at most `limit` of some positions (n, 2), given by indices, by farthest-point sampling; ascending."""
    if len(indices) <= limit:
        return indices
    chosen = [0]
    distance = np.hypot(*(positions[indices] - positions[indices[0]]).T)
    while len(chosen) < limit:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.hypot(*(positions[indices] - positions[indices[chosen[-1]]]).T))
    return indices[np.sort(chosen)]
