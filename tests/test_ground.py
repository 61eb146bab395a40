"""Pixels to the road and back, against OpenCV, the simulator's truth and Monte Carlo."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from recorded_clips import DATA, needs_recorded_clips
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from autocalib_ros.config import GateOptions, JointOptions, LensOptions, Options, ScaleOptions
from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import GroundPlane, pixels_ahead
from autocalib_ros.ground import Ground
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.truth import truth_of
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence
from autocalib_ros.results.calibration import GROUND_DISTANCES_M, Calibration, EvidenceSummary, StandardDeviations
from autocalib_ros.results.calibration_json import to_json
from autocalib_ros.results.refusals import Reason
from solved_once import solve_once

TYPES = get_typestore(Stores.ROS2_JAZZY).types
SIZE = (1280, 720)
K = (560.0, 0.0, 630.0, 0.0, 560.0, 371.0, 0.0, 0.0, 1.0)
TALL = (560.0, 0.0, 630.0, 0.0, 548.0, 371.0, 0.0, 0.0, 1.0)
LENSES = {
    'equidistant': ('equidistant', K, (0.015, -0.003, 0.001, -0.0002)),
    'kannala_brandt': ('kannala_brandt', K, (0.015, -0.003, 0.001, -0.0002)),
    'equidistant, tall pixels': ('equidistant', TALL, (0.015, -0.003, 0.001, -0.0002)),
    'plumb_bob': ('plumb_bob', K, (-0.2, 0.03, 0.001, -0.002, 0.0)),
    'plumb_bob, no distortion': ('plumb_bob', K, (0.0,) * 5),
    'rational_polynomial': ('rational_polynomial', TALL, (1.2, 0.3, 0.001, 0.0005, 0.01, 1.5, 0.5, 0.03)),
}
HEIGHT_M = 8.0
CAMERA_FROM_GROUND = pose(32.0, 1.0, 35.0)
EXACT_PX = 1e-6
CAMERA = Camera(*SIZE, 560.0, (630.0, 371.0), (0.015, -0.003, 0.0, 0.0))
DEVIATIONS = np.array([1.0, 0.7, 0.8, 0.002, 0.001, 0.0, 0.0, 0.1, 0.05, 0.03])
AXES = np.linalg.qr(np.random.default_rng(7).normal(size=(10, 10)))[0]
COVARIANCE = DEVIATIONS[:, None] * ((AXES * np.linspace(0.3, 1.4, 10)) @ AXES.T) * DEVIATIONS
"""Of correlated parameters, as those of a calibration are."""


def message(kind: str, **fields: Any) -> Any:
    """Return a message as rosbags reads it: numpy arrays in it, and no ROS."""
    return TYPES[kind](**fields)


def header(frame: str) -> Any:
    stamp = message('builtin_interfaces/msg/Time', sec=1, nanosec=2)
    return message('std_msgs/msg/Header', stamp=stamp, frame_id=frame)


def info(
    model: str = 'equidistant',
    k: tuple[float, ...] = K,
    d: tuple[float, ...] = (0.015, 0.0, 0.0, 0.0),
    *,
    p: tuple[float, ...] = (0.0,) * 12,
    r: np.ndarray | None = None,
    binning: int = 0,
    offset: tuple[int, int] = (0, 0),
) -> Any:
    region = message(
        'sensor_msgs/msg/RegionOfInterest',
        x_offset=offset[0],
        y_offset=offset[1],
        width=640 if any(offset) else 0,
        height=360 if any(offset) else 0,
        do_rectify=False,
    )
    return message(
        'sensor_msgs/msg/CameraInfo',
        header=header('cam'),
        width=SIZE[0],
        height=SIZE[1],
        distortion_model=model,
        k=np.array(k),
        d=np.array(d),
        r=(np.eye(3) if r is None else r).ravel(),
        p=np.array(p),
        binning_x=binning,
        binning_y=binning,
        roi=region,
    )


def transform(
    parent: str = 'road',
    child: str = 'cam',
    rotation: np.ndarray = CAMERA_FROM_GROUND.T,
    translation: tuple[float, ...] = (0.0, 0.0, HEIGHT_M),
) -> Any:
    turn = dict(zip('xyzw', Rotation.from_matrix(rotation).as_quat().tolist(), strict=True))
    shift = dict(zip('xyz', map(float, translation), strict=True))
    return message(
        'geometry_msgs/msg/TransformStamped',
        header=header(parent),
        child_frame_id=child,
        transform=message(
            'geometry_msgs/msg/Transform',
            translation=message('geometry_msgs/msg/Vector3', **shift),
            rotation=message('geometry_msgs/msg/Quaternion', **turn),
        ),
    )


def opencv_pixels(lens: tuple[str, tuple[float, ...], tuple[float, ...]], points_m: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of points (n, 3) of the ground, by OpenCV."""
    model, k, d = lens
    turn, _ = cv2.Rodrigues(CAMERA_FROM_GROUND)
    shift = CAMERA_FROM_GROUND @ [0.0, 0.0, -HEIGHT_M]
    if model in ('equidistant', 'kannala_brandt'):
        pixels, _ = cv2.fisheye.projectPoints(points_m[:, None], turn, shift, np.reshape(k, (3, 3)), np.array(d))
    else:
        pixels, _ = cv2.projectPoints(points_m, turn, shift, np.reshape(k, (3, 3)), np.array(d))
    return pixels[:, 0]


