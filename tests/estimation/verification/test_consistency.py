"""Comparison of two halves of the traffic: focal length and rotation of the camera together."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autocalib_ros.config import JointOptions, Options
from autocalib_ros.estimation.adjustment.bundle_adjustment import adjust
from autocalib_ros.estimation.adjustment.lens_prior import known_lens
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.observations.track_set import select_tracks
from autocalib_ros.estimation.verification.consistency import half_change, half_difference
from autocalib_ros.estimation.verification.gates import share_difference
from autocalib_ros.evidence.snapshot import Track
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.offline.benchmark.monte_carlo import draw_evidence
from autocalib_ros.offline.synthetic.junction import Junction, evidence_from_tracks
from autocalib_ros.results.calibration import Calibration, Refusal
from solved_once import ONE_FAMILY, evidence_once, solve_once

pytestmark = pytest.mark.solve


@pytest.mark.parametrize(('run', 'number'), [(8, 'earlier'), (10, 'later'), (28, 'turned_deg')])
def test_a_camera_that_turned_in_between_is_noticed_by_its_traffic(run: int, number: str) -> None:
    junction, evidence = draw_evidence('mixed_views', 0, run)
    result = solve_once(evidence, Options(camera_height=junction.height_m, joint=ONE_FAMILY))
    assert isinstance(result, Refusal) and result.code == 'halves_disagree'
    assert result.values['sigmas'] > result.values['limit'] and number in result.values


@pytest.mark.parametrize('run', [9, 17])
def test_a_road_of_one_view_and_another_of_the_other_do_not_hide_that_the_camera_turned(run: int) -> None:
    junction, evidence = draw_evidence('mixed_views', 101, run)
    result = solve_once(evidence, Options(camera_height=junction.height_m, joint=ONE_FAMILY))
    assert isinstance(result, Refusal) and result.code == 'halves_disagree'


def test_a_turn_that_the_halves_do_not_exclude_widens_the_standard_deviation() -> None:
    junction, evidence = draw_evidence('mixed_views', 101, 5)
    result = solve_once(evidence, Options(camera_height=junction.height_m, joint=ONE_FAMILY))
    assert isinstance(result, Calibration) and result.ground is not None
    pose = next(row for row in result.verification if row.kind == 'halves_pose')
    assert pose.passed and pose.value > 0.7 * pose.limit
    _, roll = tilt_and_roll_deg(result.ground.normal_in_camera) - tilt_and_roll_deg(junction.normal_in_camera)
    assert 1.0 < abs(roll) < 3.0 * result.stddev.roll_deg


def test_halves_of_one_view_agree() -> None:
    junction, evidence = draw_evidence('many', 0, 0)
    result = solve_once(evidence, Options(camera_height=junction.height_m, joint=ONE_FAMILY))
    assert isinstance(result, Calibration)
    rows = {row.kind: row for row in result.verification}
    assert rows['halves_pose'].passed and rows['halves_share'].passed
    assert np.isfinite(rows['halves_pose'].limit) and rows['halves_pose'].limit > 4.0


def traffic_of(junction: Junction, first_vehicle: int = 0, begin_s: float = 0.0) -> list[Track]:
    return [
        replace(track, vehicle=track.vehicle + first_vehicle, times_s=track.times_s + begin_s)
        for track in evidence_once(junction).tracks()
    ]


@pytest.mark.parametrize(('begin_s', 'expected'), [(0.0, 'full'), (200.0, 'fair')])
def test_roads_that_are_never_seen_in_the_same_half_cost_grade_full(begin_s: float, expected: str) -> None:
    along = Junction(road_angles_deg=(0.0,), turning_fraction=0.0, vehicles=30)
    across = replace(along, road_angles_deg=(90.0,))
    tracks = [*traffic_of(along), *traffic_of(across, 100, begin_s)]
    newest_s = max(track.times_s[-1] for track in tracks)
    evidence = evidence_from_tracks(tracks, along.image_size, newest_s)
    result = solve_once(evidence, Options(camera_height=along.height_m, joint=ONE_FAMILY))
    assert isinstance(result, Calibration) and result.grade == expected
    rows = {row.kind: row for row in result.verification}
    assert ('halves_roads' in rows) == (expected == 'fair')
    assert expected == 'full' or not rows['halves_roads'].passed


def test_platoons_and_phases_of_a_traffic_light_make_shares_less_certain() -> None:
    phases = np.repeat([1, 0, 1, 0, 1], 20).astype(bool)  # most follow the roads in one phase, and few in the next
    shares = share_difference(phases, np.repeat([1, 1, 0, 1, 1], 20).astype(bool))
    assert shares is not None
    earlier, later, sigmas = shares
    assert (earlier, later) == (0.6, 0.8) and sigmas < 1.0
    mixed = share_difference(phases[np.arange(100) * 7 % 100], np.ones(100, bool))
    assert mixed is not None and mixed[2] > 6.0
    assert share_difference(np.zeros(20, bool), np.ones(20, bool))[2] > 6.0


def test_what_halves_share_is_no_difference_between_them() -> None:
    """The lens that both are seen through may be another one, and turns one of them against the other."""
    road = Junction(road_angles_deg=(0.0,), turning_fraction=0.0, vehicles=15)
    fits = []
    for angle_deg in (0.0, 4.0):
        traffic = traffic_of(replace(road, road_angles_deg=(angle_deg,)))
        tracks = select_tracks(evidence_from_tracks(traffic, road.image_size, 60.0), 300)
        along = road.camera_from_ground @ Rotation.from_euler('z', angle_deg, degrees=True).as_matrix()
        start = AdjustmentState(road.camera, along, np.zeros(1))
        fits.append(adjust(start, tracks, AdjustmentConfig(known_lens(road.camera), JointOptions()), refine=True))
    alone = half_difference(*fits, 15)
    assert alone.sigmas > alone.limit and alone.turned > 0.9
    change = half_change(*fits)
    assert np.degrees(np.linalg.norm(change[1:])) == pytest.approx(4.0, abs=0.7)
    shared = half_difference(*fits, 15, np.outer(change, change))
    assert shared.sigmas < 1.0 and shared.turned < 0.05
    across = np.cross([1.0, 0.0, 0.0], change[1:])
    other = np.array([0.0, *across * np.linalg.norm(change) / np.linalg.norm(across)])
    assert half_difference(*fits, 15, np.outer(other, other)).sigmas > alone.limit
