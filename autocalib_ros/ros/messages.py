"""Results as ROS messages, and the validation of every outgoing message.

rclpy does not check fields by default: an int in a float64 field is published as 5e-324, a short list reads beyond its
memory. So every value is converted here, and `validated` checks each message before it is published.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import Any, TypeVar

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from sensor_msgs.msg import CameraInfo, RegionOfInterest
from std_msgs.msg import Header

from autocalib_ros.errors import AutocalibError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera_info import EXACT_MODELS, Readout, to_full_resolution
from autocalib_ros.lens.camera_info import CameraInfo as CameraInfoFields

COEFFICIENT_COUNT = {'plumb_bob': 5, 'rational_polynomial': 8, **dict.fromkeys(EXACT_MODELS, 4)}
"""Length of D for each distortion model known to consumers (sensor_msgs/distortion_models.hpp; Foxglove)."""
INTEGER_BITS = {'int8': 8, 'uint8': 8, 'int16': 16, 'uint16': 16, 'int32': 32, 'uint32': 32, 'int64': 64, 'uint64': 64}
TF2_QUATERNION_TOLERANCE = 1e-6
"""tf2 rejects quaternions whose length differs from 1 by more than this."""
Message = TypeVar('Message')


class InvalidMessage(AutocalibError):
    """A message that must not be published."""


def time_message(stamp_ns: int) -> Time:
    """Return a stamp in nanoseconds as a message."""
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def stamp_ns(time: Time) -> int:
    """Return a message's stamp in nanoseconds."""
    return time.sec * 1_000_000_000 + time.nanosec


def header(stamp: Time, frame_id: str) -> Header:
    """Return a new header: an incoming one is shared and must not change."""
    return Header(stamp=Time(sec=stamp.sec, nanosec=stamp.nanosec), frame_id=frame_id)


def camera_info_message(
    fields: CameraInfoFields, stamp: Time, frame_id: str, driver: CameraInfo | None = None
) -> CameraInfo:
    """Return the CameraInfo of an image with that stamp and frame.

    With the driver's message, its binning and region of interest are copied, and all other fields are in full
    resolution (REP-104); InputError if they do not fit the images.
    """
    operation: dict[str, Any] = {}
    if driver is not None:
        fields = to_full_resolution(fields, readout(driver))
        roi = driver.roi
        operation = {
            'binning_x': driver.binning_x,
            'binning_y': driver.binning_y,
            'roi': RegionOfInterest(
                x_offset=roi.x_offset,
                y_offset=roi.y_offset,
                height=roi.height,
                width=roi.width,
                do_rectify=roi.do_rectify,
            ),
        }
    return CameraInfo(
        header=header(stamp, frame_id),
        width=int(fields.width),
        height=int(fields.height),
        distortion_model=str(fields.distortion_model),
        d=[float(value) for value in fields.d],
        k=[float(value) for value in fields.k],
        r=[float(value) for value in fields.r],
        p=[float(value) for value in fields.p],
        **operation,
    )


def uncalibrated_message(fields: CameraInfoFields, stamp: Time, frame_id: str) -> CameraInfo:
    """Return the CameraInfo of an image whose camera is not calibrated now: K is zero, as ROS has it."""
    return CameraInfo(header=header(stamp, frame_id), width=int(fields.width), height=int(fields.height))


def is_uncalibrated(info: CameraInfo) -> bool:
    """Whether a CameraInfo says that its camera is not calibrated, in all its fields."""
    return not (any(info.k) or any(info.p) or len(info.d))


def readout(driver: CameraInfo) -> Readout:
    """Return size, binning and region of interest of a driver's CameraInfo."""
    return Readout(
        driver.width,
        driver.height,
        (driver.binning_x, driver.binning_y),
        (driver.roi.x_offset, driver.roi.y_offset),
        (driver.roi.width, driver.roi.height),
    )


def ground_transform_message(
    ground: GroundPlane, stamp: Time, ground_frame: str, camera_frame: str, tf_parent: str = 'ground'
) -> TransformStamped:
    """Return the transform between camera and ground: it takes points from the child to the parent frame."""
    pose = ground.transform(ground_frame, camera_frame, tf_parent)
    x, y, z = (float(value) for value in pose.translation_m)
    qx, qy, qz, qw = (float(value) for value in pose.rotation_xyzw)
    return TransformStamped(
        header=header(stamp, pose.parent),
        child_frame_id=pose.child,
        transform=Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw)),
    )


def validated(message: Message) -> Message:
    """Return the message unchanged; raise InvalidMessage with the name of an invalid field."""
    name = type(message).__name__
    _check_fields(message, name)
    check = SEMANTIC_CHECKS.get(name)
    if check is not None:
        check(message)
    return message


