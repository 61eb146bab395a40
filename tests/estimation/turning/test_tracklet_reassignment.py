"""Tracklets in a wrong minimum, tracklets that contradict windows, and halves that contradict the whole."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autocalib_ros.config import GateOptions, JointOptions, Options
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import known_lens, lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState, Parameterisation
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.estimation.motion.rigid_bodies import TrackletBundle
from autocalib_ros.estimation.observations.track_set import TrackSet, select_tracks
from autocalib_ros.estimation.observations.tracklets import Tracklets, find_tracklets
from autocalib_ros.estimation.observations.two_frame_windows import ResampledTracks, TwoFrameWindows, find_windows
from autocalib_ros.estimation.turning import turning_traffic as turning
from autocalib_ros.estimation.verification.consistency import compare_solutions, expected_half_differences
from autocalib_ros.estimation.verification.gates import ComparedHalves, check_halves
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.drives import drive_arc
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.refusals import Reason
from solved_once import ONE_FAMILY

pytestmark = pytest.mark.solve

TURNING = Junction(drive=partial(drive_arc, radii_m=(12.0, 60.0)), vehicles=14, points_per_vehicle=8, noise_px=0.3)
TRUTH = AdjustmentState(TURNING.camera, TURNING.camera_from_ground, np.zeros(0))


def evidence_of(seed: int) -> Evidence:
    return synthetic_evidence(TURNING, np.random.default_rng(seed))


def slid(evidence: Evidence, generator: np.random.Generator, reach_px: float) -> Evidence:
    """Let each tracked point slip on its vehicle, back and forth with a period of about 600 px of path."""
    points = evidence.points_px.copy()
    for begin, end in zip(evidence.track_starts[:-1], evidence.track_starts[1:], strict=True):
        steps = np.hypot(*np.diff(points[begin:end], axis=0).T)
        way = np.concatenate([[0.0], np.cumsum(steps)])[:, None]
        phase, length_px = generator.uniform(0, 2 * np.pi, 2), generator.uniform(420, 840)
        points[begin:end] += reach_px * generator.normal(size=2) * np.sin(2 * np.pi * way / length_px + phase)
    return replace(evidence, points_px=points)


def sigmas_off(result: Calibration) -> float:
    """Larger error of tilt and roll, in their standard deviations."""
    assert result.ground is not None
    sigma = np.array([result.stddev.tilt_deg, result.stddev.roll_deg], float)
    off_deg = tilt_and_roll_deg(result.ground.normal_in_camera) - tilt_and_roll_deg(TURNING.normal_in_camera)
    return float((np.abs(off_deg) / sigma).max())


@pytest.mark.parametrize('seed', range(2))
def test_few_vehicles_whose_points_slide_do_not_mislead(seed: int) -> None:
    generator = np.random.default_rng(seed)
    evidence = slid(synthetic_evidence(TURNING, generator), generator, 1.0)
    result = solve(evidence, Options(camera_height=8.0, joint=ONE_FAMILY), lens=TURNING.camera)
    if isinstance(result, Calibration) and result.ground is not None:
        assert sigmas_off(result) < 3.0


def turned_lives(windows: TwoFrameWindows, instants: ResampledTracks, limit: int, *, by_deg: float) -> Tracklets:
    """Find tracklets as a slightly rotated camera would see them: bodies that move in another plane."""
    tracklets = find_tracklets(windows, instants, limit)
    bearings, _ = TURNING.camera.unproject(tracklets.pixels)
    turn = Rotation.from_rotvec(np.radians([by_deg, 0.0, 0.0])).as_matrix()
    pixels, _ = TURNING.camera.project(bearings @ turn.T)
    return replace(tracklets, pixels=np.where(tracklets.mask[..., None], pixels, 0.0))


def test_tracklets_that_contradict_windows_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(turning, 'find_tracklets', partial(turned_lives, by_deg=8.0))
    result = solve(evidence_of(1), Options(camera_height=8.0, joint=ONE_FAMILY), lens=TURNING.camera)
    if isinstance(result, Calibration) and result.ground is not None:
        assert sigmas_off(result) < 3.0
    windows, fit, tracks = by_windows(evidence_of(1))
    kept, compared = turning.refine_with_tracklets(fit, tracks, windows, ResampledTracks(evidence_of(1)))
    assert compared is not None and compared.rejected
    assert compare_solutions(kept, fit).normal_deg < 0.1
    assert turning.widen_by_tracklet_difference(kept, None) is kept
    widened = turning.widen_by_tracklet_difference(kept, compared)
    before, after = compare_solutions(kept, kept).sigmas[1], compare_solutions(widened, widened).sigmas[1]
    apart_deg = np.degrees(np.arccos(kept.state.rotation[:, 2] @ compared.state.rotation[:, 2]))
    assert apart_deg > 5.0
    assert after**2 - before**2 == pytest.approx(2 * apart_deg**2, rel=0.05)  # as of two estimates with that error each


def by_windows(evidence: Evidence) -> tuple[TwoFrameWindows, Adjustment, TrackSet]:
    """Adjust with windows alone, starting at the truth."""
    windows = find_windows(evidence, ResampledTracks(evidence))
    nothing = select_tracks(evidence, 500).subset(np.zeros(0, int))
    fit = adjust(
        TRUTH, nothing, AdjustmentConfig(known_lens(TURNING.camera), JointOptions(), windows=windows), refine=True
    )
    return windows, turning.refine_with_turning(fit, nothing, windows) or fit, nothing


def test_a_tracklet_in_a_wrong_minimum_is_restarted() -> None:
    evidence = evidence_of(3)
    windows, fit, nothing = by_windows(evidence)
    tracklets = find_tracklets(windows, ResampledTracks(evidence), 100)
    bundle = TrackletBundle(tracklets, 0.3, 0.0)
    config = replace(fit.problem.config, windows=windows.subset(np.zeros(0, int)), bundle=bundle)
    good = adjust(TRUTH, nothing, config, refine=True)
    unknowns = good.problem.warm_start[2]
    assert unknowns is not None
    # a body that turns the other way: no small step leads to its true motion
    turns_rad = np.where(np.arange(len(tracklets))[:, None] < 3, -unknowns.turns_rad, unknowns.turns_rad)
    stuck = replace(unknowns, turns_rad=turns_rad)
    bad = adjust(TRUTH, nothing, config, refine=True, warm_start=(None, None, stuck))
    mended = turning.restart_tracklets(bad, nothing)
    assert (bad.turning2[:3] > 1.5 * good.turning2[:3]).any()
    assert (mended.turning2[:3] < 1.1 * good.turning2[:3]).all()


def test_halves_bound_the_standard_deviation_of_the_whole() -> None:
    generator = np.random.default_rng(1)
    _, fit, nothing = by_windows(slid(synthetic_evidence(TURNING, generator), generator, 8.0))
    agreed = check_halves(fit, nothing, GateOptions())
    assert isinstance(agreed, ComparedHalves) and agreed.statement.kind == 'halves'
    assert [(row.kind, row.passed) for row in agreed.rows] == [
        ('halves_focal', True),
        ('halves_normal', True),
        ('halves_pose', True),
    ]
    boasting = replace(fit, covariance=1e-4 * fit.covariance)
    doubt = check_halves(boasting, nothing, GateOptions())
    assert isinstance(doubt, Reason) and doubt.code == 'halves_disagree'


def test_equally_informative_halves_differ_by_twice_the_deviation_of_the_whole() -> None:
    _, fit, _ = by_windows(evidence_of(2))
    half = replace(fit, information=0.5 * fit.information)
    whole = compare_solutions(fit, fit).sigmas / np.sqrt(2)
    assert expected_half_differences(fit, half, half) == pytest.approx(2 * whole, rel=1e-3)
    third, rest = (replace(fit, information=share * fit.information) for share in (0.2, 0.8))
    assert expected_half_differences(fit, third, rest)[1] == pytest.approx(2.5 * whole[1], rel=1e-3)


def test_the_step_to_a_state_leads_there() -> None:
    prior = lens_priors((1280, 720), JointOptions())[0]
    base = AdjustmentState(
        Camera(1280, 720, 560.0, (640.0, 360.0), (0.01, 0, 0, 0)), TRUTH.rotation, np.array([0.0, 1.5])
    )
    steps = Parameterisation(base, AdjustmentConfig(prior, JointOptions()))
    step = np.random.default_rng(0).normal(scale=0.05, size=steps.size)
    assert steps.step_to(steps.state(step)) == pytest.approx(step, abs=1e-9)
