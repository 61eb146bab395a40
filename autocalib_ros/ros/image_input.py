"""Image subscription: matches the QoS of the publishers and reports a missing stream."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image

from autocalib_ros.config import NodeOptions
from autocalib_ros.errors import printable_line
from autocalib_ros.ros.log_throttle import LogThrottle
from autocalib_ros.ros.watchdog import NoImageDiagnosis, PublisherOffer, diagnose, other_transport_topic

QUEUE_DEPTH = 10
"""Images that DDS keeps while this process gets no CPU time: a third of a second at 30 Hz.

A depth of 1 is usual, so that a slow callback gets no old image. Here the callback takes 0.1 ms, and evidence uses the
time stamps, so old images do no harm. Measured on a machine with four times its load, 900 images of 1280x720 at 30 Hz:
a depth of 1 received 23, of 5 180 and of 10 348 images, with a median latency of 50, 180 and 340 ms.
"""
PUBLISHER_POLL_S = 1.0
"""Real seconds between two checks of the publishers."""
NO_IMAGE_TIMEOUT_S = 5.0
"""Real seconds without an image before a warning."""
MAX_ENCODING = 100
"""Most characters of an encoding that are told; those of compressed images have up to 40."""
UNKNOWN = '_UNKNOWN_'
"""Part of the name that rmw gives a node of which it has only seen a topic."""
UNNAMED = 'a node whose name is not known yet'
"""How such a node is called for the seconds until its name is known."""
RELIABILITY = {'reliable': ReliabilityPolicy.RELIABLE, 'best_effort': ReliabilityPolicy.BEST_EFFORT}


class ImageInput:
    """Subscribes to `image`, or `<image>/compressed`; its attributes describe the stream for /diagnostics."""

    def __init__(self, node: Node, options: NodeOptions, on_image: Callable[[Any], None]) -> None:
        self._node, self._on_image = node, on_image
        compressed = options.image_transport == 'compressed'
        self._type = CompressedImage if compressed else Image
        # Resolve `image` first, so that a remapping of it also applies to its compressed topic.
        self.topic = node.resolve_topic_name('image') + ('/compressed' if compressed else '')
        self.no_image: NoImageDiagnosis | None = None
        """Why no image has arrived for `NO_IMAGE_TIMEOUT_S`; None while images arrive."""
        self.offers: list[PublisherOffer] = []
        """Publishers at the last check."""
        self.lost = 0
        """Images that DDS reported as lost."""
        self.encoding = ''
        """Encoding of the newest image, for compressed images its format."""
        self._subscription: Subscription | None = None
        self._reliability: ReliabilityPolicy | None = None
        self._last_image = time.monotonic()
        self._any_image = False
        self._throttle = LogThrottle()
        self._outage_told = False
        self._requested = RELIABILITY.get(options.image_reliability)
        if self._requested is not None:
            self._subscribe(self._requested)
        node.create_timer(PUBLISHER_POLL_S, self._check_publishers, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def age_s(self) -> float | None:
        """Seconds since the newest image; None before the first."""
        return time.monotonic() - self._last_image if self._any_image else None

    @property
    def several_publishers(self) -> str:
        """Return a warning if several publishers share the topic, since their images cannot be separated; '' if not."""
        names = sorted(offer.node for offer in self.offers if offer.type_name == self._type_name())
        if len(names) < 2:
            return ''
        return (
            f'{len(names)} publishers share {self.topic} ({", ".join(names)}): their images cannot be separated, '
            'use one topic per camera'
        )

    def _check_publishers(self) -> None:
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        self.offers = [_offer(publisher) for publisher in publishers]
        wanted = self._requested or self._compatible_reliability(self.offers)
        if wanted is not None and wanted != self._reliability:
            self._subscribe(wanted)
        self._warn_no_image()

    def _compatible_reliability(self, offers: list[PublisherOffer]) -> ReliabilityPolicy | None:
        """Return the reliability that connects to all publishers; None without publishers.

        Best effort connects to all but loses half of the large images. BEST_AVAILABLE is resolved only once, before
        a camera that starts later is known.
        """
        reliable = {offer.reliable for offer in offers if offer.type_name == self._type_name()}
        if not reliable:
            return None
        return ReliabilityPolicy.RELIABLE if reliable == {True} else ReliabilityPolicy.BEST_EFFORT

    def _subscribe(self, reliability: ReliabilityPolicy) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._reliability = reliability
        profile = QoSProfile(depth=QUEUE_DEPTH, history=HistoryPolicy.KEEP_LAST, reliability=reliability)
        events = SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible, message_lost=self._on_lost)
        self._subscription = self._node.create_subscription(
            self._type, self.topic, self.take, profile, event_callbacks=events
        )
        self._node.get_logger().info(f'subscribed to {self.topic} ({self._type_name()}, {reliability.name.lower()})')

    def _on_incompatible(self, event: Any) -> None:
        """Log it: with image_reliability auto the next check resubscribes, otherwise the user has to act."""
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        if self._requested is None:
            self._node.get_logger().info(
                f'a publisher of {self.topic} offers another {policy}: resubscribing within {PUBLISHER_POLL_S:g} s'
            )
        else:
            self._node.get_logger().warning(
                f'incompatible QoS ({policy}): no images will be received from a publisher of {self.topic}; '
                'set image_reliability:=auto'
            )

    def _on_lost(self, event: Any) -> None:
        self.lost += event.total_count_change

    def take(self, message: Any) -> None:
        """Take an image, as from the topic."""
        now = time.monotonic()
        if self.no_image is not None:
            self.no_image = None
            self._throttle.forget()
            if self._outage_told:
                self._node.get_logger().info(f'images on {self.topic} again, after {now - self._last_image:.0f} s')
            self._outage_told = False
        self._last_image, self._any_image = now, True
        encoding = message.encoding if self._type is Image else message.format
        self.encoding = printable_line(encoding, MAX_ENCODING, 0)
        self._on_image(message)

    def _warn_no_image(self) -> None:
        """Diagnose a missing stream and log it, again when the reason changes."""
        now = time.monotonic()
        if now - self._last_image < NO_IMAGE_TIMEOUT_S:
            return
        other_offers = self._node.get_publishers_info_by_topic(other_transport_topic(self.topic, self._type_name()))
        self.no_image = diagnose(
            self.topic,
            self._type_name(),
            self.offers,
            requests_reliable=self._reliability == ReliabilityPolicy.RELIABLE,
            other_offers=[_offer(publisher) for publisher in other_offers],
        )
        if not self._throttle.is_due('no image', self.no_image.text, changed_s=0.0):
            return
        self._outage_told = self._any_image
        self._node.get_logger().warning(f'no image for {now - self._last_image:.0f} s: {self.no_image.text}')

    def _type_name(self) -> str:
        return f'sensor_msgs/msg/{self._type.__name__}'


def node_name(endpoint: Any) -> str:
    """Return the full name of the node of a publisher or subscription; it may not be known for some seconds."""
    if UNKNOWN in endpoint.node_name:
        return UNNAMED
    return f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'


def _offer(publisher: Any) -> PublisherOffer:
    return PublisherOffer(
        node_name(publisher), publisher.topic_type, publisher.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    )