def document(
    camera: Camera | None = None, covariance: np.ndarray | None = COVARIANCE, **changed: Any
) -> dict[str, Any]:
    """Return the document of a calibration, as it is read from its file."""
    summary = EvidenceSummary(
        image_size=SIZE, seconds=60.0, frames=900, tracks=300, segments=4000, vehicles=70, coverage=0.6
    )
    result = Calibration(
        method='joint',
        grade='full',
        assumptions=(),
        camera=camera or CAMERA,
        ground=GroundPlane(CAMERA_FROM_GROUND.T, HEIGHT_M),
        ground_refusal=None,
        road_directions=np.zeros((0, 3)),
        stddev=StandardDeviations(),
        covariance=covariance,
        paper=None,
        evidence=summary,
        newest_stamp_ns=1,
    )
    return json.loads(json.dumps(to_json(replace(result, **changed))))


@pytest.fixture
def places() -> np.ndarray:
    """Return points of the road that the camera sees, shape (n, 2)."""
    generator = np.random.default_rng(0)
    reach, around = generator.uniform(6.0, 60.0, 300), np.radians(-35.0 + generator.uniform(-30.0, 30.0, 300))
    return np.column_stack([reach * np.cos(around), reach * np.sin(around)])


@pytest.fixture
def pixels() -> np.ndarray:
    """Return pixels all over the image, shape (n, 2)."""
    return np.random.default_rng(1).uniform((0, 0), SIZE, (2000, 2))


@pytest.mark.parametrize('height_m', [0.0, 1.5])
@pytest.mark.parametrize('lens', LENSES.values(), ids=LENSES.keys())
def test_points_and_pixels_are_those_of_opencv(lens, height_m, places):
    ground = Ground.from_messages(info(*lens), transform())
    points = np.column_stack([places, np.full(len(places), height_m)])
    expected = opencv_pixels(lens, points)
    pixels, seen = ground.pixels(points)
    found = ground.points(expected, height_m=height_m)
    assert seen.all() and found.valid.all()
    np.testing.assert_allclose(pixels, expected, atol=EXACT_PX)
    np.testing.assert_allclose(found.points_m, points, atol=1e-8)


@pytest.mark.parametrize('lens', LENSES.values(), ids=LENSES.keys())
def test_pixels_come_back(lens, pixels):
    ground = Ground.from_messages(info(*lens), transform())
    found = ground.points(pixels)
    back, seen = ground.pixels(found.points_m)
    assert 0.5 < found.valid.mean() < 1.0
    np.testing.assert_array_equal(seen, found.valid)
    np.testing.assert_allclose(back[seen], pixels[seen], atol=EXACT_PX)


def test_the_published_lens_of_a_calibration_gives_the_points_of_its_file(pixels):
    camera = Camera(*SIZE, 560.0, (630.0, 371.0))  # its CameraInfo has 1e-9 for 0: the difference must not matter
    fields = camera_info(camera)
    published = Ground.from_messages(info(fields.distortion_model, tuple(fields.k), tuple(fields.d)), transform())
    saved = Ground.from_document(document(camera))
    np.testing.assert_allclose(published.points(pixels).points_m, saved.points(pixels).points_m, rtol=1e-6)
    back, seen = published.pixels(saved.points(pixels).points_m)
    np.testing.assert_allclose(back[seen], pixels[seen], atol=EXACT_PX)


