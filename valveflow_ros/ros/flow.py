"""Do not send faster than the monitor takes: follow its predictions."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from rclpy.node import Node
from valveflow_msgs.msg import Prediction

from valveflow_ros.ros.inputs import header_time_ns
from valveflow_ros.ros.taking import Taker

_PREDICTION = 'valveflow_msgs/msg/Prediction'
# Between two processes on one machine the middleware's queue holds 512 messages of all topics.
_MOST_UNDER_WAY = 240
_LEAST_STEPS = 8
_NAP_S = 0.002
_STUCK_S = 0.5
_STUCK_MOST = 3
_BLIND_STEPS_PER_S = 1000.0
_LOOK_S = 1.0


class Flow:
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
        Tells whether to give up waiting.

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
        self._takers: list[Taker] = []
        self._under_way: deque[int] = deque()
        self._newest_ns = 0
        self._stuck = 0
        self._blind_s = 0.0
        self._looked_s = 0.0

    @property
    def following(self) -> bool:
        """Tell whether there is a prediction to follow."""
        return bool(self._takers) and self._stuck < _STUCK_MOST

    def look_around(self) -> list[str]:
        """Find predictions to follow; return their topics."""
        known = {taker.topic for taker in self._takers}
        for topic, types in self._node.get_topic_names_and_types():
            if _PREDICTION in types and topic not in known:
                self._takers.append(Taker(self._node, Prediction, topic, reliable=True))
        return [taker.topic for taker in self._takers]

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
        if not self._takers and time.monotonic() - self._looked_s > _LOOK_S:
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
                time.sleep(_NAP_S)

    def _answered(self) -> bool:
        """Take predictions; tell whether one speaks of something under way."""
        for taker in self._takers:
            for taken in taker.take():
                self._newest_ns = max(self._newest_ns, header_time_ns(taken.data))
        before = len(self._under_way)
        while self._under_way and self._under_way[0] <= self._newest_ns:
            self._under_way.popleft()
        return len(self._under_way) < before

    def _wait_blindly(self) -> None:
        now_s = time.monotonic()
        self._blind_s = max(self._blind_s, now_s - 0.05) + 1.0 / _BLIND_STEPS_PER_S
        if self._blind_s > now_s:
            time.sleep(self._blind_s - now_s)
