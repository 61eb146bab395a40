"""The closed derivatives of straight tracks against differences of their exact residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior, lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState, Parameterisation
from autocalib_ros.estimation.adjustment.residual_blocks import StraightTrackBlock
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks
from autocalib_ros.lens.camera import Camera
from random_geometry import SIZE, between, poses, reproducible

HEIGHT_M, SAMPLES = 8.0, 10


def lens_prior() -> LensPrior:
    """Return a prior that leaves every parameter of the lens free."""
    prior = lens_priors(SIZE, JointOptions())[0]
    return replace(prior, sigma=np.where(prior.sigma > 0, prior.sigma, 0.02))


def tracks_along(
    state: AdjustmentState, labels: np.ndarray, noise_px: float, generator: np.random.Generator
) -> TrackSet:
    """Return straight tracks (labels,) of points that drive along their roads where the camera looks."""
    axis = state.rotation[2]
    ahead = np.arctan2(axis[1], axis[0])
    away = HEIGHT_M * generator.uniform(0.8, 3.0, len(labels))
    aside = ahead + generator.uniform(-0.4, 0.4, len(labels))
    middle = np.column_stack([away * np.cos(aside), away * np.sin(aside), np.full(len(labels), -HEIGHT_M)])
    along = np.linspace(-4.0, 4.0, SAMPLES)[None, :, None] * state.in_plane[labels][:, None]
    pixels, _ = state.camera.project((middle[:, None] + along) @ state.rotation.T)
    return TrackSet(
        pixels + generator.normal(0.0, noise_px, pixels.shape),
        np.full(pixels.shape[:2], 1.0 / SAMPLES),
        np.arange(len(labels)),
        np.tile(np.linspace(0.0, 1.0, SAMPLES), (len(labels), 1)),
        np.arange(len(labels)),
    )


@st.composite
def blocks(draw: st.DrawFn) -> tuple[StraightTrackBlock, Parameterisation]:
    """Straight tracks on two or three roads of any lens and pose, a little off the state at which they are judged."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    camera = Camera(*SIZE, draw(between(450.0, 900.0)), (639.5, 359.5), (draw(between(-0.03, 0.1)), 0.0, 0.0, 0.0))
    angles = np.array([0.0, draw(between(0.6, 1.6)), draw(between(2.0, 2.6))])[: draw(st.integers(2, 3))]
    state = AdjustmentState(camera, draw(poses()), angles)
    labels = np.arange(12) % len(angles)
    tracks = tracks_along(state, labels, draw(between(0.0, 1.0)), generator)
    crossing = angles[1] if draw(st.booleans()) else None
    config = AdjustmentConfig(lens_prior(), JointOptions(), HEIGHT_M, crossing_rad=crossing)
    exact = Parameterisation(state, config)
    base = exact.state(generator.normal(0.0, 0.01, exact.size))  # a hundredth of a sigma, and of a radian
    parameters = Parameterisation(base, config)
    block = StraightTrackBlock(
        parameters, tracks, labels, UnprojectedTracks.through(base.camera, tracks), np.ones(len(labels))
    )
    return block, parameters


@reproducible(40)
@given(blocks())
def test_gradients_of_straight_tracks_are_those_of_their_residuals(
    drawn: tuple[StraightTrackBlock, Parameterisation],
) -> None:
    block, parameters = drawn
    here = block.linearise()
    step = 1e-5
    differences = np.column_stack(
        [block.dof * (block.at(unit) - block.at(-unit)) / (2 * step) for unit in step * np.eye(parameters.size)]
    )
    squared = block.at(np.zeros(parameters.size))
    np.testing.assert_allclose(here.squared, squared, rtol=1e-9, atol=1e-12)
    # a part in a thousand of the steepest: circles minimise distances that are weighted once, so nearly the residuals
    largest = np.abs(differences).max(axis=1, keepdims=True)
    np.testing.assert_allclose(2 * here.gradient, differences, atol=1e-3 * float(largest.max()) + 1e-6)


@reproducible(40)
@given(blocks())
def test_curvature_foretells_how_residuals_change(drawn: tuple[StraightTrackBlock, Parameterisation]) -> None:
    block, parameters = drawn
    here = block.linearise()
    for index in range(parameters.size):
        step = np.zeros(parameters.size)
        step[index] = 1e-3  # of a sigma, a radian or log f: small against what bends the residuals
        changed = (block.dof * (block.at(step) - here.squared)).sum()
        foretold = (2 * here.gradient @ step + np.einsum('p,rpq,q->r', step, here.curvature, step)).sum()
        assert changed == pytest.approx(foretold, rel=0.05, abs=1e-2), index
