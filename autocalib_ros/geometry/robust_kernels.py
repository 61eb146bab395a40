"""DOCSTRING."""

from __future__ import annotations

import numpy as np

STUDENT_FREEDOM, STUDENT_PEAK_DENSITY = 4.0, 0.375
"""Of Student's distribution about a peak, and its density in the middle for a scale of one: edges of wheels and lamps
make long tails."""


def student_density(residuals: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Density of each miss by Student's distribution of these scales."""
    apart = 1.0 + (residuals / sigmas) ** 2 / STUDENT_FREEDOM
    return STUDENT_PEAK_DENSITY / sigmas / (apart * apart * np.sqrt(apart))


def student_weight(residuals: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Weight of each miss by Student's distribution."""
    return (STUDENT_FREEDOM + 1.0) / (STUDENT_FREEDOM + (residuals / sigmas) ** 2)


def wrap_undirected(turns_rad: np.ndarray) -> np.ndarray:
    """Bring angles of undirected edges to within a quarter of a turn of 0."""
    return turns_rad - np.pi * np.rint(turns_rad / np.pi)
