"""Pedestrians are distinguished from vehicles by metric speed, width and path."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.estimation.people.pedestrians import find_pedestrians
from autocalib_ros.evidence.snapshot import Evidence, Track
from autocalib_ros.offline.synthetic.junction import Junction, evidence_from_tracks, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from solved_once import ONE_FAMILY

FIRST_WALKER = 1000
"""Vehicle numbers from here on are pedestrians."""
TIMES_S = np.arange(0.0, 24.0, 0.4)


def _body(
    junction: Junction,
    number: int,
    start_s: float,
    path_m: np.ndarray,
    half_m: np.ndarray,
    generator: np.random.Generator,
) -> list[Track]:
    """Tracks of six points of a body with half sizes `half_m` (3,) along a path (n, 2) on the road."""
    tracks = []
    for _ in range(6):
        offset = generator.uniform((-half_m[0], -half_m[1], 0.1), half_m)
        points = np.column_stack([path_m + offset[:2], np.full(len(path_m), offset[2] - junction.height_m)])
        pixels, valid = junction.camera.project(points @ junction.camera_from_ground.T)
        seen = valid & (pixels >= 0).all(axis=1) & (pixels < junction.image_size).all(axis=1)
        if seen.sum() > 5:
            noisy = pixels[seen] + generator.normal(scale=0.4, size=(seen.sum(), 2))
            tracks.append(Track(number, start_s + TIMES_S[: len(path_m)][seen], noisy))
    return tracks


def _walker(junction: Junction, number: int, generator: np.random.Generator) -> list[Track]:
    """A pedestrian, 0.5 m wide and 1.7 m high, at 1 to 1.7 m/s with some sway."""
    heading, speed = generator.uniform(0, 2 * np.pi), generator.uniform(1.0, 1.7)
    start = np.array(junction.centre_m) + generator.uniform(-8.0, 8.0, 2)
    way = np.array([np.cos(heading), np.sin(heading)])
    aside = 0.05 * np.sin(2 * np.pi * 0.9 * TIMES_S)
    path = start + (TIMES_S - 8.0)[:, None] * speed * way + aside[:, None] * np.array([-way[1], way[0]])
    return _body(junction, number, 2.0 * (number - FIRST_WALKER), path, np.array([0.25, 0.25, 1.7]), generator)


def _stroller(junction: Junction, number: int, generator: np.random.Generator) -> list[Track]:
    """A pedestrian on the pavement of the first road, who crosses it and returns."""
    speed = generator.choice([-1.0, 1.0]) * generator.uniform(1.0, 1.7)
    along = generator.uniform(-8.0, 8.0) + speed * (TIMES_S - 8.0)
    aside = generator.choice([-7.0, 7.0]) + 0.5 * np.sin(along / 3.0 + generator.uniform(0, 6))
    path = np.array(junction.centre_m) + np.column_stack([along, aside])
    return _body(junction, number, 2.0 * (number - FIRST_WALKER), path, np.array([0.25, 0.25, 1.7]), generator)


def _crawler(junction: Junction, number: int, generator: np.random.Generator) -> list[Track]:
    """A car in a jam at walking speed."""
    start = np.array(junction.centre_m) + (-12.0, generator.uniform(-4, 4))
    path = start + 1.5 * TIMES_S[:, None] * (1.0, 0.0)
    return _body(junction, number, 2.0 * number, path, np.array([2.0, 0.8, 1.4]), generator)


def _joined(junction: Junction, evidence: Evidence, tracks: list[Track]) -> Evidence:
    both = [*evidence.tracks(), *tracks]
    return evidence_from_tracks(both, junction.image_size, max(float(track.times_s[-1]) for track in both))


@pytest.fixture(scope='module')
def street() -> tuple[Junction, Evidence]:
    """Return evidence of forty vehicles and thirty pedestrians."""
    generator = np.random.default_rng(5)
    junction = Junction(vehicles=40, points_per_vehicle=6)
    people = [track for number in range(30) for track in _walker(junction, FIRST_WALKER + number, generator)]
    return junction, _joined(junction, synthetic_evidence(junction, generator), people)


def test_pedestrians_are_distinguished_from_vehicles(street):
    junction, evidence = street
    told = find_pedestrians(evidence, junction.camera, junction.normal_in_camera, junction.height_m)
    people = np.unique(evidence.track_vehicles[evidence.track_vehicles >= FIRST_WALKER])
    assert len(people) > 20
    assert np.isin(told, people).mean() > 0.95
    assert np.isin(people, told).mean() > 0.8


def test_cars_in_a_jam_are_not_pedestrians():
    generator = np.random.default_rng(6)
    junction = Junction()
    crawling = [track for number in range(20) for track in _crawler(junction, number, generator)]
    evidence = evidence_from_tracks(crawling, junction.image_size, 80.0)
    told = find_pedestrians(evidence, junction.camera, junction.normal_in_camera, junction.height_m)
    # Six points are spread at random over 1.6 m: on about one car in twenty all are within half of that.
    assert len(told) <= 3


@pytest.mark.solve
def test_a_calibration_counts_pedestrians_apart_from_vehicles_and_is_no_worse(street):
    junction, evidence = street
    result = solve(evidence, Options(camera_height=junction.height_m, joint=ONE_FAMILY))
    assert isinstance(result, Calibration)
    assert result.evidence.people == pytest.approx(30, abs=5)
    assert result.evidence.vehicles + result.evidence.people == evidence.summary().vehicles
    off_deg = np.degrees(np.arccos(min(1.0, float(result.ground.normal_in_camera @ junction.normal_in_camera))))
    assert off_deg < 3.0 * np.hypot(result.stddev.tilt_deg, result.stddev.roll_deg)


@pytest.mark.solve
def test_pedestrians_beside_a_single_road_are_not_turning_traffic():
    generator = np.random.default_rng(7)
    junction = Junction(road_angles_deg=(0.0,), turning_fraction=0.0, vehicles=25, points_per_vehicle=6)
    people = [track for number in range(25) for track in _stroller(junction, FIRST_WALKER + number, generator)]
    evidence = _joined(junction, synthetic_evidence(junction, generator), people)
    # More than a third of all objects follow no road.
    assert (np.unique(evidence.track_vehicles) >= FIRST_WALKER).mean() > 0.35
    result = solve(evidence, Options(camera_height=junction.height_m, joint=ONE_FAMILY))
    assert isinstance(result, Calibration), result
    assert abs(result.camera.focal_px - junction.camera.focal_px) < 3.0 * result.stddev.focal_px
