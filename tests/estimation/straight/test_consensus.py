"""Road directions by consensus on the sphere."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.estimation.observations.track_set import select_tracks
from autocalib_ros.estimation.straight.consensus import consensus_directions
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence

pytestmark = pytest.mark.solve


def angle_deg(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(abs(first @ second), 0, 1))))


@pytest.mark.parametrize('angles', [(0.0, 90.0), (0.0, 60.0), (20.0, 125.0)])
def test_consensus_finds_both_roads_at_any_angle(angles: tuple[float, float]) -> None:
    junction = Junction(road_angles_deg=angles)
    tracks = select_tracks(synthetic_evidence(junction, np.random.default_rng(4)), 500)
    found = consensus_directions(junction.camera, tracks, np.random.default_rng(0))
    for angle in np.radians(angles):
        truth = junction.camera_from_ground @ [np.cos(angle), np.sin(angle), 0.0]
        assert min(angle_deg(truth, direction) for direction in found.directions) < 1.0


def test_consensus_scores_the_right_focal_length_highest() -> None:
    junction = Junction()
    tracks = select_tracks(synthetic_evidence(junction, np.random.default_rng(5)), 500)
    trials = [450.0, 500.0, 560.0, 630.0, 700.0]
    scores = [
        consensus_directions(Camera.equidistant(1280, 720, trial), tracks, np.random.default_rng(0)).score
        for trial in trials
    ]
    assert trials[int(np.argmax(scores))] == 560.0


def test_consensus_repeats_with_its_seed() -> None:
    junction = Junction()
    tracks = select_tracks(synthetic_evidence(junction, np.random.default_rng(6)), 500)
    first, second = (consensus_directions(junction.camera, tracks, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first.directions, second.directions)
