# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A read-only OPC UA server with curve, alarms and diagnosis. Requires asyncua."""

from __future__ import annotations

import asyncio
import dataclasses
import hmac
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.opcua.mapping import Security, ServerSettings, User
from valveflow_ros.opcua.session import (
    connected,
    in_words,
    load_certificate,
    load_key,
    not_valid,
    read_certificate,
    to_datetime,
    uri_of,
)

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

NAMESPACE = 'urn:valveflow'
# Severity of an event, 1 to 1000, by the priority of the alarm; 100 if no condition is active.
SEVERITY, NO_CONDITION = {1: 300, 2: 600, 3: 900}, 100
_EVENT_FIELDS = {'State': 'Byte', 'PreviousState': 'Byte', 'Value': 'Double', 'Limit': 'Double',
                 'Unit': 'String'}  # fmt: skip


class Field(NamedTuple):
    """A variable: name, OPC UA type ('Double', 'DateTime' in ns, ...), True for an array."""

    name: str
    kind: str
    array: bool = False


class Alarm(NamedTuple):
    """Content of an event, with the values of `Alarm.msg`."""

    name: str
    time_ns: int
    sentence: str
    severity: int
    values: Mapping[str, object]


class _Readers:
    """Accepts clients with a trusted certificate and, if required, the password; read-only.

    The certificate of the secure channel is checked, not the one that a client states when it
    creates the session. Its validity period is checked for each session. None for ``trusted``
    means a connection without certificates.
    """

    def __init__(self, trusted: Iterable[Certificate] | None, user: User) -> None:
        from cryptography.hazmat.primitives.serialization import Encoding

        self._trusted = (
            None if trusted is None else {c.public_bytes(Encoding.DER): c for c in trusted}
        )
        self._user = user

    def get_user(
        self, _server: Any, username: Any = None, password: Any = None, certificate: Any = None
    ) -> Any:
        from asyncua.crypto.permission_rules import User as Role
        from asyncua.crypto.permission_rules import UserRole

        if self._trusted is not None:
            found = self._trusted.get(certificate)
            if found is None or not_valid(found):
                return None
        if self._user.name:
            told = password.decode() if isinstance(password, bytes) else str(password or '')
            same = hmac.compare_digest(told.encode(), self._user.password.encode())
            if username != self._user.name or not same:
                return None
        return Role(role=UserRole.User)


