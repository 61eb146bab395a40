"""Straight paths as great circles: the geometry that every estimator shares.

A straight path in space, seen by any central camera, lies on a plane through the camera: its bearings
lie on a great circle with a unit normal n, past 90 degrees too. Residuals are measured in observed
pixels: the distance n.b of a bearing from the circle over the length of its gradient with respect to the
pixel. A residual that shrinks with the parameters, in the undistorted plane say, would favour wrong ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.camera import Camera
from autocalib_ros.evidence import Evidence

SAMPLES = 10
"""Points of a track that enter a fit; more of one path add correlated noise, not information."""
MIN_LENGTH = 0.04
"""Shortest displacement of a track that says something of the lens, share of the image diagonal."""
MAX_PATH_RATIO = 1.3
"""Largest path length / displacement of a track that may be straight, lens curvature and noise included."""
CELLS = (8, 5)


@dataclass(frozen=True)
class TrackSet:
    """Tracks in arrays of equal length; `weights` is 0 where a track has no point and sums to 1 per track."""

    pixels: np.ndarray
    """Shape (tracks, SAMPLES, 2)."""
    weights: np.ndarray
    """Shape (tracks, SAMPLES)."""
    vehicles: np.ndarray
    """Shape (tracks,)."""
    sample_times_s: np.ndarray
    """Time of each point, shape (tracks, SAMPLES)."""
    indices: np.ndarray
    """Index of each track in the evidence, shape (tracks,)."""

    def __len__(self) -> int:
        return len(self.vehicles)

    def subset(self, keep: np.ndarray) -> TrackSet:
        """Return the tracks that `keep`, a mask or indices, selects."""
        return TrackSet(self.pixels[keep], self.weights[keep], self.vehicles[keep], self.sample_times_s[keep],
                        self.indices[keep])

    @property
    def times_s(self) -> np.ndarray:
        """Mean time of each track, shape (tracks,)."""
        return self.sample_times_s.mean(axis=1)

    @property
    def share_of_vehicle(self) -> np.ndarray:
        """One over the number of tracks of the same vehicle, shape (tracks,)."""
        return 1.0 / self._of_same_vehicle()

    def independence(self, correlation: float) -> np.ndarray:
        """Weight (tracks,) of tracks whose errors correlate so much, 0 to 1, within a vehicle: Kish's design effect."""
        return 1.0 / (1.0 + (self._of_same_vehicle() - 1.0) * correlation)

    def _of_same_vehicle(self) -> np.ndarray:
        _, inverse, counts = np.unique(self.vehicles, return_inverse=True, return_counts=True)
        return counts[inverse].astype(float)


def select_tracks(evidence: Evidence, limit: int) -> TrackSet:
    """Choose tracks long enough to matter, at most `limit`, spread over image cells, headings and vehicles."""
    least = MIN_LENGTH * np.hypot(*evidence.image_size)
    candidates = []
    for index, track in enumerate(evidence.tracks()):
        points = track.points_px
        displacement = np.hypot(*(points[-1] - points[0]))
        path = np.hypot(*np.diff(points, axis=0).T).sum()
        if displacement >= least and path <= MAX_PATH_RATIO * displacement:
            candidates.append((index, displacement, points))
    return _track_set(evidence, _spread(candidates, evidence, limit))


