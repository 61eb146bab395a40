"""Readiness: is there enough evidence to try a solution, and if not, what is missing and for how long."""

from __future__ import annotations

from dataclasses import dataclass

from autocalib_ros.config import GateOptions
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.results.refusals import Reason, reason

REFERENCE_WIDTH_PX = 1280
"""Image width for which `max_drift_px` is given; it scales with the width."""
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


def drift_limit_px(image_width: int, gate: GateOptions) -> float:
    """Return the background drift, in pixels, up to which a camera counts as stationary."""
    return gate.max_drift_px * image_width / REFERENCE_WIDTH_PX


def check_steady(evidence: Evidence, gate: GateOptions) -> Reason | None:
    """Check that the camera is stationary."""
    limit = drift_limit_px(evidence.image_size[0], gate)
    if evidence.drift_px <= limit:
        return None
    return reason('camera_moving', drift_px=evidence.drift_px, limit_px=limit)


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
