"""The image subscription: finds its publisher, matches its reliability, and says when nothing comes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image

from autocalib_ros.config import NodeOptions

DEPTH = 5
"""Images that DDS keeps while the executor is busy; the callback takes microseconds, so none grows old there."""
POLL_S = 1.0
SILENCE_S = 5.0
REMIND_S = 60.0
"""Real seconds between two looks at the publishers, without an image before that is told, and told again."""
RELIABILITY = {'reliable': ReliabilityPolicy.RELIABLE, 'best_effort': ReliabilityPolicy.BEST_EFFORT}


class ImageInput:
    """Subscribes `image`, or `<image>/compressed`, with a queue of one: a late frame is worth less than the next."""

    def __init__(self, node: Node, options: NodeOptions, on_image: Callable[[Any], None]) -> None:
        self._node, self._on_image = node, on_image
        compressed = options.image_transport == 'compressed'
        self._type = CompressedImage if compressed else Image
        # The image topic is resolved first: a remapping of `image` has to move its compressed form along.
        self.topic = node.resolve_topic_name('image') + ('/compressed' if compressed else '')
        self._subscription: Subscription | None = None
        self._reliability: ReliabilityPolicy | None = None
        self._heard = time.monotonic()
        self._told: float | None = None
        self._fixed = RELIABILITY.get(options.image_reliability)
        if self._fixed is not None:
            self._subscribe(self._fixed)
        node.create_timer(POLL_S, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _watch(self) -> None:
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        wanted = self._fixed or self._matching([p for p in publishers if p.topic_type == self._type_name()])
        if wanted is not None and wanted != self._reliability:
            self._subscribe(wanted)
        self._tell_silence([p.topic_type for p in publishers])

    @staticmethod
    def _matching(publishers: list[Any]) -> ReliabilityPolicy | None:
        """Return what connects to all publishers; None while there is none.

        Best effort connects to everything but loses half of the large images (ROS.md 1a), and
        BEST_AVAILABLE is decided once, before a camera that starts later is known.
        """
        offered = {publisher.qos_profile.reliability for publisher in publishers}
        if ReliabilityPolicy.BEST_EFFORT in offered:
            return ReliabilityPolicy.BEST_EFFORT
        return ReliabilityPolicy.RELIABLE if ReliabilityPolicy.RELIABLE in offered else None

    def _subscribe(self, reliability: ReliabilityPolicy) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._reliability = reliability
        profile = QoSProfile(depth=DEPTH, history=HistoryPolicy.KEEP_LAST, reliability=reliability)
        self._subscription = self._node.create_subscription(self._type, self.topic, self._take, profile)
        self._node.get_logger().info(f'subscribed to {self.topic} ({self._type_name()}, {reliability.name.lower()})')

    def _take(self, message: Any) -> None:
        self._heard, self._told = time.monotonic(), None
        self._on_image(message)

    def _tell_silence(self, types: list[str]) -> None:
        now = time.monotonic()
        if now - self._heard < SILENCE_S or (self._told is not None and now - self._told < REMIND_S):
            return
        self._told = now
        self._node.get_logger().warning(
            f'no image for {now - self._heard:.0f} s on {self.topic}: publishers {len(types)}{self._hint(types)}')

    def _hint(self, types: list[str]) -> str:
        """Return what the publishers send, when it is not what this node takes."""
        if not types:
            return '; remap it with -r image:=/your/image_topic'
        sent = f', types {", ".join(sorted(set(types)))}'
        return sent if self._type_name() in types else f'{sent}, but this node takes {self._type_name()}'

    def _type_name(self) -> str:
        return f'sensor_msgs/msg/{self._type.__name__}'
