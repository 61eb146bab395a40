"""How far a straight drive's image may lie from its great circle: tracking, drift, wander and heading.

A tracked position has noise of its own, and a driver wanders in the lane, slowly: many pixels close to the camera
and few far away. Where points are followed from picture to picture each step may add a little more, a random walk,
and a track's heading is then off its road's; the residuals themselves tell whether they do. Residuals are whitened
by that covariance, so that each track weighs by what it tells, near or far, long or short, sampled densely or not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import JointOptions
from autocalib_ros.geometry.great_circles import Rays
from autocalib_ros.geometry.small_matrices import cross, dot, inverse_cholesky_factors

WANDER_CORRELATION_LENGTH_M = 10.0
"""Distance over which a driver's sideways wander is forgotten: ways of 25 to 80 m from side to side and back."""
DEFAULT_CAMERA_HEIGHT_M = 8.0
"""Height of a camera that was not given; it sets nothing but the weight of near against far."""
MIN_DEPRESSION_NOISE_RAD = 0.02
"""Least height of the road's direction below the horizon, radians: farther away all metres are alike."""


@dataclass(frozen=True)
class RoadPositions:
    """Where tracks run on the road, as far as that weighs their distances."""

    px_per_m: np.ndarray
    """Pixels across a circle for a metre across its road, shape (tracks, samples)."""
    along_m: np.ndarray
    """Metres along the road, shape (tracks, samples)."""


def locate_on_road(
    rays: Rays, normals: np.ndarray, directions: np.ndarray, up: np.ndarray, height_m: float
) -> RoadPositions:
    """Place tracks on the road: circle normals and road directions (tracks, 3), ground normal `up` (3,)."""
    below = np.maximum(-(rays.bearings @ up), MIN_DEPRESSION_NOISE_RAD) / (
        height_m if height_m > 0 else DEFAULT_CAMERA_HEIGHT_M
    )
    across = np.abs(dot(normals, cross(directions, up)))[:, None]
    return RoadPositions(
        across * rays.pixel_scale(normals[:, None]) * below, dot(rays.bearings, directions[:, None]) / below
    )


def whitening_matrices(
    pixels: np.ndarray, mask: np.ndarray, road: RoadPositions, options: JointOptions, *, drifting: bool
) -> np.ndarray:
    """Return W (tracks, samples, samples) with W^T W the inverse covariance of the distances from the circles.

    W is lower triangular. Samples where `mask` (tracks, samples) is false get zero rows and columns.
    """
    mask, along_m, px_per_m = (np.ascontiguousarray(part.T) for part in (mask, road.along_m, road.px_per_m))
    wander = options.wander_m * px_per_m
    covariance = np.exp(-0.5 * ((along_m[:, None] - along_m) / WANDER_CORRELATION_LENGTH_M) ** 2) * (
        wander[:, None] * wander
    )
    if drifting:
        lever = along_m - (along_m * mask).sum(axis=0) / np.maximum(mask.sum(axis=0), 1)
        heading = np.radians(options.heading_deg) * lever * px_per_m
        followed = _tracked_distance_px(pixels, mask)
        covariance += heading[:, None] * heading + options.drift_px**2 * np.minimum(followed[:, None], followed)
    covariance *= mask[:, None] & mask
    diagonal = np.arange(len(mask))
    covariance[diagonal, diagonal] += np.where(mask, options.noise_px**2, 1.0)
    return np.ascontiguousarray((inverse_cholesky_factors(covariance) * mask).transpose(2, 0, 1))


def _tracked_distance_px(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Way in pixels that tracks (tracks, samples, 2) have been followed up to each sample, shape (samples, tracks)."""
    steps = np.hypot(*np.diff(pixels, axis=1).T) * (mask[1:] & mask[:-1])
    return np.concatenate([np.zeros((1, len(pixels))), np.cumsum(steps, axis=0)])
