"""Cluster-robust covariance against spreads that are known."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.estimation.adjustment.covariance import (
    intraclass_correlation,
    jackknife_covariance,
    propagate_sigma,
    sigma_without_prior,
    small_sample_factor,
)


def plain(slopes: np.ndarray, residuals: np.ndarray, vehicles: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Covariance of ordinary least squares, one sample a track."""
    tracks = len(residuals)
    return jackknife_covariance(
        slopes * residuals[:, None],
        slopes[:, :, None] * slopes[:, None],
        np.ones(tracks),
        np.zeros(tracks),
        vehicles,
        prior,
    )


def test_covariance_covers_errors_shared_within_a_vehicle() -> None:
    # 40 vehicles of 10 tracks each share one error: the mean has the spread of 40 values, not of 400
    generator = np.random.default_rng(0)
    vehicles = np.repeat(np.arange(40), 10)
    residuals = np.repeat(generator.normal(size=40), 10)
    residuals -= residuals.mean()
    sigma = np.sqrt(plain(np.ones((400, 1)), residuals, vehicles, np.zeros(1))[0, 0])
    assert sigma == pytest.approx(1 / np.sqrt(40), rel=0.3)  # 40 draws tell a spread to a tenth; 3 sigma


def test_leaving_out_vehicles_gives_the_jackknife_of_a_mean() -> None:
    values = np.array([1.0, 4.0, 2.0, 7.0, 3.0])
    sigma2 = plain(np.ones((5, 1)), values - values.mean(), np.arange(5), np.zeros(1))[0, 0]
    left_out = np.array([np.delete(values, index).mean() for index in range(5)])
    moves = (left_out - values.mean())[:, None]
    assert sigma2 == pytest.approx((moves**2).sum() * small_sample_factor(moves)[0] ** 2)


def test_few_vehicles_widen_deviations_by_students_t() -> None:
    many, one = np.ones((1000, 1)), np.array([[10.0], *[[0.1]] * 40])
    assert small_sample_factor(many)[0] == pytest.approx(1.0, abs=0.01)
    assert small_sample_factor(np.ones((10, 1)))[0] == pytest.approx(
        2.042 / 1.960, abs=1e-3
    )  # all alike: 30 degrees of freedom
    assert small_sample_factor(one)[0] > 1.5


def test_few_vehicles_that_agree_by_chance_keep_the_variance_of_their_noise() -> None:
    slopes = np.ones((12, 1))
    quiet, loud = (
        plain(slopes, noise * np.resize([1.0, -1.0], 12), np.arange(12), np.zeros(1))[0, 0] for noise in (0.1, 3.0)
    )
    of_noise = 1.0 / 12  # residuals of one, of twelve vehicles, for a mean
    assert 0.2 * of_noise < quiet < 0.5 * of_noise
    assert loud > 9.0 * of_noise
    many = plain(np.ones((1200, 1)), 0.1 * np.resize([1.0, -1.0], 1200), np.arange(1200), np.zeros(1))[0, 0]
    assert many < 0.02 / 1200


def test_a_parameter_known_from_the_prior_alone_has_its_variance() -> None:
    slopes = np.column_stack([np.ones(50), np.zeros(50)])
    covariance = plain(slopes, np.zeros(50), np.arange(50), np.array([0.0, 1.0]))
    assert covariance[1, 1] == pytest.approx(1.0)


def test_undetermined_parameters_get_an_infinite_variance() -> None:
    slopes = np.column_stack([np.ones(20), np.ones(20)])
    assert np.isinf(plain(slopes, np.ones(20), np.arange(20), np.zeros(2))).all()


def test_no_information_at_all_gives_an_infinite_variance() -> None:
    assert np.isinf(plain(np.zeros((20, 2)), np.zeros(20), np.arange(20), np.zeros(2))).all()


def test_one_vehicle_gives_an_infinite_variance() -> None:
    assert np.isinf(plain(np.ones((5, 1)), np.zeros(5), np.zeros(5, int), np.zeros(1))).all()


def test_correlation_is_that_of_a_shared_part() -> None:
    generator = np.random.default_rng(0)
    groups = np.repeat(np.arange(400), 5)
    pulls = np.sqrt(0.3) * np.repeat(generator.normal(size=(400, 2)), 5, axis=0)
    pulls += np.sqrt(0.7) * generator.normal(size=(2000, 2))
    assert intraclass_correlation(groups, pulls) == pytest.approx(0.3, abs=0.08)  # 400 groups: 3 sigma


def test_two_collinear_parameters_are_both_unidentifiable() -> None:
    slopes = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
    left = sigma_without_prior(slopes.T @ slopes, np.zeros(3))
    assert np.isinf(left[:2]).all()
    assert left[2] == pytest.approx(0.5)


def test_propagation_is_linear() -> None:
    covariance = np.array([[4.0, 0.0], [0.0, 9.0]])
    sigma = propagate_sigma(lambda step: np.array([2 * step[0], step[0] + step[1]]), 2, covariance)
    np.testing.assert_allclose(sigma, (4.0, np.sqrt(13.0)), rtol=1e-6)
