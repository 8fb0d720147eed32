# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Polls subscriptions and services without the executor; the only user of rclpy internals.

An executor spends much more time on selecting callbacks than on the messages. Here the main loop
polls each subscription for raw bytes, with the stamps and the sequence number from the
middleware, and each service for a request.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import CallbackGroup
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
    """

    def __init__(
        self,
        node: Node,
        message_type: type,
        topic: str,
        *,
        reliable: bool = False,
        on_mismatch: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._node = node
        self._type = message_type
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        self._subscription = node.create_subscription(
            message_type,
            topic,
            lambda _: None,
            QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH, reliability=reliability),
            raw=True,
            callback_group=_PolledGroup(),
            qos_overriding_options=qos_overrides(node, topic, 'subscription'),
            # Each event handler costs executor time in every cycle; the others are not used.
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=lambda _: on_mismatch(self.topic), use_default_callbacks=False
            ),
        )
        self._handle = self._subscription.handle
        # Acquired once for the whole time, instead of for every poll.
        self._handle.__enter__()

    @property
    def topic(self) -> str:
        """Return the full name of the topic."""
        return str(self._subscription.topic_name)

    def take(self, most: int = DEPTH) -> list[RawMessage]:
        """Return at most ``most`` messages that have arrived, oldest first."""
        taken: list[RawMessage] = []
        while len(taken) < most and (found := self._handle.take_message(self._type, True)):
            data, info = found
            stamps = (info['source_timestamp'], info['received_timestamp'])
            number = info['publication_sequence_number']
            taken.append(RawMessage(data, *(int(n or 0) for n in (*stamps, number))))
        return taken

    def close(self) -> None:
        """Unsubscribe."""
        self._handle.__exit__(None, None, None)
        self._node.destroy_subscription(self._subscription)


def answer_request(service: Service, failed: Callable[[str], None]) -> bool:
    """Answer the oldest request of a service; return False if there is none.

    If the callback fails, ``failed`` gets a sentence, and the response reports no success.
    """
    request, header = service.handle.service_take_request(service.srv_type.Request)
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
