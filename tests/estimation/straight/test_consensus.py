"""Road directions by consensus on the sphere, and by the published votes."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import PaperOptions
from autocalib_ros.estimation.observations.track_set import select_tracks
from autocalib_ros.estimation.paper.vanishing_point_voting import (
    SegmentOrientations,
    segment_orientations,
    vote_vanishing_points,
)
from autocalib_ros.estimation.straight.consensus import consensus_directions
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence


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


def lines_through(point: np.ndarray, count: int = 200) -> np.ndarray:
    """Segments (count, 4), undistorted pixels about the centre, that point at `point` within half a degree."""
    generator = np.random.default_rng(8)
    start = generator.uniform((-600, -100), (600, 350), (count, 2))
    way = point - start
    heading = np.arctan2(way[:, 1], way[:, 0]) + generator.normal(scale=np.radians(0.2), size=count)
    return np.hstack([start, start + 60 * np.column_stack([np.cos(heading), np.sin(heading)])])


@pytest.mark.parametrize('point', [(300.0, -400.0), (5000.0, -600.0), (60000.0, -2000.0)])
def test_votes_hold_a_vanishing_point_however_far_outside(point: tuple[float, float]) -> None:
    ends = lines_through(np.array(point)).reshape(-1, 2, 2)
    step = ends[:, 1] - ends[:, 0]
    orientation = np.degrees(np.arctan2(step[:, 1], step[:, 0])) % 180
    found = SegmentOrientations(ends, orientation, np.zeros((180, 2)), (float(np.median(orientation)),))
    (voted,) = vote_vanishing_points(found, 700.0, PaperOptions(vote_sigmas=0.0, cluster_deg=30.0))
    truth, bearing = np.append(point, 700.0), np.append(voted, 700.0)
    error = angle_deg(truth / np.linalg.norm(truth), bearing / np.linalg.norm(bearing))
    assert error < 2.0  # degrees on the sphere of directions: four voting cells


def test_orientation_peaks_are_apart() -> None:
    evidence = synthetic_evidence(Junction(camera_from_ground=pose(30.0, 0.0, 45.0)), np.random.default_rng(9))
    found = segment_orientations(Camera(1280, 720, 560.0, (639.5, 359.5)), evidence.segments_px, PaperOptions())
    first, second = found.peaks_deg
    assert 25.0 <= abs((first - second + 90) % 180 - 90)
    assert found.histogram.shape == (180, 2)


def test_no_segments_have_no_peaks() -> None:
    found = segment_orientations(Camera(1280, 720, 560.0, (639.5, 359.5)), np.zeros((0, 4)), PaperOptions())
    assert found.peaks_deg == () and vote_vanishing_points(found, 560.0, PaperOptions()).shape == (0, 2)
