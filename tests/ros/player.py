"""Play the images of a recording over DDS, as a camera would: BAG TOPIC INTERVAL_S; prints how many it sent."""

import sys
import time
from pathlib import Path

import rclpy
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import Image

PATIENCE_S = 30.0


def wait_for_subscriber(publisher: Publisher) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not publisher.get_subscription_count():
        if time.monotonic() > deadline:
            raise TimeoutError(f'nobody subscribes to {publisher.topic_name}')
        time.sleep(0.05)


def play(bag: Path, topic: str, interval_s: float) -> int:
    """Send the messages of the recording unchanged, each after the previous one has arrived."""
    rclpy.init()
    node = rclpy.create_node('player')
    publisher = node.create_publisher(Image, topic, QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE))
    wait_for_subscriber(publisher)
    sent, due = 0, time.monotonic()
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        images = [connection for connection in reader.connections if connection.topic == topic]
        for _, _, raw in reader.messages(images):
            publisher.publish(bytes(raw))
            publisher.wait_for_all_acked(Duration(seconds=PATIENCE_S))
            sent, due = sent + 1, max(due + interval_s, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
    node.destroy_node()
    rclpy.shutdown()
    return sent


if __name__ == '__main__':
    print(play(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3])))
