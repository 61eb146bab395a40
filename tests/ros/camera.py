"""A camera in a process of its own, for tests: plays phases of images, the next one at each line it is sent.

camera.py TOPIC '[{"reliable": true, "compressed": false, "width": 320, "height": 240}, ...]'
"""

import json
import select
import sys
import time
from array import array

import cv2
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image

INTERVAL_S = 0.05


def picture_message(picture: np.ndarray, compressed: bool) -> Image | CompressedImage:
    if compressed:
        return CompressedImage(format='jpeg', data=cv2.imencode('.jpg', picture)[1].tobytes())
    height, width = picture.shape
    message = Image(width=width, height=height, step=width, encoding='mono8')
    message.data.frombytes(picture.tobytes())
    return message


def play(node: Node, topic: str, phase: dict) -> None:
    """Publish images until a line comes."""
    reliability = ReliabilityPolicy.RELIABLE if phase.get('reliable', True) else ReliabilityPolicy.BEST_EFFORT
    compressed = phase.get('compressed', False)
    publisher = node.create_publisher(
        CompressedImage if compressed else Image, topic, QoSProfile(depth=5, reliability=reliability)
    )
    size = (phase.get('height', 240), phase.get('width', 320))
    message = picture_message(np.random.default_rng(0).integers(0, 255, size, dtype=np.uint8), compressed)
    message.header.frame_id = 'optical'
    while not select.select([sys.stdin], [], [], 0)[0]:
        message.header.stamp = node.get_clock().now().to_msg()
        if not compressed:  # no two images of a sensor are the same
            message.data[:8] = array('B', time.time_ns().to_bytes(8, 'little'))
        publisher.publish(message)
        time.sleep(phase.get('interval_s', INTERVAL_S))
    sys.stdin.readline()
    node.destroy_publisher(publisher)


if __name__ == '__main__':
    rclpy.init()
    camera = rclpy.create_node('camera')
    for part in json.loads(sys.argv[2]):
        play(camera, sys.argv[1], part)
    camera.destroy_node()
    rclpy.shutdown()
