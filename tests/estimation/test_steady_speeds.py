"""Vehicles that keep their speed show how lengths compare from near to far."""

from dataclasses import replace

import numpy as np
from pinhole_road import PINHOLE, ROAD
from scipy.spatial.transform import Rotation

from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.steady_speeds import measure_steady_speeds

NORMAL, ACROSS = ROAD.normal_in_camera, ROAD.camera_from_ground[:, 1]


def tracks(braking: float = 0.0, spread: float = 0.0, jam: float = 0.0) -> TrackSet:
    """Vehicles on one road that end with `1 - braking` of their speed, +- `spread`; speeds vary by 10 %, or `jam`."""
    generator = np.random.default_rng(3)
    count, samples = 30, 10
    share = np.linspace(0.0, 1.0, samples)
    length = 12.0 * np.exp(generator.normal(0.0, max(0.1, jam), count))
    gain = -(braking + spread * generator.normal(size=count))
    ways = (share + 0.5 * gain[:, None] * share * (share - 1.0)) * length[:, None]
    places = np.stack(
        [
            28.0 - ways,
            np.broadcast_to(generator.uniform(-5.0, 5.0, (count, 1)), ways.shape),
            np.broadcast_to(generator.uniform(0.2, 1.2, (count, 1)) - ROAD.height_m, ways.shape),
        ],
        axis=-1,
    )
    pixels, _ = PINHOLE.project(places.reshape(-1, 3) @ ROAD.camera_from_ground.T)
    pixels = pixels + generator.normal(0.0, 0.2, pixels.shape)
    return TrackSet(
        pixels.reshape(count, samples, 2),
        np.full((count, samples), 1.0 / samples),
        np.arange(count),
        np.broadcast_to(share, (count, samples)),
        np.arange(count),
    )


def test_steady_vehicles_show_no_change_in_the_right_plane_and_one_in_a_wrong_plane() -> None:
    steady = measure_steady_speeds(PINHOLE, NORMAL, tracks())
    assert steady is not None and steady.vehicles == 30
    right = steady.change_with_distance(PINHOLE, NORMAL)
    assert abs(right.mean) < right.sigma < 0.06
    turned = [
        steady.change_with_distance(PINHOLE, Rotation.from_rotvec(np.radians(angle) * ACROSS).apply(NORMAL)).mean
        for angle in (-2.0, 2.0)
    ]
    assert turned[0] * turned[1] < 0 and min(np.abs(turned)) > 2.0 * right.sigma


def test_drivers_that_brake_differently_widen_the_standard_deviation() -> None:
    alike, differing = (measure_steady_speeds(PINHOLE, NORMAL, tracks(spread=spread)) for spread in (0.0, 0.1))
    assert alike is not None and differing is not None
    assert differing.sigma > 1.5 * alike.sigma


def test_traffic_that_stops_or_jams_measures_nothing() -> None:
    assert measure_steady_speeds(PINHOLE, NORMAL, tracks(braking=0.5, spread=0.4)) is None
    assert measure_steady_speeds(PINHOLE, NORMAL, tracks(jam=0.5)) is None


def test_few_vehicles_and_far_ones_measure_nothing() -> None:
    every = tracks()
    assert measure_steady_speeds(PINHOLE, NORMAL, every.subset(np.arange(8))) is None
    near = replace(every, pixels=every.pixels[:, :1] + 0.0 * every.pixels)
    assert measure_steady_speeds(PINHOLE, NORMAL, near) is None


def test_times_that_stand_still_measure_nothing() -> None:
    every = tracks()
    assert measure_steady_speeds(PINHOLE, NORMAL, replace(every, sample_times_s=0.0 * every.sample_times_s)) is None


def test_a_plane_that_the_road_leaves_is_no_error() -> None:
    steady = measure_steady_speeds(PINHOLE, NORMAL, tracks())
    assert steady is not None
    away = Rotation.from_rotvec(np.radians(-25.0) * ACROSS).apply(NORMAL)
    assert isinstance(steady.change_with_distance(PINHOLE, away).mean, float)
