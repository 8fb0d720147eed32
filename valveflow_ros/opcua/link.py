# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A link to an OPC UA server: session, subscription, reconnection, history. Knows asyncua."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import AsyncIterator, Callable, Iterable
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta, timezone
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from valveflow_ros.errors import DataError, RecordingError, ValveflowError, counted
from valveflow_ros.opcua.mapping import Node, Security, UnitMapping, User
from valveflow_ros.opcua.sampler import Change, Sampler
from valveflow_ros.records import NS_PER_S, SIGNALS, Quality, Readings

if TYPE_CHECKING:
    from asyncua import Client, ua
    from cryptography.x509 import Certificate

EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
# An answer is waited for so long; a server that keeps silent for longer is gone.
ANSWER_S = 4.0
FIRST_PAUSE_S = 0.2
# The clocks are compared, and nodes that were not there looked for, every so many seconds.
_LOOK_S, _NODES_S = 5.0, 30.0
# Values of so much time are read from a history at once: each takes about a kilobyte meanwhile.
HISTORY_PART_NS = 3600 * NS_PER_S
# So many messages that were lost on the way are asked for again.
_MOST_REPUBLISHED = 100
_OVERFLOW = 0x480  # StatusCode: info type DataValue, bit Overflow
_REFUSED_CERTIFICATE = 'the server does not accept the certificate of the gateway'
_WORDS = {
    'BadCertificateTimeInvalid': f'{_REFUSED_CERTIFICATE}: it has expired or is not valid yet',
    'BadCertificateUntrusted': f'{_REFUSED_CERTIFICATE}: it must be trusted there first',
    'BadSecurityChecksFailed': f'{_REFUSED_CERTIFICATE}: it must be trusted there first',
    'BadIdentityTokenRejected': 'the server does not accept the user',
    'BadIdentityTokenInvalid': 'the server does not accept the user',
    'BadUserAccessDenied': 'the server does not accept the user, or he may not read',
    'BadSecurityPolicyRejected': 'the server does not offer this security policy',
    'BadNodeIdUnknown': 'the server has no such node',
    'BadNodeIdInvalid': 'the server has no such node',
    'BadTooManySessions': 'the server has as many sessions as it allows',
}


def check_installed() -> None:
    """Return if asyncua is there; raises `DataError`."""
    if find_spec('asyncua') is None:
        raise DataError('OPC UA needs asyncua, not installed here: pip install asyncua.')
    # It logs each lost link with a traceback; what matters is told in sentences.
    log = logging.getLogger('asyncua')
    log.addHandler(logging.NullHandler())
    log.propagate = False


def to_ns(moment: datetime | None) -> int:
    """Return a time in ns since the epoch, 0 for none or one before it."""
    if moment is None:
        return 0
    aware = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
    return max(0, (aware - EPOCH) // timedelta(microseconds=1) * 1000)


def to_datetime(time_ns: int) -> datetime:
    """Return a time as OPC UA takes it, in UTC."""
    return EPOCH + timedelta(microseconds=time_ns // 1000)


def change_of(node: Node, data: ua.DataValue, received_ns: int) -> Change:
    """Return a value of the server as a change in the monitor's unit."""
    status = data.StatusCode.value if data.StatusCode is not None else 0
    quality = (Quality.GOOD, Quality.UNCERTAIN, Quality.BAD, Quality.BAD)[status >> 30]
    value = data.Value.Value if data.Value is not None else None
    number, problem = math.nan, ''
    if isinstance(value, int | float) and not isinstance(value, bool):
        number = value * node.unit.scale + node.unit.offset
        problem = '' if math.isfinite(number) or quality == Quality.BAD else 'not_finite'
    elif quality != Quality.BAD:
        problem = 'wrong_type'
    if problem:
        quality = Quality.BAD
    source_ns = to_ns(data.SourceTimestamp or data.ServerTimestamp)
    return Change(int(node.signal), source_ns, received_ns, number, int(quality), problem)


def in_words(error: BaseException) -> str:
    """Return why a link failed, without a period at its end."""
    if isinstance(error, ValveflowError):
        return str(error).rstrip('.')
    name = type(error).__name__
    if isinstance(error, ConnectionRefusedError):
        return 'nobody listens there'
    if isinstance(error, asyncio.TimeoutError | TimeoutError):
        return f'no answer within {ANSWER_S:g} s'
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    if 'No matching endpoints' in str(error):
        return 'the server does not offer this security policy and mode'
    if 'certificate mismatch' in str(error) or name == 'InvalidSignature':
        return "the server does not have the certificate named as 'trusted'"
    if name in ('ConnectionError', 'ConnectionResetError', 'IncompleteReadError'):
        return 'the server has closed the link'
    told = _WORDS.get(name, '')
    return f'{told} ({name})' if told else f'{name}: {" ".join(str(error).split())[:120]}'


def load_certificate(path: Path) -> Certificate:
    """Return a certificate that is valid now.

    Raises
    ------
    RecordingError
        It cannot be read, or its time is over or has not come.
    """
    from cryptography import x509

    try:
        data = path.read_bytes()
        pem = data.lstrip().startswith(b'-----')
        found = (
            x509.load_pem_x509_certificate(data) if pem else x509.load_der_x509_certificate(data)
        )
    except (OSError, ValueError):
        raise RecordingError(path, 'is no certificate that can be read') from None
    now = datetime.now(timezone.utc)
    if found.not_valid_after_utc < now:
        raise RecordingError(path, f'expired on {found.not_valid_after_utc:%Y-%m-%d}')
    if found.not_valid_before_utc > now:
        raise RecordingError(path, f'is not valid before {found.not_valid_before_utc:%Y-%m-%d}')
    return found


def uri_of(certificate: Certificate) -> str:
    """Return the application URI of a certificate, empty if it names none."""
    from cryptography import x509

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ''
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), '')


