"""The lens, the renderer and the ground truth of the simulator agree with each other."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from autocalib_ros.errors import UsageError
from autocalib_ros.offline.simulate.faces import Canvas, Faces, PixelRect, Texture
from autocalib_ros.offline.simulate.lens import CameraPose, KannalaBrandtLens, look_rotation
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.truth import truth_of

pytestmark = pytest.mark.render

SMALL = {'width_px': 320, 'height_px': 180, 'focal_px': 140.0, 'rate_hz': 5.0, 'duration_s': 2.0}


@pytest.mark.parametrize('k', [(0, 0, 0, 0), (0.05, -0.01, 0, 0), (1 / 3, 2 / 15, 0, 0)])
def test_lens_projects_its_own_bearings_back_to_the_pixel(k):
    lens = KannalaBrandtLens(500.0, k, (320.0, 180.0))
    pixels = np.random.default_rng(0).uniform((0, 0), (639, 359), (200, 2))
    back, valid = lens.project(3.0 * lens.bearings(pixels))
    assert valid.all()
    assert np.abs(back - pixels).max() < 1e-6


def test_lens_follows_its_polynomial():
    lens = KannalaBrandtLens(500.0, (0.1, -0.02, 0.003, -0.001), (0.0, 0.0))
    theta = 0.8
    radius = 500.0 * (theta + 0.1 * theta**3 - 0.02 * theta**5 + 0.003 * theta**7 - 0.001 * theta**9)
    pixel, _ = lens.project(np.array([math.sin(theta), 0.0, math.cos(theta)]))
    assert pixel == pytest.approx((radius, 0.0), abs=1e-9)


def test_points_outside_the_range_of_the_lens_are_invalid():
    lens = KannalaBrandtLens(500.0, (-0.1, 0, 0, 0), (0.0, 0.0))
    _, valid = lens.project(np.array([[0.0, 0.0, -1.0], [0.0, 0.1, 1.0]]))
    assert valid.tolist() == [False, True]


def test_camera_looks_down_along_its_heading():
    forward = look_rotation(90.0, 30.0, 0.0)[:, 2]
    assert forward == pytest.approx((0.0, math.cos(math.pi / 6), -0.5), abs=1e-12)


def _painted_corner_error_px(texels: int, distance_m: float) -> float:
    """Draw a checkerboard corner; return its localisation error in pixels."""
    picture = np.full((texels, texels, 4), 255, np.uint8)
    half = texels // 2
    picture[:half, half:, :3] = picture[half:, :half, :3] = 20
    lens = KannalaBrandtLens(300.0, (0.02, -0.004, 0, 0), (322.3, 181.1))
    pose = CameraPose(look_rotation(20.0, 30.0, 5.0), np.array([0.0, 0.0, 6.0]))
    bearing = pose.world_from_camera @ lens.bearings(np.array([470.0, 120.0]))
    origin = pose.position_m + distance_m * bearing
    corners = np.array([[origin, (0.9, -1.8, 0.0), (0.0, 0.0, -2.0)]])
    canvas = Canvas(lens, 640, 360)
    canvas.colour[:] = 128
    canvas.draw(canvas.project_faces([Faces(corners, (Texture(picture),))], pose)[0])
    grey = np.ascontiguousarray(canvas.resolve(PixelRect(0, 0, 640, 360))[..., 0])
    point = corners[0, 0] + 0.5 * (corners[0, 1] + corners[0, 2])
    expected, _ = lens.project(pose.to_camera(point))
    found = np.round(expected).astype(np.float32).reshape(1, 1, 2).copy()
    cv2.cornerSubPix(grey, found, (6, 6), (-1, -1), (cv2.TERM_CRITERIA_EPS, 50, 1e-4))
    return float(np.linalg.norm(found[0, 0] - expected))


@pytest.mark.parametrize('distance_m', [5.0, 12.0])
@pytest.mark.parametrize('texels', [40, 160, 640])
def test_painted_corner_appears_at_its_projection(texels, distance_m):
    # The corner detector itself is accurate to a few hundredths of a pixel.
    assert _painted_corner_error_px(texels, distance_m) < 0.1


def test_nearer_face_hides_the_farther_one_in_any_order():
    lens = KannalaBrandtLens(100.0, (0, 0, 0, 0), (31.5, 31.5))
    pose = CameraPose(look_rotation(0.0, 0.0, 0.0), np.zeros(3))
    red, blue = (np.full((8, 8, 4), c, np.uint8) for c in ((0, 0, 255, 255), (255, 0, 0, 255)))

    def wall(x: float, picture: np.ndarray) -> Faces:
        return Faces(np.array([[(x, 1, 1), (0, -2, 0), (0, 0, -2.0)]]), (Texture(picture),))

    canvas = Canvas(lens, 64, 64)
    for faces in (wall(4.0, red), wall(8.0, blue)):
        canvas.draw(canvas.project_faces([faces], pose)[0])
    assert canvas.resolve(PixelRect(0, 0, 64, 64))[32, 32].tolist() == [0, 0, 255]


@pytest.fixture(scope='module')
def truth() -> dict:
    return truth_of(Simulation(SimulationOptions(**SMALL, bump_at_s=1.0)))


def test_truth_has_the_keys_of_the_scenes(truth):
    assert {
        'case',
        'scene',
        'width',
        'height',
        'fps',
        'duration_s',
        'mode',
        'pixel_convention',
        'lens',
        'camera',
        'world',
        'road_directions',
        'ground_points',
        'vehicles',
    } <= truth.keys()
    assert truth['lens'].keys() == {'model', 'f', 'k', 'cx', 'cy', 'note'}
    assert truth['vehicles']['columns'] == ['t', 'X', 'Y', 'heading_rad', 'speed_mps', 'u', 'v']


def _worst_projection_px(truth: dict, camera: dict, rows: np.ndarray) -> float:
    """Project ground points (n, 4: X, Y, u, v) with OpenCV and compare."""
    lens = truth['lens']
    matrix = np.array([[lens['f'], 0, lens['cx']], [0, lens['f'], lens['cy']], [0, 0, 1.0]])
    world = np.pad(rows[:, :2], ((0, 0), (0, 1)))
    points = (world - camera['position']) @ np.array(camera['R_world_from_camera'])
    zero = np.zeros(3)
    pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, np.array(lens['k'], float))
    return float(np.abs(pixels[:, 0] - rows[:, 2:]).max())


def test_ground_points_agree_with_the_fisheye_model_of_opencv(truth):
    rows = np.array(truth['ground_points']['rows'])
    assert len(rows) == 48
    assert _worst_projection_px(truth, truth['camera'], rows) < 1e-3


@pytest.mark.parametrize('bumped', [False, True])
def test_vehicle_tracks_agree_with_the_fisheye_model_of_opencv(truth, bumped):
    rows = np.concatenate([np.array(t['rows']) for t in truth['vehicles']['tracks']])
    rows = rows[(rows[:, 0] >= 1.0) == bumped]
    camera = (truth['bump'] if bumped else truth)['camera']
    # Positions are rounded to 0.1 mm, pixels to 0.001.
    assert _worst_projection_px(truth, camera, rows[:, [1, 2, 5, 6]]) < 0.01


def test_truth_after_a_bump_belongs_to_the_bumped_camera(truth):
    rows = np.array(truth['bump']['ground_points']['rows'])
    assert _worst_projection_px(truth, truth['bump']['camera'], rows) < 1e-3


def test_bump_turns_the_camera_by_its_angle():
    simulation = Simulation(SimulationOptions(**SMALL, bump_at_s=1.0, bump_deg=3.0, empty=True))
    turn = simulation.pose.world_from_camera.T @ simulation.bumped_pose().world_from_camera
    assert math.degrees(math.acos((np.trace(turn) - 1) / 2)) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ({'scene': 'moon'}, 'unknown scene'),
        ({'storage': 'tape'}, 'unknown storage'),
        ({'focal_px': -1.0}, 'focal_px'),
        ({'road_angle_deg': 10.0}, 'road_angle_deg'),
        ({'night': True, 'thermal': True}, 'mutually exclusive'),
        ({'shutter_every_s': 60.0}, 'only thermal cameras'),
        ({'thermal': True, 'shutter_shows': 'open'}, 'unknown shutter_shows'),
        ({'bump_at_s': 500.0}, 'bump_at_s'),
        ({'k': (0.01,)}, 'not four'),
        ({'k': (-0.3, 0.0, 0.0, 0.0)}, 'invalid beyond'),
        ({'topic': 'image'}, 'not absolute'),
        ({'duration_s': float('nan')}, 'duration_s'),
    ],
)
def test_impossible_options_are_refused(given, message):
    with pytest.raises(UsageError, match=message):
        SimulationOptions(**given)
