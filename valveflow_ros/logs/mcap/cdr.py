"""Decodes CDR messages by the definition that stands in the file itself.

For journals, `info` and watching, not for the hot path. Every length is
checked against the bytes that are there before anything is made of it.
"""

from __future__ import annotations

import struct
from typing import Any

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.layout import LayoutError
from valveflow_ros.logs.mcap.msgdef import PRIMITIVES, Field, Fields, collect, full_name, parse_all

MAX_DEPTH = 32
_CODES = {
    'bool': '?',
    'byte': 'B',
    'char': 'B',
    'int8': 'b',
    'uint8': 'B',
    'int16': 'h',
    'uint16': 'H',
    'int32': 'i',
    'uint32': 'I',
    'int64': 'q',
    'uint64': 'Q',
    'float32': 'f',
    'float64': 'd',
}
_BYTE_LIKE = frozenset({'byte', 'char', 'uint8'})
_BIG, _LITTLE = b'\x00\x00', b'\x00\x01'


class Decoder:
    """Turns messages of one type into dictionaries.

    Parameters
    ----------
    type_name : str
        ``package/msg/Type`` or ``package/Type``.
    definition : str
        Its ros2msg text with everything it needs.

    Raises
    ------
    RecordingError
        If the definition is incomplete or cannot be understood.
    """

    def __init__(self, type_name: str, definition: str) -> None:
        self.type_name = type_name
        try:
            self._name = full_name(type_name)
            self._types: dict[str, Fields] = parse_all(type_name, definition)
            collect(self._name, self._types)
        except LayoutError as error:
            raise RecordingError(f"message type '{type_name}'", str(error)) from None

    def decode(self, data: bytes) -> dict[str, Any]:
        """Return the message as a dictionary.

        Nested messages are dictionaries, arrays are lists, arrays of bytes
        are `bytes`.

        Raises
        ------
        RecordingError
            If the bytes do not fit the definition.
        """
        try:
            return _Reader(data, self._types).message(self._name, 0)
        except LayoutError as error:
            raise RecordingError(f'a message of type {self.type_name}', str(error)) from None


class _Reader:
    def __init__(self, data: bytes, types: dict[str, Fields]) -> None:
        if data[:2] not in (_BIG, _LITTLE) or len(data) < 4:
            raise LayoutError('is not plain CDR')
        self._order = '<' if data[:2] == _LITTLE else '>'
        # Alignment counts from behind the four bytes of encapsulation.
        self._body = data[4:]
        self._position = 0
        self._types = types

    def message(self, name: str, depth: int) -> dict[str, Any]:
        if depth > MAX_DEPTH:
            raise LayoutError(f'is nested more than {MAX_DEPTH} deep')
        fields = self._types[name]
        if not fields:
            self._take(1)
        return {field.name: self._field(field, depth) for field in fields}

    def _field(self, field: Field, depth: int) -> Any:
        if not field.array:
            return self._one(field.type, depth)
        count = field.length if field.array == 'fixed' else self._number('I')
        if count > len(self._body) - self._position:
            raise LayoutError(f"has fewer bytes than its array '{field.name}' has elements")
        if field.type in _BYTE_LIKE:
            return self._take(count)
        if field.type in _CODES:
            return self._numbers(_CODES[field.type], count)
        return [self._one(field.type, depth) for _ in range(count)]

    def _one(self, kind: str, depth: int) -> Any:
        if kind in _CODES:
            return self._number(_CODES[kind])
        if kind == 'string':
            return self._text()
        if kind in PRIMITIVES:
            raise LayoutError(f'has a field of type {kind}, which is not read')
        return self.message(kind, depth + 1)

    def _number(self, code: str) -> Any:
        return self._numbers(code, 1)[0]

    def _numbers(self, code: str, count: int) -> list[Any]:
        size = struct.calcsize(code)
        if count:
            self._position += -self._position % size
        raw = self._take(size * count)
        return list(struct.unpack(f'{self._order}{count}{code}', raw))

    def _text(self) -> str:
        size = self._number('I')
        # The length counts a closing zero byte; some writers leave both out for ''.
        raw = self._take(size)
        return raw[:-1].decode(errors='replace') if raw else ''

    def _take(self, size: int) -> bytes:
        end = self._position + size
        if end > len(self._body):
            raise LayoutError('ends too early')
        raw = self._body[self._position : end]
        self._position = end
        return raw
