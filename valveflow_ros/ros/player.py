"""Publish samples in their own time, at any rate, with or without a clock."""

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
from valveflow_msgs.msg import Prediction

from valveflow_ros.ros.decoding import INPUT_BY_NAME, header_time_ns
from valveflow_ros.ros.encoding import clock_bytes
from valveflow_ros.ros.polled_subscription import PolledSubscription

_PREDICTION = 'valveflow_msgs/msg/Prediction'
# Between two processes on one machine the middleware's queue holds 512 messages of all topics.
_MOST_UNDER_WAY = 240
_LEAST_STEPS = 8
_FLOW_NAP_S = 0.002
_STUCK_S = 0.5
_STUCK_MOST = 3
_BLIND_STEPS_PER_S = 1000.0
_LOOK_S = 1.0


class FlowControl:
    """Holds a sender back while too much of what it sent is unanswered.

    What is sent in one go beyond what the middleware's queues hold is lost. The
    monitor answers each row with a prediction that carries the row's stamp, so
    what is under way is known.

    Parameters
    ----------
    node : Node
    messages : int
        How many messages a sample takes.
    stop : callable
        Returns True to give up waiting.

    Notes
    -----
    Where nobody predicts, there is nothing to follow: `wait` then limits the
    rate to what an ordinary subscriber takes.
    """

    def __init__(
        self, node: Node, messages: int, stop: Callable[[], bool] = lambda: False
    ) -> None:
        self._node = node
        self._window = max(_LEAST_STEPS, _MOST_UNDER_WAY // messages)
        self._stop = stop
        self._subscriptions: list[PolledSubscription] = []
        self._under_way: deque[int] = deque()
        self._newest_ns = 0
        self._stuck = 0
        self._blind_s = 0.0
        self._looked_s = 0.0

    @property
    def following(self) -> bool:
        """Return True if there is a prediction to follow."""
        return bool(self._subscriptions) and self._stuck < _STUCK_MOST

    def look_around(self) -> list[str]:
        """Find predictions to follow; return their topics."""
        known = {subscription.topic for subscription in self._subscriptions}
        for topic, types in self._node.get_topic_names_and_types():
            if _PREDICTION in types and topic not in known:
                self._subscriptions.append(
                    PolledSubscription(self._node, Prediction, topic, reliable=True)
                )
        return [subscription.topic for subscription in self._subscriptions]

    def sent(self, time_ns: int) -> None:
        """Note that the sample of a time was sent."""
        self._under_way.append(time_ns)

    def wait(self, unlimited: bool) -> None:
        """Return when the next sample may be sent.

        Parameters
        ----------
        unlimited : bool
            Nothing else holds the sender back.
        """
        if not self._subscriptions and time.monotonic() - self._looked_s > _LOOK_S:
            self._looked_s = time.monotonic()
            self.look_around()
        if not self.following:
            self._under_way.clear()
            if unlimited:
                self._wait_blindly()
            return
        begun_s = time.monotonic()
        while len(self._under_way) >= self._window and not self._stop():
            if self._answered():
                self._stuck = 0
                begun_s = time.monotonic()
            elif time.monotonic() - begun_s > _STUCK_S:
                # It may be waiting for what we hold back; and if it has gone, so be it.
                self._stuck += 1
                for _ in range(self._window // 4):
                    self._under_way.popleft()
            else:
                time.sleep(_FLOW_NAP_S)

    def _answered(self) -> bool:
        """Take predictions; return True if one answers something under way."""
        for subscription in self._subscriptions:
            for message in subscription.take():
                self._newest_ns = max(self._newest_ns, header_time_ns(message.data))
        before = len(self._under_way)
        while self._under_way and self._under_way[0] <= self._newest_ns:
            self._under_way.popleft()
        return len(self._under_way) < before

    def _wait_blindly(self) -> None:
        now_s = time.monotonic()
        self._blind_s = max(self._blind_s, now_s - 0.05) + 1.0 / _BLIND_STEPS_PER_S
        if self._blind_s > now_s:
            time.sleep(self._blind_s - now_s)


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
            name: node.create_publisher(INPUT_BY_NAME[name].message_type, name, qos)
            for name in names
        }
        self._clock = node.create_publisher(Clock, '/clock', qos) if use_clock else None
        self._flow = FlowControl(node, len(self.publishers) + use_clock, stop)
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
