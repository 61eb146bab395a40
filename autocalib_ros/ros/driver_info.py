"""The driver's own CameraInfo on `camera_info_in`, with `use_driver_camera_info`."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo

from autocalib_ros.config import NodeOptions
from autocalib_ros.lens.camera_info import check_readout
from autocalib_ros.ros.messages import readout

DRIVER_INFO_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort connects to every publisher; messages this small are not lost."""


class DriverInfo:
    """Subscribes to `camera_info_in` if `use_driver_camera_info` is set."""

    def __init__(self, node: Node, options: NodeOptions) -> None:
        self.newest: CameraInfo | None = None
        """Newest message; None before the first, and always without `use_driver_camera_info`."""
        self.topic = node.resolve_topic_name('camera_info_in') if options.use_driver_camera_info else ''
        if self.topic:
            node.create_subscription(CameraInfo, self.topic, self._take, DRIVER_INFO_QOS)

    def _take(self, message: CameraInfo) -> None:
        self.newest = message

    def check(self, image_size: tuple[int, int] | None) -> str:
        """Return what is wrong with the driver's message; '' if nothing is, or none is used."""
        if not self.topic:
            return ''
        if self.newest is None:
            return f'no CameraInfo on {self.topic}: remap camera_info_in, or set use_driver_camera_info:=false'
        return check_size(self.newest, image_size) if image_size else ''


def check_size(info: CameraInfo, image_size: tuple[int, int]) -> str:
    """Return why images of a size (width, height) do not fit the driver's size, binning and roi; '' if they do.

    A driver that gives no size passes.
    """
    has_size = (info.roi.width or info.width) and (info.roi.height or info.height)
    mismatch = check_readout(readout(info), image_size) if has_size else ''
    return f'{mismatch}: is camera_info_in from this camera?' if mismatch else ''
