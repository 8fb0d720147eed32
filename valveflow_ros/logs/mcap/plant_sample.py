"""Reads many stamped samples at once, by the definition that stands in the file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.logs.mcap.layout import LayoutError
from valveflow_ros.logs.mcap.msgdef import PRIMITIVES, Fields, parse_all
from valveflow_ros.logs.mcap.walk import HEAD_SIZE, MessageTable, rows
from valveflow_ros.logs.names import PLANT_SAMPLE
from valveflow_ros.records import (
    N_SIGNALS,
    NS_PER_S,
    SIGNALS,
    ByteArray,
    FloatArray,
    IntArray,
    Quality,
)

_NUMPY = {
    'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'uint8': 'u1', 'int8': 'i1',
    'uint16': 'u2', 'int16': 'i2', 'uint32': 'u4', 'int32': 'i4',
    'uint64': 'u8', 'int64': 'i8', 'float32': 'f4', 'float64': 'f8',
}  # fmt: skip
_SEC, _NANOSEC = 'header.stamp.sec', 'header.stamp.nanosec'
_NEEDED = {_SEC: 'int32', _NANOSEC: 'uint32'} | {
    name: kind
    for info in SIGNALS
    for name, kind in ((info.topic, 'float64'), (f'{info.topic}_quality', 'uint8'))
}
MAX_DEPTH = 8


@dataclass(frozen=True, slots=True)
class Samples:
    """Stamped samples: times (n,), values (n, 5) and qualities (n, 5), and which fitted."""

    time_ns: IntArray
    values: FloatArray
    quality: ByteArray
    good: NDArray[np.bool_]


class PlantSampleReader:
    """Knows where the values stand in messages of one definition.

    Parameters
    ----------
    definition : str
        The ros2msg text of the type with everything it needs.

    Raises
    ------
    LayoutError
        If a field is missing, of another type, or behind an array.
    """

    def __init__(self, definition: str) -> None:
        types = parse_all(PLANT_SAMPLE, definition)
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
        if depth > MAX_DEPTH or name not in types:
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
        self,
        content: bytes,
        body: IntArray,
        end: IntArray,
        order: str,
        samples: Samples,
        mine: IntArray,
    ) -> None:
        """Walk the fields of all messages side by side; ``place`` is where each has got to."""
        place = np.zeros(len(body), dtype=np.int64)
        alive = np.ones(len(body), dtype=np.bool_)
        found: dict[str, NDArray[np.generic]] = {}
        for name, kind in self._steps:
            code = 'u4' if kind == 'string' else _NUMPY[kind]
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
        self._store(found, alive, samples, mine)

    def _store(
        self,
        found: dict[str, NDArray[np.generic]],
        alive: NDArray[np.bool_],
        samples: Samples,
        mine: IntArray,
    ) -> None:
        good = mine[alive]
        samples.good[good] = True
        seconds = found[_SEC][alive].astype(np.int64)
        samples.time_ns[good] = seconds * NS_PER_S + found[_NANOSEC][alive].astype(np.int64)
        for info in SIGNALS:
            samples.values[good, info.signal] = found[info.topic][alive]
            quality = found[f'{info.topic}_quality'][alive]
            # A code that is not known says at least that all is not well.
            samples.quality[good, info.signal] = np.minimum(quality, int(Quality.BAD))
