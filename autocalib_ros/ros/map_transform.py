"""The place of the ground frame in a map, from control points: on `~/map_transform` and, if possible, /tf_static."""

from __future__ import annotations

import math

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.node import Node

from autocalib_ros.errors import AutocalibError, UsageError
from autocalib_ros.ground import Ground
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.control_points import ControlPoints, MapPlacement, place_in_map
from autocalib_ros.ros.messages import header, validated
from autocalib_ros.ros.qos import LATCHED, latched_publisher
from autocalib_ros.ros.transforms import TFMessage


class MapTransformPublisher:
    """Places each new calibration in the map."""

    def __init__(self, node: Node, *, map_frame: str, tf_parent: str, publish_tf: bool) -> None:
        self._node, self._map_frame = node, map_frame
        self._publisher = latched_publisher(node, TransformStamped, '~/map_transform')
        # a frame with two parents breaks the tree of tf: below the camera, the ground has one already
        broadcasts = publish_tf and TFMessage is not None and tf_parent == 'ground'
        self._tf_static = node.create_publisher(TFMessage, '/tf_static', LATCHED) if broadcasts else None

    def publish(self, result: Calibration, points: ControlPoints | None, stamp: Time, ground_frame: str) -> None:
        """Publish where the ground of a calibration lies, from control points where they are in its view.

        A fault of the points is logged, and nothing published; likewise without points, after a move of the camera that
        was not measured.
        """
        try:
            if points is None:
                raise UsageError(
                    'the control points are pixels of the view before the camera moved: measure their pixels anew and '
                    'restart the node'
                )
            placement = place_in_map(Ground.of(result).points(points.pixels).points_m[:, :2], points)
        except AutocalibError as error:
            self._node.get_logger().error(f'not placed in the map: {error}')
            self._broadcast()
            return
        message = validated(map_transform_message(placement, stamp, self._map_frame, ground_frame))
        self._publisher.publish(message)
        self._broadcast(message)
        apart = placement.left_out_m
        checked = f'; control points that are left out are at most {max(apart):.2f} m off' if apart else ''
        self._node.get_logger().info(
            f'placed in the map ({placement.crs}) with a scale of {placement.scale:.4f}{checked}'
        )

    def forget(self) -> None:
        """Remove the latched transform by renewing its publisher. Call this in the executor's thread."""
        self._broadcast()
        self._node.destroy_publisher(self._publisher)
        self._publisher = latched_publisher(self._node, TransformStamped, '~/map_transform')

    def _broadcast(self, *transforms: TransformStamped) -> None:
        """Latch a transform on /tf_static, or none."""
        if self._tf_static is not None:
            self._tf_static.publish(validated(TFMessage(transforms=list(transforms))))


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
