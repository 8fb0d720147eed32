# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Finds the definition of a message type, including those of its nested types."""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.records import LayoutError

# Definitions of standard messages, for machines without ROS.
#
# The fields are those of ROS 2 Jazzy (the type hashes agree); the comments are our own.

BUNDLED: dict[str, str] = {
    'builtin_interfaces/msg/Time': """\
int32 sec       # [s] since the Unix epoch
uint32 nanosec  # [ns] added to the seconds, below 1e9
""",
    'builtin_interfaces/msg/Duration': """\
int32 sec       # [s]
uint32 nanosec  # [ns] added to the seconds, below 1e9
""",
    'std_msgs/msg/Header': """\
builtin_interfaces/Time stamp  # time of the data
string frame_id                # what the data belong to
""",
    'std_msgs/msg/Float64': 'float64 data\n',
    'std_msgs/msg/Bool': 'bool data\n',
    'std_msgs/msg/String': 'string data\n',
    'std_msgs/msg/MultiArrayDimension': """\
string label   # name of the dimension
uint32 size    # elements along it
uint32 stride  # elements from here inwards
""",
    'std_msgs/msg/MultiArrayLayout': """\
MultiArrayDimension[] dim  # outermost first
uint32 data_offset         # elements to skip at the front
""",
    'std_msgs/msg/Float64MultiArray': """\
MultiArrayLayout layout
float64[] data
""",
    'rosgraph_msgs/msg/Clock': 'builtin_interfaces/Time clock\n',
    'diagnostic_msgs/msg/KeyValue': """\
string key
string value
""",
    'diagnostic_msgs/msg/DiagnosticStatus': """\
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3

byte level          # one of the above
string name         # node and component
string message      # for a person
string hardware_id  # the device
KeyValue[] values
""",
    'diagnostic_msgs/msg/DiagnosticArray': """\
std_msgs/Header header
DiagnosticStatus[] status
""",
}


# Parser of ROS 2 message definitions (`.msg` text).
#
# Only fields are kept: constants, defaults and comments are skipped.
# A text may hold further definitions after lines of ``=``, as in recordings.

# Each with its number in a type's description, see below.
# A char of a .msg file is an unsigned byte, unlike the char of type descriptions.
PRIMITIVES = {
    'int8': 2, 'uint8': 3, 'char': 3, 'int16': 4, 'uint16': 5, 'int32': 6, 'uint32': 7, 'int64': 8,
    'uint64': 9, 'float32': 10, 'float64': 11, 'bool': 15, 'byte': 16, 'string': 17, 'wstring': 18,
}  # fmt: skip
SEPARATOR = '=' * 80
MAX_TYPES = 256
MAX_FIELDS = 4096

