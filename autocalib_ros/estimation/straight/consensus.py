"""Road directions by RANSAC on the sphere: vanishing points as unit vectors, shared by great circles of tracks."""

from __future__ import annotations

import numpy as np

from autocalib_ros.estimation.adjustment.parameters import RoadDirections
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.geometry.great_circles import (
    fit_circles,
    orthonormal_basis,
    quadratic_forms,
    squared_distances,
    unproject_rays,
)
from autocalib_ros.geometry.small_matrices import cross
from autocalib_ros.lens.camera import Camera

RANSAC_HYPOTHESES = 400
"""Pairs of tracks whose great circles are intersected, for each direction."""
RANDOM_DIRECTIONS = 200
"""Random directions that estimate the probability that a track supports a direction by chance."""
CONSENSUS_INLIER_PX = 2.0
"""Root mean square distance in pixels from the best circle through a direction within which a track supports it."""
MIN_HYPOTHESIS_SEPARATION_DEG = 30.0
"""Smallest angle between two directions of one consensus: closer ones are one road with errors. Judgement."""
SEARCH_OFFSETS = np.array([(np.cos(turn), np.sin(turn)) for turn in np.arange(8) * np.pi / 4])
"""Eight unit offsets in the tangent plane for the local search."""


def consensus_directions(
    camera: Camera,
    tracks: TrackSet,
    generator: np.random.Generator,
    count: int = 2,
    inlier_px: float = CONSENSUS_INLIER_PX,
) -> RoadDirections:
    """Find up to `count` directions, strongest first, shared by the great circles of tracks.

    Support of a track is weighted by its information in nats: minus the log of the fraction of random directions that
    it supports. A short track that supports any direction has weight 0.
    """
    rays = unproject_rays(camera, tracks.pixels)
    normals, own, matrix = fit_circles(rays, tracks.weights)
    probes = generator.normal(size=(RANDOM_DIRECTIONS, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    forms = quadratic_forms(matrix)
    chance = _support(forms, probes, inlier_px).mean(axis=0)
    nats = (
        -np.log(np.clip(chance, 1.0 / RANDOM_DIRECTIONS, 1.0)) * np.sqrt(tracks.vehicle_weight) * (own < inlier_px**2)
    )
    found: list[np.ndarray] = []
    labels = np.full(len(tracks), -2)
    score = 0.0
    left = nats.copy()
    for label in range(count):
        candidate = _strongest(normals, forms, left, found, generator, inlier_px)
        if candidate is None:
            break
        support = _support(forms, candidate[None], inlier_px)[0]
        score += float((left * support).sum())
        labels[(support > 0) & (left > 0)] = label
        left = np.where(support > 0, 0.0, left)
        found.append(candidate)
    return RoadDirections(np.array(found).reshape(-1, 3), labels, score)


def _support(forms: np.ndarray, directions: np.ndarray, inlier_px: float) -> np.ndarray:
    """Return the support, 0 to 1, of every track for every direction (directions, 3), shape (directions, tracks)."""
    return np.maximum(0.0, 1.0 - squared_distances(forms, directions) / inlier_px**2)


def _strongest(
    normals: np.ndarray,
    forms: np.ndarray,
    nats: np.ndarray,
    found: list[np.ndarray],
    generator: np.random.Generator,
    inlier_px: float,
) -> np.ndarray | None:
    """Return the direction (3,) with the most support among intersections of pairs of great circles.

    Pairs are drawn with probability proportional to `nats`; directions close to those `found` are excluded.
    """
    total = nats.sum()
    if np.count_nonzero(nats) < 3:
        return None
    pairs = generator.choice(len(normals), size=(RANSAC_HYPOTHESES, 2), p=nats / total)
    candidates = cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    size = np.linalg.norm(candidates, axis=1)
    candidates = candidates[size > 1e-3] / size[size > 1e-3, None]
    for other in found:
        candidates = candidates[np.abs(candidates @ other) < np.cos(np.radians(MIN_HYPOTHESIS_SEPARATION_DEG))]
    if not len(candidates):
        return None
    forms, nats = forms[..., nats > 0], nats[nats > 0]
    best = candidates[np.argmax(_support(forms, candidates, inlier_px) @ nats)]
    return _local_search(best, forms, nats, inlier_px)


def _local_search(direction: np.ndarray, forms: np.ndarray, nats: np.ndarray, inlier_px: float) -> np.ndarray:
    """Maximise the support by pattern search: eight neighbours, step halved from 2 to 0.02 degrees."""
    step = np.radians(2.0)
    best = (_support(forms, direction[None], inlier_px) @ nats)[0]
    ring = SEARCH_OFFSETS @ orthonormal_basis(direction)
    while step > np.radians(0.02):
        trials = (direction + step * ring) / np.sqrt(1.0 + step * step)
        support = _support(forms, trials, inlier_px) @ nats
        strongest = np.argmax(support)
        if support[strongest] > best:
            best, direction = support[strongest], trials[strongest]
            ring = SEARCH_OFFSETS @ orthonormal_basis(direction)
        else:
            step /= 2
    return direction
