# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings by other programs: what is known is read, the rest is skipped and counted."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

from log_files import FLOAT64, START_NS, STOCK, float64
from mcap.writer import CompressionType, IndexType, Writer

from benchmarks.torture.stock import stock_count
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.logs import open_log
from valveflow_ros.logs.mcap.recover import recover

STEPS = 500
INPUTS = ('/valve_opening', '/main_steam_pressure', '/main_steam_temperature', '/generated_power')
INDEXES = {'all indexes': IndexType.ALL, 'no index': IndexType.NONE}
IMAGE = 'uint8[] data\n'


def foreign(options: Options) -> Outcome:
    """Write with the reference library in every way it knows, beside topics of other kinds."""
    outcome = Outcome()
    ways = itertools.product(
        CompressionType, INDEXES, (True, False), (True, False), (1024, 1 << 20)
    )
    for number, (packing, index, crcs, chunked, size) in enumerate(ways):
        way = {
            'compression': packing, 'index_types': INDEXES[index], 'enable_crcs': crcs,
            'use_chunking': chunked, 'chunk_size': size,
        }  # fmt: skip
        path = options.folder / f'{number}.mcap'
        values = _write(path, way)
        what = f'{packing.name}, {index}, crcs {crcs}, chunked {chunked}, {size}'
        _read(path, values, what, outcome)
    outcome.sentence = (
        f'{outcome.counts["files"]} files in as many ways: {outcome.counts["read"]} read whole, '
        f'{outcome.counts["skipped_messages"]} messages of other kinds counted and skipped'
    )
    return outcome


def _write(path: Path, way: dict[str, Any]) -> list[float]:
    values: list[float] = []
    with path.open('wb') as stream:
        writer = Writer(stream, **way)
        writer.start(profile='ros2', library='somebody else')
        double = writer.register_schema(FLOAT64, 'ros2msg', STOCK.text(FLOAT64).encode())
        image = writer.register_schema('x_msgs/msg/Image', 'ros2msg', IMAGE.encode())
        note = writer.register_schema('note', 'jsonschema', b'{}')
        inputs = [writer.register_channel(topic, 'cdr', double) for topic in INPUTS]
        others = {
            writer.register_channel('/camera', 'cdr', image): b'\0\1\0\0\4\0\0\0abcd',
            writer.register_channel('/note', 'json', note): json.dumps({'a': 1}).encode(),
            writer.register_channel('/plain', 'json', 0): b'{}',
            writer.register_channel('/proto', 'protobuf', note): b'\x08\x96\x01',
            writer.register_channel('/odd_double', 'cdr', double): b'\0\1\0\0',
        }
        for step in range(STEPS):
            time_ns = START_NS + step * 10**9
            for number, channel in enumerate(inputs):
                values.append(step + number / 8)
                writer.add_message(channel, time_ns, float64(values[-1]), time_ns, step)
            for channel, data in others.items():
                writer.add_message(channel, time_ns, data, time_ns, step)
        writer.add_attachment(START_NS, START_NS, 'a.txt', 'text/plain', b'hello')
        writer.add_metadata('m', {'k': 'v'})
        writer.finish()
    return values


def _read(path: Path, values: list[float], what: str, outcome: Outcome) -> None:
    outcome.count('files')
    copy = path.with_suffix('.copy.mcap')
    try:
        log = open_log(path)
        recover(path, copy)
    except Exception as error:  # noqa: BLE001 - that is what is looked for
        outcome.expect(False, f'{what}: {type(error).__name__}: {error}')
        return
    outcome.count('read')
    same = log.readings.value.tolist() == values
    outcome.expect(same, f'{what}: {len(log.readings)} of {len(values)} values, or others')
    counts = {topic.name: topic.count for topic in log.topics.values()}
    rest = sum(count for name, count in counts.items() if name not in INPUTS)
    outcome.count('skipped_messages', rest)
    outcome.expect(rest == 5 * STEPS, f'{what}: {rest} messages of other kinds counted')
    raw = sum(1 for _ in log.iter_messages())
    outcome.expect(raw == 9 * STEPS, f'{what}: {raw} raw messages')
    outcome.expect(stock_count(copy) == raw, f'{what}: the recovered file has other messages')
    outcome.expect(log.attachments == {'a.txt': b'hello'}, f'{what}: attachments')
    outcome.expect(log.metadata.get('m') == {'k': 'v'}, f'{what}: metadata {log.metadata}')
