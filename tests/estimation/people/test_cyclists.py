"""Cyclists are distinguished from vehicles by the size of their silhouettes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.estimation.people.cyclists import find_cyclists
from autocalib_ros.evidence.snapshot import Evidence, Outlines, Track
from autocalib_ros.offline.synthetic.junction import Junction, evidence_from_tracks, synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from silhouette_evidence import CAR_M, RIDER_M, crossing_bodies, with_outlines
from solved_once import ONE_FAMILY, solve_once

pytestmark = pytest.mark.solve

JUNCTION = Junction(vehicles=30)
FIRST_RIDER, FIRST_CAR = 1000, 2000


def several(
    first: int, count: int, size_m: tuple[float, float, float], speeds_m_s: tuple[float, float] = (4.0, 7.0)
) -> tuple[list[Track], list[Outlines]]:
    return crossing_bodies(JUNCTION, first, count, size_m, speeds_m_s)


def told(tracks: list[Track], outlines: list[Outlines]) -> np.ndarray:
    newest = max(float(track.times_s[-1]) for track in tracks)
    evidence = with_outlines(evidence_from_tracks(tracks, JUNCTION.image_size, newest), outlines)
    return find_cyclists(evidence, JUNCTION.camera, JUNCTION.normal_in_camera, JUNCTION.height_m)


def test_riders_are_distinguished_from_cars_of_the_same_speed() -> None:
    riders, cars = several(FIRST_RIDER, 20, RIDER_M), several(FIRST_CAR, 30, CAR_M)
    found = told(riders[0] + cars[0], riders[1] + cars[1])
    assert (found < FIRST_CAR).all()
    assert len(found) >= 16


@pytest.mark.parametrize('size_m', [(2.7, 1.66, 1.55), (3.6, 1.6, 1.5), (11.0, 2.5, 3.0)])
def test_no_vehicle_that_is_seen_whole_is_a_cyclist(size_m: tuple[float, float, float]) -> None:
    assert not len(told(*several(FIRST_CAR, 20, size_m)))


def test_faster_than_bicycles_is_a_vehicle() -> None:
    assert not len(told(*several(FIRST_RIDER, 20, RIDER_M, speeds_m_s=(13.0, 13.0))))


def test_a_part_of_a_car_that_is_as_low_as_a_bumper_is_no_rider() -> None:
    tracks, _ = several(FIRST_CAR, 20, CAR_M)
    _, outlines = several(FIRST_CAR, 20, (1.75, 0.6, 0.5))
    assert not len(told(tracks, outlines))


def test_a_car_is_recognised_by_the_silhouettes_that_are_whole() -> None:
    """A car with a quarter of its silhouettes whole, and the others a part as narrow as a rider."""
    tracks, whole = several(FIRST_CAR, 20, CAR_M)
    _, parts = several(FIRST_CAR, 20, RIDER_M)
    now_and_then = {(each.time_s, int(each.vehicles[0])): each for each in whole[::4]}
    assert not len(told(tracks, [now_and_then.get((each.time_s, int(each.vehicles[0])), each) for each in parts]))


@pytest.mark.parametrize('gap_px', [0.0, 7.0])
def test_a_silhouette_that_touches_another_is_not_classified(gap_px: float) -> None:
    tracks, outlines = several(FIRST_RIDER, 20, RIDER_M)
    touching = [replace(each, ends_px=np.column_stack([each.ends_px[:, :-1], [gap_px]])) for each in outlines]
    assert not len(told(tracks, touching))


def test_a_fragmented_silhouette_is_not_classified() -> None:
    tracks, outlines = several(FIRST_RIDER, 20, RIDER_M)
    torn = [
        Outlines(
            each.time_s, np.tile(each.vehicles, 2), np.concatenate([each.ends_px, each.ends_px + [*[300, 0] * 8, 0]])
        )
        for each in outlines
    ]
    assert not len(told(tracks, torn))


def test_three_silhouettes_are_too_few() -> None:
    tracks, outlines = several(FIRST_RIDER, 20, RIDER_M)
    seen: dict[int, list[Outlines]] = {}
    for each in outlines:
        seen.setdefault(int(each.vehicles[0]), []).append(each)
    assert not len(told(tracks, [each for one in seen.values() for each in one[:3]]))


def test_evidence_without_silhouettes_has_no_cyclists() -> None:
    tracks, _ = several(FIRST_RIDER, 10, RIDER_M)
    assert not len(told(tracks, []))


@pytest.fixture(scope='module')
def street() -> tuple[Evidence, Evidence]:
    """Evidence of thirty vehicles, and the same with twenty riders."""
    vehicles = synthetic_evidence(JUNCTION, np.random.default_rng(5))
    tracks, outlines = several(FIRST_RIDER, 20, RIDER_M)
    both = [*vehicles.tracks(), *tracks]
    return vehicles, with_outlines(evidence_from_tracks(both, JUNCTION.image_size, 100.0), outlines)


@pytest.mark.solve
def test_lens_and_plane_come_from_vehicles_alone(street: tuple[Evidence, Evidence]) -> None:
    alone, among = (solve_once(each, Options(camera_height=JUNCTION.height_m, joint=ONE_FAMILY)) for each in street)
    assert isinstance(alone, Calibration) and isinstance(among, Calibration)
    found = among.evidence.people
    assert 17 <= found <= 21
    assert among.evidence.vehicles == len(np.unique(street[1].track_vehicles)) - found
    riders = street[1].track_vehicles >= FIRST_RIDER
    assert (among.figures.track_labels[riders] == -1).mean() > 0.8
    assert among.camera.focal_px == pytest.approx(alone.camera.focal_px, abs=alone.stddev.focal_px)
    off_deg = np.degrees(np.arccos(min(1.0, float(among.ground.normal_in_camera @ JUNCTION.normal_in_camera))))
    assert off_deg < 3.0 * np.hypot(among.stddev.tilt_deg, among.stddev.roll_deg)


@pytest.mark.solve
def test_with_too_few_vehicles_left_cyclists_stay_in_the_plane_and_are_reported(
    street: tuple[Evidence, Evidence],
) -> None:
    options = Options(camera_height=JUNCTION.height_m, joint=ONE_FAMILY)
    _, among = street
    least = int((among.track_vehicles < FIRST_RIDER).sum()) + 20
    demanding = replace(options, gate=replace(options.gate, min_tracks=least))
    result = solve_once(among, demanding)
    assert isinstance(result, Calibration), result
    [check] = [check for check in result.checks if check.kind == 'pedestrians_kept']
    assert f'at least {least} needed' in check.text
    assert result.evidence.people >= 17
