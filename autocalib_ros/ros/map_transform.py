"""The place of the ground frame in a map, from control points: on `~/map_transform` and, if possible, /tf_static."""

from __future__ import annotations

import math
from pathlib import Path

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.node import Node

from autocalib_ros.errors import AutocalibError
from autocalib_ros.ground import Ground
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.control_points import MapPlacement, place_in_map, read_control_points
from autocalib_ros.ros.messages import header, validated
from autocalib_ros.ros.qos import LATCHED, latched_publisher
from autocalib_ros.ros.transforms import TFMessage


class MapTransformPublisher:
    """Places each new calibration in the map; InputError if the control points cannot be read."""

    def __init__(self, node: Node, control_points: str, *, map_frame: str, tf_parent: str, publish_tf: bool) -> None:
        self._node, self._map_frame = node, map_frame
        self._points = read_control_points(Path(control_points))
        self._publisher = latched_publisher(node, TransformStamped, '~/map_transform')
        # a frame with two parents breaks the tree of tf: below the camera, the ground has one already
        broadcasts = publish_tf and TFMessage is not None and tf_parent == 'ground'
        self._tf_static = node.create_publisher(TFMessage, '/tf_static', LATCHED) if broadcasts else None

    def publish(self, result: Calibration, stamp: Time, ground_frame: str) -> None:
        """Publish where the ground of a calibration lies; a fault of the points is logged, and nothing published."""
        try:
            placement = place_in_map(Ground.of(result).points(self._points.pixels).points_m[:, :2], self._points)
        except AutocalibError as error:
            self._node.get_logger().error(f'not placed in the map: {error}')
            return
        message = validated(map_transform_message(placement, stamp, self._map_frame, ground_frame))
        self._publisher.publish(message)
        if self._tf_static is not None:
            self._tf_static.publish(validated(TFMessage(transforms=[message])))
        apart = placement.left_out_m
        checked = f'; control points that are left out are at most {max(apart):.2f} m off' if apart else ''
        self._node.get_logger().info(
            f'placed in the map ({placement.crs}) with a scale of {placement.scale:.4f}{checked}'
        )


def map_transform_message(placement: MapPlacement, stamp: Time, map_frame: str, ground_frame: str) -> TransformStamped:
    """Return the transform that takes points of the ground frame to the map; the road is at z = 0 of both."""
    half = math.radians(placement.heading_deg) / 2
    east_m, north_m = placement.translation_m
    return TransformStamped(
        header=header(stamp, map_frame),
        child_frame_id=ground_frame,
        transform=Transform(
            translation=Vector3(x=east_m, y=north_m, z=0.0),
            rotation=Quaternion(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)),
        ),
    )
