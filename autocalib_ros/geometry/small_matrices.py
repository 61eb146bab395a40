"""Vectorised algebra of many small vectors and matrices, where NumPy's linear algebra loops over them."""

from __future__ import annotations

import math

import numpy as np

NEXT, LAST = [1, 2, 0], [2, 0, 1]
"""Cyclic successor and predecessor of each of three indices."""
LAGUERRE_STEPS = 3
"""Iterations of Laguerre's method from 0, a lower bound of all eigenvalues: convergence is cubic, each step triples the
number of correct digits."""


def dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the scalar products of vectors (..., 3) that broadcast against each other, shape (...)."""
    if first.ndim == second.ndim > 1 and second.shape[-2] == 1:
        # one vector against a row of vectors: a matrix product, which is faster
        return (first @ second.swapaxes(-1, -2))[..., 0]
    return np.einsum('...i,...i->...', first, second)


def cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors (..., 3) that broadcast against each other, shape (..., 3)."""
    (x, y, z), (u, v, w) = ([vectors[..., axis] for axis in range(3)] for vectors in (first, second))
    first_component = y * w - z * v
    product = np.empty((*first_component.shape, 3))
    product[..., 0], product[..., 1], product[..., 2] = first_component, z * u - x * w, x * v - y * u
    return product


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) in radians, by the formula of Rodrigues."""
    x, y, z = (float(component) for component in vector)
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    # sin(angle) / angle and (1 - cos(angle)) / angle^2
    ratio = math.sin(half) / half if half else 1.0
    first, second = ratio * math.cos(half), 0.5 * ratio * ratio
    return np.array(
        [
            [1.0 - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y],
            [second * x * y + first * z, 1.0 - second * (x * x + z * z), second * y * z - first * x],
            [second * x * z - first * y, second * y * z + first * x, 1.0 - second * (x * x + y * y)],
        ]
    )


def cofactors(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return diagonals and off-diagonals of symmetric matrices (n, 3, 3) and of their cofactor matrices, (3, n) each.

    Entry i of an off-diagonal is the element in the row and the column other than i.
    """
    flat = matrix.reshape(-1, 9).T
    diagonal, off = flat[[0, 4, 8]], flat[[5, 2, 1]]
    return (diagonal, off, diagonal[NEXT] * diagonal[LAST] - off * off, off[NEXT] * off[LAST] - diagonal * off)


def smallest_eigenvectors(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit eigenvectors (n, 3) of the smallest eigenvalues of PSD matrices (n, 3, 3), and the eigenvalues.

    The cofactor matrix of S - l I, l close to the smallest eigenvalue, is nearly a multiple of e e^T. Its largest
    column is nearly e; one multiplication by the cofactor matrix refines it (inverse iteration).
    """
    diagonal, off, minors, mixed = cofactors(matrix)
    trace = diagonal.sum(axis=0)
    shift = _smallest_roots(trace, minors.sum(axis=0), diagonal[0] * minors[0] + (off[1:] * mixed[1:]).sum(axis=0))
    minors = minors + shift * (diagonal - trace + shift)
    mixed = mixed + shift * off
    near = np.stack(
        [minors[0], mixed[2], mixed[1], mixed[2], minors[1], mixed[0], mixed[1], mixed[0], minors[2]], axis=-1
    ).reshape(-1, 3, 3)
    columns = near[np.arange(len(near)), np.argmax(minors, axis=0)]
    axes = np.einsum('nij,nj->ni', near, columns)
    axes /= np.sqrt(dot(axes, axes))[:, None]
    return axes, np.einsum('ni,nij,nj->n', axes, matrix, axes)


def _smallest_roots(trace: np.ndarray, minors: np.ndarray, determinant: np.ndarray) -> np.ndarray:
    """Return the smallest roots (n,) of l^3 - trace l^2 + minors l - determinant by Laguerre's method.

    All three roots are real, as for a symmetric matrix.
    """
    root = np.zeros(len(trace))
    for _ in range(LAGUERRE_STEPS):
        value = ((root - trace) * root + minors) * root - determinant
        slope = (3 * root - 2 * trace) * root + minors
        second_derivative = 6 * root - 2 * trace
        spread = np.sqrt(np.maximum(4 * slope * slope - 6 * value * second_derivative, 0.0))
        root = root - 3 * value / np.maximum(slope + spread, 1e-300)
    return root


def inverse_cholesky_factors(matrix: np.ndarray) -> np.ndarray:
    """Return the inverses of the lower Cholesky factors of positive definite matrices, shape (size, size, n)."""
    factor, inverse = np.zeros((2, *matrix.shape))
    for row in range(len(matrix)):
        column = matrix[row:, row] - np.einsum('jkn,kn->jn', factor[row:, :row], factor[row, :row])
        root = np.sqrt(column[0])
        factor[row:, row] = column / root
        inverse[row, :row] = np.einsum('kn,kjn->jn', factor[row, :row], inverse[:row, :row]) / -root
        inverse[row, row] = 1.0 / root
    return inverse
