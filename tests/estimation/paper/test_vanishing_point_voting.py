"""Vanishing points by orientation histogram and voting."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import PaperOptions
from autocalib_ros.estimation.paper.vanishing_point_voting import (
    SegmentOrientations,
    segment_orientations,
    vote_vanishing_points,
)
from autocalib_ros.geometry.ground_plane import angles_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence


def lines_through(point: np.ndarray, count: int = 200) -> np.ndarray:
    """Segments (count, 4), undistorted pixels about the centre, that point at `point` within half a degree."""
    generator = np.random.default_rng(8)
    start = generator.uniform((-600, -100), (600, 350), (count, 2))
    way = point - start
    heading = np.arctan2(way[:, 1], way[:, 0]) + generator.normal(scale=np.radians(0.2), size=count)
    return np.hstack([start, start + 60 * np.column_stack([np.cos(heading), np.sin(heading)])])


@pytest.mark.parametrize('point', [(300.0, -400.0), (5000.0, -600.0), (60000.0, -2000.0)])
def test_voting_finds_a_vanishing_point_at_any_distance(point: tuple[float, float]) -> None:
    ends = lines_through(np.array(point)).reshape(-1, 2, 2)
    step = ends[:, 1] - ends[:, 0]
    orientation = np.degrees(np.arctan2(step[:, 1], step[:, 0])) % 180
    found = SegmentOrientations(ends, orientation, np.zeros((180, 2)), (float(np.median(orientation)),))
    (voted,) = vote_vanishing_points(found, 700.0, PaperOptions(vote_sigmas=0.0, cluster_deg=30.0))
    truth, bearing = np.append(point, 700.0), np.append(voted, 700.0)
    assert angles_deg(truth, bearing) < 2.0  # degrees on the sphere of directions: four voting cells


def test_orientation_peaks_are_separated() -> None:
    evidence = synthetic_evidence(Junction(camera_from_ground=pose(30.0, 0.0, 45.0)), np.random.default_rng(9))
    found = segment_orientations(Camera(1280, 720, 560.0, (639.5, 359.5)), evidence.segments_px, PaperOptions())
    first, second = found.peaks_deg
    assert abs((first - second + 90) % 180 - 90) >= 25.0
    assert found.histogram.shape == (180, 2)


def test_no_segments_have_no_peaks() -> None:
    found = segment_orientations(Camera(1280, 720, 560.0, (639.5, 359.5)), np.zeros((0, 4)), PaperOptions())
    assert found.peaks_deg == ()
    assert vote_vanishing_points(found, 560.0, PaperOptions()).shape == (0, 2)
