"""What a calibration needs, and how near the evidence is to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from autocalib_ros.config import GateOptions
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.stillness import drift_limit_px
from autocalib_ros.report.text import sentence
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.refusals import BY_CODE
from autocalib_ros.results.statements import Value, in_words

USUAL_RECORDING_S = 10.0
"""Shortest recording in which traffic is usually enough, seconds: a vehicle takes some through the picture."""
NUMBERS = {
    'no_agreement': ('lens curvature seen in straight traffic', '{contrast:.2f}', 'at least {limit:g}'),
    'turning_traffic': ('vehicles that follow straight roads', '{fraction:.0%}', 'at least {limit:.0%}'),
    'horizon': ('traffic above the horizon', '{fraction:.0%}', 'at most {limit:.0%}'),
    'too_little_curvature': ('focal length', '{sigma:±.0%}', 'at most ± {limit:.0%}'),
    'too_little_turning': ('focal length', '{sigma:±.0%}', 'at most ± {limit:.0%}'),
    'lens_model': ('lens unlike a usual one', '{sigmas:.1f} sigma', 'at most {limit:g} sigma'),
    'one_direction': ('tracks across the main road', '{across}', 'at least {limit}'),
    'plane_uncertain': ('ground normal', '± {sigma_deg:.1f} degrees', 'at most ± {limit_deg:g} degrees'),
    'too_few_vehicles': ('vehicles on one straight road', '{vehicles}', 'at least {limit}'),
    'grade_too_low': (
        'certainty of lengths on the road',
        '± {along:.0%} along the view, ± {across:.0%} across it',
        'grade {least}: at most ± {limit:.0%}',
    ),
    'scale_uncertain': ('camera height', '{sigma:±.0%}', 'at most ± {limit:.0%}'),
    'too_few_tracks': ('tracks that are long and straight enough', '{tracks}', 'at least {limit}'),
}
"""Name, value and limit of the requirement of a code, as templates of the numbers of its message."""


@dataclass(frozen=True)
class ReportRequirement:
    """Requirement of a calibration with the value found, the value needed and whether it is met."""

    name: str
    found: str
    needed: str
    met: bool


def needs(result: Calibration | Refusal, evidence: Evidence, gate: GateOptions) -> list[ReportRequirement]:
    """Return the requirements with those that were not met; empty if the calibration is complete."""
    refusal = result if isinstance(result, Refusal) else result.ground_refusal
    if refusal is None:
        return []
    counted = _counted(refusal.code, evidence, gate)
    rows = [_recorded(result), *(need for _, need in counted)]
    if any(refusal.code in codes and not need.met for codes, need in counted):
        return rows
    rows.append(
        _of_code(refusal.code, refusal.values)
        or ReportRequirement(
            BY_CODE[refusal.code].missing if refusal.code in BY_CODE else refusal.code.replace('_', ' '),
            sentence(refusal.message),
            '',
            False,
        )
    )
    further = _of_code(str(refusal.values.get('further', '')), _further_numbers(refusal.values))
    if further is None:
        return rows
    # of two values of one requirement the last strategy's, which the message tells
    return [*(rows[:-1] if further.name == rows[-1].name else rows), further]


def _recorded(result: Calibration | Refusal) -> ReportRequirement:
    seconds = result.evidence.seconds
    return ReportRequirement(
        'recording', f'{seconds:.0f} s', f'about {USUAL_RECORDING_S:g} s or more', round(seconds) >= USUAL_RECORDING_S
    )


def _counted(code: str, evidence: Evidence, gate: GateOptions) -> list[tuple[tuple[str, ...], ReportRequirement]]:
    """Return what the evidence is counted by, with the codes that miss it."""
    limit = drift_limit_px(evidence.image_size[0], gate)
    return [
        (
            ('camera_moving',),
            ReportRequirement(
                'stationary camera',
                f'{evidence.drift_px:.1f} px of motion',
                f'at most {limit:.1f} px',
                code != 'camera_moving' and evidence.drift_px <= limit,
            ),
        ),
        (
            ('no_motion', 'too_few_tracks'),
            ReportRequirement(
                'tracks of moving traffic',
                f'{evidence.track_count}',
                f'at least {gate.min_tracks}',
                evidence.track_count >= gate.min_tracks,
            ),
        ),
        (
            ('poor_coverage',),
            ReportRequirement(
                'image coverage',
                f'{100 * evidence.coverage:.0f} %',
                f'at least {100 * gate.min_coverage:.0f} %',
                evidence.coverage >= gate.min_coverage,
            ),
        ),
    ]


def _of_code(code: str, values: Mapping[str, Value]) -> ReportRequirement | None:
    """Return the requirement that a code missed, None where it has no number."""
    templates = NUMBERS.get(code)
    if templates is None:
        return None
    try:
        name, found, needed = (in_words(text, values) for text in templates)
    except (KeyError, ValueError, TypeError):  # another cause of the code, or numbers that a file does not have
        return None
    return ReportRequirement(name, found, needed, False)


def _further_numbers(values: Mapping[str, Value]) -> dict[str, Value]:
    return {name.removeprefix('further_'): value for name, value in values.items() if name.startswith('further_')}
