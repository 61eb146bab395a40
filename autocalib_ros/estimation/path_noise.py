"""How far a straight drive's image may lie from its great circle: pixels of tracking, and metres of wander.

A driver wanders in the lane by a tenth of a metre, slowly: that is many pixels close to the camera and few far
away, and neighbouring points share it. Residuals are whitened by that covariance, so that each track weighs by
what it tells, near or far, sampled densely or not.
"""

from __future__ import annotations

import numpy as np

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.great_circles import Rays, dot

WANDER_LENGTH_M = 10.0
"""Distance over which a driver's sideways wander is forgotten: ways of 25 to 80 m from side to side and back."""
USUAL_HEIGHT_M = 8.0
"""Height of a camera that was not given; it sets nothing but the weight of near against far."""
SEEN_FROM = 0.02
"""Least height of the road's direction below the horizon, radians: farther away all metres are alike."""


def whitening(rays: Rays, mask: np.ndarray, normals: np.ndarray, directions: np.ndarray, up: np.ndarray,
              height_m: float, options: JointOptions) -> np.ndarray:
    """Return W (tracks, samples, samples) with W^T W the inverse covariance of the distances from the circles.

    `normals` (tracks, 3) are the circles', `directions` (tracks, 3) the roads', `up` (3,) the ground normal. Samples
    where `mask` (tracks, samples) is false get zero rows and columns.
    """
    height = height_m if height_m > 0 else USUAL_HEIGHT_M
    below = np.maximum(-(rays.bearings @ up), SEEN_FROM) / height
    across = np.cross(directions, up)
    px_per_m = np.abs(dot(normals, across))[:, None] * rays.pixel_scale(normals[:, None]) * below
    along_m = dot(rays.bearings, directions[:, None]) / below
    apart = (along_m[:, :, None] - along_m[:, None, :]) / WANDER_LENGTH_M
    wander = options.wander_m * np.where(mask, px_per_m, 0.0)
    covariance = np.exp(-0.5 * apart * apart) * wander[:, :, None] * wander[:, None, :]
    diagonal = np.arange(mask.shape[1])
    covariance[:, diagonal, diagonal] += np.where(mask, options.noise_px**2, 1.0)
    return np.linalg.inv(np.linalg.cholesky(covariance)) * mask[:, None, :]
