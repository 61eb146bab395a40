"""Publishes /diagnostics at 1 Hz on a steady clock; `status` makes its content."""

from __future__ import annotations

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from autocalib_ros.ros.messages import validated
from autocalib_ros.ros.status import Situation, status

PERIOD_S = 1.0
"""Real seconds between two messages."""
QUEUE = 10


class Diagnostics:
    """Publishes the status of the node once a second."""

    def __init__(self, node: Node, situation: Callable[[], Situation], hardware_id: Callable[[], str]) -> None:
        self._node, self._situation, self._hardware_id = node, situation, hardware_id
        # the namespace lets an aggregator separate the nodes of several cameras
        self._name = f'{node.get_fully_qualified_name().lstrip("/")}: calibration'
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', QUEUE)
        node.create_timer(PERIOD_S, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _publish(self) -> None:
        current = status(self._situation())
        message = DiagnosticArray(
            status=[
                DiagnosticStatus(
                    level=bytes([current.level]),
                    name=self._name,
                    message=current.message,
                    hardware_id=self._hardware_id(),
                    values=[KeyValue(key=key, value=value) for key, value in current.values],
                )
            ]
        )
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(validated(message))
