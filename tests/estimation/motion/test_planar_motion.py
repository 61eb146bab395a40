"""Planar two-frame motion: estimation, derivatives, and the side-slip test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moved_lenses import moved_lens

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState, Parameterisation
from autocalib_ros.estimation.adjustment.residual_blocks import PlanarMotionBlock
from autocalib_ros.estimation.motion.planar_motion import (
    PlanarMotion,
    WindowRays,
    initial_motion,
    refined,
    without_side_slip,
)
from autocalib_ros.estimation.observations.two_frame_windows import TwoFrameWindows
from autocalib_ros.geometry.lens_slopes import PolarRays
from autocalib_ros.geometry.small_matrices import rotation_matrix
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import pose

CAMERA = Camera(1280, 720, 560.0, (645.0, 352.0), (0.01, 0.0, 0.0, 0.0))
POSE = pose(30.0, 1.5, 20.0)
HEIGHT_M = 8.0
POINTS = 8


def window(positions: np.ndarray, headings: np.ndarray, bodies: list[np.ndarray]) -> np.ndarray:
    """Pixels (3, POINTS, 2) of points on bodies at positions (bodies, 3, 2) with headings (bodies, 3)."""
    seen = []
    for where, heading, body in zip(positions, headings, bodies, strict=True):
        forward = np.column_stack([np.cos(heading), np.sin(heading)])
        left = np.column_stack([-forward[:, 1], forward[:, 0]])
        ground = where[:, None] + body[:, 0, None] * forward[:, None] + body[:, 1, None] * left[:, None]
        up = np.broadcast_to(body[:, 2] - HEIGHT_M, ground.shape[:2])
        seen.append(CAMERA.project(np.dstack([ground, up]) @ POSE.T)[0])
    return np.concatenate(seen, axis=1)


def windows_of(pixels: np.ndarray) -> TwoFrameWindows:
    """Windows of pixels (windows, 3, POINTS, 2), one body each."""
    count = len(pixels)
    return TwoFrameWindows(
        first_px=pixels[:, 0],
        second_px=pixels[:, 2],
        middle_px=pixels[:, 1],
        mask=np.ones((count, pixels.shape[2]), bool),
        bodies=np.arange(count),
        times_s=np.zeros(count),
        duration_s=np.full(count, 1.6),
        tracks=np.zeros((count, pixels.shape[2]), int),
    )


def car(generator: np.random.Generator, points: int = POINTS) -> np.ndarray:
    return generator.uniform([-2.0, -0.8, 0.2], [2.0, 0.8, 1.6], (points, 3))


def turning(generator: np.random.Generator, turn_deg: float, speed_m: float = 8.0) -> np.ndarray:
    """One car that turns by `turn_deg` at constant rate."""
    heading = generator.uniform(0, 2 * np.pi) + np.radians(turn_deg) * np.array([0.0, 0.5, 1.0])
    chords = (
        0.5
        * speed_m
        * np.column_stack([np.cos(0.5 * (heading[:-1] + heading[1:])), np.sin(0.5 * (heading[:-1] + heading[1:]))])
    )
    where = generator.uniform([12.0, -6.0], [22.0, 6.0]) + np.concatenate([[[0.0, 0.0]], np.cumsum(chords, axis=0)])
    return window(where[None], heading[None], [car(generator)])


def crossing(generator: np.random.Generator) -> np.ndarray:
    """Two cars on straight paths, grouped as one."""
    heading = generator.uniform(0, 2 * np.pi) + np.array([0.0, generator.uniform(0.3, 1.2)])
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    start = generator.uniform([14.0, -5.0], [20.0, 5.0])
    where = start + np.array([0.0, 4.0, 8.0])[:, None] * forward[:, None]
    return window(where, np.repeat(heading[:, None], 3, axis=1), [car(generator, POINTS // 2) for _ in range(2)])


def view_of(windows: TwoFrameWindows) -> WindowRays:
    return WindowRays.of(windows, CAMERA, POSE, JointOptions())


@pytest.mark.parametrize('turn_deg', [-70.0, -12.0, 3.0, 25.0, 90.0])
def test_the_motion_of_a_turning_car_is_found_without_an_initial_value(turn_deg: float) -> None:
    generator = np.random.default_rng(3)
    view = view_of(windows_of(np.stack([turning(generator, turn_deg) for _ in range(5)])))
    motion = refined(view, initial_motion(view), rounds=30)
    assert np.degrees(motion.turn_rad) == pytest.approx(np.full(5, turn_deg), abs=0.01)
    assert np.abs(view.distances(motion)).max() < 1e-3


def test_the_distance_is_in_observed_pixels_over_their_standard_deviation() -> None:
    generator = np.random.default_rng(4)
    windows = windows_of(turning(generator, 20.0)[None])
    view = view_of(windows)
    motion = initial_motion(view)
    for step in np.array([[1.0, 0.0], [0.0, 1.0]]):
        nearer = windows.second_px.copy()
        nearer[0, 0] += 0.01 * step
        shifted = WindowRays.of(
            TwoFrameWindows(
                windows.first_px,
                nearer,
                windows.middle_px,
                windows.mask,
                windows.bodies,
                windows.times_s,
                windows.duration_s,
                windows.tracks,
            ),
            CAMERA,
            POSE,
            JointOptions(),
        )
        off_px = shifted.distances(motion)[0, 0] * view.sigma_px[0, 0]
        assert abs(off_px) <= 0.01 / np.sqrt(2) * 1.5  # both ends share a displacement
    assert (view.sigma_px > JointOptions().noise_px).all()


def test_refinement_converges_from_nearby_and_ignores_an_outlier() -> None:
    generator = np.random.default_rng(5)
    windows = windows_of(turning(generator, 20.0)[None])
    view = view_of(windows)
    true = initial_motion(view)
    back = refined(view, true.moved(0.05, -0.1), rounds=20)
    assert back.turn_rad == pytest.approx(true.turn_rad, abs=1e-4)
    windows.second_px[0, 0] += [15.0, -20.0]
    assert refined(view_of(windows), true, 20).turn_rad == pytest.approx(true.turn_rad, abs=np.radians(1.0))


def test_only_steered_motion_counts_as_turning() -> None:
    generator = np.random.default_rng(6)
    kinds = {
        'turning': [turning(generator, sign * turn) for turn in (12.0, 20.0, 35.0, 60.0) for sign in (-1, 1)],
        'straight': [turning(generator, 0.0) for _ in range(40)],
        'crossing': [crossing(generator) for _ in range(20)],
    }
    shares = {}
    for kind, pixels in kinds.items():
        windows = windows_of(np.stack(pixels) + generator.normal(scale=0.3, size=np.shape(pixels)))
        view = view_of(windows)
        motion = initial_motion(view)
        shares[kind] = without_side_slip(windows, view, motion, CAMERA, POSE, HEIGHT_M)[1].mean()
        if kind == 'crossing':
            assert np.median(np.abs(np.degrees(motion.turn_rad))) > 5.0  # their displacements look like a turn
    assert shares['turning'] > 0.5  # some turns are too small
    assert shares['straight'] == 0.0
    assert shares['crossing'] < 0.1


def test_derivatives_match_finite_differences() -> None:
    generator = np.random.default_rng(7)
    pixels = np.stack([turning(generator, turn) for turn in (15.0, -30.0, 40.0)])
    windows = windows_of(pixels + generator.normal(scale=0.05, size=pixels.shape))
    prior = lens_priors((1280, 720), JointOptions())[0]
    parameters = Parameterisation(
        AdjustmentState(CAMERA, POSE, np.zeros(0)), AdjustmentConfig(prior, JointOptions(), windows=windows)
    )
    rows = PlanarMotionBlock(parameters, None)
    here = rows.linearise()
    assert here.curvature.shape == (3, parameters.size, parameters.size)
    # log f, the principal point and k1 in their prior's sigmas, two turns of the plane
    step = np.array([1e-3, 2e-3, -2e-3, 2e-3, 4e-4, -3e-4])
    _, there = rows.at(step)
    changed = rows.dof * (there - here.squared)
    foretold = 2 * here.gradient @ step + np.einsum('p,rpq,q->r', step, here.curvature, step)
    assert changed == pytest.approx(foretold, rel=0.03)


@pytest.mark.parametrize(
    'camera',
    [replace(CAMERA, k=(0.05, -0.01, 0.002, 0.0)), replace(CAMERA, pixel_aspect=1.3, skew=0.05)],
    ids=['square', 'squeezed'],
)
def test_shared_slopes_are_those_of_small_steps(camera: Camera) -> None:
    generator = np.random.default_rng(7)
    pixels = np.stack([turning(generator, turn) for turn in (15.0, -30.0, 40.0, 3.0)])
    windows = windows_of(pixels + generator.normal(scale=1.0, size=pixels.shape))

    def view_through(lens: Camera, pose_after: np.ndarray) -> WindowRays:
        return WindowRays.of(windows, lens, pose_after, JointOptions())

    def difference(ahead: WindowRays, behind: WindowRays) -> np.ndarray:
        return (ahead.distances(motion) - behind.distances(motion)) / (2 * step)

    view, step, axes = view_through(camera, POSE), 1e-6, np.eye(3)
    motion = initial_motion(view)
    differences = [
        difference(*(view_through(moved_lens(camera, parameter, sign * step), POSE) for sign in (1, -1)))
        for parameter in range(6)
    ] + [
        difference(*(view_through(camera, POSE @ rotation_matrix(sign * step * axis)) for sign in (1, -1)))
        for axis in axes
    ]
    slopes = view.shared_slopes(motion, PolarRays(camera, windows.ends_px, view.rays.bearings), np.arange(6), axes)
    for slope, expected in zip(slopes, differences, strict=True):
        np.testing.assert_allclose(slope, expected, atol=1e-6 * np.abs(expected).max())


def test_a_subset_of_motions_keeps_its_order() -> None:
    motion = PlanarMotion(np.array([0.1, 0.2]), np.array([1.0, 2.0]))
    assert motion.subset(np.array([1])).heading_rad.tolist() == [2.0]
