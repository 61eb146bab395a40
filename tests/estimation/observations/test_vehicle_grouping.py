"""Grouping of tracks into vehicles, and their weights."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.estimation.observations.track_set import SAMPLES_PER_TRACK, TrackSet
from autocalib_ros.estimation.observations.vehicle_grouping import (
    SINGLE_TRACK_WEIGHT,
    corroboration_weights,
    group_into_bodies,
    heading_error_deg,
)


def moving(
    starts: list[tuple[float, float]], speeds: list[tuple[float, float]], begin_s: list[float]
) -> tuple[TrackSet, np.ndarray]:
    """Tracks of 3 s with their positions on the ground in metres."""
    times = np.array(begin_s)[:, None] + np.linspace(0.0, 3.0, SAMPLES_PER_TRACK)
    ground = np.array(starts)[:, None] + np.array(speeds)[:, None] * (times - times[:, :1])[..., None]
    count = len(starts)
    tracks = TrackSet(
        np.zeros((count, SAMPLES_PER_TRACK, 2)),
        np.full((count, SAMPLES_PER_TRACK), 1 / SAMPLES_PER_TRACK),
        np.zeros(count, int),
        times,
        np.arange(count),
    )
    return tracks, ground


def test_points_that_stay_together_are_one_body() -> None:
    tracks, ground = moving([(0, 0), (2, 1)], [(8, 0), (8, 0)], [0.0, 0.0])
    first, second = group_into_bodies(tracks, ground)
    assert first == second


@pytest.mark.parametrize(
    ('start', 'speed', 'begin'),
    [
        ((0, 30), (8, 0), 0.0),  # far away
        ((1, 1), (-8, 0), 0.0),  # the opposite direction
        ((0, 0), (8, 0), 2.8),
    ],
)  # seen together for 0.2 s only
def test_points_that_separate_are_two_bodies(
    start: tuple[float, float], speed: tuple[float, float], begin: float
) -> None:
    tracks, ground = moving([(0, 0), start], [(8, 0), speed], [0.0, begin])
    first, second = group_into_bodies(tracks, ground)
    assert first != second


def test_a_body_is_linked_from_track_to_track() -> None:
    tracks, ground = moving([(0, 0), (8, 0), (16, 0)], [(8, 0)] * 3, [0.0, 1.0, 2.0])
    assert len(set(group_into_bodies(tracks, ground))) == 1


def test_a_track_that_leaves_its_road_by_a_degree_has_a_heading_of_one_degree() -> None:
    along = np.linspace(0.0, 20.0, SAMPLES_PER_TRACK)[None]
    px_per_m = np.full((1, SAMPLES_PER_TRACK), 30.0)
    off, _ = heading_error_deg(
        np.tan(np.radians(1.0)) * along * px_per_m, px_per_m, along, np.ones((1, SAMPLES_PER_TRACK), bool)
    )
    assert off[0] == pytest.approx(1.0, rel=1e-3)


def test_all_tracks_of_a_turning_vehicle_lose_their_weight() -> None:
    generator = np.random.default_rng(0)
    vehicles = np.repeat(np.arange(20), 4)
    off = 0.1 * generator.normal(size=80)
    off[vehicles == 7] += 3.0  # all four tracks of one vehicle, by three degrees
    off[0] = 3.0  # a single drifting track of another vehicle
    weight = corroboration_weights(off, np.full(80, 0.1), vehicles, np.zeros(80, int))
    assert weight[vehicles == 7].max() < 0.05
    assert weight[0] > 0.3


def test_uncorroborated_tracks_weigh_less() -> None:
    vehicles = np.concatenate([np.repeat(np.arange(15), 3), [99]])
    weight = corroboration_weights(np.zeros(46), np.full(46, 0.1), vehicles, np.zeros(46, int))
    assert weight[-1] == pytest.approx(SINGLE_TRACK_WEIGHT)
    assert weight[0] == pytest.approx(1.0)


def test_without_corroborated_vehicles_all_weights_are_one() -> None:
    weight = corroboration_weights(np.linspace(-3, 3, 30), np.full(30, 0.1), np.arange(30), np.zeros(30, int))
    np.testing.assert_array_equal(weight, 1.0)
