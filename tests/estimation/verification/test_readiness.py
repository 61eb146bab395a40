"""What is missing, and how long it will take."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.verification.readiness import coarse_duration, outlook, requirements
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence

GATE = GateOptions()


def evidence_after(seconds: float, newest_track_s: float, tracks: int = 17) -> Evidence:
    """So many tracks, the last of which ended then."""
    evidence = synthetic_evidence(Junction(tracks=tracks), np.random.default_rng(0))
    return replace(
        evidence, newest_stamp_ns=int(seconds * 1e9), times_s=evidence.times_s - evidence.times_s.max() + newest_track_s
    )


def told(evidence: Evidence) -> str:
    return outlook(evidence, min(need.fraction for need in requirements(evidence, GATE, 10.0)))


def test_the_scarcest_requirement_says_how_long_it_takes() -> None:
    evidence = evidence_after(260.0, 255.0)
    tracks, coverage, seconds = requirements(evidence, GATE, 10.0)
    assert tracks.description == '17 of 40 tracks' and tracks.fraction == pytest.approx(0.425)
    assert coverage.fraction == seconds.fraction == 1.0
    assert told(evidence) == 'about 6 min more at this rate'  # 23 more at 17 in 260 s: 352 s


def test_the_share_of_the_image_counts_as_well() -> None:
    evidence = evidence_after(600.0, 590.0, tracks=60)
    needs = requirements(evidence, replace(GATE, min_coverage=1.5 * evidence.coverage), 10.0)
    assert [need.fraction for need in needs] == [1.0, pytest.approx(2 / 3), 1.0]
    assert outlook(evidence, needs[1].fraction) == 'about 5 min more at this rate'


def test_nothing_is_foretold_in_the_first_moments() -> None:
    assert told(evidence_after(20.0, 19.0)) == ''


def test_nothing_is_foretold_when_nothing_is_missing() -> None:
    assert told(evidence_after(600.0, 590.0, tracks=60)) == ''


@pytest.mark.parametrize(
    ('seconds', 'description'),
    [(290.0, ''), (720.0, 'no traffic in the last 12 min'), (4 * 3600.0, 'no traffic in the last 4 h')],
)
def test_without_any_traffic_that_is_said(seconds: float, description: str) -> None:
    nothing = replace(evidence_after(seconds, 0.0).select_tracks(np.zeros(0, int)))
    assert told(nothing) == description


def test_a_rate_that_stopped_is_no_rate() -> None:
    assert told(evidence_after(1200.0, 300.0)) == 'no traffic in the last 15 min'


@pytest.mark.parametrize(
    ('seconds', 'description'),
    [
        (1.0, '10 s'),
        (44.0, '40 s'),
        (89.0, '90 s'),
        (95.0, '2 min'),
        (3000.0, '50 min'),
        (5400.0, '2 h'),
        (86_400.0, '24 h'),
        (3 * 86_400.0, '3 days'),
    ],
)
def test_times_are_told_coarsely(seconds: float, description: str) -> None:
    assert coarse_duration(seconds) == description
