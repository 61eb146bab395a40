"""Robust kernels: weights are derivatives of losses, and bounds are reached."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.geometry.robust_kernels import (
    geman_mcclure_bounded_loss,
    geman_mcclure_loss,
    geman_mcclure_weight,
)

SQUARED = np.linspace(0.0, 20.0, 41)


def test_the_weight_is_one_at_zero_and_a_quarter_at_the_limit() -> None:
    np.testing.assert_allclose(geman_mcclure_weight(np.array([0.0, 3.0]), 3.0), [1.0, 0.25])


def test_the_weight_is_the_derivative_of_the_loss() -> None:
    step = 1e-6
    slope = (geman_mcclure_loss(SQUARED + step, 3.0) - geman_mcclure_loss(SQUARED - step, 3.0)) / (2 * step)
    np.testing.assert_allclose(geman_mcclure_weight(SQUARED, 3.0), slope, rtol=1e-6, atol=1e-9)


def test_an_infinite_residual_costs_the_limit() -> None:
    losses = geman_mcclure_bounded_loss(np.array([np.inf, 1e12, 2.0]), np.array([3.0, 3.0, 2.0]))
    assert losses == pytest.approx([3.0, 3.0, 1.0])
