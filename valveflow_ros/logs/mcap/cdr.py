# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Decodes CDR messages with the definition that is stored in the file.

`Decoder` is slow; it is meant for `info`, watching and exports. Every length
is checked against the available bytes before memory is allocated.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.definitions import (
    PRIMITIVES,
    Field,
    Fields,
    collect,
    full_name,
    parse_all,
)
from valveflow_ros.logs.mcap.records import HEAD_SIZE, LayoutError, MessageTable, rows
from valveflow_ros.logs.names import PLANT_SAMPLE, qualities
from valveflow_ros.records import (
    N_SIGNALS,
    NS_PER_S,
    SIGNALS,
    ByteArray,
    FloatArray,
    IntArray,
    Quality,
)

MAX_DEPTH = 32
_CODES = {
    'bool': '?', 'byte': 'B', 'char': 'B', 'int8': 'b', 'uint8': 'B', 'int16': 'h', 'uint16': 'H',
    'int32': 'i', 'uint32': 'I', 'int64': 'q', 'uint64': 'Q', 'float32': 'f', 'float64': 'd',
}  # fmt: skip
_BYTE_LIKE = frozenset({'byte', 'char', 'uint8'})
_BIG, _LITTLE = b'\x00\x00', b'\x00\x01'


class Decoder:
    """Turns messages of one type into dictionaries.

    ``type_name`` is ``package/msg/Type`` or ``package/Type``, ``definition`` its ros2msg text with
    those of all nested types. Raises `RecordingError` if it is incomplete or cannot be parsed.
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

        Nested messages are dictionaries, arrays are lists, arrays of bytes are `bytes`. Raises
        `RecordingError` if the bytes do not match the definition.
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
        # Alignment is relative to the end of the four bytes of encapsulation.
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
        # The length includes the final zero byte; some writers omit that byte for ''.
        raw = self._take(size)
        return raw[:-1].decode(errors='replace') if raw else ''

    def _take(self, size: int) -> bytes:
        end = self._position + size
        if end > len(self._body):
            raise LayoutError('ends too early')
        raw = self._body[self._position : end]
        self._position = end
        return raw


_SEC, _NANOSEC = 'header.stamp.sec', 'header.stamp.nanosec'
_NEEDED = {_SEC: 'int32', _NANOSEC: 'uint32'} | {
    name: kind
    for info in SIGNALS
    for name, kind in ((info.topic, 'float64'), (f'{info.topic}_quality', 'uint8'))
}
MAX_SAMPLE_DEPTH = 8


@dataclass(frozen=True, slots=True)
class Samples:
    """Decoded PlantSample messages: times (n,), values and qualities (n, 5), valid rows (n,)."""

    time_ns: IntArray
    values: FloatArray
    quality: ByteArray
    good: NDArray[np.bool_]


class PlantSampleReader:
    """Reads the values of PlantSample messages that have one ros2msg definition.

    Raises `LayoutError` if a field is missing, of another type, or after an array.
    """

    def __init__(self, definition: str) -> None:
        types = parse_all(PLANT_SAMPLE, definition)
        self._qualities = qualities(definition)
        self._steps: list[tuple[str, str]] = []
        self._flatten(types, PLANT_SAMPLE, '', 0)
        have = dict(self._steps)
        for name, kind in _NEEDED.items():
            if have.get(name) != kind:
                raise LayoutError(f"the definition of {PLANT_SAMPLE} has no {kind} '{name}'")

    def read(self, content: bytes, table: MessageTable, picked: IntArray) -> Samples:
        """Return the samples in the messages ``picked`` from ``table``."""
        n = len(picked)
        start = table.offset[picked] + HEAD_SIZE
        end = start + table.size[picked]
        samples = Samples(
            np.zeros(n, dtype=np.int64),
            np.full((n, N_SIGNALS), np.nan),
            np.full((n, N_SIGNALS), int(Quality.BAD), dtype=np.uint8),
            np.zeros(n, dtype=np.bool_),
        )
        whole = np.flatnonzero(end - start >= 4)
        if len(whole):
            marks = rows(content, np.dtype([('mark', '>u2')]), 0, start[whole])['mark']
            for mark, order in ((0, '>'), (1, '<')):
                mine = whole[marks == mark]
                if len(mine):
                    self._read(content, start[mine] + 4, end[mine], order, samples, mine)
        return samples

    def _flatten(self, types: dict[str, Fields], name: str, prefix: str, depth: int) -> None:
        if depth > MAX_SAMPLE_DEPTH or name not in types:
            raise LayoutError(f"the definition of '{name}' cannot be used")
        for field in types[name]:
            path = prefix + field.name
            if set(_NEEDED) <= {step for step, _ in self._steps}:
                return
            if field.array or field.type == 'wstring':
                raise LayoutError(f"the field '{path}' stands before a value that is needed")
            if field.type in PRIMITIVES:
                self._steps.append((path, field.type))
            else:
                self._flatten(types, field.type, f'{path}.', depth + 1)

    def _read(
        self, content: bytes, body: IntArray, end: IntArray, order: str, samples: Samples,
        mine: IntArray,
    ) -> None:  # fmt: skip
        """Decode all messages field by field; ``place`` is the current offset in each of them."""
        place = np.zeros(len(body), dtype=np.int64)
        alive = np.ones(len(body), dtype=np.bool_)
        found: dict[str, NDArray[np.generic]] = {}
        for name, kind in self._steps:
            code = 'I' if kind == 'string' else _CODES[kind]
            dtype = np.dtype([('value', order + code)])
            place += -place % dtype.itemsize
            alive &= body + place + dtype.itemsize <= end
            at = np.where(alive, body + place, 0)
            if len(content) < dtype.itemsize:
                return
            value = rows(content, dtype, 0, at)['value']
            place += dtype.itemsize
            if kind == 'string':
                place += value.astype(np.int64)
                alive &= body + place <= end
            elif name in _NEEDED:
                found[name] = value
        good = mine[alive]
        samples.good[good] = True
        seconds = found[_SEC][alive].astype(np.int64)
        samples.time_ns[good] = seconds * NS_PER_S + found[_NANOSEC][alive].astype(np.int64)
        for info in SIGNALS:
            values, codes = found[info.topic][alive], found[f'{info.topic}_quality'][alive]
            if not info.required and self._qualities[0] == Quality.BAD:
                # The sender did not set this optional value: it is absent, not bad.
                values = np.where(codes == 0, np.nan, values)
            samples.values[good, info.signal] = values
            samples.quality[good, info.signal] = self._qualities[codes]