def _check_fields(message: Any, path: str) -> None:
    for name, kind in message.get_fields_and_field_types().items():
        _check_value(getattr(message, name), kind, f'{path}.{name}')


def _check_value(value: Any, kind: str, path: str) -> None:
    if kind == 'sequence<uint8>' and isinstance(value, array) and value.typecode == 'B':
        return  # can hold nothing else, and may be long
    if kind.startswith('sequence<'):
        for item in _listed(value, path):
            _check_value(item, kind[len('sequence<') : -1].partition(',')[0], path)
    elif kind.endswith(']'):
        element, _, length = kind[:-1].partition('[')
        items = _listed(value, path)
        _require(len(items) == int(length), path, f'holds {len(items)} numbers, not {length}')
        for item in items:
            _check_value(item, element, path)
    elif '/' in kind:
        _check_fields(value, path)
    else:
        _check_scalar(value, kind, path)


def _check_scalar(value: Any, kind: str, path: str) -> None:
    if kind in ('double', 'float'):
        _require(type(value) is float, path, f'is a {type(value).__name__}, not a float')
        _require(math.isfinite(value), path, f'is {value}')
    elif kind in INTEGER_BITS:
        _require(type(value) is int, path, f'is a {type(value).__name__}, not an int')
        bits, unsigned = INTEGER_BITS[kind], kind.startswith('u')
        low, high = (0, 2**bits) if unsigned else (-(2 ** (bits - 1)), 2 ** (bits - 1))
        _require(low <= value < high, path, f'is {value}, which is not a {kind}')
    elif kind == 'boolean':
        _require(type(value) is bool, path, f'is a {type(value).__name__}, not a bool')
    elif kind == 'octet':
        _require(type(value) is bytes and len(value) == 1, path, f'is {value!r}, not one byte')
    elif kind.startswith('string'):
        _require(type(value) is str, path, f'is a {type(value).__name__}, not a string')


def _listed(value: Any, path: str) -> list[Any]:
    """Return a list, array or one-dimensional numpy array as a list of Python numbers."""
    _require(getattr(value, 'ndim', 1) == 1, path, 'has more than one dimension')
    return value.tolist() if hasattr(value, 'tolist') else list(value)


def _check_camera_info(info: CameraInfo) -> None:
    path = 'CameraInfo'
    _check_frame(info.header.frame_id, f'{path}.header.frame_id')
    _require(info.width > 0 and info.height > 0, path, f'has the size {info.width}x{info.height}')
    if is_uncalibrated(info):
        return
    length = COEFFICIENT_COUNT.get(info.distortion_model)
    _require(length is not None, f'{path}.distortion_model', f'is {info.distortion_model!r}')
    _require(len(info.d) == length, f'{path}.d', f'holds {len(info.d)} numbers, not {length}')
    # image_proc does not rectify at all if D is all zero, whatever the model
    _require(info.distortion_model not in EXACT_MODELS or any(info.d), f'{path}.d', 'is all zero')
    for field, matrix, columns in (('k', info.k, 3), ('p', info.p, 4)):
        _require(matrix[0] > 0 and matrix[columns + 1] > 0, f'{path}.{field}', 'has no positive focal length')
    roi = info.roi
    _require(
        roi.x_offset + roi.width <= info.width and roi.y_offset + roi.height <= info.height,
        f'{path}.roi',
        f'reaches beyond the {info.width}x{info.height} pixels of the sensor',
    )


def _check_transform(stamped: TransformStamped) -> None:
    path = 'TransformStamped'
    _check_frame(stamped.header.frame_id, f'{path}.header.frame_id')
    _check_frame(stamped.child_frame_id, f'{path}.child_frame_id')
    _require(stamped.header.frame_id != stamped.child_frame_id, path, 'joins a frame with itself')
    q = stamped.transform.rotation
    norm = math.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2)
    _require(abs(norm - 1) < TF2_QUATERNION_TOLERANCE, f'{path}.transform.rotation', f'has the length {norm}')


def _check_transforms(message: Any) -> None:
    for stamped in message.transforms:
        _check_transform(stamped)
    children = [stamped.child_frame_id for stamped in message.transforms]
    _require(len(set(children)) == len(children), 'TFMessage.transforms', 'give a frame two parents')


def _check_frame(frame_id: str, path: str) -> None:
    _require(bool(frame_id) and not frame_id.startswith('/'), path, f'is {frame_id!r}')


def _require(holds: bool, path: str, what: str) -> None:
    if not holds:
        raise InvalidMessage(f'{path} {what}')


SEMANTIC_CHECKS: dict[str, Callable[[Any], None]] = {
    'CameraInfo': _check_camera_info,
    'TransformStamped': _check_transform,
    'TFMessage': _check_transforms,
}
"""Checks of message types beyond the types of their fields."""
