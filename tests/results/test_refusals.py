"""The table of refusal codes against the limits in the code."""

import pytest

from autocalib_ros.config import GateOptions, JointOptions, PaperOptions
from autocalib_ros.estimation.markings.markings_solution import MIN_ALIGNED_FRACTION, MIN_PLACES
from autocalib_ros.estimation.strategies import MAX_CONFIRMING_SIGMA_DEG
from autocalib_ros.estimation.verification.gates import (
    HALVES_FOCAL_TOLERANCE,
    HALVES_NORMAL_TOLERANCE_DEG,
    MAX_FOCAL_DIAGONALS,
    MAX_HALVES_SIGMAS,
    MAX_K1_SIGMAS,
    MIN_FOCAL_CONTRAST,
    MIN_KEPT_ROAD_FRACTION,
    MIN_LANE_KEEPING_FRACTION,
    MIN_ONE_ROAD_FRACTION,
    MIN_STRAIGHT_FRACTION,
)
from autocalib_ros.estimation.verification.scale import MIN_SPEED_VEHICLES
from autocalib_ros.evidence.stillness import MIN_DRIFT_LIMIT_PX, MIN_STILL_PART_S
from autocalib_ros.geometry.ground_plane import MIN_FRACTION_BELOW_HORIZON
from autocalib_ros.lens.opencv_lens import MAX_MODEL_ERROR_PX
from autocalib_ros.results.refusals import BY_CODE, REFUSALS, reason
from autocalib_ros.results.statements import UNDETERMINED

GATE, JOINT, PAPER = GateOptions(), JointOptions(), PaperOptions()
LIMITS = {
    'camera_moving': [f'{GATE.max_drift_px:g} px', f'{MIN_DRIFT_LIMIT_PX:g} px', f'{MIN_STILL_PART_S:g} s'],
    'too_few_tracks': [f'{GATE.min_tracks}', f'{100 * PAPER.min_lifetime:g} %', f'{PAPER.window_s:g} s'],
    'poor_coverage': [f'{100 * GATE.min_coverage:g} %'],
    'no_agreement': [f'{MIN_FOCAL_CONTRAST:g} times'],
    'turning_traffic': [
        f'{100 * value:g} %'
        for value in (
            MIN_STRAIGHT_FRACTION,
            MIN_ONE_ROAD_FRACTION,
            MIN_KEPT_ROAD_FRACTION,
            MIN_LANE_KEEPING_FRACTION,
        )
    ],
    'horizon': [f'{100 * MIN_FRACTION_BELOW_HORIZON:g} %'],
    'too_little_curvature': [f'{100 * GATE.max_sigma_focal_rel:g} %', f'{MAX_FOCAL_DIAGONALS:g} image diagonals'],
    'too_little_turning': [f'{100 * GATE.max_sigma_focal_rel:g} %'],
    'lens_model': [f'{MAX_K1_SIGMAS:g} times', f'({JOINT.k1_sigma:g})'],
    'halves_disagree': [
        f'{100 * HALVES_FOCAL_TOLERANCE:g} %',
        f'{HALVES_NORMAL_TOLERANCE_DEG:g} degrees',
        f'{MAX_HALVES_SIGMAS:g} sigma',
    ],
    'one_direction': [f'{GATE.min_tracks_per_road} tracks'],
    'plane_uncertain': [f'{GATE.max_sigma_tilt_deg:g} degrees'],
    'no_markings': [f'{100 * MIN_ALIGNED_FRACTION:g} %', f'{MIN_PLACES} places'],
    'markings_unconfirmed': [f'{MAX_CONFIRMING_SIGMA_DEG:g} degrees'],
    'too_few_vehicles': [f'{MIN_SPEED_VEHICLES} vehicles'],
    'scale_uncertain': [f'{100 * GATE.max_sigma_height_rel:g} %'],
    'distortion_model': [f'{MAX_MODEL_ERROR_PX:g} px'],
}


@pytest.mark.parametrize('code', LIMITS)
def test_limits_of_the_table_are_those_of_the_code(code: str) -> None:
    assert [limit for limit in LIMITS[code] if limit not in BY_CODE[code].limit] == []


def test_codes_are_unique_and_every_entry_has_its_texts() -> None:
    assert len(BY_CODE) == len(REFUSALS)
    assert all(entry.cause and entry.limit and entry.remedy and entry.missing and entry.message for entry in REFUSALS)


def test_a_reason_carries_its_numbers_and_the_limit() -> None:
    why = reason('poor_coverage', coverage=0.071, limit=0.15)
    assert (why.code, dict(why.values)) == ('poor_coverage', {'coverage': 0.071, 'limit': 0.15})
    assert why.message == 'traffic crossed 7% of the image (at least 15% needed)'
    assert why.remedy == BY_CODE['poor_coverage'].remedy


def test_a_variant_has_its_own_message_and_the_usual_remedy_unless_it_names_another() -> None:
    short, paper = (
        reason('too_few_tracks', 'short', tracks=3, limit=40),
        reason('too_few_tracks', 'paper', lifetime=0.8, window_s=6.0, path_ratio=1.3),
    )
    assert short.message.startswith('3 tracks are long enough') and short.remedy == BY_CODE['too_few_tracks'].remedy
    assert 'paper.window_s' in paper.remedy


def test_a_number_that_is_not_determined_is_told_as_such_and_without_a_made_up_uncertainty():
    known = reason('too_little_curvature', focal_px=293.0, sigma=0.312, limit=0.25).message
    assert known.endswith('focal length 293 px, ± 31.2% (at most ± 25% allowed)')
    unknown = reason('too_little_curvature', focal_px=293.0, sigma=UNDETERMINED, limit=0.25).message
    assert unknown.endswith('focal length 293 px, not determined (at most ± 25% allowed)')
