# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Polls subscriptions and services without the executor; the only user of rclpy internals.

An executor spends much more time on selecting callbacks than on the messages. Here the main loop
polls each subscription for raw bytes, with the stamps and the sequence number from the
middleware, and each service for a request. If this version of rclpy does not support polling, the
executor calls back instead.
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
    """Return the QoS overrides that the user set, such as qos_overrides.TOPIC.publisher.depth.

    rclpy declares a parameter for each policy in the result, so policies not set are left out.
    """
    before = f'qos_overrides.{node.resolve_topic_name(topic)}.{entity}.'
    given = getattr(node, '_parameter_overrides', {})
    kinds = [kind for kind in _POLICIES if f'{before}{kind.name.lower()}' in given]
    return QoSOverridingOptions(kinds) if kinds else None


class RawMessage(NamedTuple):
    """A message as delivered by the middleware; stamps in ns, 0 if there is none."""

    data: bytes
    source_ns: int
    received_ns: int
    sequence: int


class _PolledGroup(CallbackGroup):
    """Callback group that excludes subscriptions from the executor, but not their events."""

    def can_execute(self, entity: Any) -> bool:
        """Return False for a subscription."""
        return not isinstance(entity, Subscription)

    def beginning_execution(self, entity: Any) -> bool:
        """Return the same as `can_execute`."""
        return self.can_execute(entity)

    def ending_execution(self, entity: Any) -> None:
        """Do nothing, because `can_execute` has no state."""


def can_poll(subscription: Subscription) -> bool:
    """Return True if this version of rclpy supports polling."""
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
        True to request reliable delivery; a best-effort subscription matches every publisher.
    on_mismatch : callable
        Called with the topic when the QoS of a publisher is incompatible.
    polled : bool
        False to let the executor call back even if polling is possible.
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
        # Acquired once for the whole time, instead of for every poll.
        self._handle.__enter__()

    @property
    def topic(self) -> str:
        """Return the full name of the topic."""
        return str(self._subscription.topic_name)

    @property
    def polled(self) -> bool:
        """Return True if messages are polled, False if the executor calls back."""
        return self._polled

    def take(self, most: int = DEPTH) -> list[RawMessage]:
        """Return at most ``most`` messages that have arrived, oldest first."""
        if not self._polled:
            return [self._waiting.popleft() for _ in range(min(most, len(self._waiting)))]
        taken: list[RawMessage] = []
        while len(taken) < most and (found := self._take_message(self._type, True)) is not None:
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
            # Each event handler costs executor time in every cycle; the others are not used.
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=lambda _: on_mismatch(self.topic), use_default_callbacks=False
            ),
        )

    def _call_back(self, data: bytes, info: dict[str, Any]) -> None:
        self._waiting.append(_raw_message(data, info))


def answer_request(service: Service, failed: Callable[[str], None]) -> bool:
    """Answer the oldest request of a service; return False if there is none.

    If the callback fails, ``failed`` gets a sentence, and the response reports no success.
    """
    take = getattr(service.handle, 'service_take_request', None)
    request, header = (None, None) if take is None else take(service.srv_type.Request)
    if header is None:
        return False
    response = service.srv_type.Response()
    try:
        response = service.callback(request, response)
    except Exception as error:  # noqa: BLE001 - no request may end the monitor
        failed(f'{service.service_name} was asked what it cannot do: {with_place(error)}')
        _refuse(request, response, f'This cannot be done ({one_line(error)}).')
    service.send_response(response, header)
    return True


def _refuse(request: Any, response: Any, reason: str) -> None:
    """Set the reason of a refusal if the response has a field for it, for each parameter."""
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
