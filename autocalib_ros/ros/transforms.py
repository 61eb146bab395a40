"""The ground transform on its own topic and, unless other publishers own these frames, on /tf_static.

tf2 needs a tree: a frame with two parents, or a loop, breaks it for all consumers. So /tf and /tf_static are checked
for conflicts before and after the broadcast. tf2_msgs is optional (there is no wheel of it). tf2_ros is not used: its
Python broadcaster has dropped a second transform with the same child, which every new calibration is.
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

from autocalib_ros.ros.headers import MAX_FRAME_LENGTH
from autocalib_ros.ros.messages import validated
from autocalib_ros.ros.qos import LATCHED, latched_publisher

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

LISTEN_S = 2.0
"""Real seconds of listening before the first broadcast: tf2 consumers never drop a static transform."""
TF_QUEUE = 100
"""Queue of /tf and /tf_static messages: each static publisher latches one."""
MAX_FOREIGN = 10_000
"""Most transforms of others that are kept: a robot has hundreds of frames, but a tracker may publish one for each
vehicle, for months."""
TF_STATIC_QOS = QoSProfile(
    depth=TF_QUEUE, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
TF_QOS = QoSProfile(depth=TF_QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort connects to every publisher of /tf; lost messages are repeated there."""
TF2_MISSING = (
    'tf2_msgs is not installed: the ground transform is published on {} but not on /tf_static '
    '(apt install ros-jazzy-tf2-msgs; publish_tf:=false hides this line)'
)


class GroundTransformPublisher:
    """Publishes `~/ground_transform`, and the same on /tf_static if tf stays a tree; thread-safe."""

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
        """Reason why nothing is broadcast; '' if there is none."""
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
        """Name the frames of a future transform, so that a conflict is reported before the first calibration."""
        with self._lock:
            below = self._tf_parent == 'ground'
            self._set_edge(*((ground_frame, camera_frame) if below else (camera_frame, ground_frame)))

    def publish(self, message: TransformStamped) -> None:
        """Publish the transform between camera and ground; it replaces the previous one."""
        with self._lock:
            self._ground_transform.publish(validated(message))
            self._latest = message
            self._set_edge(message.header.frame_id, message.child_frame_id)
            self._broadcast()

    def forget(self) -> None:
        """Remove the latched transform by renewing its publisher. Call this in the executor's thread.

        Consumers that have received the transform keep it.
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
        """Parse only messages that name our frames: a robot's tree at 100 Hz would cost a tenth of a core."""
        edge = self._edge
        if edge is None or any(frame.encode() in serialized for frame in edge):
            self._on_tf(deserialize_message(serialized, TFMessage))

    def _on_tf(self, message: Any) -> None:
        """Record the parents that others publish; our own transforms arrive here too."""
        edges = {
            (transform.header.frame_id.lstrip('/'), transform.child_frame_id.lstrip('/'))
            for transform in message.transforms
        }
        with self._lock:
            new = edges - self._ours - self._foreign
            if new:
                self._foreign |= new
                if len(self._foreign) > MAX_FOREIGN:
                    self._foreign = set() if self._edge is None else relevant(*self._edge, self._foreign)
                self._check_conflict()

    def _set_edge(self, parent: str, child: str) -> None:
        if self._edge != (parent, child):
            self._edge = parent, child
            self._check_conflict()

    def _check_conflict(self) -> None:
        """Check for a conflict; on a new one, withdraw our broadcast."""
        if not self._may_broadcast or self._edge is None:
            return
        before, self.conflict = self.conflict, conflict(*self._edge, self._foreign, tf_parent=self._tf_parent)
        if self.conflict and self.conflict != before:
            self._node.get_logger().error(self.conflict)
        if self.conflict:
            self._clear()

    def _broadcast(self) -> None:
        if not (self._may_broadcast and self._listened) or self._edge is None or self._latest is None:
            return
        if not self.conflict:
            self._ours.add(self._edge)
            self._tf_static.publish(validated(TFMessage(transforms=[self._latest])))
            self._broadcasting = True

    def _clear(self) -> None:
        if self._broadcasting:
            self._tf_static.publish(validated(TFMessage()))
            self._broadcasting = False


def conflict(parent: str, child: str, foreign: Set[tuple[str, str]], *, tf_parent: str) -> str:
    """Return why a transform would break the tf tree of others, and the parameter to set; '' if it would not.

    `foreign` holds (parent, child) of their transforms. The same parent and child as ours are no conflict: they come
    from a recording, or from this node before a restart.
    """
    others = sorted(above for above, below in foreign if below == child and above != parent)
    unique_name = 'set ground_frame to a unique name'
    if others:
        remedy = (
            f"set tf_parent to 'camera', which makes '{child}' the parent of the ground frame"
            if tf_parent == 'ground'
            else f"{unique_name}, or tf_parent to 'ground'"
        )
        other = others[0][:MAX_FRAME_LENGTH]
        problem = f"publishes {other!r} as the parent of '{child}', and tf allows one parent"
    elif child in _ancestors(parent, foreign):
        remedy, problem = unique_name, f"publishes '{parent}' below '{child}', and ours would close a loop in tf"
    else:
        return ''
    return f'nothing is published on /tf_static: another node {problem}; {remedy}, and restart the node'


def relevant(parent: str, child: str, foreign: Set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Return the transforms of others that can be in conflict with ours: what our frames hang from."""
    above = {parent, child} | _ancestors(parent, foreign) | _ancestors(child, foreign)
    return {edge for edge in foreign if edge[1] in above}


def _ancestors(frame: str, edges: Set[tuple[str, str]]) -> set[str]:
    """Return all ancestors of a frame."""
    found: set[str] = set()
    waiting = {frame}
    while waiting:
        waiting = {above for above, below in edges if below in waiting} - found
        found |= waiting
    return found