class ResultsServer:
    """The server; all calls must be made in one event loop.

    ``units`` are objects by unit tag, such as ``characteristic`` and ``alarms.residual``, and
    their variables. The id of a variable is ``ns=N;s=TAG.OBJECT.FIELD``.
    """

    def __init__(
        self, settings: ServerSettings, units: Mapping[str, Mapping[str, Iterable[Field]]]
    ) -> None:
        self._settings, self._units = settings, units
        self._server: Any = None
        self._variables: dict[tuple[str, str, str], tuple[Any, Any]] = {}
        self._last: dict[tuple[str, str, str], Any] = {}
        self._events: dict[str, Any] = {}
        self._one = asyncio.Lock()

    async def start(self) -> list[str]:
        """Start the server; return warnings about client certificates that cannot be used.

        Raises `DataError` if the address is in use or does not belong to this machine, and
        `RecordingError` if the server's own certificate or key cannot be used.
        """
        from asyncua import Server, ua

        settings, security = self._settings, self._settings.security
        told, trusted = [], None
        if not security.none:
            trusted = []
            for path in security.trusted:
                try:
                    trusted.append(read_certificate(path))
                    problem = not_valid(trusted[-1])
                except RecordingError as error:
                    problem = error.problem
                if problem:
                    told.append(f'{path}: {problem}; the client that has it is refused.')
        self._server = server = Server(user_manager=_Readers(trusted, settings.user))
        await server.init()
        server.set_server_name('valveflow')
        server.set_endpoint(settings.endpoint)
        if security.none:
            server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        else:
            assert security.certificate is not None
            assert security.private_key is not None
            own = load_certificate(security.certificate)
            await load_key(security.private_key, own)
            await server.load_certificate(security.certificate)
            await server.load_private_key(security.private_key)
            await server.set_application_uri(uri_of(own) or NAMESPACE)
            server.set_security_policy(
                [getattr(ua.SecurityPolicyType, f'{security.policy}_{security.mode}')]
            )
        tokens = ua.UserNameIdentityToken if settings.user.name else ua.AnonymousIdentityToken
        server.set_identity_tokens([tokens])
        await self._build()
        try:
            await server.start()
        except OSError as error:
            raise DataError(f'{settings.endpoint} cannot be offered: {in_words(error)}.') from None
        return told

    async def stop(self) -> None:
        """Stop the server."""
        if self._server is not None:
            await self._server.stop()

    async def update(
        self, tag: str, name: str, values: Mapping[str, object], time_ns: int
    ) -> None:
        """Write the variables of an object; times are in ns, a missing number is NaN."""
        from asyncua import ua

        async with self._one:
            for field, value in values.items():
                node, kind = self._variables[tag, name, field]
                if kind == ua.VariantType.DateTime:
                    value = to_datetime(int(str(value)))
                data = ua.DataValue(
                    ua.Variant(value, kind, is_array=isinstance(value, list)),
                    SourceTimestamp=to_datetime(time_ns),
                )
                self._last[tag, name, field] = data
                await self._write(node, data)

    async def alarm(self, tag: str, alarm: Alarm) -> None:
        """Send the event of an alarm's change, or of a diagnosis."""
        from asyncua import ua

        async with self._one:
            generator = self._events[tag]
            event = generator.event
            event.SourceName = alarm.name
            event.Severity = ua.UInt16(alarm.severity)
            for name in _EVENT_FIELDS:
                setattr(event, name, alarm.values[name])
            await generator.trigger(to_datetime(alarm.time_ns), alarm.sentence)

    async def mark(self, tag: str, present: bool) -> None:
        """Set the status of a unit's values: good, or last usable value if its monitor ended."""
        from asyncua import ua

        code = ua.StatusCodes.Good if present else ua.StatusCodes.UncertainLastUsableValue
        async with self._one:
            for key, data in self._last.items():
                if key[0] == tag:
                    node, _ = self._variables[key]
                    await self._write(
                        node, dataclasses.replace(data, StatusCode=ua.StatusCode(code))
                    )

    async def _write(self, node: Any, data: Any) -> None:
        from asyncua import ua

        # Written inside the server, because clients must not write the variables.
        await self._server.iserver.aspace.write_attribute_value(
            node.nodeid, ua.AttributeIds.Value, data
        )

    async def _build(self) -> None:
        from asyncua import ua

        server = self._server
        index = await server.register_namespace(NAMESPACE)
        kind = await server.create_custom_event_type(
            index, 'ValveflowAlarmType', ua.ObjectIds.BaseEventType,
            [(name, getattr(ua.VariantType, of)) for name, of in _EVENT_FIELDS.items()],
        )  # fmt: skip
        waiting = ua.StatusCode(ua.StatusCodes.BadWaitingForInitialData)
        root = await server.nodes.objects.add_folder(_id(index, 'valveflow'), f'{index}:valveflow')
        for tag, objects in self._units.items():
            places = {'': await root.add_object(_id(index, tag), f'{index}:{tag}')}
            self._events[tag] = await server.get_event_generator(kind, places[''])
            for name, fields in objects.items():
                above = ''
                for word in name.split('.'):
                    here = f'{above}.{word}' if above else word
                    if here not in places:
                        places[here] = await places[above].add_object(
                            _id(index, f'{tag}.{here}'), f'{index}:{word}'
                        )
                    above = here
                for field in fields:
                    of = getattr(ua.VariantType, field.kind)
                    node = await places[name].add_variable(
                        _id(index, f'{tag}.{name}.{field.name}'), f'{index}:{field.name}',
                        ua.Variant([] if field.array else ua.get_default_value(of), of,
                                   is_array=field.array), of,
                    )  # fmt: skip
                    self._variables[tag, name, field.name] = node, of
                    await self._write(node, ua.DataValue(StatusCode=waiting))


def _id(index: int, text: str) -> Any:
    from asyncua import ua

    return ua.NodeId(text, index)


async def read_results(endpoint: str, security: Security, names: Sequence[str]) -> list[Any]:
    """Return variables of a results server by name, such as ``U1.characteristic.status``.

    A variable without a value is None. Raises whatever asyncua raises; see `in_words`.
    """
    async with connected(endpoint, security, User()) as client:
        index = await client.get_namespace_index(NAMESPACE)
        nodes = [client.get_node(_id(index, name)) for name in names]
        data = [await node.read_data_value(raise_on_bad_status=False) for node in nodes]
        return [None if found.Value is None else found.Value.Value for found in data]
