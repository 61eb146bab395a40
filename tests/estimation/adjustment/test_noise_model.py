"""Whitening of simulated distances gives independent residuals of unit variance."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.noise_model import RoadPositions, whitening_matrices

SAMPLES, TRACKS = 10, 4000
OPTIONS = JointOptions()


def place() -> tuple[np.ndarray, np.ndarray, RoadPositions]:
    """Tracks 400 px and 30 m long, from 10 px a metre to 40."""
    pixels = np.zeros((TRACKS, SAMPLES, 2))
    pixels[..., 0] = np.linspace(0, 400, SAMPLES)
    along = np.broadcast_to(np.linspace(0, 30, SAMPLES), (TRACKS, SAMPLES))
    scale = np.broadcast_to(np.linspace(10, 40, SAMPLES), (TRACKS, SAMPLES))
    return pixels, np.ones((TRACKS, SAMPLES), bool), RoadPositions(scale, along)


def test_noise_and_wander_come_out_white() -> None:
    pixels, mask, road = place()
    generator = np.random.default_rng(0)
    apart = (road.along_m[0][:, None] - road.along_m[0]) / 10.0
    shared = np.linalg.cholesky(np.exp(-0.5 * apart**2) + 1e-9 * np.eye(SAMPLES))
    wander = OPTIONS.wander_m * generator.normal(size=(TRACKS, SAMPLES)) @ shared.T * road.px_per_m
    distance = wander + OPTIONS.noise_px * generator.normal(size=(TRACKS, SAMPLES))
    white = np.einsum('tij,tj->ti', whitening_matrices(pixels, mask, road, OPTIONS, drifting=False), distance)
    np.testing.assert_allclose(white.T @ white / TRACKS, np.eye(SAMPLES), atol=0.1)  # 4000 draws: 4 sigma


def test_drift_lowers_the_weight_of_the_ends_of_long_tracks() -> None:
    pixels, mask, road = place()
    steady, drifting = (
        whitening_matrices(
            pixels[:1], mask[:1], RoadPositions(road.px_per_m[:1], road.along_m[:1]), OPTIONS, drifting=drifting
        )[0]
        for drifting in (False, True)
    )
    slope = np.linspace(-1.0, 1.0, SAMPLES)
    assert np.sum((drifting @ slope) ** 2) < 0.7 * np.sum((steady @ slope) ** 2)


@pytest.mark.parametrize('drifting', [False, True])
def test_masked_samples_have_no_weight(drifting: bool) -> None:
    pixels, mask, road = place()
    mask[:, 7:] = False
    whiten = whitening_matrices(pixels, mask, road, OPTIONS, drifting=drifting)[0]
    assert not whiten[:, 7:].any()
    distance = np.zeros(SAMPLES)
    distance[7:] = 1e6
    assert not (whiten @ distance).any()
