# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A session with an OPC UA server: certificates, values, history, error messages."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import AsyncIterator, Awaitable, Iterable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from valveflow_ros.errors import DataError, RecordingError, ValveflowError
from valveflow_ros.opcua.mapping import Node, Security, UnitMapping, User
from valveflow_ros.opcua.sampler import Change
from valveflow_ros.records import NS_PER_S, SIGNALS, Quality, Readings, Signal

if TYPE_CHECKING:
    from asyncua import Client, ua
    from cryptography.x509 import Certificate

EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
# Maximum wait for a response; a server that is silent for longer is considered lost.
ANSWER_S = 4.0
# Duration of history that is read at once; a value needs about 1 kB of memory meanwhile.
HISTORY_PART_NS = 3600 * NS_PER_S
_REFUSED_CERTIFICATE = 'the server does not accept the certificate of the gateway'
WORDS = {
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
    """Check that asyncua is installed and silence its log; raises `DataError` if it is not."""
    if find_spec('asyncua') is None:
        raise DataError('OPC UA needs asyncua, not installed here: pip install asyncua.')
    # It logs each lost link with a traceback; we report such errors in sentences.
    log = logging.getLogger('asyncua')
    log.addHandler(logging.NullHandler())
    log.propagate = False


def to_ns(moment: datetime | None) -> int:
    """Return a time in ns since the epoch; 0 for None or a time before the epoch."""
    if moment is None:
        return 0
    aware = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
    return max(0, (aware - EPOCH) // timedelta(microseconds=1) * 1000)


def to_datetime(time_ns: int) -> datetime:
    """Return a time in ns as the datetime in UTC that OPC UA needs."""
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
    """Return the reason of a failed connection, without a final period."""
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
    told = WORDS.get(name, '')
    return f'{told} ({name})' if told else f'{name}: {" ".join(str(error).split())[:120]}'


def read_certificate(path: Path) -> Certificate:
    """Return a certificate, valid now or not; raises `RecordingError` if it cannot be read."""
    from cryptography import x509

    try:
        data = path.read_bytes()
        pem = data.lstrip().startswith(b'-----')
        return (
            x509.load_pem_x509_certificate(data) if pem else x509.load_der_x509_certificate(data)
        )
    except (OSError, ValueError):
        raise RecordingError(path, 'is no certificate that can be read') from None


def load_certificate(path: Path) -> Certificate:
    """Return a certificate that is valid now; raises `RecordingError` if there is none."""
    found = read_certificate(path)
    if problem := not_valid(found):
        raise RecordingError(path, problem)
    return found


def not_valid(certificate: Certificate) -> str:
    """Return why a certificate is not valid now; empty if it is."""
    now = datetime.now(timezone.utc)
    if certificate.not_valid_after_utc < now:
        return f'expired on {certificate.not_valid_after_utc:%Y-%m-%d}'
    if certificate.not_valid_before_utc > now:
        return f'is not valid before {certificate.not_valid_before_utc:%Y-%m-%d}'
    return ''


async def _server_certificate(endpoint: str, trusted: Sequence[Path]) -> Certificate:
    """Return the trusted certificate that the server has and that is valid now.

    With several trusted certificates, the server is asked for its own one. The response is not
    protected, so it only selects one of the trusted certificates.

    Raises `RecordingError` if it is not valid now or cannot be read, and `DataError` if the server
    has none of them.
    """
    from asyncua import Client
    from cryptography.hazmat.primitives.serialization import Encoding

    if len(trusted) == 1:
        return load_certificate(trusted[0])
    asking = Client(endpoint, timeout=ANSWER_S)
    told = await asyncio.wait_for(asking.connect_and_get_server_endpoints(), 2.0 * ANSWER_S)
    theirs = {bytes(e.ServerCertificate) for e in told if e.ServerCertificate}
    unreadable: RecordingError | None = None
    for path in trusted:
        try:
            own = read_certificate(path).public_bytes(Encoding.DER)
        except RecordingError as error:
            unreadable = error
            continue
        # A server may send its certificate chain, which begins with its own certificate.
        if any(chain.startswith(own) for chain in theirs):
            return load_certificate(path)
    if unreadable is not None:  # it may be that of the server
        raise unreadable
    raise DataError("The server has none of the certificates named as 'trusted'.")


def uri_of(certificate: Certificate) -> str:
    """Return the application URI of a certificate; empty if it has none."""
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

    Raises `ValveflowError` if a certificate or key cannot be used, or has expired. Any
    exception of asyncua is passed on if the server cannot be reached or refuses; see `in_words`.
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
        trusted = await _server_certificate(endpoint, security.trusted)
        client.application_uri = uri_of(own) or client.application_uri
        key = await load_key(security.private_key, own)
        policy = getattr(security_policies, f'SecurityPolicy{security.policy}')
        client.security_policy = policy(
            trusted, own, key, getattr(MessageSecurityMode, security.mode)
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
        # Servers do not respond if they cannot decrypt the first message.
        raise DataError(
            f'no answer within {ANSWER_S:g} s: the server does not offer this policy, does not '
            "accept the certificate, or does not have the one named as 'trusted'"
        ) from None
    try:
        yield client
    finally:
        with contextlib.suppress(Exception, asyncio.CancelledError):
            await asyncio.wait_for(client.disconnect(), ANSWER_S)
        client.disconnect_socket()


async def resolve(client: Client, node: Node) -> ua.NodeId:
    """Return the id of a node; a namespace given by its URI is looked up on the server.

    Raises `DataError` if the server does not know it, or the id has no valid form.
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
    """Return the history of a node in time order, including both end points.

    Raises whatever asyncua raises if there is none or no link; see `in_words`.
    """
    values = await client.get_node(node_id).read_raw_history(
        to_datetime(start_ns), to_datetime(end_ns), return_bounds=False
    )
    changes = [change_of(node, value, end_ns) for value in values]
    return sorted(change for change in changes if start_ns <= change.source_ns <= end_ns)


def readings_of(changes: Iterable[Change]) -> Readings:
    """Return changes as readings in time order; bad values are NaN."""
    rows = sorted((c.source_ns, c.signal, c.value, c.quality) for c in changes)
    found = Readings.of([(t, s, v, q) for t, s, v, q in rows])
    return replace(found, value=np.where(found.quality == Quality.BAD, np.nan, found.value))


async def history(
    client: Client, nodes: Iterable[Node], start_ns: int, end_ns: int
) -> AsyncIterator[Readings]:
    """Yield the history of nodes in parts of an hour; ``end_ns`` itself is excluded.

    Raises `DataError` if a node does not exist, or has no history that can be read, and whatever
    asyncua raises if the server cannot be reached; see `in_words`.
    """
    ids = [(node, await resolve(client, node)) for node in nodes]
    for node, node_id in ids:  # servers may return an empty history for a missing node
        await _named(node, client.get_node(node_id).read_node_class())
    for part_ns in range(start_ns, end_ns, HISTORY_PART_NS):
        last_ns = min(part_ns + HISTORY_PART_NS, end_ns) - 1000
        changes: list[Change] = []
        for node, node_id in ids:
            changes += await _named(node, read_history(client, node, node_id, part_ns, last_ns))
        yield readings_of(changes)


async def _named(node: Node, work: Awaitable[Any]) -> Any:
    """Return a result; a failure names the signal."""
    try:
        return await work
    except Exception as error:  # noqa: BLE001 - with the name of the signal
        topic = SIGNALS[node.signal].topic
        raise DataError(f'{topic}, {node.node}: {in_words(error)}.') from None


def _called(node: Node) -> str:
    """Return a node's id with the conversion of its value to the monitor's unit."""
    scale, offset = node.unit.scale, node.unit.offset
    words = f' times {scale:g}' if scale != 1.0 else ''
    return node.node + words + (f' plus {offset:g}' if offset else '')


class OpcUaHistory:
    """The history of a unit's nodes, as a source for `valveflow import`.

    ``endpoint`` replaces that of the unit.
    """

    def __init__(self, unit: UnitMapping, endpoint: str) -> None:
        self._unit, self._endpoint = unit, endpoint
        self.name = endpoint
        self.columns: dict[Signal, str] = {node.signal: _called(node) for node in unit.nodes}

    def read(self, start_ns: int, end_ns: int) -> list[Readings]:
        """Return the readings of a period, without its end, in the monitor's units.

        Raises `DataError` if the server has no such node or no history, or cannot be reached.
        """

        async def parts() -> list[Readings]:
            async with connected(self._endpoint, self._unit.security, self._unit.user) as client:
                return [p async for p in history(client, self._unit.nodes, start_ns, end_ns)]

        try:
            return asyncio.run(parts())
        except Exception as error:  # noqa: BLE001 - every failure is reported
            raise DataError(f'{self._endpoint}: {in_words(error)}.') from None
