"""Focal length from straightness, as published."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import PaperOptions
from autocalib_ros.estimation.paper.intrinsics import (
    distortion_polynomial,
    paper_intervals,
    paper_intrinsics,
)
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence

pytestmark = pytest.mark.solve

STRAIGHT = Junction(turning_fraction=0.0, wander_m=0.0, noise_px=0.2)
WINDOW = PaperOptions(window_s=3.0)  # synthetic vehicles cross the image in three to eight seconds


def test_published_sweep_finds_the_focal_length_of_clean_straight_traffic() -> None:
    evidence = synthetic_evidence(STRAIGHT, np.random.default_rng(0))
    found = paper_intrinsics(evidence, WINDOW)
    assert found is not None
    assert found.report.focal_px == pytest.approx(560.0, rel=0.05)  # the published method's own error is 7 %


def test_straightness_improves_by_undistortion() -> None:
    found = paper_intrinsics(synthetic_evidence(STRAIGHT, np.random.default_rng(0)), WINDOW)
    assert found is not None
    before, after = found.report.straightness_px2
    assert after < before / 4


def test_published_sweep_never_reaches_ninety_degrees() -> None:
    evidence = synthetic_evidence(STRAIGHT, np.random.default_rng(0))
    found = paper_intrinsics(evidence, WINDOW)
    assert found is not None
    paths = [evidence.track(int(index)).points_px for index in found.tracks]
    radius = min(np.hypot(*(path - (639.5, 359.5)).T).min() for path in paths)
    assert radius / found.sweep[0, 0] < np.pi / 2
    assert np.isfinite(found.sweep).all()
    assert found.sweep[-1, 0] == pytest.approx(np.hypot(1280, 720))


def test_published_filters_keep_the_longest_of_each_interval() -> None:
    intervals = paper_intervals(synthetic_evidence(STRAIGHT, np.random.default_rng(0)), WINDOW)
    assert len({len(interval.paths) for interval in intervals}) == 1
    for interval in intervals:
        lengths = [np.hypot(*(path[-1] - path[0])) for path in interval.paths]
        assert len(lengths) <= 10
        assert lengths == sorted(lengths, reverse=True)


def test_published_filters_drop_short_tracks() -> None:
    evidence = synthetic_evidence(STRAIGHT, np.random.default_rng(0))
    assert not paper_intervals(evidence, PaperOptions(window_s=60.0))
    assert paper_intrinsics(evidence, PaperOptions(window_s=60.0)) is None


def test_polynomial_maps_distorted_to_undistorted() -> None:
    camera = Camera(1280, 720, 700.0, (639.5, 359.5))
    k1, k2, k3 = distortion_polynomial(camera)
    r = 0.8
    assert r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) == pytest.approx(np.tan(r), rel=2e-3)
