# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions and services polled without the executor; the one place that uses rclpy's inside.

An executor spends far more time on choosing callbacks than the messages are worth. Here the loop
polls each subscription for raw bytes with the stamps and the sequence number that the middleware
delivers, and each service for a request. Where this rclpy does not offer that, the executor calls
back instead.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from rclpy.subscription import Subscription

from valveflow_ros.ros.process import one_line, with_place

DEPTH = 1000
_POLICIES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)


def qos_overrides(node: Node, topic: str, entity: str) -> QoSOverridingOptions | None:
    """Return what a user set from outside, as qos_overrides.TOPIC.publisher.depth and the like.

    rclpy keeps a parameter for each policy that may be set; where none is set, none is wanted.
    """
    before = f'qos_overrides.{node.resolve_topic_name(topic)}.{entity}.'
    given = getattr(node, '_parameter_overrides', {})
    kinds = [kind for kind in _POLICIES if f'{before}{kind.name.lower()}' in given]
    return QoSOverridingOptions(kinds) if kinds else None


class RawMessage(NamedTuple):
    """One message as the middleware delivered it; stamps in ns, 0 where it gave none."""

    data: bytes
    source_ns: int
    received_ns: int
    sequence: int


class _PolledGroup(CallbackGroup):
    """Keeps the executor away from subscriptions, and lets their events through."""

    def can_execute(self, entity: Any) -> bool:
        """Return False for a subscription."""
        return not isinstance(entity, Subscription)

    def beginning_execution(self, entity: Any) -> bool:
        """Allow what `can_execute` allows."""
        return self.can_execute(entity)

    def ending_execution(self, entity: Any) -> None:
        """Do nothing: `can_execute` keeps no record."""


def can_poll(subscription: Subscription) -> bool:
    """Return True if this rclpy lets a message be taken by hand."""
    return callable(getattr(subscription.handle, 'take_message', None))


class PolledSubscription:
    """A subscription that is polled.

    Parameters
    ----------
    node : Node
    message_type : type
    topic : str
        May be relative; the node resolves and remaps it.
    reliable : bool
        Whether to ask for reliable delivery; a best-effort request matches every publisher.
    on_mismatch : callable
        Called with the topic when a publisher's quality of service does not match.
    polled : bool
        False to let the executor call back even where polling is possible.
    """

    def __init__(
        self,
        node: Node,
        message_type: type,
        topic: str,
        *,
        reliable: bool = False,
        on_mismatch: Callable[[str], None] = lambda _: None,
        polled: bool = True,
    ) -> None:
        self._node = node
        self._type = message_type
        self._waiting: deque[RawMessage] = deque(maxlen=DEPTH)
        self._polled = polled
        self._make(topic, reliable, on_mismatch, _PolledGroup() if polled else None)
        if polled and not can_poll(self._subscription):
            node.destroy_subscription(self._subscription)
            self._polled = False
            self._make(topic, reliable, on_mismatch, None)
        self._handle = self._subscription.handle
        self._take_message = getattr(self._handle, 'take_message', None)
        # Held as long as we poll, so that not every look has to.
        self._handle.__enter__()

    @property
    def topic(self) -> str:
        """Return the full name of the topic."""
        return str(self._subscription.topic_name)

    @property
    def polled(self) -> bool:
        """Return True if messages are polled rather than called back."""
        return self._polled

    def take(self, most: int = DEPTH) -> list[RawMessage]:
        """Return what has arrived, oldest first, at most ``most`` messages."""
        if not self._polled:
            return [self._waiting.popleft() for _ in range(min(most, len(self._waiting)))]
        # Most looks find nothing, a hundred times a second: they have to be cheap.
        found = self._take_message(self._type, True)
        if found is None:
            return []
        taken = [_raw_message(*found)]
        while len(taken) < most:
            found = self._take_message(self._type, True)
            if found is None:
                break
            taken.append(_raw_message(*found))
        return taken

    def close(self) -> None:
        """Unsubscribe."""
        self._handle.__exit__(None, None, None)
        self._node.destroy_subscription(self._subscription)

    def _make(
        self,
        topic: str,
        reliable: bool,
        on_mismatch: Callable[[str], None],
        group: CallbackGroup | None,
    ) -> None:
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        self._subscription = self._node.create_subscription(
            self._type,
            topic,
            self._call_back,
            QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH, reliability=reliability),
            raw=True,
            callback_group=group or MutuallyExclusiveCallbackGroup(),
            qos_overriding_options=qos_overrides(self._node, topic, 'subscription'),
            # Each event costs the executor time at every look; the rest says nothing of use.
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=lambda _: on_mismatch(self.topic), use_default_callbacks=False
            ),
        )

    def _call_back(self, data: bytes, info: dict[str, Any]) -> None:
        self._waiting.append(_raw_message(data, info))


def answer_request(service: Service, failed: Callable[[str], None]) -> bool:
    """Answer the oldest request of a service; return False if there is none.

    What cannot be done is said to ``failed``, and the answer is one without success.
    """
    take = getattr(service.handle, 'service_take_request', None)
    request, header = (None, None) if take is None else take(service.srv_type.Request)
    if header is None:
        return False
    response = service.srv_type.Response()
    try:
        response = service.callback(request, response)
    except Exception as error:  # noqa: BLE001 - nothing that is asked may end the monitor
        failed(f'{service.service_name} was asked what it cannot do: {with_place(error)}')
        _refuse(request, response, f'This cannot be done ({one_line(error)}).')
    service.send_response(response, header)
    return True


def _refuse(request: Any, response: Any, reason: str) -> None:
    """Say no where the answer has a place for it; whoever sets parameters gets one for each."""
    if hasattr(response, 'results') and hasattr(request, 'parameters'):
        missing = len(request.parameters) - len(response.results)
        response.results += [SetParametersResult(successful=False, reason=reason)] * missing
    elif hasattr(response, 'result') and hasattr(response.result, 'reason'):
        response.result = SetParametersResult(successful=False, reason=reason)


def _raw_message(data: bytes, info: dict[str, Any]) -> RawMessage:
    return RawMessage(
        data,
        int(info['source_timestamp'] or 0),
        int(info['received_timestamp'] or 0),
        int(info['publication_sequence_number'] or 0),
    )
