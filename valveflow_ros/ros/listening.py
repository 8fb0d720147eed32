# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Finds running monitors and subscribes to them; a board collects the decoded messages."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from valveflow_msgs.msg import Alarm, Diagnosis, FlowCharacteristic, Prediction

from valveflow_ros.report.terminal.board import (
    ALARM,
    CURVE,
    DIAGNOSIS,
    HEALTH,
    KEPT,
    PREDICTION,
    MonitorState,
)

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Lost samples are only missing in the display.
_STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
_CURVE_TOPIC = '/characteristic'


def full_name(monitor: str) -> str:
    """Return the full name of a monitor's node; empty stays empty."""
    return '/' + monitor.strip('/') if monitor else ''


def monitors(node: Node) -> list[str]:
    """Return the full names of the running monitors, sorted."""
    return sorted(
        topic.removesuffix(_CURVE_TOPIC)
        for topic, kinds in node.get_topic_names_and_types()
        if CURVE in kinds and topic.endswith(_CURVE_TOPIC) and node.count_publishers(topic)
    )


def waiting_for(monitor: str) -> str:
    """Return the advice for the case that no monitor is found."""
    return (
        f'No monitor{" " if monitor else ""}{monitor} was found yet. If it runs, compare '
        'ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE here and there: they must be the same.'
    )


class Listener:
    """Subscribes to one monitor and updates a board.

    ``monitor`` is the full name of its node. Call `tell` before reading the board.
    """

    def __init__(self, node: Node, monitor: str, board: MonitorState) -> None:
        self._node = node
        self.monitor = monitor
        self.board = board
        self._predictions: deque[Prediction] = deque(maxlen=KEPT)
        self.heard: set[str] = set()
        for name, kind, type_name in (
            ('characteristic', FlowCharacteristic, CURVE),
            ('alarms', Alarm, ALARM),
            ('diagnosis', Diagnosis, DIAGNOSIS),
        ):
            self._subscribe(f'{monitor}/{name}', kind, type_name)
        node.create_subscription(Prediction, f'{monitor}/prediction', self._on_prediction, _STREAM)

    @property
    def present(self) -> bool:
        """Return True while the monitor runs."""
        return bool(self._node.count_publishers(self.monitor + _CURVE_TOPIC))

    @property
    def note(self) -> str:
        """Return a sentence if the monitor has ended or is silent; otherwise empty."""
        if not self.present:
            return 'The monitor has stopped. Its last values are shown.'
        return '' if self.heard else 'The monitor was found; nothing has come from it yet.'

    def tell(self) -> None:
        """Pass the predictions received since the last call to the board."""
        while self._predictions:
            self.board.take(PREDICTION, fields_of(self._predictions.popleft()))

    def health(self, fields: Mapping[str, Any]) -> None:
        """Process a message of `/diagnostics`, which is one topic for all monitors."""
        self.heard.add(HEALTH)
        self.board.take(HEALTH, fields)

    def _subscribe(self, topic: str, kind: type, type_name: str) -> None:
        def take(message: Any) -> None:
            self.heard.add(type_name)
            self.board.take(type_name, fields_of(message))

        self._node.create_subscription(kind, topic, take, LATCHED)

    def _on_prediction(self, message: Prediction) -> None:
        self.heard.add(PREDICTION)
        self._predictions.append(message)


def hear_health(node: Node, listeners: Mapping[str, Listener]) -> None:
    """Subscribe to `/diagnostics` once, for all current and later ``listeners``."""

    def take(message: DiagnosticArray) -> None:
        fields = fields_of(message)
        for listener in listeners.values():
            listener.health(fields)

    node.create_subscription(DiagnosticArray, '/diagnostics', take, QoSProfile(depth=10))


def fields_of(message: Any) -> Mapping[str, Any]:
    """Return a message as a mapping; nested messages are mappings, too."""
    return {name: _plain(getattr(message, name)) for name in message.get_fields_and_field_types()}


def _plain(value: Any) -> Any:
    if hasattr(value, 'get_fields_and_field_types'):
        return fields_of(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
