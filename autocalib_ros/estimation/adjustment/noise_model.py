"""Noise model of a straight track: covariance of its distances from the great circle, and its whitening.

Four terms: white noise of tracked positions; lateral wander of the driver in the lane, correlated along the road, many
pixels close to the camera and few far away; and, for points tracked from frame to frame, drift as a random walk and a
heading error of the track against its road. Model selection decides whether drift and heading error apply. Whitening
by this covariance weights each track by its information, whatever its distance, length or sampling.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.observations.point_drift import tracked_path_px
from autocalib_ros.geometry.great_circles import Rays
from autocalib_ros.geometry.ground_plane import depression_sine
from autocalib_ros.geometry.small_matrices import cross, dot, inverse_cholesky_factors

WANDER_CORRELATION_LENGTH_M = 10.0
"""Correlation length in metres of the lateral wander in the lane: drivers weave with periods of 25 to 80 m."""
DEFAULT_CAMERA_HEIGHT_M = 8.0
"""Assumed camera height in metres where none is given; it only sets the weight of near against far points."""
MIN_DEPRESSION_NOISE_RAD = 0.02
"""Smallest depression angle in radians in the noise model: beyond 50 camera heights the wander in pixels is constant.
"""


@dataclass(frozen=True)
class RoadPositions:
    """Approximate positions of tracks on the road, for the noise model."""

    px_per_m: np.ndarray
    """Pixels across the circle per metre across the road, shape (tracks, samples)."""
    along_m: np.ndarray
    """Position along the road in metres, shape (tracks, samples)."""


def locate_on_road(
    rays: Rays, normals: np.ndarray, directions: np.ndarray, up: np.ndarray, height_m: float
) -> RoadPositions:
    """Locate tracks on the road from circle normals and road directions (tracks, 3) and the ground normal `up` (3,)."""
    below = depression_sine(rays.bearings, up, MIN_DEPRESSION_NOISE_RAD) / (
        height_m if height_m > 0 else DEFAULT_CAMERA_HEIGHT_M
    )
    across = np.abs(dot(normals, cross(directions, up)))[:, None]
    return RoadPositions(
        across * rays.pixel_scale(normals[:, None]) * below, dot(rays.bearings, directions[:, None]) / below
    )


def whitening_matrices(
    pixels: np.ndarray, mask: np.ndarray, road: RoadPositions, options: JointOptions, *, drifting: bool
) -> np.ndarray:
    """Return lower triangular W (tracks, samples, samples), W^T W = inverse covariance of the circle distances.

    Samples with a false `mask` (tracks, samples) get zero rows and columns. With `drifting`, random-walk drift and
    heading error are part of the covariance.
    """
    mask, along_m, px_per_m = (np.ascontiguousarray(part.T) for part in (mask, road.along_m, road.px_per_m))
    wander = options.wander_m * px_per_m
    covariance = np.exp(-0.5 * ((along_m[:, None] - along_m) / WANDER_CORRELATION_LENGTH_M) ** 2) * (
        wander[:, None] * wander
    )
    if drifting:
        lever = along_m - (along_m * mask).sum(axis=0) / np.maximum(mask.sum(axis=0), 1)
        heading = np.radians(options.heading_deg) * lever * px_per_m
        followed = tracked_path_px(pixels, mask.T).T
        covariance += heading[:, None] * heading + options.drift_px**2 * np.minimum(followed[:, None], followed)
    covariance *= mask[:, None] & mask
    diagonal = np.arange(len(mask))
    covariance[diagonal, diagonal] += np.where(mask, options.noise_px**2, 1.0)
    return np.ascontiguousarray((inverse_cholesky_factors(covariance) * mask).transpose(2, 0, 1))
