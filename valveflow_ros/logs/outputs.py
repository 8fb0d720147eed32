# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables of the monitor's outputs in a recording: one table per kind, one row per message."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.errors import DataError
from valveflow_ros.logs.contents import LogContents
from valveflow_ros.logs.mcap.definitions import Field, Fields, full_name, parse_all
from valveflow_ros.records import finite

OUTPUTS = {
    'curves': 'valveflow_msgs/msg/FlowCharacteristic',
    'predictions': 'valveflow_msgs/msg/Prediction',
    'alarms': 'valveflow_msgs/msg/Alarm',
    'diagnoses': 'valveflow_msgs/msg/Diagnosis',
    'health': 'diagnostic_msgs/msg/DiagnosticArray',
}
_TIME = 'builtin_interfaces/msg/Time'
_HEADER = 'std_msgs/msg/Header'
_STATUS = 'diagnostic_msgs/msg/DiagnosticStatus'
_ROWS = 20_000  # in memory at a time


def outputs_in(log: LogContents) -> list[str]:
    """Return the kinds of `OUTPUTS` in a recording; raises `DataError` if there are none."""
    there = {topic.type for topic in log.topics.values() if topic.count}
    found = [kind for kind, name in OUTPUTS.items() if name in there]
    if not found:
        raise DataError(f'{log.path} contains no monitor output; valveflow monitor computes it.')
    return found


def write_outputs(log: LogContents, kind: str, path: Path) -> int:
    """Write the messages of one kind as CSV or Parquet (by suffix); return the number of rows.

    The columns are ``time`` (UTC) and ``unit_tag`` of the header, the topic, and the fields of the
    message. Health has one row per status. An array is a list in Parquet and JSON in CSV. A time
    of zero is an empty cell; in CSV a number that is not finite is an empty cell, too. Raises
    `RecordingError` if the recording lacks a definition, or a message does not match it.
    """
    topics = [t for t in log.topics.values() if t.type == OUTPUTS[kind] and t.count]
    types = parse_all(topics[0].type, topics[0].definition)
    fields = list(types[full_name(topics[0].type)])
    if kind == 'health':
        fields = [f for f in fields if f.type == _HEADER] + list(types[_STATUS])
    rows = _rows(log, [t.name for t in topics], fields, types)
    with ExitStack() as stack:
        if path.suffix.lower() == '.parquet':
            return _parquet(path, fields, types, rows, stack)
        file = stack.enter_context(path.open('w', encoding='utf-8', newline=''))
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(_names(fields))
        return sum(1 for row in rows if writer.writerow([_cell(value) for value in row]))


def _names(fields: list[Field]) -> list[str]:
    head = ['time', 'unit_tag', 'topic']
    return head + [f.name for f in fields if f.type != _HEADER]


def _rows(
    log: LogContents, topics: list[str], fields: list[Field], types: dict[str, Fields]
) -> Iterator[list[Any]]:
    """Yield the values of each row in the order of `_names`; times are of type `_Time`."""
    decoders = {topic: log.decoder(topic) for topic in topics}
    own = [f for f in fields if f.type != _HEADER]
    for message in log.iter_messages(topics):
        content = decoders[message.topic].decode(message.data)
        header = content['header']
        head = [_plain(header['stamp'], _TIME, types), header['frame_id'], message.topic]
        # Health has one row per status.
        for part in content['status'] if message.type == OUTPUTS['health'] else [content]:
            yield head + [_plain(part[f.name], f.type, types, bool(f.array)) for f in own]


class _Time(int):
    """A time in ns since 1970."""


def _plain(value: Any, kind: str, types: dict[str, Fields], array: bool = False) -> Any:
    """Return a field's value with times as `_Time`, and a time of zero as None."""
    if array and not isinstance(value, bytes):
        return [_plain(v, kind, types) for v in value]
    if kind == _TIME:
        return _Time(value['sec'] * 10**9 + value['nanosec']) or None
    if isinstance(value, bytes):
        return list(value)
    if isinstance(value, dict):
        return {f.name: _plain(value[f.name], f.type, types, bool(f.array)) for f in types[kind]}
    return value


def _cell(value: Any) -> Any:
    if isinstance(value, _Time):
        return f'{np.datetime64(int(value), "ns")}Z'
    if isinstance(value, float) and not math.isfinite(value):
        return ''
    if isinstance(value, list | dict):
        return json.dumps(finite(value), ensure_ascii=False)
    return value


def _parquet(
    path: Path, fields: list[Field], types: dict[str, Fields], rows: Iterator[list[Any]],
    stack: ExitStack,
) -> int:  # fmt: skip
    import pyarrow as pa
    import pyarrow.parquet as pq

    moment = pa.timestamp('ns', tz='UTC')

    def of(field: Field) -> Any:
        if field.type == _TIME:
            found = moment
        elif field.type in types:
            found = pa.struct([(f.name, of(f)) for f in types[field.type]])
        else:
            alike = {'bool': 'bool', 'byte': 'uint8', 'char': 'uint8', 'wstring': 'string'}
            found = pa.type_for_alias(alike.get(field.type, field.type))
        return pa.list_(found) if field.array else found

    columns = [of(f) for f in fields if f.type != _HEADER]
    schema = pa.schema(list(zip(
        _names(fields), [moment, pa.string(), pa.string(), *columns], strict=True
    )))  # fmt: skip
    writer = stack.enter_context(pq.ParquetWriter(path, schema))
    count = 0
    while block := list(islice(rows, _ROWS)):
        arrays = [
            pa.array(values, f.type) for values, f in zip(zip(*block, strict=True), schema,
                                                          strict=True)
        ]  # fmt: skip
        writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
        count += len(block)
    return count
