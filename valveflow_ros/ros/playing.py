"""Publish samples in their own time, at any rate, with or without a clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from valveflow_ros.ros.flow import Flow
from valveflow_ros.ros.inputs import INPUT_BY_NAME
from valveflow_ros.ros.wire import clock_bytes

_DEPTH = 1000
_NAP_S = 0.05
# The other side may learn of us a little later than we of it.
_SETTLE_S = 1.0


class Step(NamedTuple):
    """The messages of one instant: (input's name, bytes)."""

    time_ns: int
    messages: list[tuple[str, bytes]]


class Player:
    """Publishes steps.

    Parameters
    ----------
    node : Node
    names : iterable of str
        The inputs that will be published.
    rate : float
        Seconds of the samples' own time in a second; 0 as fast as the monitor takes them.
    use_clock : bool
        Publish /clock before each step.
    stop : callable
        Tells whether to stop.
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
            name: node.create_publisher(INPUT_BY_NAME[name].message_type, name, qos)
            for name in names
        }
        self._clock = node.create_publisher(Clock, '/clock', qos) if use_clock else None
        self._flow = Flow(node, len(self.publishers) + use_clock, stop)
        self.sent: dict[str, int] = dict.fromkeys(self.publishers, 0)

    def wait_for_listeners(self, patience_s: float) -> list[str]:
        """Wait until every input has a subscriber; return the topics that have none.

        Parameters
        ----------
        patience_s : float
            How long to wait; 0 waits for nobody.
        """
        begun_s = time.monotonic()
        missing = self._without_listener()
        while missing and time.monotonic() - begun_s < patience_s and not self._stop():
            time.sleep(_NAP_S)
            missing = self._without_listener()
        if len(missing) < len(self.publishers):
            self._sleep(_SETTLE_S)
        return missing

    def play(self, steps: Iterable[Step]) -> int:
        """Publish steps until they end or we are asked to stop; return how many."""
        following = self._flow.look_around()
        log = self._node.get_logger()
        if following:
            log.info(f'Sending no faster than {", ".join(following)} answers.')
        elif self._rate == 0:
            log.info('Nobody predicts, so there is nobody to follow: 1000 samples a second.')
        done = 0
        first_ns, begun_s = 0, time.monotonic()
        for step in steps:
            if done == 0:
                first_ns = step.time_ns
            if self._rate > 0:
                self._sleep_until(begun_s + (step.time_ns - first_ns) * 1e-9 / self._rate)
            self._flow.wait(unlimited=self._rate == 0)
            if self._stop():
                break
            self._publish(step)
            done += 1
        for publisher in self.publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_SETTLE_S))
        return done

    def _publish(self, step: Step) -> None:
        if self._clock is not None:
            self._clock.publish(clock_bytes(step.time_ns))
        for name, data in step.messages:
            self.publishers[name].publish(data)
            self.sent[name] += 1
        self._flow.sent(step.time_ns)

    def _without_listener(self) -> list[str]:
        return [
            str(publisher.topic_name)
            for publisher in self.publishers.values()
            if publisher.get_subscription_count() == 0
        ]

    def _sleep_until(self, until_s: float) -> None:
        while not self._stop() and (left := until_s - time.monotonic()) > 0:
            time.sleep(min(left, _NAP_S))

    def _sleep(self, seconds: float) -> None:
        self._sleep_until(time.monotonic() + seconds)
