"""How far a told focal length is believed."""

from types import SimpleNamespace

import numpy as np
import pytest

from autocalib_ros.estimation.single_road.told_focal import WRONG_TOLD, probability_of_told
from autocalib_ros.estimation.solution import Solution


@pytest.mark.parametrize(
    ('difference', 'road_sigma', 'low', 'high'),
    [
        (0.0, 0.1, 0.9, 0.95),  # the road shows the same
        (0.3, 0.3, 0.75, 0.85),  # the road hardly shows anything
        (0.9, 0.3, 0.2, 0.5),  # three standard deviations
        (0.9, 0.1, 0.0, 1e-4),
    ],
)
def test_a_number_is_believed_as_far_as_the_road_allows(
    difference: float, road_sigma: float, low: float, high: float
) -> None:
    believed = probability_of_told(difference, road_sigma, 0.1)
    assert low <= believed <= high
    assert probability_of_told(-difference, road_sigma, 0.1) == believed


def test_where_nothing_is_seen_the_prior_remains() -> None:
    assert probability_of_told(0.0, 50.0, 0.1) == pytest.approx(1.0 - WRONG_TOLD, abs=1e-4)


@pytest.mark.parametrize(
    ('sigma', 'told', 'from_markings', 'rests'),
    [(0.095, 0.1, True, True), (0.05, 0.1, True, False), (0.095, np.inf, True, False), (0.095, 0.1, False, False)],
)
def test_lane_markings_that_hardly_measure_a_told_focal_length_rest_on_it(
    sigma: float, told: float, from_markings: bool, rests: bool
) -> None:
    prior = SimpleNamespace(focal_known=np.isfinite(told), sigma=np.array([told, 1.0, 1.0]))
    fit = SimpleNamespace(focal_sigma=sigma, problem=SimpleNamespace(config=SimpleNamespace(prior=prior)))
    found = SimpleNamespace(fit=fit, from_markings=from_markings)
    assert Solution.rests_on_told_focal.fget(found) is rests
