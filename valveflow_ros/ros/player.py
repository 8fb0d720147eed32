# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Publishes samples with their original timing, at any rate, with or without /clock.

Messages that exceed the queues of the middleware are lost. The monitor answers each row with a
prediction that has the row's stamp, so the number of unanswered rows is known, and the player
waits while there are too many. If there is no monitor, a player without a rate is limited to what
an ordinary subscriber can receive.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64
from valveflow_msgs.msg import Prediction

from valveflow_ros.errors import counted
from valveflow_ros.ros.decoding import INPUT_BY_NAME, header_time_ns
from valveflow_ros.ros.encoding import clock_bytes
from valveflow_ros.ros.node.polled_subscription import PolledSubscription

_PREDICTION = 'valveflow_msgs/msg/Prediction'
_DEPTH = 1000
# The middleware's queue between two processes on one machine holds 512 messages of all topics.
_MAX_UNANSWERED = 240
_LEAST_STEPS = 8
_FLOW_NAP_S = 0.002
_STUCK_S = 0.5
_MAX_STUCK = 3
_UNLED_STEPS_PER_S = 1000.0
_LOOK_S = 1.0
_NAP_S = 0.05
# The other side may discover this node a little later.
_SETTLE_S = 1.0


class Step(NamedTuple):
    """The messages of one instant, as pairs of input name and bytes."""

    time_ns: int
    messages: list[tuple[str, bytes]]


class Player:
    """Publishes steps.

    Parameters
    ----------
    node : Node
    names : iterable of str
        The inputs that will be published; any other name is the topic of a covariate.
    rate : float
        Speed relative to the samples' own time; 0: as fast as the monitor can process them.
    use_clock : bool
        Publish /clock before each step.
    stop : callable
        Returns True to stop.
    """

    def __init__(
        self,
        node: Node,
        names: Iterable[str],
        rate: float,
        use_clock: bool,
        stop: Callable[[], bool],
    ) -> None:
        self._node = node
        self._rate = rate
        self._stop = stop
        qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self.publishers: Mapping[str, Publisher] = {
            name: node.create_publisher(
                INPUT_BY_NAME[name].message_type if name in INPUT_BY_NAME else Float64, name, qos
            )
            for name in names
        }
        self._clock = node.create_publisher(Clock, '/clock', qos) if use_clock else None
        self._window = max(_LEAST_STEPS, _MAX_UNANSWERED // (len(self.publishers) + use_clock))
        self._predictions: list[PolledSubscription] = []
        self._unanswered: deque[int] = deque()
        self._answered_ns = 0
        self._stuck = 0
        self._free_at_s = self._looked_s = 0.0

    def wait_for_listeners(self, patience_s: float) -> list[str]:
        """Wait until every input has a subscriber; return the topics that have none.

        Nobody needs to listen to a covariate. A ``patience_s`` of 0 does not wait.
        """
        begun_s = time.monotonic()
        missing = self._without_listener()
        while missing and time.monotonic() - begun_s < patience_s and not self._stop():
            time.sleep(_NAP_S)
            missing = self._without_listener()
        if len(missing) < len(self.publishers):
            self._sleep_until(time.monotonic() + _SETTLE_S)
        if missing and patience_s > 0 and not self._stop():
            self._node.get_logger().warning(f'Nobody listens to {", ".join(missing)}.')
        return missing

    def play(self, steps: Iterable[Step], what: str = 'sample') -> None:
        """Publish steps until they end or ``stop`` returns True; log their number."""
        self._find_predictions()
        log = self._node.get_logger()
        if self._predictions:
            topics = ', '.join(found.topic for found in self._predictions)
            log.info(f'Sending no faster than {topics} answers.')
        elif self._rate == 0:
            log.info('No monitor publishes predictions: 1000 samples a second.')
        done = sent = first_ns = 0
        begun_s = time.monotonic()
        for step in steps:
            if done == 0:
                first_ns = step.time_ns
            if self._rate > 0:
                self._sleep_until(begun_s + (step.time_ns - first_ns) * 1e-9 / self._rate)
            self._wait_for_answers()
            if self._stop():
                break
            if self._clock is not None:
                self._clock.publish(clock_bytes(step.time_ns))
            for name, data in step.messages:
                self.publishers[name].publish(data)
            sent += len(step.messages)
            self._unanswered.append(step.time_ns)
            done += 1
        for publisher in self.publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_SETTLE_S))
        end = 'Stopped' if self._stop() else 'Finished'
        log.info(f'{end} after {counted(done, what)}, {counted(sent, "message")}.')

    def _without_listener(self) -> list[str]:
        return [
            str(publisher.topic_name)
            for name, publisher in self.publishers.items()
            if name in INPUT_BY_NAME and publisher.get_subscription_count() == 0
        ]

    def _sleep_until(self, until_s: float) -> None:
        while not self._stop() and (left := until_s - time.monotonic()) > 0:
            time.sleep(min(left, _NAP_S))

    def _find_predictions(self) -> None:
        known = {found.topic for found in self._predictions}
        for topic, types in self._node.get_topic_names_and_types():
            if _PREDICTION in types and topic not in known:
                made = PolledSubscription(self._node, Prediction, topic, reliable=True)
                self._predictions.append(made)

    def _wait_for_answers(self) -> None:
        """Wait until the next step may be sent."""
        now_s = time.monotonic()
        if not self._predictions and now_s - self._looked_s > _LOOK_S:
            self._looked_s = now_s
            self._find_predictions()
        if not self._predictions or self._stuck >= _MAX_STUCK:
            self._unanswered.clear()
            if self._rate == 0:
                now_s = time.monotonic()
                self._free_at_s = max(self._free_at_s, now_s - 0.05) + 1.0 / _UNLED_STEPS_PER_S
                time.sleep(max(0.0, self._free_at_s - now_s))
            return
        begun_s = now_s
        while len(self._unanswered) >= self._window and not self._stop():
            if self._take_answers():
                self._stuck = 0
                begun_s = time.monotonic()
            elif time.monotonic() - begun_s > _STUCK_S:
                # The monitor may need more rows before it answers, or may have ended: send some.
                self._stuck += 1
                for _ in range(self._window // 4):
                    self._unanswered.popleft()
            else:
                time.sleep(_FLOW_NAP_S)

    def _take_answers(self) -> bool:
        """Receive predictions; return True if one answers a waiting row."""
        for predictions in self._predictions:
            for message in predictions.take():
                self._answered_ns = max(self._answered_ns, header_time_ns(message.data))
        before = len(self._unanswered)
        while self._unanswered and self._unanswered[0] <= self._answered_ns:
            self._unanswered.popleft()
        return len(self._unanswered) < before
