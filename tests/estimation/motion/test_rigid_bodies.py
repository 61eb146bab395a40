"""Bundle adjustment of rigid bodies: exact motion, derivatives, outliers and drift."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState, Parameterisation
from autocalib_ros.estimation.adjustment.residual_blocks import RigidBodyBlock
from autocalib_ros.estimation.motion.rigid_bodies import TrackletBundle
from autocalib_ros.estimation.observations.track_set import SAMPLES_PER_TRACK
from autocalib_ros.estimation.observations.tracklets import MAX_INSTANTS, Tracklets, find_tracklets, no_tracklets
from autocalib_ros.estimation.observations.two_frame_windows import ResampledTracks, find_windows
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.monte_carlo import draw_evidence
from autocalib_ros.offline.synthetic.junction import pose

CAMERA = Camera(1280, 720, 560.0, (645.0, 352.0), (0.01, 0.0, 0.0, 0.0))
POSE = pose(30.0, 1.5, 20.0)
HEIGHT_M = 8.0
NOISE_PX = 0.3


def life(generator: np.random.Generator, turn_deg: float, points: int = SAMPLES_PER_TRACK) -> np.ndarray:
    """Pixels (SAMPLES_PER_TRACK, MAX_INSTANTS, 2) of a car that turns by `turn_deg`."""
    heading = generator.uniform(0, 2 * np.pi) + np.radians(turn_deg) * np.linspace(0, 1, MAX_INSTANTS)
    steps = 1.5 * np.column_stack([np.cos(heading), np.sin(heading)])
    where = generator.uniform([14.0, -5.0], [20.0, 5.0]) + np.cumsum(steps, axis=0)
    body = generator.uniform([-2.0, -0.8, 0.2], [2.0, 0.8, 1.6], (points, 3))
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    left = np.column_stack([-forward[:, 1], forward[:, 0]])
    ground = where + body[:, 0, None, None] * forward + body[:, 1, None, None] * left
    up = np.broadcast_to((body[:, 2] - HEIGHT_M)[:, None], ground.shape[:2])
    return CAMERA.project(np.dstack([ground, up]) @ POSE.T)[0]


def lives_of(pixels: np.ndarray) -> Tracklets:
    count = len(pixels)
    return Tracklets(pixels, np.ones(pixels.shape[:3], bool), np.arange(count), np.zeros(count))


def noisy(generator: np.random.Generator, count: int = 12) -> Tracklets:
    pixels = np.stack([life(generator, turn) for turn in np.linspace(-70, 70, count)])
    return lives_of(pixels + generator.normal(scale=NOISE_PX, size=pixels.shape))


def test_perfect_motion_leaves_no_residual() -> None:
    generator = np.random.default_rng(1)
    bundle = TrackletBundle(
        lives_of(np.stack([life(generator, turn) for turn in (-60.0, -10.0, 0.0, 25.0, 80.0)])), 0.3, 0.05
    )
    unknowns = bundle.refined(CAMERA, POSE, bundle.initialised(CAMERA, POSE), 60)
    assert np.abs(bundle.residuals(CAMERA, POSE, unknowns)).max() < 0.05
    reference = bundle.reference[0]
    assert not unknowns.translations[0, reference].any() and unknowns.turns_rad[0, reference] == 0.0
    assert np.degrees(np.ptp(unknowns.turns_rad, axis=1)) == pytest.approx([60.0, 10.0, 0.0, 25.0, 80.0], abs=0.5)


def test_whitened_residuals_have_unit_variance() -> None:
    bundle = TrackletBundle(noisy(np.random.default_rng(2)), NOISE_PX, 0.0)
    unknowns = bundle.initialised(CAMERA, POSE)
    squared = (bundle.residuals(CAMERA, POSE, unknowns) ** 2).sum(axis=(1, 2, 3)) / bundle.dof
    assert squared.mean() == pytest.approx(1.0, abs=0.25)


def test_an_outlier_on_the_body_is_down_weighted() -> None:
    generator = np.random.default_rng(3)
    tracklets = noisy(generator, 4)
    tracklets.pixels[0, 0] += np.linspace(0, 60, MAX_INSTANTS)[:, None]
    bundle = TrackletBundle(tracklets, NOISE_PX, 0.0)
    unknowns = bundle.initialised(CAMERA, POSE)
    robust_weight = bundle.robust_weight(bundle.residuals(CAMERA, POSE, unknowns))
    assert robust_weight[0, 0] < 0.1 < 0.5 < np.median(robust_weight)


def test_derivatives_match_finite_differences() -> None:
    prior = lens_priors((1280, 720), JointOptions())[0]
    bundle = TrackletBundle(noisy(np.random.default_rng(4), 5), NOISE_PX, 0.0)
    steps = Parameterisation(
        AdjustmentState(CAMERA, POSE, np.zeros(0)), AdjustmentConfig(prior, JointOptions(), bundle=bundle)
    )
    unknowns = bundle.initialised(CAMERA, POSE)
    rows = RigidBodyBlock(steps, bundle, unknowns)
    here = rows.linearise()
    for index in range(steps.size):
        step = np.zeros(steps.size)
        step[index] = 2e-3
        _, there = rows.at(step)
        changed = (rows.dof * (there - here.squared)).sum()
        foretold = (2 * here.gradient @ step + np.einsum('p,rpq,q->r', step, here.curvature, step)).sum()
        assert changed == pytest.approx(foretold, rel=0.1, abs=2e-3)


def test_the_likelihood_shows_whether_points_drift() -> None:
    generator = np.random.default_rng(5)
    without_drift = noisy(generator, 20)
    walk = np.cumsum(generator.normal(scale=0.5, size=without_drift.pixels.shape), axis=2)
    drifting = lives_of(without_drift.pixels + walk)
    for tracklets, drifts in ((without_drift, False), (drifting, True)):
        bundle = TrackletBundle(tracklets, NOISE_PX, 0.05)
        unknowns = bundle.initialised(CAMERA, POSE)
        more_probable = bundle.noise_cost(CAMERA, POSE, unknowns) < bundle.without_drift().noise_cost(
            CAMERA, POSE, unknowns
        )
        assert more_probable == drifts


def test_tracklets_follow_the_tracks_of_a_body_and_take_bodies_in_turn() -> None:
    _, evidence = draw_evidence('turning', 0, 0)
    instants = ResampledTracks(evidence)
    windows = find_windows(evidence, instants)
    tracklets = find_tracklets(windows, instants, 1000)
    assert len(np.unique(tracklets.bodies)) > 15
    assert (tracklets.mask.sum(axis=(1, 2)) >= 15).all()
    times = evidence.times_s[evidence.track_starts[0] : evidence.track_starts[1]]
    assert times.min() - 1 < tracklets.times_s.min()
    few = find_tracklets(windows, instants, 10)
    assert len(np.unique(few.bodies)) == 10
    assert not len(find_tracklets(windows.subset(np.zeros(0, int)), instants, 10))
    assert not len(no_tracklets())
