"""Reads ROS 2 message definitions (`.msg` text) into fields.

Only what carries data is kept: constants, defaults and comments are skipped.
A text may hold further definitions after lines of ``=``, as recordings do.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from valveflow_ros.logs.mcap.layout import LayoutError

PRIMITIVES = frozenset(
    {
        'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16',
        'int32', 'uint32', 'int64', 'uint64', 'string', 'wstring',
    }
)  # fmt: skip
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

    Attributes
    ----------
    name : str
        Its name.
    type : str
        One of `PRIMITIVES`, or a full name ``package/msg/Type``.
    array : str
        ``''`` for one value, ``'fixed'``, ``'bounded'`` or ``'unbounded'``.
    length : int
        How many elements (fixed), or at most how many (bounded).
    text_bound : int
        Longest string, 0 if not bounded.
    """

    name: str
    type: str
    array: str = ''
    length: int = 0
    text_bound: int = 0


Fields = tuple[Field, ...]


def full_name(name: str) -> str:
    """Return ``package/msg/Type`` for either way of writing it; raises `LayoutError`."""
    match = _TYPE_NAME.match(name)
    if match is None:
        raise LayoutError(f"'{name[:80]}' is not the name of a message type")
    return f'{match.group(1)}/msg/{match.group(2)}'


def short_name(name: str) -> str:
    """Return ``package/Type``, the way recordings name what follows a separator."""
    return full_name(name).replace('/msg/', '/')


def parse_fields(text: str, package: str) -> Fields:
    """Return the fields of one definition; ``package`` completes names without one."""
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
    """Return the fields of a type and of everything that follows it in the text.

    Raises
    ------
    LayoutError
        If a name or a line cannot be understood.
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


def dependencies(fields: Fields) -> list[str]:
    """Return the message types that fields mention, each once, in order."""
    return list(dict.fromkeys(f.type for f in fields if f.type not in PRIMITIVES))


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
        waiting += dependencies(types[name])
    return needed


def _field(match: re.Match[str], package: str) -> Field:
    base = match['base']
    if base == 'Header':
        base = 'std_msgs/Header'
    if base not in PRIMITIVES:
        base = full_name(base if '/' in base else f'{package}/{base}')
    bound = int(match['bound'] or 0)
    if match['array'] is None:
        return Field(match['name'], base, '', 0, bound)
    if not match['length']:
        return Field(match['name'], base, 'unbounded', 0, bound)
    kind = 'bounded' if match['upto'] else 'fixed'
    return Field(match['name'], base, kind, int(match['length']), bound)