async def load_key(path: Path, certificate: Certificate) -> Any:
    """Return the private key of a certificate; raises `RecordingError`."""
    from asyncua.crypto import uacrypto

    try:
        key = await uacrypto.load_private_key(path)
    except (OSError, ValueError, TypeError):
        raise RecordingError(path, 'is no private key that can be read') from None
    if key.public_key() != certificate.public_key():
        raise RecordingError(path, 'is not the key of the certificate beside it')
    return key


@contextlib.asynccontextmanager
async def connected(endpoint: str, security: Security, user: User) -> AsyncIterator[Client]:
    """Open a session, and close it at the end.

    Raises
    ------
    ValveflowError
        A certificate or key cannot be used, or has expired.
    Exception
        Whatever asyncua raises where the server cannot be reached or refuses; see `in_words`.
    """
    from asyncua import Client
    from asyncua.crypto import security_policies
    from asyncua.ua import MessageSecurityMode

    client = Client(endpoint, timeout=ANSWER_S, watchdog_intervall=ANSWER_S)
    client.name = client.description = 'valveflow'
    client.session_timeout = 60_000
    if not security.none:
        assert security.certificate is not None
        assert security.private_key is not None
        own = load_certificate(security.certificate)
        trusted = [load_certificate(path) for path in security.trusted]
        client.application_uri = uri_of(own) or client.application_uri
        key = await load_key(security.private_key, own)
        policy = getattr(security_policies, f'SecurityPolicy{security.policy}')
        client.security_policy = policy(
            trusted[0], own, key, getattr(MessageSecurityMode, security.mode)
        )
        client.uaclient.set_security(client.security_policy)
    if user.name:
        client.set_user(user.name)
        client.set_password(user.password)
    elif user.certificate is not None:
        assert user.private_key is not None
        client.user_certificate = load_certificate(user.certificate)
        client.user_private_key = await load_key(user.private_key, client.user_certificate)
    try:
        await asyncio.wait_for(client.connect(), 4.0 * ANSWER_S)
    except asyncio.TimeoutError:
        if security.none:
            raise
        # So servers act to whom the first encrypted message means nothing.
        raise DataError(
            f'no answer within {ANSWER_S:g} s: the server does not offer this policy, does not '
            "accept the certificate, or does not have the one named as 'trusted'"
        ) from None
    try:
        yield client
    finally:
        with contextlib.suppress(Exception, asyncio.CancelledError):
            await asyncio.wait_for(client.disconnect(), ANSWER_S)


async def resolve(client: Client, node: Node) -> ua.NodeId:
    """Return the id of a node; a namespace given by its URI is looked up on the server.

    Raises
    ------
    DataError
        The server does not know the namespace, or the id is of no known form.
    """
    from asyncua import ua

    text = node.node
    topic = SIGNALS[node.signal].topic
    if text.startswith('nsu='):
        uri, _, rest = text[4:].partition(';')
        try:
            text = f'ns={await client.get_namespace_index(uri)};{rest}'
        except ValueError:
            raise DataError(f"{topic}: the server has no namespace '{uri}'.") from None
    try:
        return ua.NodeId.from_string(text)
    except (ua.UaError, ValueError):
        raise DataError(f"{topic}: '{node.node}' is no node id.") from None


