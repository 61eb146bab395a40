"""Outgoing messages hold what their consumers take for granted."""

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from autocalib_ros.calibration import GroundPlane
from autocalib_ros.camera import Camera
from autocalib_ros.camera_info import camera_info
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


@given(st.integers(16, 4096), st.integers(16, 4096), st.floats(50, 5000), st.floats(-0.02, 0.02))
def test_camera_info_of_any_lens_is_valid_and_survives_the_wire(width, height, focal_px, k1):
    camera = Camera(width, height, focal_px, ((width - 1) / 2, (height - 1) / 2), (k1, 0.0, 0.0, 0.0))
    fields = camera_info(camera)
    message = validated(camera_info_message(fields, STAMP, 'cam'))
    arrived = deserialize_message(serialize_message(message), CameraInfo)
    assert (list(arrived.k), list(arrived.d), list(arrived.p)) == (fields.k, fields.d, fields.p)
    assert (arrived.width, arrived.height, arrived.distortion_model) == (width, height, 'equidistant')


def test_camera_info_converts_numpy_numbers():
    fields = camera_info(Camera.equidistant(640, 360, 300.0))
    numpy_fields = type(fields)(np.int64(640), np.int64(360), fields.distortion_model, np.array(fields.k, np.float32),
                                np.array(fields.d), np.array(fields.r, int), np.array(fields.p))
    assert list(validated(camera_info_message(numpy_fields, STAMP, 'cam')).r) == fields.r


def test_ground_transform_is_the_pose_of_the_camera_in_the_ground_frame():
    message = validated(transform_message(GroundPlane(ROTATION, 8.0)))
    assert (message.header.frame_id, message.child_frame_id) == ('cam_ground', 'cam')
    t, q = message.transform.translation, message.transform.rotation
    assert (t.x, t.y, t.z) == (0.0, 0.0, 8.0)
    # The optical axis (z) is the ground's x: the field's usual quaternion of an optical frame.
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], [-0.5, 0.5, -0.5, 0.5], atol=1e-12)


def test_header_is_a_copy():
    given_header = Header(stamp=STAMP, frame_id='cam')
    made = header(given_header.stamp, given_header.frame_id)
    made.stamp.sec, made.frame_id = 1, 'other'
    assert (given_header.stamp.sec, given_header.frame_id) == (1_700_000_000, 'cam')


def test_stamp_keeps_every_nanosecond():
    assert stamp_ns(time_message(1_700_000_000_123_456_789)) == 1_700_000_000_123_456_789


@pytest.mark.parametrize(('field', 'value', 'told'), [
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
])
def test_broken_camera_info_is_refused_by_name(field, value, told):
    with pytest.raises(InvalidMessage, match=told.replace('.', r'\.')):
        validated(unchecked(info_message(), field, value))


@pytest.mark.parametrize('frame', ['', '/cam'])
def test_camera_info_with_a_frame_that_tf2_rejects_is_refused(frame):
    message = info_message()
    message.header.frame_id = frame
    with pytest.raises(InvalidMessage, match=r'header\.frame_id'):
        validated(message)


@pytest.mark.parametrize(('field', 'value', 'told'), [
    ('x', 1, 'rotation.x is a int, not a float'),
    ('x', np.float32(1), 'rotation.x is a float32, not a float'),
    ('w', 2.0, 'rotation has the length'),
])
def test_broken_rotation_is_refused(field, value, told):
    message = transform_message(GroundPlane(ROTATION, 8.0))
    unchecked(message.transform.rotation, field, value)
    with pytest.raises(InvalidMessage, match=told):
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
