"""A lens family that an option states, and that the traffic contradicts, is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from autocalib_ros.config import JointOptions, Options
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import solve_once

GOLDEN = Path(__file__).parents[2] / 'golden'


def solved(evidence: str, **joint: object) -> Calibration | Refusal:
    options = Options(camera_height=8.0, joint=JointOptions(**joint))  # type: ignore[arg-type]
    return solve_once(Evidence.load(GOLDEN / f'{evidence}.npz'), options)


# a wide prior of the principal point lets a wrong family bend half of the paths back: tilt wrong by ten sigmas
@pytest.mark.parametrize('more', [{'principal_point_sigma_px': 60.0}, {'wander_m': 0.2}, {}])
def test_a_lens_without_distortion_contradicts_a_stated_equidistant_one(more: dict[str, float]) -> None:
    found = solved('distortion_free', lens_prior='equidistant', road_angle='90', **more)
    assert isinstance(found, Refusal)
    assert (found.code, found.values['cause'], found.values['other']) == ('lens_model', 'family', 'distortion_free')
    assert found.values['other_following'] > 0.8 > 0.7 > found.values['following']
    assert 'joint.lens_prior equidistant' in found.message


def test_an_equidistant_lens_contradicts_a_stated_one_without_distortion() -> None:
    found = solved('skew', lens_prior='distortion_free')
    assert isinstance(found, Refusal)
    assert (found.values['cause'], found.values['other']) == ('family', 'equidistant')


@pytest.mark.parametrize(
    ('evidence', 'family', 'angle'),
    [('skew', 'equidistant', 'auto'), ('distortion_free', 'distortion_free', '90')],
)
def test_the_right_family_passes(evidence: str, family: str, angle: str) -> None:
    found = solved(evidence, lens_prior=family, road_angle=angle)
    assert isinstance(found, Calibration)
    [row] = [row for row in found.verification if row.kind == 'lens_family']
    assert row.passed and row.value is not None and row.value < 1.0
