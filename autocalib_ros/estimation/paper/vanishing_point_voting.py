"""Vanishing points by orientation histogram and voting: steps 7 to 9 of Jain & Saunier (arXiv 2001.07243)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import PaperOptions
from autocalib_ros.geometry.great_circles import orthonormal_basis
from autocalib_ros.lens.camera import Camera

HISTOGRAM_BINS = 180
"""Bins of the orientation histogram, one degree each."""
VOTE_CELL_DEG = 0.5
"""Side of a voting cell in degrees from the optical axis."""
MAX_VANISHING_ANGLE_DEG = 89.5
"""Largest angle of a vanishing point from the optical axis: keeps points at infinity at finite coordinates."""
MAX_VOTING_SEGMENTS = 2000
"""Segments of one cluster that vote; more do not move the maximum."""


@dataclass(frozen=True)
class SegmentOrientations:
    """Segments in the undistorted image and their orientations."""

    ends_px: np.ndarray
    """End points relative to the principal point, in pixel heights, shape (n, 2, 2)."""
    orientation_deg: np.ndarray
    """0 to 180, shape (n,)."""
    histogram: np.ndarray
    """Orientation in degrees and number of segments, shape (HISTOGRAM_BINS, 2)."""
    peaks_deg: tuple[float, ...]
    """Orientations of the two roads; fewer where the histogram has no second peak."""


def segment_orientations(camera: Camera, segments_px: np.ndarray, options: PaperOptions) -> SegmentOrientations:
    """Undistort segments x0, y0, x1, y1 (n, 4) and compute their orientation histogram: steps 7 and 8 of the paper."""
    ends = camera.offsets(camera.undistort(segments_px.reshape(-1, 2, 2)))
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    step = ends[:, 1] - ends[:, 0]
    orientation = np.degrees(np.arctan2(step[:, 1], step[:, 0])) % 180.0
    counts, edges = np.histogram(orientation, bins=HISTOGRAM_BINS, range=(0.0, 180.0))
    centres = (edges[:-1] + edges[1:]) / 2
    return SegmentOrientations(
        ends, orientation, np.column_stack([centres, counts]), _peaks(centres, counts, options.min_separation_deg)
    )


def vote_vanishing_points(found: SegmentOrientations, focal_px: float, options: PaperOptions) -> np.ndarray:
    """Vote for the vanishing point of each peak: step 9 of the paper.

    Returns undistorted pixels relative to the principal point, shape (peaks, 2).
    """
    points = [
        _vote_vanishing_point(
            found.ends_px[_orientation_difference(found.orientation_deg, peak) <= options.cluster_deg],
            focal_px,
            options,
        )
        for peak in found.peaks_deg
    ]
    return np.array(points).reshape(-1, 2)


def _orientation_difference(first_deg: np.ndarray, second_deg: float) -> np.ndarray:
    """Return the angle between undirected orientations, 0 to 90 degrees."""
    return np.abs((first_deg - second_deg + 90.0) % 180.0 - 90.0)


def _peaks(centres: np.ndarray, counts: np.ndarray, separation_deg: float) -> tuple[float, ...]:
    """Return the centre of the fullest bin, and of the fullest one at least `separation_deg` from it."""
    if not counts.any():
        return ()
    first = float(centres[np.argmax(counts)])
    separated = np.where(_orientation_difference(centres, first) >= separation_deg, counts, 0)
    return (first, float(centres[np.argmax(separated)])) if separated.any() else (first,)


def _vote_vanishing_point(ends: np.ndarray, focal_px: float, options: PaperOptions) -> np.ndarray:
    """Vote with segments (n, 2, 2) as infinite lines and return the vanishing point (2,).

    The accumulator is the half sphere of viewing directions in equidistant projection: a line is a great circle, and a
    point at infinity is on the rim.
    """
    chosen = np.linspace(0, len(ends) - 1, min(len(ends), MAX_VOTING_SEGMENTS)).astype(int)
    votes = _vote_histogram(ends[chosen], focal_px)
    half = (votes.shape[0] - 1) / 2
    rows, columns = np.nonzero(votes >= options.vote_share * votes.max())
    weight = votes[rows, columns].astype(float)
    cells = np.column_stack([columns - half, rows - half]) * VOTE_CELL_DEG
    # opposite points of the rim are one point at infinity: bring all cells to the side of the strongest
    strongest = cells[np.argmax(weight)]
    cells = np.where((cells @ strongest < 0)[:, None], -cells, cells)
    mean = weight @ cells / weight.sum()
    distance = max(float(np.hypot(*mean)), 1e-9)
    outward = mean / distance
    sigma = np.sqrt(weight @ ((cells - mean) @ outward) ** 2 / weight.sum())
    angle = min(distance + options.vote_sigmas * float(sigma), MAX_VANISHING_ANGLE_DEG)
    return focal_px * np.tan(np.radians(angle)) * outward


def _vote_histogram(ends: np.ndarray, focal_px: float) -> np.ndarray:
    """Count the lines of segments (n, 2, 2) through each cell of the half sphere, shape (cells, cells)."""
    half = round(90.0 / VOTE_CELL_DEG)
    votes = np.zeros((2 * half + 1, 2 * half + 1), int)
    tail, head = (np.column_stack([ends[:, i], np.full(len(ends), focal_px)]) for i in (0, 1))
    normals = np.cross(tail, head)
    first, second = orthonormal_basis(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))
    around = np.linspace(0.0, np.pi, 4 * half, endpoint=False)[:, None]
    for one, other in zip(first, second, strict=True):
        points = np.cos(around) * one + np.sin(around) * other
        points *= np.where(points[:, 2:] < 0, -1.0, 1.0)
        across = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-12)
        angle = np.degrees(np.arctan2(across, points[:, 2])) / VOTE_CELL_DEG
        cells = np.round(points[:, :2] * (angle / across)[:, None]).astype(int) + half
        votes.ravel()[np.unique(cells[:, 1] * votes.shape[1] + cells[:, 0])] += 1
    return votes
