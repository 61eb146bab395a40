"""Outgoing messages meet the assumptions of their consumers."""

import copy

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, RegionOfInterest
from std_msgs.msg import Header

from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import ModelMisfit, camera_info
from autocalib_ros.ros.messages import (
    InvalidMessage,
    camera_info_message,
    ground_transform_message,
    header,
    stamp_ns,
    time_message,
    validated,
)
from bench import ROTATION

STAMP = time_message(1_700_000_000_123_456_789)


def info_message() -> CameraInfo:
    return camera_info_message(camera_info(Camera.equidistant(640, 360, 300.0)), STAMP, 'cam')


def transform_message(ground: GroundPlane):
    return ground_transform_message(ground, STAMP, 'cam_ground', 'cam')


def unchecked(message, field: str, value):
    """Set a field past the checks, as rclpy does when they are off."""
    object.__setattr__(message, f'_{field}', value)
    return message


@given(
    st.integers(16, 4096),
    st.integers(16, 4096),
    st.floats(50, 5000),
    st.floats(-0.02, 0.02),
    st.floats(0, 1),
    st.sampled_from(['auto', 'equidistant', 'kannala_brandt', 'rational_polynomial', 'plumb_bob']),
)
@settings(deadline=None)
def test_camera_info_of_any_lens_is_valid_and_survives_the_wire(width, height, focal_px, k1, balance, model):
    camera = Camera(width, height, focal_px, ((width - 1) / 2, (height - 1) / 2), (k1, 0.0, 0.0, 0.0))
    try:
        fields = camera_info(camera, model, balance)
    except ModelMisfit:
        assume(False)
    message = validated(camera_info_message(fields, STAMP, 'cam'))
    arrived = deserialize_message(serialize_message(message), CameraInfo)
    assert (list(arrived.k), list(arrived.d), list(arrived.p)) == (fields.k, fields.d, fields.p)
    assert (arrived.width, arrived.height) == (width, height)
    assert arrived.distortion_model == ('equidistant' if model == 'auto' else model)


def test_camera_info_converts_numpy_numbers():
    fields = camera_info(Camera.equidistant(640, 360, 300.0))
    numpy_fields = type(fields)(
        np.int64(640),
        np.int64(360),
        fields.distortion_model,
        np.array(fields.k, np.float32),
        np.array(fields.d),
        np.array(fields.r, int),
        np.array(fields.p),
    )
    assert list(validated(camera_info_message(numpy_fields, STAMP, 'cam')).r) == fields.r


def test_ground_transform_is_the_pose_of_the_camera_in_the_ground_frame():
    message = validated(transform_message(GroundPlane(ROTATION, 8.0)))
    assert (message.header.frame_id, message.child_frame_id) == ('cam_ground', 'cam')
    t, q = message.transform.translation, message.transform.rotation
    assert (t.x, t.y, t.z) == (0.0, 0.0, 8.0)
    # The optical axis (z) is the ground's x: the field's usual quaternion of an optical frame.
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], [-0.5, 0.5, -0.5, 0.5], atol=1e-12)


@pytest.mark.parametrize('tf_parent', ['ground', 'camera'])
def test_ground_transform_takes_points_of_the_child_to_the_parent(tf_parent):
    message = validated(ground_transform_message(GroundPlane(ROTATION, 8.0), STAMP, 'cam_ground', 'cam', tf_parent))
    t, q = message.transform.translation, message.transform.rotation
    # 20 m ahead in the optical axis, 8 m above the road
    ends = {'cam': [0.0, 0.0, 20.0], 'cam_ground': [20.0, 0.0, 8.0]}
    moved = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply(ends[message.child_frame_id]) + [t.x, t.y, t.z]
    np.testing.assert_allclose(moved, ends[message.header.frame_id], atol=1e-12)


def driver_message(width: int, height: int, binning: int, roi: RegionOfInterest | None = None) -> CameraInfo:
    """Return the CameraInfo of an uncalibrated driver."""
    return CameraInfo(width=width, height=height, binning_x=binning, binning_y=binning, roi=roi or RegionOfInterest())


def test_binning_and_region_of_the_driver_are_copied_and_the_rest_is_in_full_resolution():
    region = RegionOfInterest(x_offset=100, y_offset=60, width=1280, height=720, do_rectify=True)
    driver = driver_message(1920, 1080, 2, region)
    fields = camera_info(Camera.equidistant(640, 360, 300.0))
    message = validated(camera_info_message(fields, STAMP, 'cam', driver))
    assert (message.width, message.height, message.binning_x, message.binning_y) == (1920, 1080, 2, 2)
    assert message.roi == region and message.roi is not region
    # twice the pixels of the image, the middle of which is at (100, 60) and half of 1280x720 from there
    assert list(message.k) == [600.0, 0.0, 100 + 2 * 319.5, 0.0, 600.0, 60 + 2 * 179.5, 0.0, 0.0, 1.0]
    assert message.p[0] == 2 * fields.p[0] and list(message.d) == fields.d