def test_points_of_the_road_have_height_zero_and_need_no_third_coordinate(places):
    ground = Ground.from_messages(info(), transform())
    pixels, _ = ground.pixels(places)
    np.testing.assert_allclose(ground.points(pixels).points_m, np.pad(places, ((0, 0), (0, 1))), atol=1e-8)


def test_either_frame_may_be_the_parent(pixels):
    upwards = Ground.from_messages(info(), transform())
    shift = -CAMERA_FROM_GROUND @ [0.0, 0.0, HEIGHT_M]
    downwards = Ground.from_messages(info(), transform('cam', 'road', CAMERA_FROM_GROUND, tuple(shift)))
    assert (upwards.ground_frame, downwards.ground_frame) == ('road', 'road')
    np.testing.assert_allclose(upwards.points(pixels).points_m, downwards.points(pixels).points_m, rtol=1e-9)


def test_a_ground_frame_elsewhere_gives_points_in_that_frame(places):
    here, away = (
        Ground.from_messages(info(), transform(translation=(*shift, HEIGHT_M)))
        for shift in ((0.0, 0.0), (100.0, -50.0))
    )
    pixels, _ = here.pixels(places)
    np.testing.assert_allclose(away.points(pixels).points_m[:, :2], places + [100.0, -50.0], atol=1e-8)


@pytest.mark.parametrize(('parent', 'child'), [('road', 'other'), ('other', 'road'), ('cam', 'cam')])
def test_a_transform_of_another_frame_is_refused(parent, child):
    with pytest.raises(InputError, match=f"joins '{parent}' and '{child}', but not the camera's frame 'cam'"):
        Ground.from_messages(info(), transform(parent, child))


def test_the_frame_of_the_pose_may_have_another_name():
    assert Ground.from_messages(info(), transform('road', 'lens'), camera_frame='lens').ground_frame == 'road'


@pytest.mark.parametrize(
    ('changed', 'said'),
    [
        ({'translation': (0.0, 0.0, -8.0)}, 'z axis points up'),
        ({'translation': (0.0, 0.0, float('nan'))}, 'z axis points up'),
    ],
)
def test_a_camera_that_is_not_above_the_road_is_refused(changed, said):
    with pytest.raises(InputError, match=said):
        Ground.from_messages(info(), transform(**changed))


def test_a_rotation_that_is_none_is_refused():
    stamped = transform()
    stamped.transform.rotation.w += 0.5
    with pytest.raises(InputError, match='length'):
        Ground.from_messages(info(), stamped)


@pytest.mark.parametrize(
    ('given', 'said'),
    [
        ({'k': (0.0,) * 9}, 'not calibrated'),
        ({'model': 'division'}, 'distortion model'),
        ({'d': (0.0,) * 9}, '9 numbers, expected at most 4'),
    ],
)
def test_what_is_no_lens_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        Ground.from_messages(info(**given), transform())


def horizon_row(column: float) -> float:
    """The row of the horizon in a column, by bisection of OpenCV's bearings."""

    def depression(row: float) -> float:
        _model, k, d = LENSES['equidistant']
        slope = cv2.fisheye.undistortPoints(np.array([[[column, row]]]), np.reshape(k, (3, 3)), np.array(d))[0, 0]
        return float(-(CAMERA_FROM_GROUND.T @ [*slope, 1.0])[2])

    low, high = 0.0, 360.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if depression(middle) < 0 else (low, middle)
    return high


@pytest.mark.parametrize('column', [0.0, 640.0, 1279.0])
def test_at_and_above_the_horizon_there_is_no_point(column):
    ground = Ground.from_messages(info(*LENSES['equidistant']), transform())
    below_px = np.array([-200.0, -10.0, -1.0, -1e-6, 0.0, 1e-6, 0.5, 1.5, 3.0, 10.0, 100.0])
    found = ground.points(np.column_stack([np.full(len(below_px), column), horizon_row(column) + below_px]))
    np.testing.assert_array_equal(found.valid, below_px > 1.0)
    assert np.isnan(found.points_m[~found.valid]).all()
    distances = np.hypot(*found.points_m[found.valid, :2].T)
    assert (np.diff(distances) < 0).all()
    assert distances[0] < 1.2 * 560.0 * HEIGHT_M  # one pixel of depression


def test_a_plane_as_high_as_the_camera_is_seen_by_no_pixel(pixels):
    assert not Ground.from_messages(info(), transform()).points(pixels, height_m=HEIGHT_M).valid.any()


