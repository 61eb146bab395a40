"""Closed forms for many small matrices agree with LAPACK."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autocalib_ros.geometry.small_matrices import (
    cofactors,
    cross,
    dot,
    inverse_cholesky_factors,
    rotation_matrix,
    smallest_eigenvectors,
)

COUNT = 300


def scatters(least: tuple[float, float], middle: tuple[float, float]) -> np.ndarray:
    """Symmetric matrices (COUNT, 3, 3) with a largest eigenvalue of 1e6, as a focal length of 1000 px makes it."""
    generator = np.random.default_rng(0)
    axes = np.linalg.qr(generator.normal(size=(COUNT, 3, 3)))[0]
    values = np.column_stack([generator.uniform(*least, COUNT), generator.uniform(*middle, COUNT), np.full(COUNT, 1e6)])
    return (axes * values[:, None]) @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize(
    ('least', 'middle'),
    [
        ((0.0, 1e-9), (100.0, 1e4)),  # perfect paths
        ((0.0, 4.0), (100.0, 1e4)),
        ((4.0, 50.0), (100.0, 1e4)),  # paths that bend
        ((0.0, 4.0), (1e5, 9e5)),
    ],
)  # paths from border to border
def test_smallest_eigenvectors_agree_with_lapack(least: tuple[float, float], middle: tuple[float, float]) -> None:
    matrix = scatters(least, middle)
    axes, values = smallest_eigenvectors(matrix)
    expected, vectors = np.linalg.eigh(matrix)
    np.testing.assert_allclose(values, expected[:, 0], atol=1e-8)  # px^2; rounding leaves 1e-16 of 1e6
    np.testing.assert_allclose(np.abs(dot(axes, vectors[:, :, 0])), 1.0, atol=1e-12)
    assert np.linalg.norm(cross(axes, vectors[:, :, 0]), axis=1).max() < 1e-8  # radians


def test_cofactors_are_determinant_times_inverse() -> None:
    matrix = scatters((1.0, 2.0), (1e5, 9e5))
    _, _, minors, mixed = cofactors(matrix)
    expected = np.linalg.det(matrix)[:, None, None] * np.linalg.inv(matrix)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(minors.T, np.diagonal(expected, axis1=1, axis2=2), atol=1e-6 * scale)
    np.testing.assert_allclose(mixed.T, expected[:, [1, 2, 0], [2, 0, 1]], atol=1e-6 * scale)


def test_inverse_cholesky_factors_whiten() -> None:
    root = np.random.default_rng(1).normal(size=(COUNT, 10, 10))
    covariance = root @ root.transpose(0, 2, 1) + np.eye(10)
    expected = np.linalg.inv(np.linalg.cholesky(covariance))
    np.testing.assert_allclose(
        inverse_cholesky_factors(covariance.transpose(1, 2, 0)).transpose(2, 0, 1), expected, atol=1e-12
    )


@pytest.mark.parametrize('shapes', [((3,), (3,)), ((7, 3), (3,)), ((7, 5, 3), (7, 1, 3)), ((7, 3), (7, 3))])
def test_products_agree_with_numpy(shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> None:
    generator = np.random.default_rng(2)
    first, second = (generator.normal(size=shape) for shape in shapes)
    np.testing.assert_allclose(dot(first, second), (first * second).sum(axis=-1), atol=1e-14)
    np.testing.assert_allclose(cross(first, second), np.cross(first, second), atol=1e-14)


@pytest.mark.parametrize('angle_rad', [0.0, 1e-200, 1e-8, 1e-3, 1.0, np.pi, 6.0])
def test_rotation_matrices_are_those_of_scipy(angle_rad: float) -> None:
    vector = angle_rad * np.array([0.6, -0.64, 0.48])
    np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
