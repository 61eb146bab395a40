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


@pytest.mark.parametrize(('freedom', 'median'), [(1, 0.455), (2, 1.386), (3, 2.366)])
def test_a_track_counts_as_many_times_as_its_distance_sums_up(freedom: int, median: float) -> None:
    assert information(freedom) == pytest.approx(median, rel=0.15)


def test_equal_distances_count_as_a_way_of_several_correlation_lengths_at_most() -> None:
    assert information(40) == pytest.approx(3.357, rel=0.01)


def test_tracks_that_do_not_follow_hardly_matter() -> None:
    assert information(1, 4000, 200) == pytest.approx(information(1), rel=0.1)
