"""Piecewise cubic curves through points. Their import costs nothing, that of scipy.interpolate a tenth of a second."""

from __future__ import annotations

import numpy as np


def cubic_through(x: np.ndarray, y: np.ndarray, slopes: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return a curve of cubics at wanted places (m,), shape (m, ...).

    It goes through values `y` (n, ...) at increasing places `x` (n,) with `slopes` (n, ...) there; beyond the ends the
    outermost cubics go on.
    """
    piece = np.clip(np.searchsorted(x, wanted, side='right') - 1, 0, len(x) - 2)
    by_row = (slice(None), *(None,) * (y.ndim - 1))
    width, ahead = (x[piece + 1] - x[piece])[by_row], (wanted - x[piece])[by_row]
    chord = (y[piece + 1] - y[piece]) / width
    first, last = slopes[piece], slopes[piece + 1]
    bend = (first + last - 2.0 * chord) / width
    return np.asarray(y[piece] + ahead * (first + ahead * ((chord - first) / width - bend + ahead * bend / width)))


def spline_slopes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return slopes (n,) of the smoothest curve of cubics through values y (n,) at increasing places x (n,), n >= 4.

    Second derivatives are continuous, and third ones at the second and the last but one place ("not a knot", de Boor
    1978).
    """
    count, steps = len(x), np.diff(x)
    chords = np.diff(y) / steps
    matrix, aim = np.zeros((count, count)), np.empty(count)
    inner = np.arange(1, count - 1)
    matrix[inner, inner - 1], matrix[inner, inner + 1] = steps[1:], steps[:-1]
    matrix[inner, inner] = 2.0 * (steps[:-1] + steps[1:])
    aim[inner] = 3.0 * (steps[1:] * chords[:-1] + steps[:-1] * chords[1:])
    two = x[2] - x[0]
    matrix[0, :2] = steps[1], two
    aim[0] = ((steps[0] + 2.0 * two) * steps[1] * chords[0] + steps[0] ** 2 * chords[1]) / two
    two = x[-1] - x[-3]
    matrix[-1, -2:] = two, steps[-2]
    aim[-1] = (steps[-1] ** 2 * chords[-2] + (2.0 * two + steps[-1]) * steps[-2] * chords[-1]) / two
    return np.linalg.solve(matrix, aim)