async def read_history(
    client: Client, node: Node, node_id: ua.NodeId, start_ns: int, end_ns: int
) -> list[Change]:
    """Return the values of a node's history in the order of time, ends included.

    Raises
    ------
    Exception
        The server has none, or cannot be reached; see `in_words`.
    """
    values = await client.get_node(node_id).read_raw_history(
        to_datetime(start_ns), to_datetime(end_ns), return_bounds=False
    )
    changes = [change_of(node, value, end_ns) for value in values]
    return sorted(change for change in changes if start_ns <= change.source_ns <= end_ns)


def readings_of(changes: Iterable[Change]) -> Readings:
    """Return changes as readings in the order of time; bad ones are NaN."""
    rows = sorted((c.source_ns, c.signal, c.value, c.quality) for c in changes)
    found = Readings.of([(t, s, v, q) for t, s, v, q in rows])
    return replace(found, value=np.where(found.quality == Quality.BAD, np.nan, found.value))


@dataclass
class LinkState:
    """How the link is, for `/diagnostics`; written by the link's thread, read by any.

    Attributes
    ----------
    up, since_s : bool, float
        Whether it is up, and since when by a clock that never goes back.
    problem : str
        Why it is not up, empty before the first attempt.
    attempts, losses : int
        Attempts since it was up, and how often it was lost.
    lost_messages, republished : int
        Messages of the server that are missing in its numbering, and those sent again.
    clock_ahead_s : float
        How far the server's clock is ahead of this machine's; NaN: not known.
    nodes : dict of int to str
        Problem of a signal's node, by signal.
    backfill : str
        What came of the last outage's history.
    """

    up: bool = False
    since_s: float = field(default_factory=time.monotonic)
    problem: str = ''
    attempts: int = 0
    losses: int = 0
    lost_messages: int = 0
    republished: int = 0
    clock_ahead_s: float = math.nan
    nodes: dict[int, str] = field(default_factory=dict)
    backfill: str = ''
    overflows: dict[int, int] = field(default_factory=dict)


