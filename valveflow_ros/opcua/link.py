# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Client connection to an OPC UA server: subscription, reconnection, history of outages."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from valveflow_ros.errors import DataError, counted
from valveflow_ros.opcua.mapping import UnitMapping
from valveflow_ros.opcua.sampler import Change, Sampler
from valveflow_ros.opcua.session import (
    ANSWER_S,
    HISTORY_PART_NS,
    WORDS,
    change_of,
    connected,
    history,
    in_words,
    read_history,
    resolve,
    to_ns,
)
from valveflow_ros.records import NS_PER_S, Readings

if TYPE_CHECKING:
    from asyncua import Client, ua

FIRST_PAUSE_S = 0.2
# Period in s of the comparison of clocks, and of the search for missing nodes.
_LOOK_S, _NODES_S = 5.0, 30.0
# Maximum number of lost messages that are requested again.
_MOST_REPUBLISHED = 100
_OVERFLOW = 0x480  # StatusCode: info type DataValue, bit Overflow


@dataclass
class LinkState:
    """State of the link for `/diagnostics`; written by its thread, read by any thread.

    Attributes
    ----------
    up, since_s : bool, float
        Whether the link is up, and the monotonic time of the last change.
    problem : str
        Why it is not up; empty before the first attempt.
    attempts, losses : int
        Attempts to connect since it was up, and number of losses.
    lost_messages, republished : int
        Messages missing by their sequence numbers, and those received on request.
    clock_ahead_s : float
        Server's clock minus this machine's clock; NaN if unknown.
    nodes : dict of int to str
        Problem with the node of a signal, by signal.
    backfill : str
        Result of reading the history of the last outage.
    """

    # up, since_s: whether the link is up, and the monotonic time of the last change
    up: bool = False
    since_s: float = field(default_factory=time.monotonic)
    problem: str = ''  # why it is not up; empty before the first attempt
    # attempts, losses: attempts to connect since it was up, and number of losses
    attempts: int = 0
    losses: int = 0
    # lost_messages, republished: messages missing by their sequence numbers, and those received on
    # request
    lost_messages: int = 0
    republished: int = 0
    clock_ahead_s: float = math.nan  # server's clock minus this machine's clock; NaN if unknown
    # Problem with the node of a signal, by signal.
    nodes: dict[int, str] = field(default_factory=dict)
    backfill: str = ''
    overflows: dict[int, int] = field(default_factory=dict)


