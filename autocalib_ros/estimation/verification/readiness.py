"""Readiness: is there enough evidence to try a solution, and if not, what is missing and for how long."""

from __future__ import annotations

from dataclasses import dataclass

from autocalib_ros.config import GateOptions
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.stillness import (
    MIN_REPORTED_SWAY_PX,
    MIN_STILL_PART_S,
    Stillness,
    ViewChange,
    ViewChangeKind,
    drift_limit_px,
)
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import Statement, check

MOVES = (ViewChangeKind.TURN, ViewChangeKind.DRIFT, ViewChangeKind.MOTION)
"""Changes of the view that are motions of the camera."""
MIN_MOVES, MOVES_S = 3, 60.0
"""Least number of motions of a camera without a mount, and seconds around the still part within which they are counted:
a fixed camera is bumped once. Such a camera counts as moving unless it stood still for half of that time."""

MIN_RATE_TIME_S = 30.0
"""A shorter time shows one or two vehicles, and no rate."""
NO_TRAFFIC_S = 300.0
"""After this time without traffic the earlier rate predicts nothing."""


@dataclass(frozen=True)
class Requirement:
    """One requirement of a first solution: how much there is, and how much is needed."""

    have: float
    need: float
    description: str

    @property
    def fraction(self) -> float:
        """Fraction of the need that is there, 1 if it is met."""
        return min(1.0, self.have / self.need) if self.need > 0 else 1.0


def check_steady(evidence: Evidence, gate: GateOptions) -> Reason | None:
    """Check that the camera is stationary, and that the still part of the recording is long enough."""
    limit = drift_limit_px(evidence.image_size[0], gate)
    if evidence.drift_px > limit:
        return reason('camera_moving', drift_px=evidence.drift_px, limit_px=limit)
    return _check_still_part(evidence.stillness, limit)


def _check_still_part(stillness: Stillness, limit_px: float) -> Reason | None:
    """Return why the still part of a recording with several views is no evidence, by what most of them are."""
    changes = stillness.changes
    by_kind = {kind: [change for change in changes if change.kind is kind] for kind in ViewChangeKind}
    zooms, cuts = by_kind[ViewChangeKind.ZOOM], by_kind[ViewChangeKind.CUT]
    moves = [change for change in changes if change.kind in MOVES]
    paused = sum(_is_near(change, stillness) for change in moves) >= MIN_MOVES
    limit_s = max(MIN_STILL_PART_S, 0.5 * _watched_s(stillness) if paused else 0.0)
    if not changes or stillness.part_s >= limit_s:
        return None
    common = {'part_s': stillness.part_s, 'limit_s': limit_s}
    if zooms and len(zooms) > len(moves) and len(zooms) >= len(cuts):
        times = {'factor': zooms[-1].amount, 'from_s': zooms[-1].start_s, 'to_s': zooms[-1].end_s}
        return reason('camera_moving', 'zoom', count=len(zooms), **times, **common)
    if len(cuts) > len(moves):
        return reason('camera_moving', 'cut', count=len(cuts), time_s=cuts[-1].start_s, **common)
    last = moves[-1]
    settled = last.start_s > 0.0 and last.end_s < stillness.recorded_s and stillness.sway_px <= limit_px
    if len(moves) == 1 and last.kind is ViewChangeKind.TURN and settled:
        return reason('camera_moving', 'turned', moved_px=last.amount, time_s=last.start_s, **common)
    travel_px = max([stillness.travel_px, *(change.amount for change in moves)])
    return reason('camera_moving', 'always', travel_px=travel_px, seconds=stillness.recorded_s, **common)


def _is_near(change: ViewChange, stillness: Stillness) -> bool:
    """Whether a change lies within `MOVES_S` of the still part: a bump a month ago says nothing about the mount."""
    return change.end_s >= stillness.start_s - MOVES_S and change.start_s <= stillness.end_s + MOVES_S


def _watched_s(stillness: Stillness) -> float:
    """Return the length of the recording within `MOVES_S` of the still part, seconds."""
    return min(stillness.recorded_s, stillness.end_s + MOVES_S) - max(0.0, stillness.start_s - MOVES_S)


def stillness_checks(evidence: Evidence) -> tuple[Statement, ...]:
    """Return the checks of sway and of the parts of the recording that were left out."""
    stillness = evidence.stillness
    checks: list[Statement] = []
    if stillness.sway_px >= MIN_REPORTED_SWAY_PX:
        checks.append(check('sway', sway_px=stillness.sway_px))
    if stillness.changes or stillness.start_s > 0:
        kinds = [change.kind for change in stillness.changes]
        checks.append(
            check(
                'still_part',
                start_s=stillness.start_s,
                end_s=stillness.end_s,
                recorded_s=stillness.recorded_s,
                cuts=kinds.count(ViewChangeKind.CUT),
                zooms=kinds.count(ViewChangeKind.ZOOM),
                moves=sum(kind in MOVES for kind in kinds),
            )
        )
    return tuple(checks)


def check_readiness(evidence: Evidence, gate: GateOptions) -> Reason | None:
    """Return the first reason against estimating from the evidence, or None."""
    moving = check_steady(evidence, gate)
    if moving:
        return moving
    if not evidence.track_count:
        return reason('no_motion', frames=evidence.frames, seconds=evidence.seconds)
    if evidence.track_count < gate.min_tracks:
        return reason('too_few_tracks', tracks=evidence.track_count, seconds=evidence.seconds, limit=gate.min_tracks)
    if evidence.coverage < gate.min_coverage:
        return reason('poor_coverage', coverage=evidence.coverage, limit=gate.min_coverage)
    return None


def requirements(evidence: Evidence, gate: GateOptions, first_solve_s: float) -> list[Requirement]:
    """Return the requirements of a first solution."""
    tracks, coverage, seconds = evidence.track_count, evidence.coverage, evidence.seconds
    return [
        Requirement(tracks, gate.min_tracks, f'{tracks} of {gate.min_tracks} tracks'),
        Requirement(
            coverage,
            gate.min_coverage,
            f'traffic crossed {coverage:.0%} of the image, {gate.min_coverage:.0%} needed',
        ),
        Requirement(seconds, first_solve_s, f'{seconds:.0f} s of the first {first_solve_s:g} s watched'),
    ]


def outlook(evidence: Evidence, fraction: float) -> str:
    """Return the time until `fraction` of the requirements has grown to all of them, at the rate so far, as text.

    '' at the start, before any traffic, and if nothing is missing; without traffic the text says so.
    """
    if fraction >= 1.0:
        return ''
    idle_s = evidence.seconds - evidence.times_s.max(initial=0.0)
    if idle_s >= NO_TRAFFIC_S:
        return f'no traffic in the last {coarse_duration(idle_s)}'
    if evidence.seconds < MIN_RATE_TIME_S or fraction <= 0.0:
        return ''
    return f'about {coarse_duration(evidence.seconds * (1.0 / fraction - 1.0))} more at this rate'


def coarse_duration(seconds: float) -> str:
    """Return a duration as text, rounded as an estimate should be."""
    for unit, length_s, most_s in (('s', 10.0, 90.0), ('min', 60.0, 5400.0), ('h', 3600.0, 172800.0)):
        if seconds < most_s:
            count = max(1, round(seconds / length_s))
            return f'{10 * count if unit == "s" else count} {unit}'
    return f'{seconds / 86400.0:.0f} days'
