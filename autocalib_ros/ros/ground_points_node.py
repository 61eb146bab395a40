"""The executable `ground_points_node`: pixels in, points on the road out. An example to copy.

    ground_points_node --ros-args -r __ns:=/cam1/autocalib -r pixels:=/cam1/wheels

`pixels` is a geometry_msgs/PolygonStamped, which any detector can publish without further packages: x and y of each
point are a pixel, z is its height above the road in metres, 0 at a contact point of a vehicle. Stamp and frame are
those of the image. `ground_points` is a PointCloud2 in the ground frame with the stamp of the image: the same number
of points in the same order, nan where a pixel does not show the ground.
"""

from __future__ import annotations

import sys
from array import array
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PolygonStamped, TransformStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField
from std_msgs.msg import Header

from autocalib_ros.errors import InputError
from autocalib_ros.ground import Ground
from autocalib_ros.ros.log_throttle import LogThrottle
from autocalib_ros.ros.messages import header, validated
from autocalib_ros.ros.qos import LATCHED
from autocalib_ros.ros.spinning import spin_until, stop_on_signals


class GroundPointsNode(Node):
    """Node `ground_points`: keeps the newest calibration and converts each message of pixels to points."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__('ground_points', **node_arguments)
        self.declare_parameter('camera_frame', '')  # only if autocalib has this option set
        self._throttle = LogThrottle()
        self._info: CameraInfo | None = None
        self._transform: TransformStamped | None = None
        self._points = self.create_publisher(PointCloud2, 'ground_points', 10)
        self.create_subscription(CameraInfo, 'camera_info', self._on_info, LATCHED)
        self.create_subscription(TransformStamped, 'ground_transform', self._on_transform, LATCHED)
        # best effort connects to publishers of either kind, and messages this small are not lost
        self.create_subscription(PolygonStamped, 'pixels', self._on_pixels, qos_profile_sensor_data)

    def _on_info(self, info: CameraInfo) -> None:
        self._info = info

    def _on_transform(self, transform: TransformStamped) -> None:
        self._transform = transform

    def _on_pixels(self, message: PolygonStamped) -> None:
        if self._info is None or self._transform is None:
            missing = 'camera_info' if self._info is None else 'ground_transform'
            self._warn(f'pixels skipped: no {missing} yet on {self.resolve_topic_name(missing)}')
            return
        try:
            # The calibration can change at any time; building from it is faster than checking whether it has.
            ground = Ground.from_messages(
                self._info, self._transform, camera_frame=self.get_parameter('camera_frame').value
            )
            if message.header.frame_id != self._info.header.frame_id:
                raise InputError(
                    f"their frame is '{message.header.frame_id}', that of the calibration "
                    f"'{self._info.header.frame_id}': publish them with the header of the image"
                )
        except InputError as error:
            self._warn(f'pixels skipped: {error}')
            return
        given = np.array([(point.x, point.y, point.z) for point in message.polygon.points]).reshape(-1, 3)
        found = ground.points(given[:, :2], height_m=given[:, 2])
        self._points.publish(validated(cloud(found.points_m, header(message.header.stamp, ground.ground_frame))))

    def _warn(self, text: str) -> None:
        if self._throttle.is_due('pixels', text):
            self.get_logger().warning(text)


def cloud(points_m: np.ndarray, cloud_header: Header) -> PointCloud2:
    """Return points (n, 3) as a PointCloud2 of x, y, z in single precision."""
    values = points_m.astype('<f4')
    fields = [
        PointField(name=name, offset=4 * place, datatype=PointField.FLOAT32, count=1)
        for place, name in enumerate('xyz')
    ]
    return PointCloud2(
        header=cloud_header,
        height=1,
        width=len(values),
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(values),
        data=array('B', values.tobytes()),
        is_dense=bool(np.isfinite(values).all()),
    )


def main(args: list[str] | None = None) -> int:
    """Run the node until it is interrupted; print its description for --help."""
    if {'-h', '--help'} & set((sys.argv if args is None else args)[1:]):
        print(__doc__)
        return 0
    stop = stop_on_signals()
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = GroundPointsNode()
        try:
            spin_until(node, stop)
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
