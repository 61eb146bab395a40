"""The image subscription: finds its publisher, matches its reliability, and says why nothing comes."""

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
from autocalib_ros.ros.watchdog import NoImageDiagnosis, PublisherOffer, diagnose, other_transport_topic

QUEUE_DEPTH = 10
"""Images that DDS keeps while this process has no processor: a third of a second at 30 Hz.

One is usual, so that a slow callback sees no old image; this one takes a tenth of a millisecond, and evidence goes by
stamps, so that age costs nothing. Side by side on a machine with four times more to do than it can, of 900 images of
1280x720 at 30 Hz a queue of 1 got 23, of 5 180 and of 10 348, which were 50, 180 and 340 ms old at the median.
"""
PUBLISHER_POLL_S = 1.0
NO_IMAGE_TIMEOUT_S = 5.0
NO_IMAGE_REMINDER_S = 60.0
"""Real seconds between two looks at the publishers, without an image before that is told, and told again."""
RELIABILITY = {'reliable': ReliabilityPolicy.RELIABLE, 'best_effort': ReliabilityPolicy.BEST_EFFORT}


class ImageInput:
    """Subscribes `image`, or `<image>/compressed`; what it knows of the stream is for diagnostics."""

    def __init__(self, node: Node, options: NodeOptions, on_image: Callable[[Any], None]) -> None:
        self._node, self._on_image = node, on_image
        compressed = options.image_transport == 'compressed'
        self._type = CompressedImage if compressed else Image
        # The image topic is resolved first: a remapping of `image` has to move its compressed form along.
        self.topic = node.resolve_topic_name('image') + ('/compressed' if compressed else '')
        self.silence: NoImageDiagnosis | None = None
        """Why no image has come for `NO_IMAGE_TIMEOUT_S`; None while images come."""
        self.offers: list[PublisherOffer] = []
        """What publishers offered at the last look."""
        self.lost = 0
        """Images that DDS says it lost before they came here."""
        self.encoding = ''
        """What the newest image says it is."""
        self._subscription: Subscription | None = None
        self._reliability: ReliabilityPolicy | None = None
        self._last_image = time.monotonic()
        self._any_image = False
        self._last_warning: tuple[str, float] | None = None
        self._requested = RELIABILITY.get(options.image_reliability)
        if self._requested is not None:
            self._subscribe(self._requested)
        node.create_timer(PUBLISHER_POLL_S, self._check_publishers, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def age_s(self) -> float | None:
        """Seconds since the newest image came; None before the first."""
        return time.monotonic() - self._last_image if self._any_image else None

    @property
    def several_publishers(self) -> str:
        """Say that several publishers share the topic, '' where they do not: nothing tells their images apart."""
        names = sorted(offer.node for offer in self.offers if offer.type_name == self._type_name())
        return (
            ''
            if len(names) < 2
            else (
                f'{len(names)} publishers share {self.topic} ({", ".join(names)}): images of '
                'two cameras cannot be told apart'
            )
        )

    def _check_publishers(self) -> None:
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        self.offers = [_offer(publisher) for publisher in publishers]
        wanted = self._requested or self._compatible_reliability(self.offers)
        if wanted is not None and wanted != self._reliability:
            self._subscribe(wanted)
        self._warn_no_image()

    def _compatible_reliability(self, offers: list[PublisherOffer]) -> ReliabilityPolicy | None:
        """Return what connects to all publishers; None while there is none.

        Best effort connects to everything but loses half of the large images, and
        BEST_AVAILABLE is decided once, before a camera that starts later is known.
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
            self._type, self.topic, self._take, profile, event_callbacks=events
        )
        self._node.get_logger().info(f'subscribed to {self.topic} ({self._type_name()}, {reliability.name.lower()})')

    def _on_incompatible(self, event: Any) -> None:
        """Tell it: with image_reliability auto the next look at the publishers mends it, else a person has to."""
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        if self._requested is None:
            self._node.get_logger().info(
                f'a publisher of {self.topic} offers another {policy}: it is matched within {PUBLISHER_POLL_S:g} s'
            )
        else:
            self._node.get_logger().warning(
                f'a publisher of {self.topic} offers less {policy} than this node asks '
                'for, and nothing comes from it: set image_reliability:=auto'
            )

    def _on_lost(self, event: Any) -> None:
        self.lost += event.total_count_change

    def _take(self, message: Any) -> None:
        self._last_image, self._any_image, self._last_warning, self.silence = time.monotonic(), True, None, None
        self.encoding = message.encoding if self._type is Image else message.format
        self._on_image(message)

    def _warn_no_image(self) -> None:
        """Find out why nothing comes; log it, and again when the reason changes or much time has gone."""
        now = time.monotonic()
        if now - self._last_image < NO_IMAGE_TIMEOUT_S:
            return
        other_offers = self._node.get_publishers_info_by_topic(other_transport_topic(self.topic, self._type_name()))
        self.silence = diagnose(
            self.topic,
            self._type_name(),
            self.offers,
            asks_reliable=self._reliability == ReliabilityPolicy.RELIABLE,
            other_offers=[_offer(publisher) for publisher in other_offers],
        )
        words, warned_at = self._last_warning or ('', -NO_IMAGE_REMINDER_S)
        if words == self.silence.words and now - warned_at < NO_IMAGE_REMINDER_S:
            return
        self._last_warning = self.silence.words, now
        self._node.get_logger().warning(f'no image for {now - self._last_image:.0f} s: {self.silence.words}')

    def _type_name(self) -> str:
        return f'sensor_msgs/msg/{self._type.__name__}'


def _offer(publisher: Any) -> PublisherOffer:
    name = f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'
    return PublisherOffer(name, publisher.topic_type, publisher.qos_profile.reliability == ReliabilityPolicy.RELIABLE)
