"""A neighbour on /tf in a process of its own, until its standard input is closed.

neighbour.py listen                     prints a line of JSON for each message of /tf_static and ~/ground_transform
neighbour.py hang CHILD PARENT TOPIC    publishes a transform that hangs CHILD from PARENT
"""

import contextlib
import json
import sys
import threading

import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
REPEAT_S = 0.1


def described(stamped: TransformStamped) -> list:
    t, q = stamped.transform.translation, stamped.transform.rotation
    return [stamped.header.frame_id, stamped.child_frame_id, [t.x, t.y, t.z], [q.x, q.y, q.z, q.w]]


def listen(node: Node) -> None:
    def tell(topic: str, transforms: list[TransformStamped]) -> None:
        print(json.dumps([topic, [described(stamped) for stamped in transforms]]), flush=True)

    node.create_subscription(TFMessage, '/tf_static', lambda message: tell('/tf_static', message.transforms), LATCHED)
    node.create_subscription(
        TransformStamped, '/autocalib/ground_transform', lambda message: tell('ground_transform', [message]), LATCHED
    )


def hang(node: Node, child: str, parent: str, topic: str) -> None:
    stamped = TransformStamped(child_frame_id=child)
    stamped.header.frame_id = parent
    message = TFMessage(transforms=[stamped])
    publisher = node.create_publisher(TFMessage, topic, LATCHED if topic == '/tf_static' else 10)
    publisher.publish(message)
    if topic == '/tf':
        node.create_timer(REPEAT_S, lambda: publisher.publish(message))


def main() -> None:
    rclpy.init()
    node = rclpy.create_node('neighbour')
    {'listen': listen, 'hang': hang}[sys.argv[1]](node, *sys.argv[2:])
    threading.Thread(target=lambda: (sys.stdin.read(), rclpy.try_shutdown()), daemon=True).start()
    with contextlib.suppress(rclpy.executors.ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
