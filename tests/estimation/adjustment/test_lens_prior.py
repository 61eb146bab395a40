"""Lens families and their fixed parameters."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import JointOptions
from autocalib_ros.errors import UsageError
from autocalib_ros.estimation.adjustment.lens_prior import known_lens, lens_priors
from autocalib_ros.lens.camera import Camera

SIZE = (1280, 720)


def test_auto_gives_the_most_common_family_first() -> None:
    assert [prior.family for prior in lens_priors(SIZE, JointOptions())] == [
        'equidistant',
        'distortion_free',
        'kannala_brandt',
    ]


def test_a_distortion_free_lens_projects_by_the_tangent() -> None:
    prior = lens_priors(SIZE, JointOptions(lens_prior='distortion_free'))[0]
    angles = np.radians([10.0, 25.0, 40.0])
    radius = prior.start(500.0).radius(angles)
    np.testing.assert_allclose(radius, 500.0 * np.tan(angles), rtol=1e-3)  # four terms of the series, up to 40 degrees


def test_a_sigma_of_zero_fixes_a_parameter() -> None:
    prior = lens_priors(SIZE, JointOptions(k1_sigma=0.0, principal_point_sigma_px=0.0))[0]
    moved = prior.moved(prior.start(600.0), np.array([0.1]))
    assert list(prior.free) == [0]
    assert moved.focal_px == pytest.approx(600.0 * np.exp(0.1))
    assert (moved.principal_point_px, moved.k) == (prior.centre.principal_point_px, prior.centre.k)


def test_a_given_focal_length_is_where_solutions_start() -> None:
    prior = lens_priors(SIZE, JointOptions(focal_prior_px=700.0, focal_sigma_px=7.0))[0]
    assert prior.start(400.0).focal_px == 700.0
    assert prior.deviations(prior.moved(prior.centre, np.array([2.0, 0, 0, 0])))[0] == pytest.approx(2.0)


def test_deviations_are_in_sigmas() -> None:
    prior = lens_priors(SIZE, JointOptions(principal_point_sigma_px=10.0, k1_sigma=0.02))[0]
    camera = Camera(1280, 720, 555.0, (649.5, 339.5), (0.06, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(prior.deviations(camera), [0.0, 1.0, -2.0, 3.0])


def test_a_known_lens_has_no_free_parameters() -> None:
    assert len(known_lens(Camera.equidistant(1280, 720, 500.0)).free) == 0


@pytest.mark.parametrize('angle', ['right', '5', '-90', ''])
def test_an_invalid_angle_is_refused_with_the_accepted_values(angle: str) -> None:
    with pytest.raises(UsageError, match='between 10 and 170 degrees'):
        JointOptions(road_angle=angle)


def test_an_angle_may_be_a_number() -> None:
    assert JointOptions(road_angle=75).crossing_deg == 75.0  # type: ignore[arg-type]
