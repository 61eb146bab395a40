"""Qualities of service that several publishers share."""

from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions


def latched() -> QoSProfile:
    """One publisher serves late joiners and, message by message, everybody else."""
    return QoSProfile(
        depth=1,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


LATCHED = latched()


def latched_publisher(node: Node, kind: type[Any], topic: str) -> Publisher:
    """Publish latched, unless parameters `qos_overrides.<topic>.publisher.*` say otherwise."""
    # overrides are written into the profile, so it is one of its own
    return node.create_publisher(
        kind, topic, latched(), qos_overriding_options=QoSOverridingOptions.with_default_policies()
    )
