"""Normal equations of tracklets against the whole matrix."""

from __future__ import annotations

import numpy as np

from autocalib_ros.estimation.motion.tracklet_equations import TrackletJacobian

TRACKLETS, POINTS, ROWS, POSES = 3, 4, 10, 15


def drawn() -> tuple[TrackletJacobian, np.ndarray, np.ndarray]:
    """Derivatives, the same as one matrix (tracklets, rows, unknowns), and residuals (tracklets, points, n, 2)."""
    generator = np.random.default_rng(0)
    jacobian = TrackletJacobian(
        generator.normal(size=(TRACKLETS, POINTS, ROWS, 3)), generator.normal(size=(TRACKLETS, POINTS, ROWS, POSES))
    )
    whole = np.zeros((TRACKLETS, POINTS, ROWS, 3 * POINTS + POSES))
    for point in range(POINTS):
        whole[:, point, :, 3 * point : 3 * point + 3] = jacobian.by_point[:, point]
    whole[..., 3 * POINTS :] = jacobian.by_pose
    residuals = generator.normal(size=(TRACKLETS, POINTS, ROWS, 2))
    return jacobian, whole.reshape(TRACKLETS, POINTS * ROWS, -1), residuals


def flat(by_points: np.ndarray, by_poses: np.ndarray) -> np.ndarray:
    return np.concatenate([by_points.reshape(TRACKLETS, 3 * POINTS, -1), by_poses], axis=1)


def test_blocks_are_those_of_the_whole_matrix() -> None:
    jacobian, whole, residuals = drawn()
    transposed = whole.transpose(0, 2, 1)
    np.testing.assert_allclose(jacobian.equations().matrix, transposed @ whole, atol=1e-12)
    pulled = transposed @ residuals.reshape(TRACKLETS, POINTS * ROWS, -1)
    np.testing.assert_allclose(flat(*jacobian.pulled(residuals)), pulled, atol=1e-12)
    root = np.random.default_rng(1).uniform(size=(TRACKLETS, POINTS))
    weighted = whole * np.repeat(root, ROWS, axis=1)[..., None]
    np.testing.assert_allclose(
        jacobian.weighted(root).equations().matrix, weighted.transpose(0, 2, 1) @ weighted, atol=1e-12
    )


def test_points_that_are_eliminated_change_no_solution() -> None:
    jacobian, whole, residuals = drawn()
    equations, right = jacobian.equations().damped(np.array([0.0, 1e-3, 1.0])), jacobian.pulled(residuals)
    found = equations.solve(*right)
    np.testing.assert_allclose(flat(*found), np.linalg.solve(equations.matrix, flat(*right)), atol=1e-10)
    np.testing.assert_allclose(
        jacobian.times(*found).reshape(TRACKLETS, POINTS * ROWS, -1), whole @ flat(*found), atol=1e-10
    )


def test_damping_lifts_the_diagonal_and_what_nothing_constrains() -> None:
    jacobian, _, _ = drawn()
    jacobian.by_point[0, 1] = 0.0  # a point that is not seen
    before, after = jacobian.equations().matrix, jacobian.equations().damped(np.full(TRACKLETS, 0.5)).matrix
    diagonal = np.einsum('tii->ti', before)
    lift = np.einsum('tii->ti', after - before) - 0.5 * diagonal
    least = 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-9
    np.testing.assert_allclose(lift, np.broadcast_to(least, lift.shape), atol=1e-12)
    unseen, _ = jacobian.equations().damped(np.zeros(TRACKLETS)).solve(*jacobian.pulled(np.ones((3, 4, 10, 1))))
    assert not unseen[0, 1].any() and np.isfinite(unseen).all()
