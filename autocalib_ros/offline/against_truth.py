"""How far a result is from the truth: distances on the road and angles."""

from __future__ import annotations

import numpy as np

LEAST_DISTANCE_M = 2.0
"""Shorter distances on the road are not compared: their relative error says little."""


def distances_error(true_m: np.ndarray, found_m: np.ndarray) -> float:
    """Median relative error of the distances between points (n, 2) on the road; nan where all are too short."""
    first, second = np.triu_indices(len(true_m), 1)
    true_lengths = np.hypot(*(true_m[first] - true_m[second]).T)
    lengths = np.hypot(*(found_m[first] - found_m[second]).T)
    far_apart = true_lengths > LEAST_DISTANCE_M
    if not far_apart.any():
        return float('nan')
    # a point that ends up above the horizon is as wrong as can be, and must not drop out of the median
    errors = np.where(np.isfinite(lengths), np.abs(lengths / np.maximum(true_lengths, 1e-9) - 1), np.inf)
    return float(np.median(errors[far_apart]))


def angles_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles in degrees between vectors (..., 3)."""
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.degrees(np.arctan2(across, (first * second).sum(axis=-1)))
