# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads the mapping file: OPC UA nodes of the signals, and how to connect to the servers."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import yaml

from valveflow_ros.errors import InputError, ParameterError, RecordingError
from valveflow_ros.parameters import Parameter, Value
from valveflow_ros.records import NS_PER_S, SIGNALS, Signal
from valveflow_ros.signals.units import UNITS, Unit, unit_of

POLICIES = ('Basic256Sha256', 'Aes256Sha256RsaPss', 'None')

# Keys that are valid at the top of the file for all units, and within a unit for that unit.
LINK: tuple[Parameter, ...] = (
    Parameter('endpoint', '', '', 'Address of the server, opc.tcp://host:port/path.'),
    Parameter('period', 1.0, 's', 'Time from one plant_sample to the next.', 0.05, 3600.0),
    Parameter('publishing_interval', 0.5, 's', 'How often the server sends what has changed, or '
              'that nothing has.', 0.01, 3600.0),
    Parameter('sampling_interval', 0.5, 's', 'How often the server looks at the values.',
              0.0, 3600.0),
    Parameter('queue_size', 10, '', 'Changes of a value that the server keeps between two '
              'messages.', 1, 10000),
    Parameter('lateness', 2.0, 's', 'How long a sample waits for the server, or for its history '
              'after an outage, before it is sent as bad.', 0.1, 3600.0),
    Parameter('reconnect_longest', 30.0, 's', 'Longest pause between two attempts to connect.',
              0.1, 3600.0),
    Parameter('backfill_directory', '', '', 'Folder for the history of outages longer than '
              'lateness; empty: it is not read.'),
)  # fmt: skip
SECURITY: tuple[Parameter, ...] = (
    Parameter('policy', 'Basic256Sha256', '', 'Security policy.', choices=POLICIES),
    Parameter('mode', 'SignAndEncrypt', '', 'Message security mode.',
              choices=('SignAndEncrypt', 'Sign')),
    Parameter('certificate', '', '', 'Own certificate, .der or .pem.'),
    Parameter('private_key', '', '', 'Its private key, .pem or .der.'),
    Parameter('trusted', '', '', 'Certificate of the other side, .der or .pem, or a list of them; '
              'no other is accepted.'),
    Parameter('allow_unencrypted', False, '', 'Accept policy None, or mode Sign.'),
)  # fmt: skip
USER: tuple[Parameter, ...] = (
    Parameter('name', '', '', 'User name.'),
    Parameter('password_file', '', '', 'File whose first line is the password.'),
    Parameter('certificate', '', '', 'User certificate, in place of name and password.'),
    Parameter('private_key', '', '', 'Its private key.'),
)  # fmt: skip
NODE: tuple[Parameter, ...] = (
    Parameter('node', '', '', 'Node id, such as ns=2;s=HV101.ZT or nsu=urn:plant;i=4711.'),
    Parameter('unit', '', '', 'Unit of the value on the server.'),
    Parameter('dead_band', 0.0, '', 'Smaller changes are not sent, in that unit.', 0.0, 1e9),
)  # fmt: skip
_NODE_ID = re.compile(r'(ns=\d+;|nsu=[^;]+;)?[isgb]=.+')
_ENDPOINT = re.compile(r'opc\.tcp://[^\s/]+:\d{1,5}(/\S*)?')
_NAMESPACE = re.compile(r'(/[A-Za-z_]\w*)*')


@dataclass(frozen=True, slots=True)
class Security:
    """Security settings of a connection; paths are absolute."""

    policy: str
    mode: str
    certificate: Path | None
    private_key: Path | None
    trusted: tuple[Path, ...]

    @property
    def none(self) -> bool:
        """Return True if messages are neither signed nor encrypted."""
        return self.policy == 'None'


@dataclass(frozen=True, slots=True)
class User:
    """User of a session; anonymous if neither name nor certificate is given."""

    name: str = ''
    password: str = ''
    certificate: Path | None = None
    private_key: Path | None = None


@dataclass(frozen=True, slots=True)
class Node:
    """A node with a signal; ``unit`` converts its value to the monitor's unit."""

    signal: Signal
    node: str
    unit: Unit
    dead_band: float


