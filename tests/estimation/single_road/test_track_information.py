"""How many independent observations a straight track counts as: by how much the distances of tracks vary."""

from types import SimpleNamespace

import numpy as np
import pytest

from autocalib_ros.estimation.single_road.road_through_lens import RoadThrough


def information(freedom: int, followers: int = 4000, strays: int = 0) -> float:
    generator = np.random.default_rng(7)
    squared = np.append(generator.chisquare(freedom, followers) / freedom, np.full(strays, 20.0))
    start = SimpleNamespace(distance_px=np.sqrt(squared), inliers=lambda: np.ones(len(squared), bool))
    return RoadThrough(start, None).information  # type: ignore[arg-type]


def test_tracks_whose_distances_vary_as_of_one_deviation_count_less() -> None:
    assert information(1) == pytest.approx(0.455, rel=0.15)
    assert information(1) < information(2)


def test_tracks_of_equal_distances_count_as_one_observation() -> None:
    assert information(40) == information(4) == pytest.approx(0.99, rel=0.02)


def test_tracks_that_do_not_follow_hardly_matter() -> None:
    assert information(1, 4000, 200) == pytest.approx(information(1), rel=0.1)
