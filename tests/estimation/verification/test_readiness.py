"""What is missing, and how long it will take."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.verification.readiness import (
    check_readiness,
    check_steady,
    coarse_duration,
    outlook,
    requirements,
    stillness_checks,
)
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.stillness import Stillness, ViewChange, ViewChangeKind, drift_limit_px, sway_limit_px
from autocalib_ros.offline.synthetic.junction import Junction
from solved_once import evidence_once

GATE = GateOptions()


def evidence_after(seconds: float, newest_track_s: float, tracks: int = 17) -> Evidence:
    """So many tracks, the last of which ended then."""
    evidence = evidence_once(Junction(tracks=tracks))
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


@pytest.mark.parametrize(('width', 'limit_px'), [(320, 1.5), (640, 1.5), (1280, 3.0), (1920, 4.5)])
def test_the_limit_of_the_drift_scales_with_the_width_down_to_what_video_scatters(width: int, limit_px: float) -> None:
    assert drift_limit_px(width, GATE) == pytest.approx(limit_px)
    assert sway_limit_px(width, GATE) >= 4.5 and sway_limit_px(3840, GATE) == pytest.approx(13.44)


def stood(start_s: float, end_s: float, recorded_s: float, *changes: ViewChange, travel_px: float = 0.0) -> Evidence:
    return replace(
        evidence_once(Junction(tracks=60)), stillness=Stillness(start_s, end_s, recorded_s, 0.0, travel_px, changes)
    )


TURN, ZOOM, CUT = ViewChangeKind.TURN, ViewChangeKind.ZOOM, ViewChangeKind.CUT


@pytest.mark.parametrize(
    ('evidence', 'words'),
    [
        (
            stood(6, 12, 12, ViewChange(CUT, 4.1, 6)),
            'the view was cut at 4.1 s (cuts, title cards or other cameras in all: 1)',
        ),
        (stood(6, 12, 12, ViewChange(ZOOM, 4.1, 6, 1.3)), 'zoomed by 1.30 between 4.1 and 6.0 s (zooms in all: 1)'),
        (stood(6, 12, 12, ViewChange(TURN, 4.1, 6, 8.1)), 'moved at 4.1 s: the picture was displaced by 8.1 px'),
        (
            stood(0, 4, 12, ViewChange(ViewChangeKind.MOTION, 4, 12, 17.0)),
            'the camera moves all the time: the picture moved by 17 px in 12 s; its longest still part lasts 4.0 s',
        ),
        (
            stood(30, 42, 60, *(ViewChange(TURN, at, at + 5, 9.0) for at in (5, 20, 42)), travel_px=31.0),
            'the camera moves all the time: the picture moved by 31 px in 60 s',
        ),
    ],
)
def test_a_short_still_part_is_refused_for_what_happened_to_the_view(evidence: Evidence, words: str) -> None:
    why = check_readiness(evidence, GATE)
    assert why is not None and why.code == 'camera_moving' and words in why.message


@pytest.mark.parametrize(
    'evidence',
    [
        stood(0, 5, 5),
        stood(6, 30, 30, ViewChange(CUT, 4, 6)),
        stood(0, 20, 60, ViewChange(TURN, 20, 22, 9.0), ViewChange(ZOOM, 30, 34, 1.2)),
        # bumped three times in a month
        stood(2e6, 2e6 + 20, 2e6 + 20, *(ViewChange(TURN, at, at + 2, 9.0) for at in (5.0, 1e6, 2e6 - 2))),
    ],
)
def test_a_still_part_that_is_long_enough_is_used(evidence: Evidence) -> None:
    assert check_steady(evidence, GATE) is None


def test_sway_and_what_was_left_out_are_told() -> None:
    evidence = stood(6, 30, 40, ViewChange(CUT, 4, 6), ViewChange(TURN, 30, 34, 5.0))
    assert stillness_checks(stood(0, 40, 40)) == ()
    (part,) = stillness_checks(evidence)
    assert part.text.startswith('only the part from 6.0 to 30.0 s of 40.0 s was used')
    assert 'cuts to another view: 1, motions of the camera: 1' in part.text
    swaying = replace(evidence, stillness=Stillness(0, 40, 40, 2.0))
    assert [check.kind for check in stillness_checks(swaying)] == ['sway']