def _spread(candidates: list[tuple[int, float, np.ndarray]], evidence: Evidence, limit: int) -> list[int]:
    """Rank each candidate within its cell and heading, longest first, vehicles in turn; take the best ranks."""
    seen_in_bucket: dict[tuple[int, int, int], int] = {}
    seen_of_vehicle: dict[tuple[int, int], int] = {}
    ranked = []
    for index, displacement, points in sorted(candidates, key=lambda item: -item[1]):
        vehicle = int(evidence.track_vehicles[index])
        column, row = np.floor(points[len(points) // 2] / evidence.image_size * CELLS).astype(int)
        heading = int(np.arctan2(*(points[-1] - points[0])[::-1]) // (np.pi / 4))
        bucket, family = (int(column), int(row), heading), (vehicle, int(column) + CELLS[0] * int(row))
        rank = seen_in_bucket.get(bucket, 0) + 4 * seen_of_vehicle.get(family, 0)
        seen_in_bucket[bucket] = seen_in_bucket.get(bucket, 0) + 1
        seen_of_vehicle[family] = seen_of_vehicle.get(family, 0) + 1
        ranked.append((rank, -displacement, index))
    return sorted(index for _, _, index in sorted(ranked)[:limit])


def _track_set(evidence: Evidence, indices: list[int]) -> TrackSet:
    pixels, weights = np.zeros((len(indices), SAMPLES, 2)), np.zeros((len(indices), SAMPLES))
    times = np.zeros((len(indices), SAMPLES))
    for row, index in enumerate(indices):
        track = evidence.track(index)
        chosen = np.round(np.linspace(0, len(track.times_s) - 1, SAMPLES)).astype(int)
        first = np.concatenate([[True], np.diff(chosen) > 0])
        pixels[row], weights[row], times[row] = track.points_px[chosen], first / first.sum(), track.times_s[chosen]
    return TrackSet(pixels, weights, evidence.track_vehicles[indices].astype(int), times, np.array(indices, int))


@dataclass(frozen=True)
class Rays:
    """Bearings of pixels with the directions in which a pixel moves them."""

    bearings: np.ndarray
    """Unit vectors, shape (..., 3)."""
    radial: np.ndarray
    """Change of the bearing for one pixel outwards, shape (..., 3)."""
    tangential: np.ndarray
    """Change of the bearing for one pixel around the principal point, shape (..., 3)."""

    def pixel_scale(self, normals: np.ndarray) -> np.ndarray:
        """Pixels per unit of n.b for circle normals (..., 3) that broadcast against the bearings."""
        gradient = np.hypot(dot(self.radial, normals), dot(self.tangential, normals))
        return 1.0 / np.maximum(gradient, 1e-9)

    def distance_px(self, normals: np.ndarray) -> np.ndarray:
        """Signed distance in observed pixels of each bearing from the great circle of its normal."""
        return dot(self.bearings, normals) * self.pixel_scale(normals)


def dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Scalar products of vectors (..., 3) that broadcast against each other, shape (...)."""
    return np.einsum('...i,...i->...', first, second)


def rays_of(camera: Camera, pixels: np.ndarray) -> Rays:
    """Unproject pixels (..., 2); where the lens model does not reach, the last bearing that it reaches."""
    offset = pixels - np.asarray(camera.principal_point_px)
    radius = np.maximum(np.hypot(offset[..., 0], offset[..., 1]), 1e-9)
    theta, _ = camera.angle(radius)
    sine, cosine = np.sin(theta), np.cos(theta)
    x, y = offset[..., 0] / radius, offset[..., 1] / radius
    outward = 1.0 / np.maximum(camera.radius_slope(theta), 1e-3 * camera.focal_px)
    around = sine / radius
    rays = Rays(*(np.empty((*radius.shape, 3)) for _ in range(3)))
    rays.bearings[..., 0], rays.bearings[..., 1], rays.bearings[..., 2] = sine * x, sine * y, cosine
    along = cosine * outward
    rays.radial[..., 0], rays.radial[..., 1], rays.radial[..., 2] = along * x, along * y, -sine * outward
    rays.tangential[..., 0], rays.tangential[..., 1], rays.tangential[..., 2] = -y * around, x * around, 0.0
    return rays


def scatter(rays: Rays, weights: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Sum w s^2 b b^T per track, shape (tracks, 3, 3): n^T S n is the mean squared distance in pixels."""
    weighted = rays.bearings * (weights * scale * scale)[..., None]
    return weighted.transpose(0, 2, 1) @ rays.bearings


def fit_circles(rays: Rays, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit a great circle to each track.

    Returns the normals (tracks, 3), the mean squared distances in px^2 (tracks,) and the scatter (tracks, 3, 3).
    """
    scale = np.ones(weights.shape)
    for _ in range(2):
        _, vectors = np.linalg.eigh(scatter(rays, weights, scale))
        normals = vectors[:, :, 0]
        scale = rays.pixel_scale(normals[:, None])
    matrix = scatter(rays, weights, scale)
    values, vectors = np.linalg.eigh(matrix)
    return vectors[:, :, 0], np.maximum(values[:, 0], 0.0), matrix


def orthonormal_basis(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors (..., 3) that span the plane perpendicular to unit vectors (..., 3)."""
    helper = np.eye(3)[np.argmin(np.abs(directions), axis=-1)]
    first = np.cross(directions, helper)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, np.cross(directions, first)


def fit_circles_through(matrix: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit to each track's scatter (tracks, 3, 3) the great circle through its direction (tracks, 3).

    Returns normals (tracks, 3) and mean squared distances in px^2 (tracks,): a 2x2 eigenproblem each.
    """
    first, second = orthonormal_basis(directions)
    a = np.einsum('ti,tij,tj->t', first, matrix, first)
    b = np.einsum('ti,tij,tj->t', first, matrix, second)
    c = np.einsum('ti,tij,tj->t', second, matrix, second)
    angle = 0.5 * np.arctan2(2 * b, a - c) + np.pi / 2
    cosine, sine = np.cos(angle), np.sin(angle)
    normals = first * cosine[:, None] + second * sine[:, None]
    return normals, np.maximum(a * cosine**2 + 2 * b * cosine * sine + c * sine**2, 0.0)
