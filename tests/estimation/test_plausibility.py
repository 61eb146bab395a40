"""What is not as usual is doubted, and refused if it is far from it."""

from dataclasses import replace

import numpy as np
import pytest
from dashed_road import dashes
from pinhole_road import PINHOLE, ROAD

from autocalib_ros.estimation.lanes.lane_dashes import measure_lanes
from autocalib_ros.estimation.plausibility import (
    median_speed_km_h,
    why_implausible,
    with_usual_lanes,
    with_usual_vehicles,
)
from autocalib_ros.estimation.publish import require_grade
from autocalib_ros.evidence.snapshot import Evidence, Track
from autocalib_ros.geometry.ground_plane import ground_plane
from autocalib_ros.offline.synthetic.junction import evidence_from_tracks, synthetic_evidence
from autocalib_ros.results.calibration import Calibration, Refusal
from synthetic_results import full_result, junction_evidence

NORMAL, ALONG = ROAD.normal_in_camera, ROAD.camera_from_ground[:, 0]
TEXT = {'usual_speed': 'faster than', 'usual_lanes': 'm wide', 'usual_dashes': 'repeat every'}


def at_height(height_m: float) -> Calibration:
    """A calibration of grade full that is right but for its scale."""
    return replace(
        full_result(junction_evidence()),
        camera=PINHOLE,
        grade='full',
        ground=ground_plane(NORMAL, ALONG, height_m, metric=True),
        verification=(),
        checks=(),
        assumptions=(),
    )


def flowing(speed_m_s: float, vehicles: int = 12) -> Evidence:
    """Vehicles one after the other along the road."""
    times = np.arange(0.0, 1.5, 0.1)
    tracks = []
    for vehicle in range(vehicles):
        ahead = 15.0 + vehicle + speed_m_s * times
        ground = np.column_stack([ahead, np.full(len(times), -2.0), np.full(len(times), 0.75 - ROAD.height_m)])
        pixels, _ = PINHOLE.project(ground @ ROAD.camera_from_ground.T)
        tracks.append(Track(vehicle, times + 3.0 * vehicle, pixels))
    return evidence_from_tracks(tracks, ROAD.image_size, 3.0 * vehicles)


@pytest.mark.parametrize('speed_m_s', [5.0, 25.0])
def test_the_median_speed_is_that_of_the_traffic(speed_m_s: float) -> None:
    measured = median_speed_km_h(flowing(speed_m_s), PINHOLE, NORMAL, ROAD.height_m)
    assert measured == pytest.approx(3.6 * speed_m_s, rel=0.02)
    assert median_speed_km_h(flowing(speed_m_s, 5), PINHOLE, NORMAL, ROAD.height_m) is None


@pytest.mark.parametrize(
    ('factor', 'grade', 'refused'), [(1.0, 'full', False), (1.45, 'coarse', False), (2.2, 'coarse', True)]
)
def test_vehicles_that_are_too_fast_are_doubted_and_then_refused(factor: float, grade: str, refused: bool) -> None:
    result = with_usual_vehicles(at_height(factor * ROAD.height_m), flowing(33.0))
    assert result.grade == grade
    said = [statement.text for statement in result.checks]
    assert [True for text in said if 'faster than' in text and '130 km/h are usual' in text] == [True] * (
        grade != 'full'
    )
    why = why_implausible(result)
    assert (why is not None) is refused and (why is None or why.code == 'implausible')
    accepted = require_grade(result, 'coarse')
    assert isinstance(accepted, Refusal) is refused
    assert not refused or (accepted.candidate == result and 'km/h' in accepted.message)


@pytest.mark.parametrize(
    ('factor', 'kinds'),
    [(1.0, set()), (2.2, set()), (0.5, {'usual_lanes'}), (0.15, {'usual_lanes', 'usual_dashes'})],
)
def test_lanes_and_dashes_that_are_too_small_are_doubted(factor: float, kinds: set[str]) -> None:
    evidence = replace(
        synthetic_evidence(replace(ROAD, vehicles=15), np.random.default_rng(0)),
        stripes_px=dashes(ROAD, np.random.default_rng(1)),
    )
    lanes = measure_lanes(evidence, PINHOLE, NORMAL, ALONG, 0.02)
    result = with_usual_lanes(at_height(factor * ROAD.height_m), lanes)
    assert {row.kind for row in result.verification if not row.passed} == kinds
    assert {statement.kind for statement in result.checks} == kinds
    assert all(TEXT[statement.kind] in statement.text and 'usual' in statement.text for statement in result.checks)
    assert result.grade == ('coarse' if kinds else 'full')


def test_without_metres_nothing_is_compared() -> None:
    unscaled = replace(at_height(8.0), ground=ground_plane(NORMAL, ALONG, 1.0, metric=False), grade='unit_scale')
    assert with_usual_vehicles(unscaled, flowing(60.0)) == unscaled
    assert with_usual_lanes(unscaled, None) == unscaled
