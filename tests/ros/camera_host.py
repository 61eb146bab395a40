"""The host of a camera: the node, and a camera that sends a few images; FOCAL_PX is what its solver finds."""

import sys
from functools import partial

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image

from autocalib_ros.ros.autocalib_node import AutocalibNode
from bench import calibration, image

IMAGES = 5
INTERVAL_S = 0.05


class Camera:
    """Sends images once there is a subscriber, then stops, so that the node solves the rest."""

    def __init__(self, node: rclpy.node.Node) -> None:
        self._publisher = node.create_publisher(Image, 'image', QoSProfile(depth=IMAGES))
        self._sent = 0
        node.create_timer(INTERVAL_S, self._send)

    def _send(self) -> None:
        if self._publisher.get_subscription_count() and self._sent < IMAGES:
            self._sent += 1
            self._publisher.publish(image(10**18 + self._sent * 10**8))


def solve(evidence, options, focal_px: float, lens=None):
    return calibration(evidence, focal_px)


def main(focal_px: float) -> None:
    rclpy.init()
    node = AutocalibNode(
        solve=partial(solve, focal_px=focal_px),
        parameter_overrides=[
            rclpy.parameter.Parameter('camera_height', value=8.0),
            rclpy.parameter.Parameter('idle_solve_s', value=0.2),
        ],
    )
    camera = rclpy.create_node('camera')
    Camera(camera)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.add_node(camera)
    executor.spin()


if __name__ == '__main__':
    main(float(sys.argv[1]))