_TYPE_NAME = re.compile(r'([A-Za-z][A-Za-z0-9_]*)/(?:msg/)?([A-Za-z][A-Za-z0-9_]*)\Z')
_LINE = re.compile(
    r'(?P<base>[A-Za-z][A-Za-z0-9_/]*)(?:<=(?P<bound>[0-9]{1,9}))?'
    r'(?P<array>\[(?P<upto><=)?(?P<length>[0-9]{0,9})\])?'
    r'\s+(?P<name>[A-Za-z][A-Za-z0-9_]*)\s*(?P<rest>.*)\Z'
)
_BREAK = re.compile(r'^={20,}[ \t]*$', re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message.

    ``type`` is one of `PRIMITIVES` or ``package/msg/Type``. ``array`` is ``''`` for one value,
    ``'fixed'`` for ``length`` elements, ``'bounded'`` for at most ``length``, or ``'unbounded'``.
    ``text_bound`` is the maximum length of a string, 0 if not bounded.
    """

    name: str
    type: str
    array: str = ''
    length: int = 0
    text_bound: int = 0


Fields = tuple[Field, ...]


def full_name(name: str) -> str:
    """Return ``package/msg/Type`` for that or ``package/Type``; raises `LayoutError`."""
    match = _TYPE_NAME.match(name)
    if match is None:
        raise LayoutError(f"'{name[:80]}' is not the name of a message type")
    return f'{match.group(1)}/msg/{match.group(2)}'


def parse_fields(text: str, package: str) -> Fields:
    """Return the fields of one definition; ``package`` is used for type names without one."""
    fields: list[Field] = []
    for line in text.splitlines():
        stripped = line.split('#', 1)[0].strip()
        if not stripped:
            continue
        match = _LINE.match(stripped)
        if match is None:
            raise LayoutError(f"the line '{stripped[:80]}' of a message definition is not clear")
        if not match['rest'].startswith('='):
            fields.append(_field(match, package))
        if len(fields) > MAX_FIELDS:
            raise LayoutError(f'a message has more than {MAX_FIELDS} fields')
    return tuple(fields)


def parse_all(type_name: str, text: str) -> dict[str, Fields]:
    """Return the fields of a type and of all types that follow it in the text.

    Raises `LayoutError` if a name or a line cannot be parsed.
    """
    main, *parts = _BREAK.split(text)
    if len(parts) > MAX_TYPES:
        raise LayoutError(f'a message definition holds more than {MAX_TYPES} types')
    types = {full_name(type_name): main}
    for part in parts:
        head, _, body = part.lstrip().partition('\n')
        if not head.startswith('MSG:'):
            raise LayoutError('a part of a message definition does not say what it defines')
        types.setdefault(full_name(head[4:].strip()), body)
    return {name: parse_fields(body, name.split('/')[0]) for name, body in types.items()}


def collect(type_name: str, types: Mapping[str, Fields]) -> list[str]:
    """Return the types that a type needs, itself first; raises `LayoutError` if one is missing."""
    needed, waiting = [], [full_name(type_name)]
    while waiting:
        name = waiting.pop(0)
        if name in needed:
            continue
        if name not in types:
            raise LayoutError(f"the definition of '{name}' is missing")
        needed.append(name)
        waiting += (f.type for f in types[name] if f.type not in PRIMITIVES)
    return needed


def _field(match: re.Match[str], package: str) -> Field:
    base = match['base']
    if base == 'Header':
        base = 'std_msgs/Header'
    if base not in PRIMITIVES:
        base = full_name(base if '/' in base else f'{package}/{base}')
    kind = ''
    if match['array'] is not None:
        kind = 'bounded' if match['upto'] else 'fixed'
        kind = kind if match['length'] else 'unbounded'
    return Field(match['name'], base, kind, int(match['length'] or 0), int(match['bound'] or 0))


# Type hashes RIHS01: the SHA-256 of a type's description (ROS Enhancement Proposal 2011).

_NESTED = 1
_BOUNDED_TEXT = 4
_ARRAY_STEP = {'': 0, 'fixed': 48, 'bounded': 96, 'unbounded': 144}
# A message without fields gets one, because C has no empty structures.
_FILLER: Fields = (Field('structure_needs_at_least_one_member', 'uint8'),)


def type_hash(type_name: str, types: Mapping[str, Fields]) -> str:
    """Return ``RIHS01_`` and 64 hexadecimal digits.

    Raises `LayoutError` if the definition of a type it needs is missing.
    """
    main, *others = collect(type_name, types)
    description = {
        'type_description': _describe(main, types),
        'referenced_type_descriptions': [_describe(name, types) for name in sorted(others)],
    }
    text = json.dumps(description, separators=(', ', ': '), ensure_ascii=True)
    return f'RIHS01_{hashlib.sha256(text.encode()).hexdigest()}'


def _describe(name: str, types: Mapping[str, Fields]) -> dict[str, Any]:
    fields = types[full_name(name)] or _FILLER
    return {'type_name': name, 'fields': [_described_field(field) for field in fields]}


def _described_field(field: Field) -> dict[str, Any]:
    number = PRIMITIVES.get(field.type, _NESTED) + (_BOUNDED_TEXT if field.text_bound else 0)
    kind = {
        'type_id': number + _ARRAY_STEP[field.array],
        'capacity': field.length,
        'string_capacity': field.text_bound,
        'nested_type_name': '' if field.type in PRIMITIVES else field.type,
    }
    return {'name': field.name, 'type': kind}


OWN_PACKAGE = 'valveflow_msgs'
MAX_FILE_BYTES = 1 << 20


class Definitions:
    """Looks up types in installed packages, then in this one, then in `BUNDLED`.

    Parameters
    ----------
    prefixes : sequence of Path, optional
        Install prefixes in order of preference; by default those of
        ``AMENT_PREFIX_PATH``.
    """

    def __init__(self, prefixes: Sequence[Path] | None = None) -> None:
        if prefixes is None:
            named = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
            prefixes = [Path(name) for name in named if name]
        self._prefixes = tuple(prefixes)
        self._texts: dict[str, str] = {}
        self._fields: dict[str, Fields] = {}

    def text(self, type_name: str) -> str:
        """Return the definition of a type followed by those of all types it needs.

        Raises `RecordingError` if a definition is not found or cannot be parsed.
        """
        main, *others = self._needed(type_name)
        parts = [self._texts[main]]
        for name in others:
            short = name.replace('/msg/', '/')
            parts.append(f'{SEPARATOR}\nMSG: {short}\n{self._texts[name]}')
        return '\n'.join(parts)

    def type_hash(self, type_name: str) -> str:
        """Return the RIHS01 hash of a type; raises like `text`."""
        self._needed(type_name)
        return type_hash(type_name, self._fields)

    def _needed(self, type_name: str) -> list[str]:
        try:
            name = full_name(type_name)
            self._learn(name)
            return collect(name, self._fields)
        except LayoutError as error:
            raise RecordingError(f"message type '{type_name}'", str(error)) from None

    def _learn(self, type_name: str) -> None:
        waiting = [type_name]
        while waiting:
            name = waiting.pop()
            if name not in self._fields:
                text = self._find(name)
                fields = parse_fields(text, name.split('/')[0])
                self._texts[name], self._fields[name] = text, fields
                waiting += [f.type for f in fields if '/' in f.type]

    def _find(self, name: str) -> str:
        package, _, stem = name.split('/')
        places = self._places(package, stem)
        for place in places:
            try:
                with place.open(encoding='utf-8') as stream:
                    text = stream.read(MAX_FILE_BYTES)
            except (OSError, UnicodeDecodeError):
                continue
            return text if text.endswith('\n') else f'{text}\n'
        if name in BUNDLED:
            return BUNDLED[name]
        looked = ', '.join(str(place.parent) for place in places) or 'nowhere'
        raise LayoutError(f"the definition of '{name}' was not found (looked in {looked})")

    def _places(self, package: str, stem: str) -> list[Path]:
        folders = [prefix / 'share' / package / 'msg' for prefix in self._prefixes]
        if package == OWN_PACKAGE:
            # The package of the node has a copy, in case the messages are not built.
            folders += [prefix / 'share/valveflow_ros/msg' for prefix in self._prefixes]
            folders += [Path(__file__).parents[3] / 'msg']
            folders += [Path(sys.prefix) / 'share/valveflow_ros/msg']
        return [folder / f'{stem}.msg' for folder in folders]
