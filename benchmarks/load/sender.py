# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A process that publishes plain values at a rate, each with a number of its own.

    python -m benchmarks.load.sender PLAN

PLAN is JSON, see `Plan`. It says ``ready`` when every topic has a listener, begins at a line on
its standard input, and ends with a line of JSON: how many messages each topic was sent.
"""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64

from valveflow_ros.ros.encoding import float64_bytes

DEPTH = 1000
# One message in so many units of the last digits; a plant does not notice.
NUMBER = 1e-9
_BATCH_S = 0.01
_TAIL_HZ, _TAIL_S = 20.0, 1.0
_PATIENCE_S = 120.0


@dataclass(frozen=True, slots=True)
class Stream:
    """What is sent on a topic: the k-th message adds k times `NUMBER` to ``base``.

    From ``step_at_s`` on ``step_by`` is added, too.
    """

    topic: str
    rate_hz: float
    base: float
    step_at_s: float = 1e9
    step_by: float = 0.0

    def value(self, k: int, at_s: float) -> float:
        """Return the value of the k-th message."""
        return self.base + k * NUMBER + (self.step_by if at_s >= self.step_at_s else 0.0)

    def numbers(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return which messages values came with."""
        beyond = values - self.base
        if self.step_by:
            beyond = np.where(beyond > 0.5 * self.step_by, beyond - self.step_by, beyond)
        return np.rint(beyond / NUMBER).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Plan:
    """What a sender does."""

    seconds: float
    reliable: bool
    streams: list[Stream] = field(default_factory=list)

    def text(self) -> str:
        """Return it as JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def read(cls, text: str) -> Plan:
        """Return the plan in a text."""
        content = json.loads(text)
        return cls(**{**content, 'streams': [Stream(**s) for s in content['streams']]})


class _Sending:
    """One topic on its way."""

    def __init__(self, node: Node, stream: Stream, reliable: bool) -> None:
        weak, strong = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
        qos = QoSProfile(depth=DEPTH, reliability=strong if reliable else weak)
        self.stream = stream
        self.publisher = node.create_publisher(Float64, stream.topic, qos)
        self.sent = 0

    def send(self, up_to: int, at_s: float) -> None:
        """Publish until so many were sent."""
        publish, value = self.publisher.publish, self.stream.value
        for k in range(self.sent, up_to):
            publish(float64_bytes(value(k, at_s)))
        self.sent = max(self.sent, up_to)


def _run(sending: list[_Sending], seconds: float) -> float:
    """Send in batches, at most a few at once if we are late; return how long it took."""
    begun_s = time.monotonic()
    totals = [math.ceil(s.stream.rate_hz * seconds) for s in sending]
    batch = 0
    while any(s.sent < total for s, total in zip(sending, totals, strict=True)):
        at_s = time.monotonic() - begun_s
        for one, total in zip(sending, totals, strict=True):
            rate = one.stream.rate_hz
            most = one.sent + max(1, round(4 * _BATCH_S * rate))
            one.send(min(int(at_s * rate) + 1, total, most), at_s)
        batch = max(batch + 1, int(at_s / _BATCH_S))
        time.sleep(max(0.0, begun_s + batch * _BATCH_S - time.monotonic()))
    return time.monotonic() - begun_s


def _tail(sending: list[_Sending], began_s: float) -> None:
    """Send a little more, so that a gap at the end has another side."""
    for _ in range(round(_TAIL_HZ * _TAIL_S)):
        time.sleep(1.0 / _TAIL_HZ)
        for one in sending:
            one.send(one.sent + 1, began_s)


def main(arguments: list[str]) -> int:
    """Send what the plan says."""
    plan = Plan.read(arguments[0])
    rclpy.init(args=[])
    node = Node('load_sender', enable_rosout=False, start_parameter_services=False)
    sending = [_Sending(node, stream, plan.reliable) for stream in plan.streams]
    end_s = time.monotonic() + _PATIENCE_S
    while any(s.publisher.get_subscription_count() == 0 for s in sending):
        if time.monotonic() > end_s:
            sys.exit('load sender: nobody listens')
        time.sleep(0.05)
    # The other side may learn of us a little later than we of it.
    time.sleep(1.0)
    print('ready', flush=True)
    sys.stdin.readline()
    took_s = _run(sending, plan.seconds)
    print('sent', flush=True)
    _tail(sending, took_s)
    if plan.reliable:
        for one in sending:
            one.publisher.wait_for_all_acked(Duration(seconds=5))
    result: dict[str, Any] = {'took_s': took_s, 'sent': {s.stream.topic: s.sent for s in sending}}
    print(json.dumps(result), flush=True)
    # What is not acknowledged yet is sent again as long as we live.
    sys.stdin.readline()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
