"""Positions on the road in the figures against the truth of synthetic traffic."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.pictures.views import TopView, grid_lines, grid_step, ground_to_image, image_to_ground
from autocalib_ros.report.road_figures import position_sigma_m, tracked_road_points
from autocalib_ros.report.scene import ReportScene
from autocalib_ros.results.calibration import Calibration
from solved_once import solve_once

pytestmark = pytest.mark.solve

JUNCTION = Junction()
TRUTH = GroundPlane(JUNCTION.camera_from_ground.T, JUNCTION.height_m)
SIGMAS = 3.0
"""All places are off together, by one draw of ten numbers: one in 370 draws is farther off in one direction."""


@pytest.fixture(scope='module', params=[0, 1])
def scene(request) -> ReportScene:
    """Return what a report is about, solved from traffic whose truth is known."""
    evidence, options = synthetic_evidence(JUNCTION, np.random.default_rng(request.param)), Options(camera_height=8.0)
    result = solve_once(evidence, options)
    assert isinstance(result, Calibration) and result.grade == 'full'
    return ReportScene(result=result, evidence=evidence, background=None, options=options, source='made up')


def ahead(ground: GroundPlane) -> float:
    """Heading in the ground frame to which the optical axis points, radians."""
    x, y, _ = ground.rotation[:, 2]
    return float(np.arctan2(y, x))


def errors_m(scene: ReportScene, points_m: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """How far places (n, 2) are from what pixels (n, 2) show in truth; headings are chosen, so that they agree."""
    turn = ahead(scene.calibration.ground) - ahead(TRUTH)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    shown = image_to_ground(JUNCTION.camera, TRUTH, pixels) @ rotation.T
    return np.hypot(*(shown - points_m).T)


def inside(pixels: np.ndarray) -> np.ndarray:
    return (pixels > 0).all(axis=1) & (pixels < np.array(JUNCTION.image_size) - 1).all(axis=1)


def test_corners_of_the_grid_lie_where_the_truth_has_them(scene):
    calibration = scene.calibration
    lines = np.concatenate(grid_lines(np.median(tracked_road_points(scene), axis=0), grid_step(calibration.ground)))
    pixels = ground_to_image(calibration.camera, calibration.ground, lines)
    near = inside(np.nan_to_num(pixels, nan=-1.0)) & (np.hypot(*lines[:, :2].T) < 50.0)
    assert near.sum() > 1000
    sigma = position_sigma_m(scene, lines[near, :2])
    assert (errors_m(scene, lines[near, :2], pixels[near]) < SIGMAS * sigma).all()


def test_the_top_view_shows_places_where_the_truth_has_them(scene):
    calibration = scene.calibration
    view = TopView.around(tracked_road_points(scene), calibration.ground, 100)
    sources = view.sources(calibration.camera, calibration.ground).astype(float).reshape(-1, 2)
    columns, rows = np.meshgrid(np.arange(view.columns), np.arange(view.rows))
    x = view.low_m[0] + (columns + 0.5) / view.px_per_m
    y = view.high_m[1] - (rows + 0.5) / view.px_per_m
    places = np.stack([x, y], axis=-1).reshape(-1, 2)
    near = inside(sources) & (np.hypot(*places.T) < 50.0)
    assert near.sum() > 500
    sigma = position_sigma_m(scene, places[near])
    # the table holds single precision, a millionth of the image
    assert (errors_m(scene, places[near], sources[near]) < SIGMAS * sigma + 1e-3).all()


def test_sigma_of_positions_equals_the_reported_numbers(scene):
    reported = scene.result.stddev.ground_point_m
    heading = ahead(scene.calibration.ground)
    places = np.array([[np.cos(heading), np.sin(heading)]]) * np.array([[10.0], [20.0], [40.0]])
    assert position_sigma_m(scene, places) == pytest.approx(np.array(reported, float), rel=0.1, nan_ok=True)


def test_outside_the_image_there_is_no_sigma(scene):
    assert np.isnan(position_sigma_m(scene, np.array([[-100.0, 0.0], [0.0, 0.0]]))).all()
