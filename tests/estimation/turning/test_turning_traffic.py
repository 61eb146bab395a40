"""Calibration from turning vehicles, and motion that only looks like turning."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from autocalib_ros.config import JointOptions, LensOptions, Options
from autocalib_ros.offline.synthetic.drives import (
    Companion,
    beside,
    drive_arc,
    drive_ring,
    shadow,
    trailer,
    walk_along_road,
)
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import solve_once

pytestmark = pytest.mark.solve

TURNING = Junction(drive=partial(drive_arc, radii_m=(12.0, 60.0)), vehicles=40, points_per_vehicle=8)
FEWER = replace(TURNING, vehicles=24, points_per_vehicle=6)
OPTIONS = Options(camera_height=8.0, lens=LensOptions(pixel_aspect=1.0))
ONE_FAMILY = replace(OPTIONS, joint=JointOptions(lens_prior='equidistant'))
"""For questions that do not depend on how the family of the lens is chosen: each of the others is another solution."""


def solved(junction: Junction, seed: int = 0, options: Options = OPTIONS) -> Calibration | Refusal:
    return solve_once(synthetic_evidence(junction, np.random.default_rng(seed)), options)


def normal_error_deg(result: Calibration, junction: Junction) -> float:
    assert result.ground is not None
    return float(np.degrees(np.arccos(np.clip(result.ground.normal_in_camera @ junction.normal_in_camera, -1, 1))))


def test_perfect_turning_traffic_gives_the_truth() -> None:
    junction = replace(FEWER, wander_m=0.0, noise_px=0.0)
    result = solved(junction)
    assert isinstance(result, Calibration)
    assert result.camera.focal_px == pytest.approx(560.0, rel=5e-3)
    assert normal_error_deg(result, junction) < 0.2
    assert any(check.kind == 'turning_vehicles' and check.values['vehicles'] >= 8 for check in result.checks)


@pytest.mark.parametrize(
    ('traffic', 'joined', 'companion'),
    [
        (FEWER, 0.3, beside),
        (FEWER, 0.5, partial(beside, speeds=(1.0, 1.0))),
        (FEWER, 0.5, trailer),
        (TURNING, 0.5, shadow),
    ],
    ids=['beside', 'as_fast', 'trailer', 'shadow'],
)
def test_turning_traffic_alone_calibrates_even_when_groups_are_wrong(
    traffic: Junction, joined: float, companion: Companion
) -> None:
    """Without wrong groups: the golden case `turning`, which has hardly any."""
    junction = replace(traffic, merged_fraction=joined, companion=companion)
    result = solved(junction, seed=1, options=ONE_FAMILY)
    assert isinstance(result, Calibration)
    sigma = result.stddev
    assert sigma.focal_px is not None and sigma.tilt_deg is not None and sigma.roll_deg is not None
    assert abs(result.camera.focal_px - 560.0) < max(3.0 * sigma.focal_px, 0.02 * 560.0)
    assert normal_error_deg(result, junction) < 3.0 * np.hypot(sigma.tilt_deg, sigma.roll_deg)
    assert sigma.focal_px < 0.05 * 560.0


def test_cars_side_by_side_on_one_road_give_no_plane() -> None:
    junction = Junction(
        road_angles_deg=(0.0,),
        camera_from_ground=pose(30.0, 1.0, 60.0),
        vehicles=40,
        points_per_vehicle=4,
        turning_fraction=0.0,
        merged_fraction=0.7,
    )
    joint = replace(ONE_FAMILY.joint, single_road=False)  # which needs no turning vehicle
    result = solved(junction, options=replace(OPTIONS, joint=joint))
    if isinstance(result, Calibration):
        assert result.ground is None and result.ground_refusal is not None
        assert result.ground_refusal.code == 'one_direction'


def test_turning_traffic_completes_a_single_road() -> None:
    junction = Junction(
        road_angles_deg=(0.0,),
        camera_from_ground=pose(30.0, 1.0, 50.0),
        vehicles=40,
        points_per_vehicle=6,
        turning_fraction=0.5,
    )
    result = solved(junction, options=ONE_FAMILY)
    assert isinstance(result, Calibration)
    assert normal_error_deg(result, junction) < 1.5


def test_a_ring_alone_is_refused_unless_it_tells_the_lens() -> None:
    result = solved(
        replace(TURNING, drive=partial(drive_ring, radius_m=20.0), vehicles=25, points_per_vehicle=6), 0, ONE_FAMILY
    )
    if isinstance(result, Refusal):
        assert result.code in ('turning_traffic', 'too_little_turning')
    else:
        assert result.stddev.focal_px is not None and result.stddev.focal_px < 0.05 * 560.0
        assert abs(result.camera.focal_px - 560.0) < 3.0 * result.stddev.focal_px


def test_pedestrians_are_not_rigid_bodies() -> None:
    result = solved(Junction(drive=walk_along_road, vehicles=30, points_per_vehicle=6))
    assert isinstance(result, Refusal)


def test_a_known_lens_and_turning_traffic_give_the_plane() -> None:
    evidence = synthetic_evidence(FEWER, np.random.default_rng(2))
    result = solve_once(evidence, ONE_FAMILY, lens=FEWER.camera)
    assert isinstance(result, Calibration) and result.camera == FEWER.camera
    sigma = result.stddev
    assert sigma.tilt_deg is not None and sigma.roll_deg is not None
    assert normal_error_deg(result, FEWER) < min(3.0 * np.hypot(sigma.tilt_deg, sigma.roll_deg), 0.5)