def test_what_is_higher_than_the_camera_is_seen_above_the_horizon():
    points = np.array([[20.0, -14.0, 10.0]])
    ground = Ground.from_messages(info(*LENSES['equidistant']), transform())
    found = ground.points(opencv_pixels(LENSES['equidistant'], points), height_m=10.0)
    np.testing.assert_allclose(found.points_m, points, atol=1e-8)


def test_each_point_may_have_its_own_height(places):
    heights = np.linspace(0.0, 3.0, len(places))
    points = np.column_stack([places, heights])
    ground = Ground.from_messages(info(), transform())
    np.testing.assert_allclose(ground.points(ground.pixels(points)[0], height_m=heights).points_m, points, atol=1e-8)


# x (1 - 0.5 r^2) is largest, 0.544, at r = 0.816; theta - 0.3 theta^3 is largest, 0.703, at 60 degrees
@pytest.mark.parametrize(
    ('model', 'd', 'largest'),
    [('plumb_bob', (-0.5, 0.0, 0.0, 0.0, 0.0), 0.5443), ('equidistant', (-0.3, 0.0, 0.0, 0.0), 0.7027)],
)
def test_a_pixel_that_the_lens_does_not_reach_has_no_point(model, d, largest):
    ground = Ground.from_messages(info(model, K, d), transform(rotation=pose(90.0, 0.0, 0.0).T))
    shares = np.array([0.5, 0.95, 0.99, 1.01, 1.5, 3.0])  # straight down: no horizon is near
    found = ground.points(np.column_stack([630.0 + 560.0 * largest * shares, np.full(6, 371.0)]))
    np.testing.assert_array_equal(found.valid, shares < 1.0)
    assert np.isnan(found.points_m[~found.valid]).all()


def test_a_point_beyond_the_fold_or_behind_has_no_pixel():
    ground = Ground.from_messages(
        info('plumb_bob', K, (-0.5, 0.0, 0.0, 0.0, 0.0)), transform(rotation=pose(90.0, 0.0, 0.0).T)
    )
    pixels, seen = ground.pixels(np.array([[0.0, 0.0, 0.0], [0.0, 7.0, 0.0], [0.0, 1.0, 20.0], [0.0, 0.0, HEIGHT_M]]))
    np.testing.assert_array_equal(seen, [True, False, False, False])
    assert np.isnan(pixels[1:]).all()


@pytest.mark.parametrize('lens', ['equidistant', 'kannala_brandt', 'rational_polynomial'])
def test_binned_and_cut_images_show_the_same_road(lens, places):
    whole = Ground.from_messages(info(*LENSES[lens]), transform())
    part = Ground.from_messages(info(*LENSES[lens], binning=2, offset=(320, 180)), transform())
    full, _ = whole.pixels(places)
    delivered = (full - [320, 180]) / 2  # as image_geometry reduces them
    np.testing.assert_allclose(part.pixels(places)[0], delivered, atol=EXACT_PX)
    np.testing.assert_allclose(part.points(delivered).points_m[:, :2], places, atol=1e-7)


