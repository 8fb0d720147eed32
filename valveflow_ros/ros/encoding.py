"""Messages as CDR bytes that depend on nothing but their fields.

The middleware's own serialiser leaves whatever was in memory between fields
that need alignment, so two equal messages may differ in their bytes. What is
recorded here is to be compared byte for byte, and is to carry nothing of the
process's memory; so the bytes between fields are zero.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable
from typing import Any

_HEAD = b'\x00\x01\x00\x00'  # plain CDR, little endian
_LENGTH = struct.Struct('<I')
_CODES = {
    'boolean': '?', 'int8': 'b', 'uint8': 'B', 'int16': 'h', 'uint16': 'H', 'int32': 'i',
    'uint32': 'I', 'int64': 'q', 'uint64': 'Q', 'float': 'f', 'double': 'd',
}  # fmt: skip

_Writer = Callable[[bytearray, Any], None]


def encode(message: Any) -> bytes:
    """Return a message as it goes over the wire.

    Raises
    ------
    TypeError
        A field is of a kind that none of our messages has.
    """
    out = bytearray()
    _write_message(out, message)
    return _HEAD + out


def _write_message(out: bytearray, message: Any) -> None:
    for name, write in _plan(type(message)):
        write(out, getattr(message, name))


@functools.cache
def _plan(kind: type) -> tuple[tuple[str, _Writer], ...]:
    fields: dict[str, str] = kind.get_fields_and_field_types()  # type: ignore[attr-defined]
    return tuple((name, _writer(text)) for name, text in fields.items())


def _writer(text: str) -> _Writer:
    if text.startswith('sequence<') and ',' not in text:
        return _sequence_writer(text[len('sequence<') : -1])
    if text == 'string':
        return _write_string
    if text == 'octet':
        return _write_octet
    if text in _CODES:
        return _number_writer(_CODES[text])
    if '/' in text and '[' not in text and '<' not in text:
        return _write_message
    raise TypeError(f"fields of type '{text}' are not supported")


def _number_writer(code: str) -> _Writer:
    layout = struct.Struct(f'<{code}')
    size = layout.size

    def write(out: bytearray, value: Any) -> None:
        out += bytes(-len(out) % size)
        out += layout.pack(value)

    return write


def _sequence_writer(element: str) -> _Writer:
    write = _writer(element)
    code = _CODES.get(element)

    def one_by_one(out: bytearray, values: Any) -> None:
        out += bytes(-len(out) % 4)
        out += _LENGTH.pack(len(values))
        for value in values:
            write(out, value)

    def at_once(out: bytearray, values: Any) -> None:
        out += bytes(-len(out) % 4)
        out += _LENGTH.pack(len(values))
        if len(values):
            out += bytes(-len(out) % struct.calcsize(f'<{code}'))
            out += struct.pack(f'<{len(values)}{code}', *values)

    return one_by_one if code is None else at_once


def _write_string(out: bytearray, value: Any) -> None:
    data = value.encode()
    out += bytes(-len(out) % 4)
    out += _LENGTH.pack(len(data) + 1)
    out += data
    out.append(0)


def _write_octet(out: bytearray, value: Any) -> None:
    out += value
