"""What is done to all of the evidence is done to the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import JointOptions, Options
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import angles_deg
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from solved_once import solve_once

pytestmark = pytest.mark.solve
OPTIONS = Options(camera_height=8.0, joint=JointOptions(lens_prior='equidistant'))
"""One family of lenses: the others take as long again."""
JUNCTION = Junction(vehicles=60, points_per_vehicle=3, turning_fraction=0.1)


def solved(evidence: Evidence, options: Options = OPTIONS) -> Calibration:
    result = solve_once(evidence, options)
    assert isinstance(result, Calibration) and result.grade == 'full', result
    return result


@pytest.fixture(scope='module')
def evidence() -> Evidence:
    return synthetic_evidence(JUNCTION, np.random.default_rng(0))


@pytest.fixture(scope='module')
def result(evidence: Evidence) -> Calibration:
    return solved(evidence)


def mapped(evidence: Evidence, scale: np.ndarray, shift: np.ndarray, size: tuple[int, int]) -> Evidence:
    """Return the evidence with every pixel moved to `scale * pixel + shift`."""
    return replace(
        evidence,
        image_size=size,
        points_px=evidence.points_px * scale + shift,
        segments_px=evidence.segments_px * np.tile(scale, 2) + np.tile(shift, 2),
    )


def require_same(
    found: Calibration, expected: Calibration, *, scale: float = 1.0, mirrored: bool = False, sigmas: float = 0.1
) -> None:
    """Require lens and plane to be `expected`, scaled and mirrored, within so many of its standard deviations."""
    camera, stddev = expected.camera, expected.stddev
    x, y = camera.principal_point_px
    x = camera.width - 1 - x if mirrored else x
    assert found.camera.focal_px == pytest.approx(scale * camera.focal_px, abs=sigmas * scale * stddev.focal_px)
    assert np.add(found.camera.principal_point_px, 0.5) == pytest.approx(
        scale * np.array([x + 0.5, y + 0.5]), abs=sigmas * scale * max(stddev.principal_point_px)
    )
    assert found.camera.k[0] == pytest.approx(camera.k[0], abs=sigmas * stddev.k1)
    normal = expected.ground.normal_in_camera * ([-1, 1, 1] if mirrored else 1)
    off_deg = angles_deg(found.ground.normal_in_camera, normal)
    assert off_deg < sigmas * np.hypot(stddev.tilt_deg, stddev.roll_deg)
    assert found.stddev.focal_px == pytest.approx(scale * stddev.focal_px, rel=0.1)
    assert found.stddev.tilt_deg == pytest.approx(stddev.tilt_deg, rel=0.1)


def test_a_mirrored_image_gives_the_mirrored_result(evidence: Evidence, result: Calibration) -> None:
    width, height = evidence.image_size
    mirrored = mapped(evidence, np.array([-1.0, 1.0]), np.array([width - 1.0, 0.0]), (width, height))
    require_same(solved(mirrored), result, mirrored=True)


def test_a_doubled_resolution_gives_a_doubled_focal_length(evidence: Evidence, result: Calibration) -> None:
    width, height = evidence.image_size
    doubled = mapped(evidence, np.array([2.0, 2.0]), np.array([0.5, 0.5]), (2 * width, 2 * height))
    joint = replace(OPTIONS.joint, noise_px=2 * OPTIONS.joint.noise_px)
    require_same(solved(doubled, replace(OPTIONS, joint=joint)), result, scale=2.0)


@pytest.mark.parametrize('seed', [1, 2])
def test_the_order_of_the_tracks_does_not_matter(evidence: Evidence, result: Calibration, seed: int) -> None:
    order = np.random.default_rng(seed).permutation(evidence.track_count)
    require_same(solved(evidence.select_tracks(order)), result)
