"""The ground transform on its own topic and on /tf_static, unless somebody else has a say about these frames.

tf2 takes a tree: a frame with two parents, or a loop, breaks it for everybody. So what others publish on /tf and
/tf_static is looked at before and after our own transform is broadcast. tf2_msgs may be missing (no wheel of it
exists); tf2_ros is not used: its Python broadcaster has dropped a second transform with the same child, which is what a
new calibration is.
"""

from __future__ import annotations

import threading
from collections.abc import Set
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from autocalib_ros.ros.messages import validated
from autocalib_ros.ros.qos import LATCHED, latched_publisher

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

LISTEN_S = 2.0
"""Real seconds of listening before the first broadcast: a transform that tf2 has taken in cannot be taken back."""
TF_QUEUE = 100
"""Messages of /tf and /tf_static that may wait: each static publisher latches one."""
TF_STATIC_QOS = QoSProfile(
    depth=TF_QUEUE, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
TF_QOS = QoSProfile(depth=TF_QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort connects to every publisher of /tf, and what is lost there comes again."""
TF2_MISSING = (
    'tf2_msgs is not there: the ground transform is published on {} but not on /tf_static '
    '(apt install ros-jazzy-tf2-msgs, or see the README for ROS from pip; publish_tf:=false hides this line)'
)


class GroundTransformPublisher:
    """Publishes `~/ground_transform`, and the same on /tf_static where that leaves tf a tree; safe in any thread."""

    def __init__(self, node: Node, *, tf_parent: str, publish_tf: bool) -> None:
        self._node, self._tf_parent = node, tf_parent
        self._ground_transform = latched_publisher(node, TransformStamped, '~/ground_transform')
        self._lock = threading.Lock()
        self._may_broadcast = publish_tf and TFMessage is not None
        self._listened = self._broadcasting = False
        self._edge: tuple[str, str] | None = None
        self._latest: TransformStamped | None = None
        self._ours: set[tuple[str, str]] = set()
        self._foreign: set[tuple[str, str]] = set()
        self.conflict = ''
        """Why nothing is broadcast, '' where nothing stands in the way."""
        if self._may_broadcast:
            self._tf_static = node.create_publisher(TFMessage, '/tf_static', LATCHED)
            node.create_subscription(TFMessage, '/tf_static', self._on_tf, TF_STATIC_QOS)
            node.create_subscription(TFMessage, '/tf', self._on_moving_tf, TF_QOS, raw=True)
            self._timer = node.create_timer(
                LISTEN_S, self._end_listening, clock=Clock(clock_type=ClockType.STEADY_TIME)
            )
        elif publish_tf:
            node.get_logger().warning(TF2_MISSING.format(self._ground_transform.topic_name))

    def announce_frames(self, ground_frame: str, camera_frame: str) -> None:
        """Name the frames of a transform that is to come, so that a conflict is told now and not after an hour."""
        with self._lock:
            below = self._tf_parent == 'ground'
            self._set_edge(*((ground_frame, camera_frame) if below else (camera_frame, ground_frame)))

    def publish(self, message: TransformStamped) -> None:
        """Publish the transform between camera and ground in place of the one before."""
        with self._lock:
            self._ground_transform.publish(validated(message))
            self._latest = message
            self._set_edge(message.header.frame_id, message.child_frame_id)
            self._broadcast()

    def forget(self) -> None:
        """Leave nothing for those who come late; who has the transform keeps it. In the executor's thread.

        A latched message goes with its publisher.
        """
        with self._lock:
            self._latest = None
            self._clear()
            self._node.destroy_publisher(self._ground_transform)
            self._ground_transform = latched_publisher(self._node, TransformStamped, '~/ground_transform')

    def _end_listening(self) -> None:
        self._timer.cancel()
        with self._lock:
            self._listened = True
            self._broadcast()

    def _on_moving_tf(self, serialized: bytes) -> None:
        """Read only what names one of our frames: a robot's whole tree at 100 Hz would cost a tenth of a core."""
        edge = self._edge
        if edge is None or any(frame.encode() in serialized for frame in edge):
            self._on_tf(deserialize_message(serialized, TFMessage))

    def _on_tf(self, message: Any) -> None:
        """Note who hangs where; our own transforms come back too."""
        edges = {
            (transform.header.frame_id.lstrip('/'), transform.child_frame_id.lstrip('/'))
            for transform in message.transforms
        }
        with self._lock:
            new = edges - self._ours - self._foreign
            if new:
                self._foreign |= new
                self._check_conflict()

    def _set_edge(self, parent: str, child: str) -> None:
        if self._edge != (parent, child):
            self._edge = parent, child
            self._check_conflict()

    def _check_conflict(self) -> None:
        """Look for a conflict; once there is one, take back what can be."""
        if not self._may_broadcast or self._edge is None:
            return
        before, self.conflict = self.conflict, conflict(*self._edge, self._foreign, tf_parent=self._tf_parent)
        if self.conflict and self.conflict != before:
            self._node.get_logger().error(self.conflict)
        if self.conflict:
            self._clear()

    def _broadcast(self) -> None:
        if self._may_broadcast and self._listened and self._latest is not None and not self.conflict:
            self._ours.add(self._edge)
            self._tf_static.publish(validated(TFMessage(transforms=[self._latest])))
            self._broadcasting = True

    def _clear(self) -> None:
        if self._broadcasting:
            self._tf_static.publish(validated(TFMessage()))
            self._broadcasting = False


def conflict(parent: str, child: str, foreign: Set[tuple[str, str]], *, tf_parent: str) -> str:
    """Say why a transform would break the tree that others publish, and which parameter to set; '' if it would not.

    `foreign` holds the parent and child of each of their transforms. The same two frames as ours are no conflict: a
    recording that is played back, or this node before it was started anew, says the same.
    """
    others = sorted(above for above, below in foreign if below == child and above != parent)
    own_name = 'set ground_frame to a name of its own'
    if others:
        remedy = (
            f"set tf_parent to 'camera', so that the ground hangs from '{child}'"
            if tf_parent == 'ground'
            else f"{own_name}, or tf_parent to 'ground'"
        )
        broken = f"publishes '{others[0]}' as the parent of '{child}', and a second parent would break tf"
    elif child in _ancestors(parent, foreign):
        remedy, broken = own_name, f"hangs '{parent}' from '{child}', and the way back would be a loop in tf"
    else:
        return ''
    return f'/tf_static is left alone: somebody else {broken}; {remedy}, and start the node again'


def _ancestors(frame: str, edges: Set[tuple[str, str]]) -> set[str]:
    """Return all frames that a frame hangs from."""
    found: set[str] = set()
    waiting = {frame}
    while waiting:
        waiting = {above for above, below in edges if below in waiting} - found
        found |= waiting
    return found