def test_pixels_of_a_rectified_image_go_by_p_and_r(places):
    turned = Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix()
    projection = (400.0, 0.0, 640.0, 0.0, 0.0, 410.0, 360.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    given = info(*LENSES['rational_polynomial'], p=projection, r=turned)
    rays = (np.pad(places, ((0, 0), (0, 1))) - [0, 0, HEIGHT_M]) @ CAMERA_FROM_GROUND.T @ turned.T
    rectified = rays[:, :2] / rays[:, 2:] * [400.0, 410.0] + [640.0, 360.0]
    ground = Ground.from_messages(given, transform(), rectified=True)
    np.testing.assert_allclose(ground.points(rectified).points_m[:, :2], places, atol=1e-8)


def test_a_rectified_image_needs_p():
    with pytest.raises(InputError, match="'p' has no valid projection"):
        Ground.from_messages(info(), transform(), rectified=True)


def test_messages_of_ros_1_are_read(pixels):
    given = info(*LENSES['plumb_bob'])
    kind = get_typestore(Stores.ROS1_NOETIC).types['sensor_msgs/msg/CameraInfo']
    old = kind(
        header=given.header,
        height=given.height,
        width=given.width,
        distortion_model=given.distortion_model,
        D=given.d,
        K=given.k,
        R=given.r,
        P=given.p,
        binning_x=0,
        binning_y=0,
        roi=given.roi,
    )
    found, expected = (Ground.from_messages(one, transform()).points(pixels) for one in (old, given))
    np.testing.assert_array_equal(found.points_m, expected.points_m)


def test_no_pixels_give_no_points():
    found = Ground.from_document(document()).points(np.zeros((0, 2)))
    assert found.points_m.shape == (0, 3) and found.valid.shape == (0,)
    assert found.sigma_m is not None and found.sigma_m.shape == (0,)


def test_pixels_that_are_no_numbers_have_no_point():
    found = Ground.from_document(document()).points(np.array([[np.nan, 300.0], [640.0, np.inf], [640.0, 500.0]]))
    np.testing.assert_array_equal(found.valid, [False, False, True])


def worst_px(truth: dict[str, Any]) -> float:
    """How far the truth's points are imaged from its pixels, and its pixels' points from its points, in pixels."""
    lens, camera = truth['lens'], truth['camera']
    ground = Ground.from_messages(
        info(k=(lens['f'], 0.0, lens['cx'], 0.0, lens['f'], lens['cy'], 0.0, 0.0, 1.0), d=tuple(lens['k'])),
        transform(rotation=np.array(camera['R_world_from_camera']), translation=tuple(camera['position'])),
    )
    rows = np.array(truth['ground_points']['rows'])
    pixels, seen = ground.pixels(rows[:, :2])
    found = ground.points(rows[:, 2:])
    again, _ = ground.pixels(found.points_m)
    assert len(rows) > 20 and seen.all() and found.valid.all()
    assert (np.hypot(*(found.points_m[:, :2] - rows[:, :2]).T) < 0.01).all()
    return float(max(np.abs(pixels - rows[:, 2:]).max(), np.abs(again - rows[:, 2:]).max()))


@pytest.mark.render
def test_the_truth_of_the_simulator_is_met():
    options = SimulationOptions(duration_s=1.0, width_px=640, height_px=360, k=(0.02, -0.004, 0.0, 0.0))
    assert worst_px(truth_of(Simulation(options))) < 1e-4  # its pixels are rounded to 4 digits, half of it


@needs_recorded_clips
def test_the_truth_of_a_rendered_scene_is_met():
    assert worst_px(json.loads((DATA / 'scenes' / 'S1' / 'truth.json').read_text())) < 1e-4


def test_sigma_is_the_spread_of_what_might_have_been_published():
    generator = np.random.default_rng(3)
    ground = Ground.from_document(document())
    pixels, _ = ground.pixels(np.array([[8.0, -6.0], [16.0, -11.0], [25.0, 0.0], [30.0, -30.0]]))
    draws = []
    for f, cx, cy, k1, k2, k3, k4, tilt, roll, height in generator.multivariate_normal(np.zeros(10), COVARIANCE, 3000):
        camera = Camera(*SIZE, 560.0 + f, (630.0 + cx, 371.0 + cy), (0.015 + k1, -0.003 + k2, k3, k4))
        rotation = pose(32.0 + tilt, 1.0 + roll, 35.0).T
        rays = camera.unproject(pixels)[0] @ rotation.T
        draws.append(-(HEIGHT_M + height) / rays[:, 2:] * rays[:, :2])
    found = ground.points(pixels)
    expected = np.array([np.cov(draw.T) for draw in np.swapaxes(draws, 0, 1)])
    # 3000 draws give a variance to 2.6 %, and the farther points are a little beyond linear
    scale = np.sqrt(np.trace(expected, axis1=1, axis2=2))
    np.testing.assert_allclose(found.sigma_m, scale, rtol=0.08)
    np.testing.assert_allclose(
        found.covariance_m2 / scale[:, None, None] ** 2, expected / scale[:, None, None] ** 2, atol=0.08
    )


def test_sigma_grows_towards_the_horizon_beyond_the_distance_itself():
    rows = horizon_row(640.0) + np.array([1.5, 5.0, 20.0, 60.0, 200.0])
    found = Ground.from_document(document(covariance=9.0 * COVARIANCE)).points(
        np.column_stack([np.full(5, 640.0), rows])
    )
    share = found.sigma_m / np.hypot(*found.points_m[:, :2].T)
    assert found.valid.all() and (np.diff(share) < 0).all()
    assert share[0] > 1.0 and share[-1] < 0.1


def test_the_noise_of_pixels_is_reported_and_adds_to_sigma():
    pixel = np.array([[640.0, 400.0]])
    shaken = pixel + np.random.default_rng(0).normal(0.0, 0.5, (4000, 2))
    live, saved = Ground.from_messages(info(), transform()), Ground.from_document(document())
    spread = np.cov(live.points(shaken).points_m[:, :2].T)
    noise = live.points(pixel, pixel_sigma_px=0.5).noise_m2[0]
    np.testing.assert_allclose(noise, spread, atol=0.08 * np.trace(spread))  # 4000 draws give a variance to 2.2 %
    found, exact = saved.points(pixel, pixel_sigma_px=0.5), saved.points(pixel)
    assert exact.noise_m2 is None
    np.testing.assert_allclose(found.sigma_m**2, exact.sigma_m**2 + np.trace(found.noise_m2[0]), rtol=1e-9)


def test_messages_and_files_without_covariance_tell_no_sigma(pixels):
    older = document()
    del older['covariance']
    grounds = (
        Ground.from_messages(info(), transform()),
        Ground.from_document(document(covariance=None)),
        Ground.from_document(older),
    )
    assert [ground.points(pixels).sigma_m for ground in grounds] == [None] * 3


SCALES = {
    'height': Options(camera_height=HEIGHT_M, camera_height_sigma=0.1),
    'distance': Options(
        scale_from='distance', scale=ScaleOptions(distance_px='500 500 900 450', distance_m=10.0, distance_sigma_m=0.1)
    ),
    'assumed': Options(
        camera_height=HEIGHT_M,
        joint=JointOptions(roll_prior_deg=2.0),
        gate=GateOptions(least_grade='assumed'),
        lens=LensOptions(pixel_aspect=1.0),
    ),
}
ONE_ROAD = Junction(
    road_angles_deg=(0.0,),
    turning_fraction=0.0,
    vehicles=120,
    camera_from_ground=pose(35.0, 1.0, 60.0),
    centre_m=(6.0, -10.0),
)


@pytest.mark.solve
@pytest.mark.parametrize('scale', SCALES)
def test_the_covariance_of_a_calibration_agrees_with_its_deviations(scale):
    junction = ONE_ROAD if scale == 'assumed' else Junction()
    result = solve_once(synthetic_evidence(junction, np.random.default_rng(0)), SCALES[scale])
    assert isinstance(result, Calibration) and result.ground is not None and result.covariance is not None
    sigma, (cx, cy) = result.stddev, result.stddev.principal_point_px
    np.testing.assert_allclose(
        np.sqrt(np.diag(result.covariance)),
        [sigma.focal_px, cx, cy, sigma.k1, sigma.k2, 0.0, 0.0, sigma.tilt_deg, sigma.roll_deg, sigma.height_m or 0.0],
        rtol=1e-6,
        atol=1e-12,
    )
    ahead = pixels_ahead(
        result.camera, result.ground.normal_in_camera, result.ground.height_m, np.array(GROUND_DISTANCES_M)
    )
    seen = np.isfinite(ahead).all(axis=1)
    found = Ground.from_document(json.loads(json.dumps(to_json(result)))).points(ahead[seen])
    assert seen.any()
    np.testing.assert_allclose(found.sigma_m, np.array(sigma.ground_point_m, float)[seen], rtol=1e-3)


def test_a_file_is_read(tmp_path, pixels):
    (tmp_path / 'calibration.json').write_text(json.dumps(document()))
    found = Ground.from_file(tmp_path / 'calibration.json').points(pixels)
    np.testing.assert_array_equal(found.points_m, Ground.from_document(document()).points(pixels).points_m)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('{', 'is not JSON'),
        ('[]', 'holds no names with values'),
        ('{"version": 1}', 'holds no calibration'),
        (json.dumps(document() | {'version': 4}), 'its version is 4; versions 1 to 3 can be read'),
        (
            json.dumps(document() | {'state': 'refused', 'refusal': {'code': 'no_motion', 'message': 'nothing moves'}}),
            'no calibration .no_motion: nothing moves.',
        ),
        (json.dumps(document(grade='unit_scale')), "units of the camera's height"),
        (
            json.dumps(document(ground=None, ground_refusal=Reason('no_height', 'none given', 'give it'))),
            'no ground plane .no_height: none given.; give it',
        ),
    ],
)
def test_a_file_without_a_ground_plane_in_metres_is_refused(tmp_path, text, said):
    path = tmp_path / 'calibration.json'
    path.write_text(text)
    with pytest.raises(InputError, match=said) as error:
        Ground.from_file(path)
    assert str(path) in str(error.value)


def test_a_missing_file_is_reported(tmp_path):
    with pytest.raises(InputError, match='cannot read'):
        Ground.from_file(tmp_path / 'none.json')
