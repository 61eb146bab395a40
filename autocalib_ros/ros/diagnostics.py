"""Publishes /diagnostics at 1 Hz on a steady clock; `status` makes its content."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from autocalib_ros.ros.messages import validated
from autocalib_ros.ros.qos import latched_publisher
from autocalib_ros.ros.status import Situation, Status, calibration_status, status

PERIOD_S = 1.0
"""Real seconds between two messages."""
QUEUE = 10


class Diagnostics:
    """Publishes the status of the node once a second, and that of the calibration, latched, when it changes."""

    def __init__(self, node: Node, situation: Callable[[], Situation], hardware_id: Callable[[], str]) -> None:
        self._node, self._situation, self._hardware_id = node, situation, hardware_id
        # the namespace lets an aggregator separate the nodes of several cameras
        self._name = f'{node.get_fully_qualified_name().lstrip("/")}: calibration'
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', QUEUE)
        self._calibration = latched_publisher(node, DiagnosticStatus, '~/status')
        self._told: Status | None = None
        node.create_timer(PERIOD_S, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _publish(self) -> None:
        situation = self._situation()
        message = DiagnosticArray(status=[self._message(status(situation))])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(validated(message))
        calibration = calibration_status(situation)
        # the message of a state without a calibration is about progress, and changes all the time
        told = calibration if situation.result is not None else replace(calibration, message='')
        if told != self._told:
            self._told = told
            self._calibration.publish(validated(self._message(calibration)))

    def _message(self, shown: Status) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=bytes([shown.level]),
            name=self._name,
            message=shown.message,
            hardware_id=self._hardware_id(),
            values=[KeyValue(key=key, value=value) for key, value in shown.values],
        )
