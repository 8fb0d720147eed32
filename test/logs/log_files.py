# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Small recordings and slow truths for the tests of logs."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from valveflow_ros.logs import LogContents, Message, RecordingWriter
from valveflow_ros.logs.mcap.definitions import Definitions
from valveflow_ros.records import SIGNALS, Readings, SampleTable, Signal

START_NS = 1_700_000_000_000_000_000
FLOAT64 = 'std_msgs/msg/Float64'
SAMPLE = 'valveflow_msgs/msg/PlantSample'
# No ROS installation may change what a test sees.
STOCK = Definitions([])


class Reading(NamedTuple):
    log_time_ns: int
    time_ns: int
    signal: int
    value: float
    quality: int


def float64(value: float, order: str = '<') -> bytes:
    mark = b'\x00\x01\x00\x00' if order == '<' else b'\x00\x00\x00\x00'
    return mark + struct.pack(f'{order}d', value)


def plant_sample(
    stamp_ns: int,
    values: list[float],
    quality: list[int],
    frame_id: str = 'HV101',
    order: str = '<',
) -> bytes:
    """Encode a PlantSample field by field."""
    body = struct.pack(f'{order}iI', stamp_ns // 10**9, stamp_ns % 10**9)
    text = frame_id.encode() + b'\0'
    body += struct.pack(f'{order}I', len(text)) + text
    for value, code in zip(values, quality, strict=True):
        body += b'\0' * (-len(body) % 8) + struct.pack(f'{order}dB', value, code)
    return (b'\x00\x01\x00\x00' if order == '<' else b'\x00\x00\x00\x00') + body


def read_back(contents: LogContents) -> list[Reading]:
    readings = contents.readings
    columns = (
        contents.log_time_ns,
        readings.time_ns,
        readings.signal,
        readings.value,
        readings.quality,
    )
    return [Reading(*row) for row in zip(*(c.tolist() for c in columns), strict=True)]


def write_chunks(
    folder: Path, chunks: int = 20, per_chunk: int = 5, close: bool = True
) -> tuple[Path, list[Reading], RecordingWriter]:
    """Write four Float64 topics; every value and time is told apart from every other."""
    writer = RecordingWriter(folder, definitions=STOCK, attachments={'parameters.yaml': b'a: 1\n'})
    wanted: list[Reading] = []
    for info in SIGNALS[:4]:
        writer.add_topic(f'/unit1/{info.topic}', FLOAT64)
    for step in range(chunks * per_chunk):
        for info in SIGNALS[:4]:
            number = 4 * step + int(info.signal)
            time_ns = START_NS + step * 10**9
            value = 1.0 + number * 0.001
            log_ns = time_ns + 1000 + int(info.signal)
            writer.write(f'/unit1/{info.topic}', float64(value), log_ns, time_ns)
            wanted.append(Reading(log_ns, time_ns, int(info.signal), value, 0))
        if step % per_chunk == per_chunk - 1:
            writer.flush()
    if close:
        writer.close()
    path = folder / f'{folder.name}_0.mcap'
    return (path if close else path.with_name(path.name + '.part')), wanted, writer


def write_messages(folder: Path, topics: dict[str, str], messages: list[Message]) -> Path:
    with RecordingWriter(folder, definitions=STOCK) as writer:
        for topic, type_name in topics.items():
            writer.add_topic(topic, type_name)
        for message in messages:
            writer.write(*message)
    return folder / f'{folder.name}_0.mcap'


def same_readings(first: Readings, second: Readings) -> bool:
    return all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=name == 'value')
        for name in ('time_ns', 'signal', 'value', 'quality')
    )


def same_tables(first: SampleTable, second: SampleTable) -> bool:
    return (
        np.array_equal(first.time_ns, second.time_ns)
        and np.array_equal(first.values, second.values, equal_nan=True)
        and np.array_equal(first.quality, second.quality)
    )


def wander(n: int, seed: int, command: bool = False) -> SampleTable:
    """Return a table of wandering signals, some of whose values are missing or doubtful."""
    rng = np.random.default_rng(seed)
    time_ns = START_NS + np.cumsum(rng.integers(1, 3_000_000_000, n))
    columns = {Signal(k): 50 + np.cumsum(rng.normal(size=n)) for k in range(5 if command else 4)}
    for column in columns.values():
        column[rng.random(n) < 0.05] = np.nan
    doubts = {s: (rng.random(n) < 0.1).astype(np.uint8) for s in columns}
    return SampleTable.from_columns(time_ns, columns, doubts)
