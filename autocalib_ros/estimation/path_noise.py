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
from autocalib_ros.estimation.great_circles import Rays, dot

WANDER_LENGTH_M = 10.0
"""Distance over which a driver's sideways wander is forgotten: ways of 25 to 80 m from side to side and back."""
USUAL_HEIGHT_M = 8.0
"""Height of a camera that was not given; it sets nothing but the weight of near against far."""
SEEN_FROM = 0.02
"""Least height of the road's direction below the horizon, radians: farther away all metres are alike."""


@dataclass(frozen=True)
class OnRoad:
    """Where tracks run on the road, as far as that weighs their distances."""

    px_per_m: np.ndarray
    """Pixels across a circle for a metre across its road, shape (tracks, samples)."""
    along_m: np.ndarray
    """Metres along the road, shape (tracks, samples)."""


def on_road(rays: Rays, normals: np.ndarray, directions: np.ndarray, up: np.ndarray, height_m: float) -> OnRoad:
    """Place tracks on the road: circle normals and road directions (tracks, 3), ground normal `up` (3,)."""
    below = np.maximum(-(rays.bearings @ up), SEEN_FROM) / (height_m if height_m > 0 else USUAL_HEIGHT_M)
    across = np.abs(dot(normals, np.cross(directions, up)))[:, None]
    return OnRoad(across * rays.pixel_scale(normals[:, None]) * below, dot(rays.bearings, directions[:, None]) / below)


def whitening(pixels: np.ndarray, mask: np.ndarray, road: OnRoad, options: JointOptions, *,
              drifting: bool) -> np.ndarray:
    """Return W (tracks, samples, samples) with W^T W the inverse covariance of the distances from the circles.

    W is lower triangular. Samples where `mask` (tracks, samples) is false get zero rows and columns.
    """
    steps = np.hypot(*np.moveaxis(np.diff(pixels, axis=1), -1, 0)) * (mask[:, 1:] & mask[:, :-1])
    followed = np.concatenate([np.zeros((len(pixels), 1)), np.cumsum(steps, axis=1)], axis=1)
    apart = (road.along_m[:, :, None] - road.along_m[:, None, :]) / WANDER_LENGTH_M
    count = np.maximum(mask.sum(axis=1, keepdims=True), 1)
    lever = road.along_m - (road.along_m * mask).sum(axis=1, keepdims=True) / count
    wander, heading = options.wander_m * road.px_per_m, np.radians(options.heading_deg) * lever * road.px_per_m
    covariance = np.exp(-0.5 * apart * apart) * wander[:, :, None] * wander[:, None, :]
    if drifting:
        covariance += heading[:, :, None] * heading[:, None, :]
        covariance += options.drift_px**2 * np.minimum(followed[:, :, None], followed[:, None, :])
    covariance *= mask[:, :, None] & mask[:, None, :]
    diagonal = np.arange(mask.shape[1])
    covariance[:, diagonal, diagonal] += np.where(mask, options.noise_px**2, 1.0)
    return np.linalg.inv(np.linalg.cholesky(covariance)) * mask[:, None, :]