@dataclass(frozen=True, slots=True)
class UnitMapping:
    """One unit: the target of its samples and the source of its values; times in ns or s."""

    namespace: str
    tag: str
    monitor: str
    endpoint: str
    period_ns: int
    publishing_interval_s: float
    sampling_interval_s: float
    queue_size: int
    lateness_ns: int
    reconnect_longest_s: float
    backfill_directory: Path | None
    security: Security
    user: User
    nodes: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """Settings of the server for curve, alarms and diagnosis."""

    endpoint: str
    security: Security
    user: User


@dataclass(frozen=True, slots=True)
class GatewayMapping:
    """Content of a mapping file."""

    units: tuple[UnitMapping, ...]
    server: ServerSettings | None


def read_mapping_file(path: str | Path) -> GatewayMapping:
    """Read and check a mapping file.

    Raises `RecordingError` if it, or a file that it names, cannot be read. Raises `InputError` if
    something in it is invalid; the message says where and why.
    """
    path = Path(path).expanduser()
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise RecordingError(path, f'cannot be read ({str(error.strerror).lower()})') from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, 'problem_mark', None)
        where = f' in line {mark.line + 1}' if mark is not None else ''
        raise RecordingError(path, f'is no YAML{where}') from None
    return _Reader(path).read(content)


