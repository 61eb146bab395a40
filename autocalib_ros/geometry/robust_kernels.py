"""DOCSTRING."""

from __future__ import annotations

import numpy as np

FREEDOM, STUDENT = 4.0, 0.375
"""Of Student's distribution about a peak, and its density in the middle for a scale of one: edges of wheels and lamps
make long tails."""


def student(misses: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Density of each miss by Student's distribution of these scales."""
    apart = 1.0 + (misses / sigmas) ** 2 / FREEDOM
    return STUDENT / sigmas / (apart * apart * np.sqrt(apart))


def robust(misses: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Weight of each miss by Student's distribution."""
    return (FREEDOM + 1.0) / (FREEDOM + (misses / sigmas) ** 2)


def folded(turns_rad: np.ndarray) -> np.ndarray:
    """Bring angles of undirected edges to within a quarter of a turn of 0."""
    return turns_rad - np.pi * np.rint(turns_rad / np.pi)
