"""Write a rosbag2 recording with the images, their CameraInfo and the ground transform."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from autocalib_ros.config import Polygons
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.offline.recordings.sources import Source, StoredImage, camera_name, image_topic
from autocalib_ros.perception.masked_messages import mask_message, require_maskable
from autocalib_ros.results.calibration import Calibration

LOG = logging.getLogger(__name__)

BAG_VERSION: Final = 9
"""Version of rosbag2 metadata, as written by ROS 2 Jazzy."""
DEFAULT_FRAME = 'camera_optical_frame'
GROUND_TOPIC = '/autocalib/ground_transform'
INFINITE_DURATION = QosTime(2147483647, 4294967295)
LATCHED_QOS = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    INFINITE_DURATION,
    INFINITE_DURATION,
    QosLiveliness.AUTOMATIC,
    INFINITE_DURATION,
    False,
)


def write_bag(
    path: Path, result: Calibration, source: Source, tf_parent: str = 'ground', ignored: Polygons = ()
) -> None:
    """Write a new bag: the images, a CameraInfo with the header of each image, and the ground transform if known.

    CameraInfo is written to the sibling of the image topic. All topics except the images are latched: nodes that start
    late during playback receive them. The `ignored` polygons are blacked out. Raise UsageError, without leaving a bag,
    if `path` exists or the image encoding cannot be blacked out; InputError if the bag cannot be written.
    """
    if path.exists():
        raise UsageError(f'{path} exists already and is not overwritten')
    try:
        with Writer(path, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
            _BagWriter(writer, result, source, tf_parent, ignored).write()
    except BaseException as error:
        shutil.rmtree(path, ignore_errors=True)  # an incomplete bag is worse than none
        if isinstance(error, OSError):
            raise InputError(f'cannot write {path}: {error.strerror or error}') from error
        raise


def camera_info_topic(source: Source) -> str:
    """Return the camera_info topic next to the image topic, following image_transport."""
    parts = image_topic(source).split('/')[:-1]
    return '/'.join([*parts, 'camera_info']) if source.topic else '/camera/camera_info'


class _BagWriter:
    """Connections and messages of a new bag."""

    def __init__(self, writer: Writer, result: Calibration, source: Source, tf_parent: str, ignored: Polygons) -> None:
        self._ignored, self._broken = ignored, 0
        self._writer, self._result, self._source, self._tf_parent = writer, result, source, tf_parent
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._ground_frame = f'{camera_name(source)}_ground'

    def write(self) -> None:
        """Write all messages in the order of the recording."""
        info = self._connect(camera_info_topic(self._source), 'sensor_msgs/msg/CameraInfo')
        images = self._connect(self._source.topic, self._source.image_type, ()) if self._source.topic else None
        for index, stored in enumerate(self._source.stored()):
            if index == 0 and self._result.ground is not None:
                self._write_ground(self._result.ground, stored)
            self._write_message(info, stored.recorded_ns, self._camera_info(stored))
            if images is not None and (cdr := self._image(stored.cdr)) is not None:
                self._writer.write(images, stored.recorded_ns, cdr)
        if self._broken:
            LOG.warning(
                '%d images cannot be decoded to black out ignore_regions and are left out of the bag',
                self._broken,
            )

    def _image(self, cdr: bytes | memoryview | None) -> bytes | memoryview | None:
        """Return an image with its ignored regions blacked out; None if it cannot be decoded, or in a video."""
        if cdr is None or not self._ignored:
            return cdr
        kind = self._source.image_type
        message: Any = self._store.deserialize_cdr(cdr, kind)
        require_maskable(message)
        try:
            black = mask_message(message, self._ignored)
        except InputError:
            self._broken += 1
            return None
        return self._store.serialize_cdr(replace(message, data=black), kind)

    def _write_ground(self, ground: GroundPlane, first: StoredImage) -> None:
        transform = self._transform(ground, first.frame_id.lstrip('/') or DEFAULT_FRAME)
        together = self._make('tf2_msgs/msg/TFMessage', transforms=[transform])
        for topic, message in ((GROUND_TOPIC, transform), ('/tf_static', together)):
            self._write_message(self._connect(topic, message.__msgtype__), first.recorded_ns, message)

    def _camera_info(self, stored: StoredImage) -> Any:
        info = self._result.camera_info
        region = self._make(
            'sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        lists = {name: np.array(getattr(info, name), float) for name in 'dkrp'}
        return self._make(
            'sensor_msgs/msg/CameraInfo',
            header=self._header(stored.stamp_ns, stored.frame_id),
            height=info.height,
            width=info.width,
            distortion_model=info.distortion_model,
            **lists,
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    def _transform(self, ground: GroundPlane, camera_frame: str) -> Any:
        """Return the transform between ground and camera, the same as the live node publishes."""
        pose = ground.transform(self._ground_frame, camera_frame, self._tf_parent)
        vector = self._make('geometry_msgs/msg/Vector3', **dict(zip('xyz', _floats(pose.translation_m), strict=True)))
        quaternion = self._make(
            'geometry_msgs/msg/Quaternion', **dict(zip('xyzw', _floats(pose.rotation_xyzw), strict=True))
        )
        return self._make(
            'geometry_msgs/msg/TransformStamped',
            header=self._header(self._result.newest_stamp_ns, pose.parent),
            child_frame_id=pose.child,
            transform=self._make('geometry_msgs/msg/Transform', translation=vector, rotation=quaternion),
        )

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        stamp = self._make('builtin_interfaces/msg/Time', sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return self._make('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)

    def _connect(self, topic: str, kind: str, qos: tuple[Qos, ...] = (LATCHED_QOS,)) -> Any:
        return self._writer.add_connection(topic, kind, typestore=self._store, offered_qos_profiles=qos)

    def _write_message(self, connection: Any, recorded_ns: int, message: Any) -> None:
        self._writer.write(connection, recorded_ns, self._store.serialize_cdr(message, message.__msgtype__))

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)


def _floats(values: np.ndarray) -> Iterator[float]:
    return (float(value) for value in values)
