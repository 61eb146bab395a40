"""Pedestrians in the evidence: the robust method does not use them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.estimation.observations.selection import drop_pedestrians
from autocalib_ros.evidence.snapshot import Evidence, TrackKind
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import ONE_FAMILY, solve_once


def with_people(evidence: Evidence, count: int, generator: np.random.Generator) -> Evidence:
    """Add tracks of pedestrians before those of the vehicles: long, straight, and in all directions."""
    samples, (width, height) = 20, evidence.image_size
    ends = generator.uniform([0, 0.4 * height], [width, height], (count, 2, 2))
    along = np.linspace(0, 1, samples)[:, None]
    paths = (ends[:, :1] + along * (ends[:, 1:] - ends[:, :1])).reshape(-1, 2)
    return replace(
        evidence,
        points_px=np.concatenate([paths, evidence.points_px]),
        times_s=np.concatenate([np.tile(0.4 * np.arange(samples), count), evidence.times_s]),
        track_starts=np.concatenate([samples * np.arange(count), evidence.track_starts + samples * count]),
        track_vehicles=np.concatenate([100000 + np.arange(count), evidence.track_vehicles]),
        track_kinds=np.concatenate(
            [np.full(count, TrackKind.PERSON), np.full(evidence.track_count, TrackKind.VEHICLE)]
        ).astype(np.uint8),
    )


@pytest.mark.solve
def test_pedestrians_change_neither_lens_nor_plane_nor_the_labels_of_vehicles() -> None:
    evidence = synthetic_evidence(Junction(), np.random.default_rng(3))
    crowd = with_people(evidence, 80, np.random.default_rng(4))
    alone, among = (solve_once(one, Options(camera_height=8.0, joint=ONE_FAMILY)) for one in (evidence, crowd))
    assert isinstance(alone, Calibration) and isinstance(among, Calibration)
    assert among.camera == alone.camera
    np.testing.assert_array_equal(among.ground.normal_in_camera, alone.ground.normal_in_camera)
    assert (among.figures.track_labels[:80] == -1).all()
    np.testing.assert_array_equal(among.figures.track_labels[80:], alone.figures.track_labels)


def test_vehicle_tracks_are_too_few_if_most_are_of_pedestrians() -> None:
    evidence = synthetic_evidence(Junction(), np.random.default_rng(3))
    kinds = np.where(np.arange(evidence.track_count) < 10, TrackKind.VEHICLE, TrackKind.PERSON).astype(np.uint8)
    refused = solve_once(replace(evidence, track_kinds=kinds), Options(camera_height=8.0))
    assert isinstance(refused, Refusal) and refused.code == 'too_few_tracks'
    assert refused.message.startswith('10 tracks after ')
    assert len(refused.figures.paper_tracks)  # the published method uses all tracks


def test_unclassified_tracks_count_as_vehicles() -> None:
    evidence = synthetic_evidence(Junction(), np.random.default_rng(3))
    traffic, kept = drop_pedestrians(evidence)
    assert traffic is evidence and len(kept) == evidence.track_count