class Link:
    """Keeps a unit's subscription alive for as long as it runs.

    Parameters
    ----------
    unit : UnitMapping
    tell : callable
        Takes, in order, what is to be done with the unit's `Sampler`, which may live in another
        thread.
    save : callable, optional
        Is called with the readings of an outage, part by part in the order of time, in a thread of
        its own; returns what to tell of it.
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
        self._held_back: list[tuple[list[Change], int]] | None = None

    async def run(self) -> None:
        """Connect, and connect again after every loss, until it is cancelled."""
        state, pause_s = self.state, FIRST_PAUSE_S
        while True:
            try:
                async with connected(
                    self._unit.endpoint, self._unit.security, self._unit.user
                ) as client:
                    await self._serve(client)
            except Exception as error:  # noqa: BLE001 - whatever it was: told, and tried again
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
            saving = asyncio.create_task(self._backfill(client, gap_from_ns, now_ns))
        try:
            await self._watch(client, 3.0 * silence_s + ANSWER_S)
        finally:
            if saving is not None:
                saving.cancel()

    async def _subscribe(self, client: Client) -> float:
        """Make the subscription; return how long the server may be silent, in s."""
        from asyncua import ua

        unit = self._unit
        wanted = ua.CreateSubscriptionParameters(
            RequestedPublishingInterval=1000.0 * unit.publishing_interval_s,
            RequestedLifetimeCount=max(30, math.ceil(60.0 / unit.publishing_interval_s)),
            # With 1, the server confirms each interval that nothing changed.
            RequestedMaxKeepAliveCount=1,
            MaxNotificationsPerPublish=10_000,
            PublishingEnabled=True,
        )
        self._sequence, self._heard_s = 0, time.monotonic()
        session = client.uaclient.session

        async def published(result: ua.PublishResult) -> None:
            await self._published(result, session)

        made = await session.create_subscription(wanted, published)
        self.state.nodes.clear()
        await self._monitor(client, made.SubscriptionId, list(self._by_signal))
        self._subscription = made.SubscriptionId
        return float(made.RevisedPublishingInterval * max(1, made.RevisedMaxKeepAliveCount)) / 1e3

    async def _monitor(self, client: Client, subscription: int, signals: list[int]) -> None:
        """Let the server monitor nodes; what it refuses is told, and the others go on."""
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
                elif dead_band and 'Filter' in name:  # it has no dead bands for this node
                    again.append(signal)
                else:
                    node = self._by_signal[signal].node
                    state.nodes[signal] = f'node {node}: {_WORDS.get(name, "refused")} ({name})'
            known = again

    async def _published(self, result: ua.PublishResult, session: Any) -> None:
        """Take a message of the server; those missing before it are asked for again."""
        now_ns, message = time.time_ns(), result.NotificationMessage
        self._heard_s = time.monotonic()
        number = int(message.SequenceNumber)
        expected = self._sequence % 0xFFFFFFFF + 1
        for missing in range(expected, min(number, expected + _MOST_REPUBLISHED)):
            try:
                again = await session.republish(result.SubscriptionId, missing)
                if not again.NotificationData:
                    raise DataError('It is empty.')
                self.state.republished += 1
                self._deliver(again.NotificationData, now_ns)
            except Exception:  # noqa: BLE001 - it is lost, whatever the server said
                self.state.lost_messages += 1
        # A message without values, a keep-alive, has the number of the next one with values.
        self._sequence = number if message.NotificationData else max(self._sequence, number - 1)
        self._deliver(message.NotificationData or [], now_ns)

    def _deliver(self, notifications: Iterable[Any], now_ns: int) -> None:
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
            self._held_back.append((changes, now_ns))
        else:
            self._give(changes, now_ns)

    def _give(self, changes: list[Change], confirmed_ns: int) -> None:
        self._newest_ns.update((change.signal, change.source_ns) for change in changes)
        self._confirmed_ns = confirmed_ns
        self._tell(lambda sampler: sampler.take(changes, confirmed_ns))

    async def _watch(self, client: Client, longest_silence_s: float) -> None:
        """Return or raise when the link is lost."""
        from asyncua.client.ua_client import UaClientState

        looked_s = nodes_s = -_NODES_S
        while True:
            now_s = time.monotonic()
            if client.state is not UaClientState.CONNECTED:
                raise ConnectionError
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
        """Return the history of a gap, or of its end, as far as the server has one.

        Each signal begins at its last value from before, so that one which did not change since
        has a value too.
        """
        found: list[Change] = []
        for signal, node_id in self._ids.items():
            start_ns = max(self._newest_ns.get(signal, gap_from_ns), now_ns - HISTORY_PART_NS)
            with contextlib.suppress(Exception):  # it has none: the gap stays bad
                node = self._by_signal[signal]
                found += await asyncio.wait_for(
                    read_history(client, node, node_id, start_ns, now_ns), ANSWER_S
                )
        return found

    async def _backfill(self, client: Client, start_ns: int, end_ns: int) -> None:
        """Read the history of an outage and have it saved."""
        told = counted(round((end_ns - start_ns) / NS_PER_S), 'second')
        try:
            parts = [
                part
                async for part in history(client, self._unit.nodes, start_ns, end_ns)
                if len(part)
            ]
            assert self._save is not None
            saved = await asyncio.to_thread(self._save, parts) if parts else 'it has none'
        except Exception as error:  # noqa: BLE001 - whatever it was is told
            saved = in_words(error)
        self.state.backfill = f'history of the last outage ({told}): {saved}'


async def history(
    client: Client, nodes: Iterable[Node], start_ns: int, end_ns: int
) -> AsyncIterator[Readings]:
    """Yield the history of nodes in parts of an hour, ends included once.

    Raises
    ------
    DataError
        A node is not there.
    Exception
        The server has no history, or cannot be reached; see `in_words`.
    """
    ids = [(node, await resolve(client, node)) for node in nodes]
    for part_ns in range(start_ns, end_ns, HISTORY_PART_NS):
        last_ns = min(part_ns + HISTORY_PART_NS, end_ns) - 1000
        changes: list[Change] = []
        for node, node_id in ids:
            try:
                changes += await read_history(client, node, node_id, part_ns, last_ns)
            except Exception as error:  # noqa: BLE001 - with the name of the signal
                raise DataError(
                    f'{SIGNALS[node.signal].topic}, {node.node}: {in_words(error)}.'
                ) from None
        yield readings_of(changes)
