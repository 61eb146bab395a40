"""A consumer on another host: prints a line of JSON for each latched message."""

import importlib.util
import json

import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def tell(what: str, value: float) -> None:
    print(json.dumps([what, value]), flush=True)


def main() -> None:
    rclpy.init()
    node = rclpy.create_node('consumer')
    node.create_subscription(CameraInfo, '/autocalib/camera_info', lambda info: tell('focal_px', info.k[0]), LATCHED)
    node.create_subscription(
        TransformStamped,
        '/autocalib/ground_transform',
        lambda pose: tell('height_m', pose.transform.translation.z),
        LATCHED,
    )
    if importlib.util.find_spec('tf2_msgs'):
        from tf2_msgs.msg import TFMessage

        node.create_subscription(
            TFMessage,
            '/tf_static',
            lambda tree: tell('tf_static_m', tree.transforms[0].transform.translation.z),
            LATCHED,
        )
    rclpy.spin(node)


if __name__ == '__main__':
    main()
