"""Drift of tracked points: a random walk along the path over which a point has been tracked."""

from __future__ import annotations

import numpy as np


def tracked_path_px(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Path length up to each sample, shape (..., samples), of pixels (..., samples, 2) where `mask` is true."""
    steps = np.hypot(*np.moveaxis(np.diff(pixels, axis=-2), -1, 0)) * (mask[..., 1:] & mask[..., :-1])
    return np.concatenate([np.zeros((*steps.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)


def drift_covariance(path_px: np.ndarray, drift_px: float) -> np.ndarray:
    """Covariance (..., samples, samples) of a random walk with `drift_px` standard deviation after a path of 1 px."""
    return drift_px**2 * np.minimum(path_px[..., :, None], path_px[..., None, :])