class Link:
    """Maintains the subscription of a unit while `run` is active.

    ``tell`` is called with functions to apply, in order, to the unit's `Sampler`, which may belong
    to another thread. ``save`` is called in a separate thread with the readings of an outage, in
    parts in time order, and returns a clause about the result.
    """

    def __init__(
        self,
        unit: UnitMapping,
        tell: Callable[[Callable[[Sampler], None]], None],
        save: Callable[[list[Readings]], str] | None = None,
    ) -> None:
        self._unit, self._tell, self._save = unit, tell, save
        self.state = LinkState()
        self._ids: dict[int, ua.NodeId] = {}
        self._by_signal = {int(node.signal): node for node in unit.nodes}
        self._newest_ns: dict[int, int] = {}
        self._confirmed_ns = 0
        self._heard_s = 0.0
        self._sequence = 0
        self._ended = ''  # why the subscription must be created again
        self._session: Any = None
        self._held_back: list[tuple[list[Change], int]] | None = None
        self._outages: list[tuple[int, int]] = []  # whose history is not saved yet

    async def run(self) -> None:
        """Connect, and reconnect after every loss, until the task is cancelled."""
        state, pause_s = self.state, FIRST_PAUSE_S
        while True:
            try:
                async with connected(
                    self._unit.endpoint, self._unit.security, self._unit.user
                ) as client:
                    await self._serve(client)
            except Exception as error:  # noqa: BLE001 - every failure is reported and retried
                state.problem = in_words(error)
            if state.up:
                state.up, state.since_s, pause_s = False, time.monotonic(), FIRST_PAUSE_S
                state.losses += 1
                self._tell(lambda sampler: sampler.lose())
            state.attempts += 1
            await asyncio.sleep(pause_s)
            pause_s = min(2.0 * pause_s, self._unit.reconnect_longest_s)

    async def _serve(self, client: Client) -> None:
        state = self.state
        gap_from_ns = self._confirmed_ns
        self._held_back = []
        silence_s = await self._subscribe(client)
        saving: asyncio.Task[None] | None = None
        now_ns = time.time_ns()
        if gap_from_ns:
            found = await self._gap(client, gap_from_ns, now_ns)
            self._tell(lambda sampler: sampler.restore(found, now_ns))
        self._tell(lambda sampler: sampler.keep_alive(silence_s))
        held_back, self._held_back = self._held_back, None
        for changes, confirmed_ns in held_back:
            self._give(changes, confirmed_ns)
        state.up, state.since_s, state.attempts, state.problem = True, time.monotonic(), 0, ''
        away_ns = now_ns - gap_from_ns if gap_from_ns else 0
        if self._save is not None and away_ns > self._unit.lateness_ns:
            self._outages.append((gap_from_ns, now_ns))
        if self._outages:
            saving = asyncio.create_task(self._backfill(client))
        try:
            await self._watch(client, 3.0 * silence_s + ANSWER_S)
        finally:
            if saving is not None:
                saving.cancel()

    async def _subscribe(self, client: Client) -> float:
        """Create the subscription; return the longest silence of the server in s."""
        from asyncua import ua

        unit = self._unit
        wanted = ua.CreateSubscriptionParameters(
            RequestedPublishingInterval=1000.0 * unit.publishing_interval_s,
            RequestedLifetimeCount=max(30, math.ceil(60.0 / unit.publishing_interval_s)),
            # With 1, the server sends a keep-alive in each interval without changes.
            RequestedMaxKeepAliveCount=1,
            MaxNotificationsPerPublish=10_000,
            PublishingEnabled=True,
        )
        self._sequence, self._heard_s, self._ended = 0, time.monotonic(), ''
        session = self._session = client.uaclient.session

        async def published(result: ua.PublishResult) -> None:
            # An old session that could not be closed may still send messages.
            if session is self._session:
                await self._published(result, session)

        made = await session.create_subscription(wanted, published)
        self.state.nodes.clear()
        await self._monitor(client, made.SubscriptionId, list(self._by_signal))
        self._subscription = made.SubscriptionId
        return float(made.RevisedPublishingInterval * max(1, made.RevisedMaxKeepAliveCount)) / 1e3

    async def _monitor(self, client: Client, subscription: int, signals: list[int]) -> None:
        """Let the server monitor nodes; refused nodes are reported, the others are used."""
        from asyncua import ua

        def request(signal: int, dead_band: bool) -> ua.MonitoredItemCreateRequest:
            node = self._by_signal[signal]
            wanted = ua.MonitoringParameters(
                ClientHandle=signal,
                SamplingInterval=1000.0 * self._unit.sampling_interval_s,
                QueueSize=self._unit.queue_size,
                DiscardOldest=True,
            )
            if dead_band and node.dead_band:
                wanted.Filter = ua.DataChangeFilter(
                    Trigger=ua.DataChangeTrigger.StatusValue,
                    DeadbandType=int(ua.DeadbandType.Absolute),
                    DeadbandValue=node.dead_band,
                )
            return ua.MonitoredItemCreateRequest(
                ItemToMonitor=ua.ReadValueId(self._ids[signal], ua.AttributeIds.Value),
                MonitoringMode=ua.MonitoringMode.Reporting,
                RequestedParameters=wanted,
            )

        known, state = [], self.state
        for signal in signals:
            try:
                self._ids[signal] = await resolve(client, self._by_signal[signal])
                known.append(signal)
            except DataError as error:
                state.nodes[signal] = str(error).rstrip('.')
        for dead_band in (True, False):
            if not known:
                return
            results = await client.uaclient.session.create_monitored_items(
                ua.CreateMonitoredItemsParameters(
                    SubscriptionId=subscription,
                    TimestampsToReturn=ua.TimestampsToReturn.Both,
                    ItemsToCreate=[request(signal, dead_band) for signal in known],
                )
            )
            again = []
            for signal, result in zip(known, results, strict=True):
                name = result.StatusCode.name
                if result.StatusCode.is_good():
                    state.nodes.pop(signal, None)
                elif dead_band and 'Filter' in name:  # no dead band supported for this node
                    again.append(signal)
                else:
                    node = self._by_signal[signal].node
                    state.nodes[signal] = f'node {node}: {WORDS.get(name, "refused")} ({name})'
            known = again

    async def _published(self, result: ua.PublishResult, session: Any) -> None:
        """Process a message of the server; request missing messages before it again."""
        from asyncua import ua

        now_ns, message = time.time_ns(), result.NotificationMessage
        if any(isinstance(n, ua.StatusChangeNotification) for n in message.NotificationData or ()):
            # The server has ended the subscription, or asyncua reports a lost link in this way.
            # Neither confirms a time. Later messages of this session are ignored.
            self._session, self._ended = None, 'the server has ended the subscription'
            return
        self._heard_s = time.monotonic()
        number = int(message.SequenceNumber)
        expected = self._sequence % 0xFFFFFFFF + 1
        lost = max(0, number - expected - _MOST_REPUBLISHED)
        for missing in range(expected, min(number, expected + _MOST_REPUBLISHED)):
            try:
                again = await session.republish(result.SubscriptionId, missing)
                if not again.NotificationData:
                    raise DataError('It is empty.')
                self.state.republished += 1
                self._deliver(again.NotificationData, now_ns, self._confirmed_ns)
            except Exception:  # noqa: BLE001 - after any failure the message is lost
                lost += 1
        if lost:
            # The lost changes are unknown; a new subscription begins with all current values.
            self.state.lost_messages += lost
            self._session, self._ended = None, 'a message of the server was lost'
            return
        # A keep-alive has no values; its number is that of the next message with values.
        self._sequence = number if message.NotificationData else max(self._sequence, number - 1)
        # If the server has more notifications, the changes up to now are not complete.
        confirmed_ns = self._confirmed_ns if result.MoreNotifications else now_ns
        self._deliver(message.NotificationData or [], now_ns, confirmed_ns)

    def _deliver(self, notifications: Iterable[Any], now_ns: int, confirmed_ns: int) -> None:
        from asyncua import ua

        changes = []
        for notification in notifications:
            if not isinstance(notification, ua.DataChangeNotification):
                continue
            for item in notification.MonitoredItems:
                node = self._by_signal.get(item.ClientHandle)
                if node is None:
                    continue
                change = change_of(node, item.Value, now_ns)
                status = item.Value.StatusCode
                if status is not None and status.value & _OVERFLOW == _OVERFLOW:
                    lost = self.state.overflows
                    lost[change.signal] = lost.get(change.signal, 0) + 1
                changes.append(change)
        if self._held_back is not None:
            self._held_back.append((changes, confirmed_ns))
        else:
            self._give(changes, confirmed_ns)

    def _give(self, changes: list[Change], confirmed_ns: int) -> None:
        self._newest_ns.update((change.signal, change.source_ns) for change in changes)
        self._confirmed_ns = confirmed_ns
        self._tell(lambda sampler: sampler.take(changes, confirmed_ns))

    async def _watch(self, client: Client, longest_silence_s: float) -> None:
        """Raise when the link is lost; compare the clocks and look for missing nodes meanwhile."""
        from asyncua.client.ua_client import UaClientState

        looked_s = nodes_s = -_NODES_S
        while True:
            now_s = time.monotonic()
            if client.state is not UaClientState.CONNECTED:
                raise ConnectionError
            if self._ended:
                raise DataError(self._ended)
            if now_s - self._heard_s > longest_silence_s:
                raise DataError(f'the server was silent for {longest_silence_s:.0f} s')
            if now_s - looked_s > _LOOK_S:
                looked_s = now_s
                await self._compare_clocks(client)
            if now_s - nodes_s > _NODES_S:
                nodes_s = now_s
                if self.state.nodes:
                    await self._monitor(client, self._subscription, list(self.state.nodes))
            await asyncio.sleep(0.1)

    async def _compare_clocks(self, client: Client) -> None:
        from asyncua import ua

        node = client.get_node(ua.ObjectIds.Server_ServerStatus_CurrentTime)
        begun_ns = time.time_ns()
        server_ns = to_ns(await asyncio.wait_for(node.read_value(), ANSWER_S))
        middle_ns = (begun_ns + time.time_ns()) // 2
        self.state.clock_ahead_s = (server_ns - middle_ns) / NS_PER_S

    async def _gap(self, client: Client, gap_from_ns: int, now_ns: int) -> list[Change]:
        """Return the history of a gap, or of its last hour, as far as the server has it.

        Each signal begins with its last value before the gap, so that an unchanged signal has a
        value, too.
        """
        found: list[Change] = []
        for signal, node_id in self._ids.items():
            if signal in self.state.nodes:
                continue  # not monitored, so later changes would not arrive
            start_ns = max(self._newest_ns.get(signal, gap_from_ns), now_ns - HISTORY_PART_NS)
            with contextlib.suppress(Exception):  # without a history the gap stays bad
                node = self._by_signal[signal]
                found += await asyncio.wait_for(
                    read_history(client, node, node_id, start_ns, now_ns), ANSWER_S
                )
        return found

    async def _backfill(self, client: Client) -> None:
        """Read and save the history of outages; an interrupted one is read again later."""
        assert self._save is not None
        while self._outages:
            start_ns, end_ns = self._outages[0]
            told = counted(round((end_ns - start_ns) / NS_PER_S), 'second')
            nodes = [n for n in self._unit.nodes if int(n.signal) not in self.state.nodes]
            try:
                parts = [
                    part async for part in history(client, nodes, start_ns, end_ns) if len(part)
                ]
                saved = await asyncio.to_thread(self._save, parts) if parts else 'it has none'
            except Exception as error:  # noqa: BLE001 - every failure is reported
                saved = in_words(error)
                try:
                    await self._compare_clocks(client)
                except Exception:  # noqa: BLE001 - the link failed, not the history
                    return
            self._outages.pop(0)
            self.state.backfill = f'history of the last outage ({told}): {saved}'
