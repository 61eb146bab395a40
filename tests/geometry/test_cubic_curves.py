"""Piecewise cubic curves, against those of SciPy."""

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from autocalib_ros.geometry.cubic_curves import cubic_through, spline_slopes


def test_a_curve_has_the_values_and_slopes_that_are_told() -> None:
    random = np.random.default_rng(0)
    x = np.cumsum(random.uniform(0.1, 2.0, 12))
    y, slopes = random.normal(size=(2, 12, 2))
    wanted = np.concatenate([random.uniform(x[0] - 0.5, x[-1] + 0.5, 50), x])
    expected = CubicHermiteSpline(x, y, slopes)(wanted)
    np.testing.assert_allclose(cubic_through(x, y, slopes, wanted), expected, rtol=1e-9, atol=1e-9)


def test_the_smoothest_curve_is_that_of_a_spline() -> None:
    random = np.random.default_rng(1)
    for count in (4, 5, 9):
        x, y = np.cumsum(random.uniform(0.2, 1.0, count)), random.normal(size=count)
        wanted = np.linspace(x[0], x[-1], 40)
        expected = CubicSpline(x, y)(wanted)
        np.testing.assert_allclose(cubic_through(x, y, spline_slopes(x, y), wanted), expected, rtol=1e-9, atol=1e-9)
