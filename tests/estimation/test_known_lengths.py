"""Several known lengths together: they agree, or they contradict each other."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from dashed_road import dashes
from lane_traffic import FOUR_LANES, traffic
from pinhole_road import PINHOLE, ROAD

from autocalib_ros.config import GateOptions, LaneOptions, LensOptions, Options, ScaleOptions
from autocalib_ros.estimation.estimate import find_solution
from autocalib_ros.estimation.known_lengths import adjust_to_lengths, scale_of, with_seen_lengths
from autocalib_ros.estimation.observations.track_set import TrackSet, select_tracks
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.estimation.verification.scale import Scale
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import synthetic_evidence
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.refusals import Reason
from solved_once import evidence_once, find_once, solve_once

pytestmark = pytest.mark.solve

ALONG, ACROSS = ((14.0, 1.0), (26.0, 1.0)), ((18.0, -5.0), (18.0, 2.0))
"""Ends of two lengths on the road, metres."""


def distance(ends: tuple[tuple[float, float], ...], factor: float = 1.0) -> str:
    relative = np.array([[x, y, -ROAD.height_m] for x, y in ends])
    pixels, _ = PINHOLE.project(relative @ ROAD.camera_from_ground.T)
    return ' '.join(f'{value:.3f}' for value in (*pixels.ravel(), factor * np.hypot(*np.subtract(*ends))))


def options_with(*distances: str, height: float = 0.0) -> Options:
    scale = ScaleOptions(distances='; '.join(distances), distance_sigma_m=0.1)
    gate = GateOptions(least_grade='assumed')
    return Options(camera_height=height, scale=scale, lens=LensOptions(pixel_aspect=1.0), gate=gate)


def found(*distances: str, height: float = 0.0) -> Calibration:
    return solve_once(evidence_once(ROAD), options_with(*distances, height=height)).candidate


def test_a_length_along_and_one_across_make_the_other_lengths_certain() -> None:
    alone, both = found(height=ROAD.height_m), found(distance(ALONG), distance(ACROSS))
    assert both.stddev.ground.worst < 0.6 * alone.stddev.ground.worst
    assert both.stddev.focal_px / both.camera.focal_px < alone.stddev.focal_px / alone.camera.focal_px
    error = np.log(both.camera.focal_px / PINHOLE.focal_px)
    assert abs(error) < 2.5 * both.stddev.focal_px / both.camera.focal_px
    assert both.ground.height_m == pytest.approx(ROAD.height_m, abs=2.5 * both.stddev.height_m)
    assert [statement.kind for statement in both.assumptions if statement.kind.startswith('scale')] == [
        'scale_distance',
        'scale_distance',
        'scale_combined',
    ]


def test_lengths_that_contradict_each_other_are_named() -> None:
    evidence, rows = evidence_once(ROAD), []
    for factor in (1.0, 1.5):
        options = options_with(distance(ALONG), distance(((16.0, 1.0), (22.0, 1.0)), factor))
        tracks = select_tracks(evidence, options.joint.max_tracks)
        adjusted = adjust_to_lengths(find_once(evidence, tracks, options), tracks, options)
        rows.append(next(row for row in adjusted.comparisons if row.kind == 'known_lengths'))
    assert rows[0].passed and not rows[1].passed and rows[1].contradicts
    assert 'known lengths against each other' in str(rows[1])


def test_a_height_and_a_length_that_agree_leave_the_height() -> None:
    result = found(distance(ALONG), height=ROAD.height_m)
    assert result.ground.height_m == pytest.approx(ROAD.height_m, rel=0.01)
    without = replace(result, verification=())
    assert without.ground == result.ground and any(row.kind == 'known_lengths' for row in result.verification)


@cache
def unscaled() -> tuple[Solution, TrackSet]:
    """The road by its traffic alone, with dashes on it."""
    generator = np.random.default_rng(0)
    evidence = replace(synthetic_evidence(ROAD, generator), stripes_px=dashes(ROAD, np.random.default_rng(1)))
    tracks = select_tracks(evidence, 300)
    found = find_solution(evidence, tracks, Options(lens=LensOptions(pixel_aspect=1.0)), height_m=ROAD.height_m)
    assert isinstance(found, Solution)
    return with_seen_lengths(found, evidence, Options()), tracks


def told(height: float = 0.0, **lanes: float) -> Solution:
    found, tracks = unscaled()
    return adjust_to_lengths(found, tracks, Options(camera_height=height, lanes=LaneOptions(**lanes)))


def horizon_px(camera: Camera, normal: np.ndarray) -> np.ndarray:
    """Return the row of the horizon above the principal point, shape (1,)."""
    ahead = np.array([[0.0, -normal[2], normal[1]]])
    return camera.project(ahead * np.sign(ahead[:, 2:]))[0][0, 1:]


def test_dashes_alone_show_the_horizon() -> None:
    before, after = unscaled()[0].plane, told().plane
    sigma = after.sigma(horizon_px)[0]
    assert sigma < 0.5 * before.sigma(horizon_px)[0]
    found, true = horizon_px(*after.lens_and_normal), horizon_px(PINHOLE, ROAD.normal_in_camera)
    assert abs(found - true) < 2.5 * sigma
    assert [row.kind for row in told().comparisons if row.kind == 'dash_period' and row.passed]


def test_dashes_and_lanes_of_known_size_give_scale_and_focal_length() -> None:
    before, after = unscaled()[0], told(width_m=3.5, dash_period_m=12.0)
    assert after.fit.focal_sigma < 0.6 * before.fit.focal_sigma
    assert abs(np.log(after.fit.state.camera.focal_px / PINHOLE.focal_px)) < 2.5 * after.fit.focal_sigma
    scale = scale_of(after, Options(lanes=LaneOptions(width_m=3.5, dash_period_m=12.0)))
    # 4 % of the width that is told, and 2 % of the period
    assert scale.height(*after.plane.lens_and_normal) == pytest.approx(ROAD.height_m, rel=0.1)
    assert [source.kind for source in scale.sources] == ['scale_lanes', 'scale_dashes']


def test_dashes_that_contradict_the_height_are_named_with_both_numbers() -> None:
    result = told(5.0 * ROAD.height_m, width_m=3.5, dash_period_m=12.0)
    row = next(row for row in result.comparisons if row.kind == 'known_lengths')
    text = next(statement.text for statement in result.checks if statement.kind == 'known_lengths')
    assert not row.passed
    assert text.startswith('the given camera height means a camera height of 40 ± 0.04 m, the ')
    assert not [each for each in told(ROAD.height_m, dash_period_m=12.0).checks if each.kind == 'known_lengths']


def test_lanes_are_told_and_no_dash_is_seen() -> None:
    why = scale_of(replace(unscaled()[0], lanes=None), Options(lanes=LaneOptions(country='us')))
    assert isinstance(why, Reason) and 'neither dashes, lines nor rows' in why.message and 'camera_height' in why.remedy
    why = scale_of(replace(unscaled()[0], lanes=None), Options(lanes=LaneOptions(dash_period_m=9.0)))
    assert isinstance(why, Reason) and 'no dashes of lane lines' in why.message


def test_a_lane_width_without_dashes_gives_the_scale_by_rows_of_vehicles() -> None:
    options = Options(lanes=LaneOptions(width_m=3.5))
    bare = replace(evidence_once(ROAD), stripes_px=np.zeros((0, 5)))
    seen = with_seen_lengths(replace(unscaled()[0], lanes=None, flow=traffic(FOUR_LANES)), bare, options)
    assert seen.spacing is not None and seen.spacing.kind == 'vehicles' and seen.vehicles is None
    scale = scale_of(seen, options)
    assert isinstance(scale, Scale)
    height = scale.height(*seen.plane.lens_and_normal)
    of_plane = seen.plane.sigma(lambda *at: np.array([scale.height(*at)]))[0]
    assert abs(height - ROAD.height_m) < 2.5 * np.hypot(scale.sigma, of_plane)
    assert scale.sigma < 0.12 * height
    assert [each.kind for each in seen.checks if each.kind == 'lane_spacing']
