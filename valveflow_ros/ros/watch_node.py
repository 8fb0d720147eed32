"""Listens to a running monitor and keeps what a terminal view needs."""

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
    Board,
)
from valveflow_ros.report.terminal.frame import Frame

_LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# A sample that is lost here is lost to the eye only.
_STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
_CURVE_TOPIC = '/characteristic'


class WatchNode(Node):
    """Finds the monitor, subscribes, and tells what it said.

    Parameters
    ----------
    monitor : str
        Full name of the monitor's node; empty: the one there is.
    """

    def __init__(self, monitor: str = '') -> None:
        super().__init__('valveflow_watch', enable_rosout=False)
        self._wanted = '/' + monitor.strip('/') if monitor else ''
        self.monitor = ''
        self.several: tuple[str, ...] = ()
        self._board = Board()
        self._predictions: deque[Prediction] = deque(maxlen=KEPT)
        self.heard: set[str] = set()

    def look(self) -> None:
        """Look for the monitor as long as it is not found."""
        if self.monitor:
            return
        found = sorted(
            topic.removesuffix(_CURVE_TOPIC)
            for topic, kinds in self.get_topic_names_and_types()
            if CURVE in kinds and topic.endswith(_CURVE_TOPIC) and self.count_publishers(topic)
        )
        self.several = tuple(found) if len(found) > 1 and not self._wanted else ()
        if self._wanted in found or (len(found) == 1 and not self._wanted):
            self._listen(self._wanted or found[0])

    def frame(self) -> Frame:
        """Return what is known now."""
        while self._predictions:
            self._board.take(PREDICTION, fields_of(self._predictions.popleft()))
        return self._board.frame(self.monitor or 'ROS 2', self._note())

    def _note(self) -> str:
        if self.several:
            return f'Several monitors run: {", ".join(self.several)}. Choose with --node NAME.'
        if not self.monitor:
            what = self._wanted or 'a monitor'
            return (
                f'Waiting for {what}. If one runs, compare ROS_DOMAIN_ID and '
                'ROS_AUTOMATIC_DISCOVERY_RANGE here and there: they must be the same.'
            )
        if not self.count_publishers(self.monitor + _CURVE_TOPIC):
            return 'The monitor has gone; this is what it said last.'
        return '' if self.heard else 'The monitor was found; nothing has come from it yet.'

    def _listen(self, monitor: str) -> None:
        self.monitor = monitor
        for name, kind, type_name in (
            ('characteristic', FlowCharacteristic, CURVE),
            ('alarms', Alarm, ALARM),
            ('diagnosis', Diagnosis, DIAGNOSIS),
        ):
            self._subscribe(f'{monitor}/{name}', kind, type_name, _LATCHED)
        self._subscribe('/diagnostics', DiagnosticArray, HEALTH, QoSProfile(depth=10))
        self.create_subscription(Prediction, f'{monitor}/prediction', self._on_prediction, _STREAM)

    def _subscribe(self, topic: str, kind: type, type_name: str, qos: QoSProfile) -> None:
        def take(message: Any) -> None:
            self.heard.add(type_name)
            self._board.take(type_name, fields_of(message))

        self.create_subscription(kind, topic, take, qos)

    def _on_prediction(self, message: Prediction) -> None:
        self.heard.add(PREDICTION)
        self._predictions.append(message)


def fields_of(message: Any) -> Mapping[str, Any]:
    """Return a message as a mapping, messages within as mappings too."""
    return {name: _plain(getattr(message, name)) for name in message.get_fields_and_field_types()}


def _plain(value: Any) -> Any:
    if hasattr(value, 'get_fields_and_field_types'):
        return fields_of(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