class _Reader:
    """Converts the YAML content to records; stores the path for error messages."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self, content: object) -> GatewayMapping:
        link = [row.name for row in LINK]
        top = self._section('', content, [*link, 'security', 'user', 'units', 'server'])
        rows = top.get('units')
        if not isinstance(rows, list) or not rows:
            raise self._error('', "'units' must be a list with a unit at least")
        common = {key: top[key] for key in (*link, 'security', 'user') if key in top}
        units = tuple(self._unit(f'unit {k + 1}', row, common) for k, row in enumerate(rows))
        for what in ('namespace', 'tag'):
            names = [getattr(unit, what) for unit in units]
            twice = [name for name in names if names.count(name) > 1]
            if twice:
                raise self._error('', f"two units have the {what} '{twice[0]}'")
        server = None
        if 'server' in top:
            given = self._section('server', top['server'], ['endpoint', 'security', 'user'])
            user = self._user('server, user', given.get('user'))
            server = ServerSettings(
                self._endpoint('server', given.get('endpoint')),
                self._security('server, security', given.get('security'), user), user,
            )  # fmt: skip
            if user.certificate is not None:
                raise self._error('server, user', 'takes name and password_file only')
        return GatewayMapping(units, server)

    def _unit(self, where: str, given: object, common: dict[str, Any]) -> UnitMapping:
        names = [row.name for row in LINK]
        own = self._section(
            where, given, [*names, 'security', 'user', 'namespace', 'tag', 'monitor', 'signals']
        )
        where = f"unit '{own['tag']}'" if own.get('tag') else where
        both = {**common, **own}
        link = self._values(where, {k: both[k] for k in names if k in both}, LINK)
        tag, namespace = own.get('tag', ''), own.get('namespace', '')
        if not isinstance(tag, str) or not tag:
            raise self._error(where, "'tag' must be a text, the tag of the unit")
        if not isinstance(namespace, str) or not _NAMESPACE.fullmatch(namespace):
            raise self._error(where, f"'namespace' must be such as /u1, not {namespace!r}")
        user = self._user(f'{where}, user', both.get('user'))
        folder = str(link['backfill_directory'])
        return UnitMapping(
            namespace, tag, str(own.get('monitor', 'valveflow_monitor')),
            self._endpoint(where, link['endpoint']),
            round(cast(float, link['period']) * NS_PER_S),
            cast(float, link['publishing_interval']), cast(float, link['sampling_interval']),
            cast(int, link['queue_size']), round(cast(float, link['lateness']) * NS_PER_S),
            cast(float, link['reconnect_longest']), self._beside(folder) if folder else None,
            self._security(f'{where}, security', both.get('security'), user), user,
            self._nodes(where, own.get('signals')),
        )  # fmt: skip

    def _nodes(self, where: str, given: object) -> tuple[Node, ...]:
        known = {info.topic: info.signal for info in SIGNALS}
        signals = self._section(f'{where}, signals', given, list(known))
        missing = [i.topic for i in SIGNALS if i.required and i.topic not in signals]
        if missing:
            raise self._error(f'{where}, signals', f"'{missing[0]}' is missing")
        nodes = []
        for topic, about in signals.items():
            here = f'{where}, {topic}'
            values = self._values(here, about, NODE)
            if not _NODE_ID.fullmatch(str(values['node'])):
                raise self._error(
                    here, f"'{values['node']}' is no node id such as ns=2;s=HV101.ZT"
                )
            # The unit is required, so that a gauge pressure is not taken as absolute.
            if not values['unit']:
                units = ', '.join(UNITS[known[topic]])
                raise self._error(here, f"'unit' must be named, such as {units}")
            try:
                unit = unit_of(known[topic], str(values['unit']))
            except InputError as error:
                raise InputError(f'{self._path}, {here}: {error}') from None
            nodes.append(
                Node(known[topic], str(values['node']), unit, cast(float, values['dead_band']))
            )
        return tuple(nodes)

    def _security(self, where: str, given: object, user: User) -> Security:
        names = [row.name for row in SECURITY]
        content = self._section(where, {} if given is None else given, names)
        trusted = content.pop('trusted', None)
        values = self._values(where, content, SECURITY)
        policy, mode = str(values['policy']), str(values['mode'])
        unencrypted = 'policy None' if policy == 'None' else 'mode Sign' if mode == 'Sign' else ''
        if unencrypted and not values['allow_unencrypted']:
            more = ' and the password would be read on the way' if user.name else ''
            raise self._error(
                where, f'{unencrypted} encrypts nothing{more}; choose another, or set '
                'allow_unencrypted: true',
            )  # fmt: skip
        if policy == 'None':
            return Security(policy, mode, None, None, ())
        own = [
            self._file(where, name, str(values[name])) for name in ('certificate', 'private_key')
        ]
        names = [trusted] if isinstance(trusted, str) else trusted
        if not isinstance(names, list) or not names:
            raise self._error(where, "'trusted' must name the certificate of the other side")
        return Security(
            policy, mode, own[0], own[1],
            tuple(self._file(where, 'trusted', str(name)) for name in names),
        )  # fmt: skip

    def _user(self, where: str, given: object) -> User:
        values = {name: str(value) for name, value in self._values(where, given, USER).items()}
        if values['certificate']:
            return User(
                certificate=self._file(where, 'certificate', values['certificate']),
                private_key=self._file(where, 'private_key', values['private_key']),
            )
        if not values['name']:
            return User()
        path = self._file(where, 'password_file', values['password_file'])
        lines = path.read_text(encoding='utf-8', errors='replace').splitlines()
        return User(values['name'], lines[0].strip() if lines else '')

    def _endpoint(self, where: str, given: object) -> str:
        if not isinstance(given, str) or not _ENDPOINT.fullmatch(given):
            raise self._error(
                where, f"'endpoint' must be such as opc.tcp://192.0.2.7:4840, not {given!r}"
            )
        return given

    def _file(self, where: str, name: str, given: str) -> Path:
        if not given:
            raise self._error(where, f"'{name}' is missing")
        path = self._beside(given)
        try:
            path.open('rb').close()
        except OSError as error:
            reason = str(error.strerror).lower()
            raise RecordingError(path, f'cannot be read as {name} ({reason})') from None
        return path

    def _beside(self, given: str) -> Path:
        return self._path.absolute().parent / Path(given).expanduser()

    def _values(self, where: str, given: object, rows: tuple[Parameter, ...]) -> dict[str, Value]:
        content = self._section(where, {} if given is None else given, [r.name for r in rows])
        try:
            return {
                row.name: row.check(content[row.name]) if row.name in content else row.default
                for row in rows
            }
        except ParameterError as error:
            raise self._error(where, f"'{error.name}' {error.problem}") from None

    def _section(self, where: str, given: object, known: list[str]) -> dict[str, Any]:
        if not isinstance(given, Mapping):
            raise self._error(where, 'keys with values are expected here')
        for key in map(str, given):
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1)
                hint = f"did you mean '{near[0]}'?" if near else f'known are {", ".join(known)}'
                raise self._error(where, f"'{key}' is unknown; {hint}")
        return dict(given)

    def _error(self, where: str, problem: str) -> InputError:
        return InputError(f'{self._path}{", " if where else ""}{where}: {problem}.')
