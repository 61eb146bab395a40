"""Directions of roads: vanishing points as unit vectors by consensus on the sphere; and the published votes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import PaperOptions
from autocalib_ros.geometry.great_circles import TrackSet, fit_circles, orthonormal_basis, rays_of
from autocalib_ros.geometry.small_matrices import LAST, NEXT, cofactors, cross
from autocalib_ros.lens.camera import Camera

HYPOTHESES = 400
PROBES = 200
"""Random directions by which a track's power to tell directions apart is measured."""
INLIER_PX = 2.0
"""A track supports a direction when its great circle through it stays this close, root mean square."""
MIN_ANGLE_DEG = 30.0
"""Two roads that differ by less are one road seen with errors."""
COMPASS = np.array([(np.cos(turn), np.sin(turn)) for turn in np.arange(8) * np.pi / 4])
"""Ways to go from a direction in search of a better one."""


@dataclass(frozen=True)
class Directions:
    """Road directions found by consensus."""

    directions: np.ndarray
    """Unit vectors in the camera frame, shape (n, 3)."""
    labels: np.ndarray
    """Direction of each track, -2 for none, shape (tracks,)."""
    score: float
    """Summed support: how many nats of coincidence the directions explain."""


def distances2_through(matrix: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Mean squared pixel distance of every track (t) from its best circle through every direction (h): (h, t)."""
    return _distances2(_forms(matrix), directions)


def _forms(matrix: np.ndarray) -> np.ndarray:
    """Quadratic forms, shape (2, 6, tracks), of a unit direction in scatter matrices S (tracks, 3, 3).

    Their values are the sum and the product of the eigenvalues that S has in the plane across the direction d:
    trace S - d^T S d, and d^T C d with the cofactors C of S.
    """
    diagonal, rest, minors, mixed = cofactors(matrix)
    return np.stack([np.concatenate([diagonal.sum(axis=0) - diagonal, -rest]), np.concatenate([minors, mixed])])


def _distances2(forms: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Lesser eigenvalue (directions, tracks) across unit directions (directions, 3), from `_forms`."""
    products = np.concatenate([directions**2, 2.0 * directions[:, NEXT] * directions[:, LAST]], axis=1)
    total, product = products @ forms
    root = np.sqrt(np.maximum(total * total - 4.0 * product, 0.0))
    return np.maximum(2.0 * product / np.maximum(total + root, 1e-300), 0.0)


def consensus_directions(camera: Camera, tracks: TrackSet, generator: np.random.Generator,
                         count: int = 2, inlier_px: float = INLIER_PX) -> Directions:
    """Find up to `count` directions, strongest first, that tracks' great circles share.

    A track counts by its surprise: minus the logarithm of the share of random directions that it would
    support. A short track that supports any direction counts for nothing.
    """
    rays = rays_of(camera, tracks.pixels)
    normals, own, matrix = fit_circles(rays, tracks.weights)
    probes = generator.normal(size=(PROBES, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    forms = _forms(matrix)
    chance = _support(forms, probes, inlier_px).mean(axis=0)
    surprise = -np.log(np.clip(chance, 1.0 / PROBES, 1.0)) * np.sqrt(tracks.share_of_vehicle) * (own < inlier_px**2)
    found: list[np.ndarray] = []
    labels = np.full(len(tracks), -2)
    score = 0.0
    left = surprise.copy()
    for label in range(count):
        candidate = _strongest(normals, forms, left, found, generator, inlier_px)
        if candidate is None:
            break
        support = _support(forms, candidate[None], inlier_px)[0]
        score += float((left * support).sum())
        labels[(support > 0) & (left > 0)] = label
        left = np.where(support > 0, 0.0, left)
        found.append(candidate)
    return Directions(np.array(found).reshape(-1, 3), labels, score)


def _support(forms: np.ndarray, directions: np.ndarray, inlier_px: float) -> np.ndarray:
    """Support of every track for every direction (directions, 3), 0 to 1, shape (directions, tracks)."""
    return np.maximum(0.0, 1.0 - _distances2(forms, directions) / inlier_px**2)


def _strongest(normals: np.ndarray, forms: np.ndarray, surprise: np.ndarray, found: list[np.ndarray],
               generator: np.random.Generator, inlier_px: float) -> np.ndarray | None:
    """Return the direction with the most support among intersections of pairs of great circles."""
    total = surprise.sum()
    if np.count_nonzero(surprise) < 3:
        return None
    pairs = generator.choice(len(normals), size=(HYPOTHESES, 2), p=surprise / total)
    candidates = cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    size = np.linalg.norm(candidates, axis=1)
    candidates = candidates[size > 1e-3] / size[size > 1e-3, None]
    for other in found:
        candidates = candidates[np.abs(candidates @ other) < np.cos(np.radians(MIN_ANGLE_DEG))]
    if not len(candidates):
        return None
    forms, surprise = forms[..., surprise > 0], surprise[surprise > 0]
    best = candidates[np.argmax(_support(forms, candidates, inlier_px) @ surprise)]
    return _refined(best, forms, surprise, inlier_px)


def _refined(direction: np.ndarray, forms: np.ndarray, surprise: np.ndarray, inlier_px: float) -> np.ndarray:
    """Climb to the local best by halving steps around the direction."""
    step = np.radians(2.0)
    best = (_support(forms, direction[None], inlier_px) @ surprise)[0]
    ring = COMPASS @ orthonormal_basis(direction)
    while step > np.radians(0.02):
        trials = (direction + step * ring) / np.sqrt(1.0 + step * step)
        support = _support(forms, trials, inlier_px) @ surprise
        strongest = np.argmax(support)
        if support[strongest] > best:
            best, direction = support[strongest], trials[strongest]
            ring = COMPASS @ orthonormal_basis(direction)
        else:
            step /= 2
    return direction


HISTOGRAM_BINS = 180
CELL_DEG = 0.5
"""Side of a voting cell, in angle from the optical axis."""
OUTERMOST_DEG = 89.5
"""A vanishing point at infinity is held at this angle, so that it keeps finite coordinates."""


MAX_VOTERS = 2000
"""Segments of one cluster that vote; more move no maximum."""


@dataclass(frozen=True)
class Orientations:
    """Segments in the undistorted image, by orientation."""

    ends_px: np.ndarray
    """Segments relative to the principal point, shape (n, 2, 2)."""
    orientation_deg: np.ndarray
    """Shape (n,), 0 to 180."""
    histogram: np.ndarray
    """Orientation in degrees and number of segments, shape (180, 2)."""
    peaks_deg: tuple[float, ...]
    """Orientations of the two roads, or fewer where the histogram has no second peak."""


def segment_orientations(camera: Camera, segments_px: np.ndarray, options: PaperOptions) -> Orientations:
    """Run steps 7 and 8 of the paper on segments x0, y0, x1, y1 (n, 4): undistort, histogram of orientation."""
    ends = camera.undistort(segments_px.reshape(-1, 2, 2)) - np.asarray(camera.principal_point_px)
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    step = ends[:, 1] - ends[:, 0]
    orientation = np.degrees(np.arctan2(step[:, 1], step[:, 0])) % 180.0
    counts, edges = np.histogram(orientation, bins=HISTOGRAM_BINS, range=(0.0, 180.0))
    centres = (edges[:-1] + edges[1:]) / 2
    return Orientations(ends, orientation, np.column_stack([centres, counts]),
                        _peaks(centres, counts, options.min_separation_deg))


def voted_points(found: Orientations, focal_px: float, options: PaperOptions) -> np.ndarray:
    """Run step 9 of the paper: vanishing points (peaks, 2) in undistorted pixels about the principal point."""
    points = [_voted_point(found.ends_px[_turn(found.orientation_deg, peak) <= options.cluster_deg], focal_px, options)
              for peak in found.peaks_deg]
    return np.array(points).reshape(-1, 2)


def _turn(first_deg: np.ndarray, second_deg: float) -> np.ndarray:
    """Angle between undirected orientations, 0 to 90 degrees."""
    return np.abs((first_deg - second_deg + 90.0) % 180.0 - 90.0)


def _peaks(centres: np.ndarray, counts: np.ndarray, separation_deg: float) -> tuple[float, ...]:
    """The fullest bin, and the fullest at least `separation_deg` from it."""
    if not counts.any():
        return ()
    first = float(centres[np.argmax(counts)])
    apart = np.where(_turn(centres, first) >= separation_deg, counts, 0)
    return (first, float(centres[np.argmax(apart)])) if apart.any() else (first,)


def _voted_point(ends: np.ndarray, focal_px: float, options: PaperOptions) -> np.ndarray:
    """Let segments (n, 2, 2) vote as infinite lines; return the vanishing point (2,).

    The canvas is the half sphere of viewing directions, by angle from the axis: a line is a great circle on it,
    and a point at infinity has its place on the rim.
    """
    voters = np.linspace(0, len(ends) - 1, min(len(ends), MAX_VOTERS)).astype(int)
    votes = _votes(ends[voters], focal_px)
    half = (votes.shape[0] - 1) / 2
    rows, columns = np.nonzero(votes >= options.vote_share * votes.max())
    weight = votes[rows, columns].astype(float)
    places = np.column_stack([columns - half, rows - half]) * CELL_DEG
    # the rim's two ends of a diameter are one point at infinity: bring all to the side of the strongest
    strongest = places[np.argmax(weight)]
    places = np.where((places @ strongest < 0)[:, None], -places, places)
    mean = weight @ places / weight.sum()
    distance = max(float(np.hypot(*mean)), 1e-9)
    outward = mean / distance
    sigma = np.sqrt(weight @ ((places - mean) @ outward) ** 2 / weight.sum())
    angle = min(distance + options.vote_sigmas * float(sigma), OUTERMOST_DEG)
    return focal_px * np.tan(np.radians(angle)) * outward


def _votes(ends: np.ndarray, focal_px: float) -> np.ndarray:
    """Count the lines of segments (n, 2, 2) that pass each cell of the half sphere, shape (cells, cells)."""
    half = int(round(90.0 / CELL_DEG))
    votes = np.zeros((2 * half + 1, 2 * half + 1), int)
    tail, head = (np.column_stack([ends[:, i], np.full(len(ends), focal_px)]) for i in (0, 1))
    normals = np.cross(tail, head)
    first, second = orthonormal_basis(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))
    around = np.linspace(0.0, np.pi, 4 * half, endpoint=False)[:, None]
    for one, other in zip(first, second, strict=True):
        points = np.cos(around) * one + np.sin(around) * other
        points *= np.where(points[:, 2:] < 0, -1.0, 1.0)
        across = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-12)
        angle = np.degrees(np.arctan2(across, points[:, 2])) / CELL_DEG
        cells = np.round(points[:, :2] * (angle / across)[:, None]).astype(int) + half
        votes.ravel()[np.unique(cells[:, 1] * votes.shape[1] + cells[:, 0])] += 1
    return votes
