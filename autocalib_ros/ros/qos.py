"""QoS profiles shared by several publishers."""

from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions


def latched() -> QoSProfile:
    """Return a QoS profile of depth 1 whose last message also reaches late joiners."""
    return QoSProfile(
        depth=1,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


LATCHED = latched()


def latched_publisher(node: Node, kind: type[Any], topic: str) -> Publisher:
    """Create a latched publisher; parameters `qos_overrides.<topic>.publisher.*` can change its QoS."""
    # a profile of its own, since overrides are written into it
    return node.create_publisher(
        kind, topic, latched(), qos_overriding_options=QoSOverridingOptions.with_default_policies()
    )
