"""Robust kernels (M-estimators): weight, loss and density, one group of functions a kernel; undirected angles.

Geman-McClure bounds the loss and rejects outliers; Student's t keeps heavy tails.
"""

from __future__ import annotations

import numpy as np

MAD_TO_SIGMA = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""
STUDENT_FREEDOM, STUDENT_PEAK_DENSITY = 4.0, 0.375
"""Degrees of freedom of Student's t distribution, and its density at 0 for unit scale: edges of wheels and lamps make
long tails."""


def geman_mcclure_weight(squared: np.ndarray, limit: np.ndarray | float) -> np.ndarray:
    """Return the weight of squared residuals: 1 at 0, a quarter at `limit`; derivative of `geman_mcclure_loss`.

    Redescending kernel of Geman & McClure (1985); both arguments broadcast.
    """
    return 1.0 / (1.0 + squared / limit) ** 2


def geman_mcclure_loss(squared: np.ndarray, limit: np.ndarray | float) -> np.ndarray:
    """Return the loss of finite squared residuals; it approaches `limit`."""
    return squared / (1.0 + squared / limit)


def geman_mcclure_bounded_loss(squared: np.ndarray, limit: np.ndarray | float) -> np.ndarray:
    """Return `geman_mcclure_loss`, and its bound `limit` for infinite squared residuals."""
    far = ~np.isfinite(squared)
    return np.where(far, limit, geman_mcclure_loss(np.where(far, 0.0, squared), limit))


def student_density(residuals: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Return Student's t density of residuals with scales `sigmas`; both broadcast."""
    scaled = 1.0 + (residuals / sigmas) ** 2 / STUDENT_FREEDOM
    return STUDENT_PEAK_DENSITY / sigmas / (scaled * scaled * np.sqrt(scaled))


def student_weight(residuals: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Return the M-estimator weight of residuals with scales `sigmas` for Student's t: (nu + 1) / (nu + r^2 / s^2)."""
    return (STUDENT_FREEDOM + 1.0) / (STUDENT_FREEDOM + (residuals / sigmas) ** 2)


def wrap_undirected(turns_rad: np.ndarray) -> np.ndarray:
    """Bring angles of undirected edges to within a quarter of a turn of 0."""
    return turns_rad - np.pi * np.rint(turns_rad / np.pi)


def cauchy_weight(scaled_squares: np.ndarray) -> np.ndarray:
    """Weight of residuals under the Cauchy kernel; `scaled_squares` are their squares over the squared scale."""
    return 1.0 / (1.0 + scaled_squares)


def cauchy_loss(scaled_squares: np.ndarray) -> np.ndarray:
    """Loss of residuals under the Cauchy kernel, over the squared scale; its derivative is `cauchy_weight`."""
    return np.log1p(scaled_squares)