def test_without_a_driver_binning_and_region_are_those_of_the_whole_image():
    message = info_message()
    assert (message.binning_x, message.binning_y, message.roi) == (0, 0, RegionOfInterest())


def test_a_driver_that_speaks_of_other_images_is_reported():
    with pytest.raises(InputError, match='for images of 320x180, these have 640x360'):
        camera_info_message(camera_info(Camera.equidistant(640, 360, 300.0)), STAMP, 'cam', driver_message(640, 360, 2))


def test_header_is_a_copy():
    given_header = Header(stamp=STAMP, frame_id='cam')
    made = header(given_header.stamp, given_header.frame_id)
    made.stamp.sec, made.frame_id = 1, 'other'
    assert (given_header.stamp.sec, given_header.frame_id) == (1_700_000_000, 'cam')


def test_stamp_keeps_every_nanosecond():
    assert stamp_ns(time_message(1_700_000_000_123_456_789)) == 1_700_000_000_123_456_789


@pytest.mark.parametrize(
    ('field', 'value', 'expected'),
    [
        ('k', [1.0] * 8, 'CameraInfo.k holds 8 numbers, not 9'),
        ('k', np.eye(3), 'CameraInfo.k has more than one dimension'),
        ('k', np.array([300.0, 0, 160, 0, np.nan, 120, 0, 0, 1]), 'CameraInfo.k is nan'),
        ('k', [1] * 9, 'CameraInfo.k is a int, not a float'),
        ('k', [0.0] * 9, 'CameraInfo.k has no positive focal length'),
        ('p', [0.0] * 12, 'CameraInfo.p has no positive focal length'),
        ('d', [0.1] * 5, 'CameraInfo.d holds 5 numbers, not 4'),
        ('d', [0.0] * 4, 'CameraInfo.d is all zero'),
        ('d', [float('inf'), 0.0, 0.0, 0.0], 'CameraInfo.d is inf'),
        ('width', np.int64(640), 'CameraInfo.width is a int64, not an int'),
        ('width', 640.0, 'CameraInfo.width is a float, not an int'),
        ('width', 0, 'CameraInfo has the size 0x360'),
        ('height', -1, 'CameraInfo.height is -1, which is not a uint32'),
        ('distortion_model', 'fisheye', "CameraInfo.distortion_model is 'fisheye'"),
    ],
)
def test_broken_camera_info_is_refused_by_name(field, value, expected):
    with pytest.raises(InvalidMessage, match=expected.replace('.', r'\.')):
        validated(unchecked(info_message(), field, value))


def test_a_region_beyond_the_sensor_is_refused():
    message = info_message()
    message.roi = RegionOfInterest(x_offset=600, width=41, height=10)
    with pytest.raises(InvalidMessage, match=r'CameraInfo\.roi reaches beyond the 640x360 pixels'):
        validated(message)


@pytest.mark.parametrize('frame', ['', '/cam'])
def test_camera_info_with_a_frame_that_tf2_rejects_is_refused(frame):
    message = info_message()
    message.header.frame_id = frame
    with pytest.raises(InvalidMessage, match=r'header\.frame_id'):
        validated(message)


@pytest.mark.parametrize(
    ('field', 'value', 'expected'),
    [
        ('x', 1, 'rotation.x is a int, not a float'),
        ('x', np.float32(1), 'rotation.x is a float32, not a float'),
        ('w', 2.0, 'rotation has the length'),
    ],
)
def test_broken_rotation_is_refused(field, value, expected):
    message = transform_message(GroundPlane(ROTATION, 8.0))
    unchecked(message.transform.rotation, field, value)
    with pytest.raises(InvalidMessage, match=expected):
        validated(message)


def test_transform_of_a_frame_to_itself_is_refused():
    message = copy.deepcopy(transform_message(GroundPlane(ROTATION, 8.0)))
    message.child_frame_id = message.header.frame_id
    with pytest.raises(InvalidMessage, match='joins a frame with itself'):
        validated(message)


def test_infinite_height_is_refused():
    with pytest.raises(InvalidMessage, match=r'translation\.z is inf'):
        validated(transform_message(GroundPlane(ROTATION, float('inf'))))


def test_messages_without_a_rule_of_their_own_are_checked_field_by_field():
    assert validated(Image(width=1, height=1, step=1, encoding='mono8'))
