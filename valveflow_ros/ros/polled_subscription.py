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

from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from rclpy.subscription import Subscription

DEPTH = 1000
# What a user may set from outside as qos_overrides.TOPIC.publisher.depth and the like.
QOS_OVERRIDES = QoSOverridingOptions.with_default_policies()


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
        overrides = None if topic == '/clock' else QOS_OVERRIDES
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        self._subscription = self._node.create_subscription(
            self._type,
            topic,
            self._call_back,
            QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH, reliability=reliability),
            raw=True,
            callback_group=group or MutuallyExclusiveCallbackGroup(),
            qos_overriding_options=overrides,
            # Each event costs the executor time at every look; the rest says nothing of use.
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=lambda _: on_mismatch(self.topic), use_default_callbacks=False
            ),
        )

    def _call_back(self, data: bytes, info: dict[str, Any]) -> None:
        self._waiting.append(_raw_message(data, info))


def answer_request(service: Service) -> bool:
    """Answer the oldest request of a service; return False if there is none."""
    take = getattr(service.handle, 'service_take_request', None)
    request, header = (None, None) if take is None else take(service.srv_type.Request)
    if header is None:
        return False
    response = service.callback(request, service.srv_type.Response())
    service.send_response(response, header)
    return True


def _raw_message(data: bytes, info: dict[str, Any]) -> RawMessage:
    return RawMessage(
        data,
        int(info['source_timestamp'] or 0),
        int(info['received_timestamp'] or 0),
        int(info['publication_sequence_number'] or 0),
    )
