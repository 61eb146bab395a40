"""What the driver says of its camera: the newest CameraInfo on `camera_info_in`, where that is wanted."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo

from autocalib_ros.config import NodeOptions
from autocalib_ros.lens.camera_info import check_readout
from autocalib_ros.ros.messages import readout

DRIVER_INFO_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""It hears every publisher, whatever that offers; messages this small are not lost."""


class DriverInfo:
    """Subscribes `camera_info_in` when `use_driver_camera_info` is set."""

    def __init__(self, node: Node, options: NodeOptions) -> None:
        self.newest: CameraInfo | None = None
        """The newest message; None before the first, and always where it is not wanted."""
        self.topic = node.resolve_topic_name('camera_info_in') if options.use_driver_camera_info else ''
        if self.topic:
            node.create_subscription(CameraInfo, self.topic, self._take, DRIVER_INFO_QOS)

    def _take(self, message: CameraInfo) -> None:
        self.newest = message

    def check(self, image_size: tuple[int, int] | None) -> str:
        """Say what is wrong with the driver's message, '' where nothing is or none is wanted."""
        if not self.topic:
            return ''
        if self.newest is None:
            return f'no CameraInfo comes on {self.topic}: remap camera_info_in, or set use_driver_camera_info:=false'
        return check_size(self.newest, image_size) if image_size else ''


def check_size(info: CameraInfo, image_size: tuple[int, int]) -> str:
    """Say why images of a size (width, height) are not what the driver's binning and roi leave of its own.

    A driver that tells no size is not doubted.
    """
    told = (info.roi.width or info.width) and (info.roi.height or info.height)
    check = check_readout(readout(info), image_size) if told else ''
    return f'{check}: is camera_info_in of this camera?' if check else ''
