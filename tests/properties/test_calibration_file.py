"""Any calibration survives its file."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from autocalib_ros.results.calibration import (
    COVARIANCE_PARAMETERS,
    Calibration,
    EvidenceSummary,
    PaperReport,
    StandardDeviations,
)
from autocalib_ros.results.calibration_json import calibration_from_json, calibration_json
from autocalib_ros.results.grades import GRADE_LIMITS
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import Statement
from autocalib_ros.results.verification_table import VerificationRow
from random_geometry import SIZE, between, ground_planes, lenses, reproducible

COUNTS = st.integers(0, 10**6)
NUMBERS = st.floats(-1e6, 1e6, allow_nan=False)
SIGMAS = st.none() | between(0.0, 1e3)
WORDS = st.text(max_size=20)
ITEMS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | WORDS
VALUES = st.dictionaries(WORDS, ITEMS, max_size=3)
STATEMENTS = st.builds(Statement, WORDS, WORDS, VALUES)
ARRAYS = ('ground', 'road_directions', 'covariance')
ROWS = st.builds(VerificationRow, WORDS, st.none() | NUMBERS, NUMBERS, st.booleans())


def summaries() -> st.SearchStrategy[EvidenceSummary]:
    return st.builds(
        EvidenceSummary,
        image_size=st.just(SIZE),
        seconds=between(0.0, 1e6),
        frames=COUNTS,
        tracks=COUNTS,
        segments=COUNTS,
        vehicles=COUNTS,
        coverage=between(0.0, 1.0),
        people=COUNTS,
    )


def deviations() -> st.SearchStrategy[StandardDeviations]:
    return st.builds(
        StandardDeviations,
        focal_px=SIGMAS,
        principal_point_px=st.none() | st.tuples(between(0.0, 1e3), between(0.0, 1e3)),
        k1=SIGMAS,
        k2=SIGMAS,
        tilt_deg=SIGMAS,
        roll_deg=SIGMAS,
        height_m=SIGMAS,
        ground_point_m=st.just(()) | st.tuples(SIGMAS, SIGMAS, SIGMAS),
    )


def paper_reports() -> st.SearchStrategy[PaperReport]:
    triples = st.tuples(NUMBERS, NUMBERS, NUMBERS)
    return st.builds(
        PaperReport,
        focal_px=between(1.0, 1e5),
        polynomial_k=triples,
        straightness_px2=st.tuples(between(0.0, 1e6), between(0.0, 1e6)),
        focal_from_vanishing_points_px=st.none() | between(1.0, 1e5),
        translation_m=st.none() | triples,
    )


@st.composite
def calibrations(draw: st.DrawFn) -> Calibration:
    """Calibrations of every grade, with numbers of any size."""
    ground = draw(st.none() | ground_planes())
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    roads = generator.normal(size=(draw(st.integers(0, 3)), 3))
    spread = generator.normal(size=(2 * [len(COVARIANCE_PARAMETERS)]))
    if ground is not None and draw(st.booleans()):
        ground = replace(ground, height_m=1.0, metric=False)
    metric = ground is not None and ground.metric
    return Calibration(
        method=draw(st.sampled_from(['joint', 'paper'])),
        grade=draw(st.sampled_from([*GRADE_LIMITS, 'assumed'])) if metric else 'unit_scale' if ground else 'lens',
        assumptions=tuple(draw(st.lists(STATEMENTS, max_size=3))),
        checks=tuple(draw(st.lists(STATEMENTS, max_size=3))),
        verification=tuple(draw(st.lists(ROWS, max_size=3))),
        camera=draw(lenses()),
        ground=ground,
        ground_refusal=None if ground else draw(st.builds(Reason, WORDS, WORDS, WORDS, VALUES)),
        road_directions=roads / np.linalg.norm(roads, axis=1, keepdims=True),
        stddev=draw(deviations()),
        covariance=spread @ spread.T if metric and draw(st.booleans()) else None,
        paper=draw(st.none() | paper_reports()),
        evidence=draw(summaries()),
        newest_stamp_ns=draw(st.integers(0, 2**63 - 1)),
    )


@reproducible(80)
@given(calibrations())
def test_a_calibration_comes_back_from_its_file_to_the_last_bit(before: Calibration) -> None:
    text = calibration_json(before)
    after = calibration_from_json(json.loads(text))
    assert calibration_json(after) == text
    for item in fields(Calibration):
        if item.name not in ('figures', *ARRAYS):
            assert getattr(after, item.name) == getattr(before, item.name), item.name
    np.testing.assert_array_equal(after.road_directions, before.road_directions)
    assert (after.covariance is None) == (before.covariance is None)
    if before.covariance is not None:
        np.testing.assert_array_equal(after.covariance, before.covariance)
    assert (after.ground is None) == (before.ground is None)
    if before.ground is not None:
        np.testing.assert_array_equal(after.ground.rotation, before.ground.rotation)
        assert (after.ground.height_m, after.ground.metric) == (before.ground.height_m, before.ground.metric)
