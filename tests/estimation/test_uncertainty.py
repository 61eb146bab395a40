"""Cluster-robust covariance against spread that can be counted."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.estimation.uncertainty import cluster_covariance, propagate


def test_covariance_covers_errors_shared_within_a_group() -> None:
    # 40 vehicles of 10 points each share one error: the mean has the spread of 40 values, not of 400
    generator = np.random.default_rng(0)
    groups = np.repeat(np.arange(40), 10)
    residuals = np.repeat(generator.normal(size=40), 10)
    residuals -= residuals.mean()
    sigma = np.sqrt(cluster_covariance(np.ones((400, 1)), residuals, groups)[0, 0])
    assert sigma == pytest.approx(1 / np.sqrt(40), rel=0.3)  # 40 draws tell a spread to a tenth; 3 sigma


def test_undetermined_parameters_get_an_infinite_variance() -> None:
    jacobian = np.column_stack([np.ones(20), np.ones(20)])
    assert np.isinf(cluster_covariance(jacobian, np.ones(20), np.arange(20))).all()


def test_one_vehicle_says_nothing_of_its_spread() -> None:
    assert np.isinf(cluster_covariance(np.ones((5, 1)), np.zeros(5), np.zeros(5, int))).all()


def test_propagation_is_linear() -> None:
    covariance = np.array([[4.0, 0.0], [0.0, 9.0]])
    sigma = propagate(lambda step: np.array([2 * step[0], step[0] + step[1]]), 2, covariance)
    np.testing.assert_allclose(sigma, (4.0, np.sqrt(13.0)), rtol=1e-6)
