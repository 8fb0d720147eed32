# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads one MCAP file and collects the values of topics that may be inputs.

Chunks are processed in groups of about 4 MiB, so that a file of many small
chunks (from a slow plant) takes no longer than a file of a few large ones.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.cdr import PlantSampleReader, Samples
from valveflow_ros.logs.mcap.records import (
    HEAD_SIZE,
    LayoutError,
    MessageTable,
    TopicTable,
    read_summary,
    rows,
    walk,
)
from valveflow_ros.logs.mcap.scan import Chunk, Findings, Scanner
from valveflow_ros.logs.names import FLOAT64, PLANT_SAMPLE, TopicChoice
from valveflow_ros.logs.source import Source
from valveflow_ros.records import SIGNALS, ByteArray, FloatArray, IntArray

_PAYLOAD = np.dtype([('mark', '>u2'), ('options', '<u2'), ('value', '<f8')])
# A Float64 message has 12 bytes; some middlewares pad it to a multiple of 8.
_SIZES = (12, 16)


class Rows(NamedTuple):
    """Values found in a group of chunks, in file order.

    Arrays of n: ``log_time`` and ``time_ns`` int64, times of reception and of the value in ns;
    ``channel`` uint16; ``signal`` int8, -1 if it follows from the topic later; ``value`` float64;
    ``quality`` uint8, good if the file does not state it.
    """

    log_time: IntArray
    time_ns: IntArray
    channel: NDArray[np.uint16]
    signal: NDArray[np.int8]
    value: FloatArray
    quality: ByteArray


class Group(NamedTuple):
    """Chunks that are read together: their offsets, log times and channels."""

    chunks: tuple[int, ...]
    first_ns: int
    last_ns: int
    channels: frozenset[int]


@dataclass(slots=True)
class FileContents:
    """Contents of one file."""

    path: str
    table: TopicTable
    findings: Findings
    groups: list[Group] = field(default_factory=list)
    rows: list[Rows] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    misfits: Counter[int] = field(default_factory=Counter)
    announced: int | None = None

    @property
    def messages(self) -> int:
        """Number of messages found."""
        return self.counts.total()

    @property
    def orphans(self) -> int:
        """Number of messages whose topic is unknown."""
        return sum(n for channel, n in self.counts.items() if channel not in self.table.channels)


# Offset of each value in its group, to merge several kinds in file order.
Placed = tuple[IntArray, Rows]


def float_rows(content: bytes, table: MessageTable, mine: IntArray) -> tuple[Placed, IntArray]:
    """Return the values of the Float64 messages ``mine``, and the malformed ones of them."""
    size = table.size if len(mine) == len(table) else table.size[mine]
    fitting = (size == _SIZES[0]) | (size == _SIZES[1])
    picked = mine if fitting.all() else mine[fitting]
    payload = rows(content, _PAYLOAD, HEAD_SIZE, table.offset[picked])
    mark = payload['mark']
    value = np.ascontiguousarray(payload['value'])
    if (mark == 0).any():
        value = np.where(mark == 0, value.byteswap(), value)
    plain = mark <= 1
    wrong = np.concatenate([mine[~fitting], picked[~plain]])
    if len(wrong):
        picked, value = picked[plain], value[plain]
    n = len(picked)
    # Usually all messages of a group are selected, in order.
    cut = slice(None) if n == len(table) else picked
    unknown, good = np.full(n, -1, dtype=np.int8), np.zeros(n, dtype=np.uint8)
    times = table.log_time[cut], table.publish_time[cut]
    return (table.offset[cut], Rows(*times, table.channel[cut], unknown, value, good)), wrong


def sample_rows(table: MessageTable, picked: IntArray, samples: Samples) -> Placed:
    """Turn each sample into a reading per signal; an optional signal that is NaN is absent."""
    required = np.array([info.required for info in SIGNALS])
    keep = samples.good[:, None] & (np.isfinite(samples.values) | required)
    message, signal = np.nonzero(keep)
    source = picked[message]
    return table.offset[source], Rows(
        table.log_time[source], samples.time_ns[message], table.channel[source],
        signal.astype(np.int8), samples.values[message, signal], samples.quality[message, signal],
    )  # fmt: skip


def _merged(parts: list[Placed]) -> Rows:
    """Merge values of several kinds in file order."""
    if len(parts) == 1:
        return parts[0][1]
    order = np.argsort(np.concatenate([offset for offset, _ in parts]), kind='stable')
    columns = zip(*(found for _, found in parts), strict=True)
    return Rows(*(np.concatenate(column)[order] for column in columns))


# Larger groups need more memory, smaller ones more calls for the same values.
GROUP_BYTES = 4 << 20


def gather(source: Source, choice: TopicChoice) -> FileContents:
    """Return the contents of one file.

    Raises `RecordingError` if the file contradicts itself or exceeds a limit.
    """
    summary = read_summary(source)
    seed = TopicTable() if summary is None else summary.table
    while True:
        collector = _Collector(source, choice, seed, Scanner(source))
        contents = collector.run()
        if not collector.unnamed & collector.known and not contents.table.replaced:
            break
        # The chunk that first named a topic is lost, but a later one repeats the name, or a
        # record outside of the chunks was damaged. The next pass knows this name from the start,
        # so there is at most one more pass per topic.
        seed = contents.table
    contents.announced = None if summary is None else summary.messages
    return contents


class _Collector:
    def __init__(
        self, source: Source, choice: TopicChoice, seed: TopicTable, scanner: Scanner
    ) -> None:
        self.contents = FileContents(source.path, TopicTable(), scanner.findings)
        self.known: set[int] = set()
        self.unnamed: set[int] = set()
        self._choice = choice
        self._scanner = scanner
        self._heard = 0
        self._floats = np.zeros(1 << 16, dtype=np.bool_)
        self._samples: dict[int, PlantSampleReader] = {}
        try:
            self.contents.table.take_over(seed)
        except LayoutError as error:
            raise RecordingError(source.path, f'cannot be used: {error}') from None
        self._learn()

    def run(self) -> FileContents:
        for chunks in _grouped(self._scanner.chunks()):
            self._hear()
            try:
                self._group(chunks)
            except LayoutError:
                # One of them is malformed: read them one by one to keep the others.
                for chunk in chunks:
                    try:
                        self._group([chunk])
                    except LayoutError as error:
                        why = f'the chunk at byte {chunk.offset}: {error}'
                        self.contents.findings.add_damage(why)
        self._hear()
        return self.contents

    def _hear(self) -> None:
        """Add records from outside of chunks, unless they contradict records with a checksum."""
        new, self._heard = self._scanner.outside[self._heard :], len(self._scanner.outside)
        for record in new:
            try:
                self.contents.table.take(record, checked=False)
            except LayoutError as error:
                self.contents.findings.add_damage(f'a record outside of the chunks: {error}')
        if new:
            self._learn()

    def _group(self, chunks: list[Chunk]) -> None:
        content = b''.join(chunk.content for chunk in chunks)
        table, others = walk(content)
        checked = chunks[0].checked
        for op, record in others:
            try:
                self.contents.table.add(op, record, checked)
            except LayoutError as error:
                if not checked:
                    raise
                problem = f'cannot be used: {error}'
                raise RecordingError(self.contents.path, problem) from None
        if others:
            self._learn()
        if not len(table):
            return
        per_channel = np.bincount(table.channel)
        present = np.flatnonzero(per_channel).tolist()
        self.contents.counts.update({channel: int(per_channel[channel]) for channel in present})
        self.unnamed |= set(present) - self.known
        offsets = tuple(chunk.offset for chunk in chunks)
        times = int(table.log_time.min()), int(table.log_time.max())
        self.contents.groups.append(Group(offsets, *times, frozenset(present)))
        self._values(content, table, present)

    def _values(self, content: bytes, table: MessageTable, present: list[int]) -> None:
        parts: list[Placed] = []
        if self._floats[present].any():
            mine = np.flatnonzero(self._floats[table.channel])
            part, wrong = float_rows(content, table, mine)
            parts.append(part)
            self.contents.misfits.update(table.channel[wrong].tolist())
        for channel in present:
            if channel in self._samples:
                picked = np.flatnonzero(table.channel == channel)
                samples = self._samples[channel].read(content, table, picked)
                parts.append(sample_rows(table, picked, samples))
                self.contents.misfits.update(table.channel[picked[~samples.good]].tolist())
        if parts:
            self.contents.rows.append(_merged(parts))

    def _learn(self) -> None:
        table = self.contents.table
        for number, channel in table.channels.items():
            if number in self.known or channel.schema_id not in table.schemas:
                continue
            self.known.add(number)
            type_name = table.type_of(channel)
            matters = self._choice.may_matter(channel.topic, type_name)
            if channel.message_encoding != 'cdr' or not matters:
                continue
            if type_name == FLOAT64:
                self._floats[number] = True
            elif type_name == PLANT_SAMPLE:
                try:
                    reader = PlantSampleReader(table.definition_of(channel))
                except LayoutError as error:
                    problem = f"the topic '{channel.topic}' cannot be read: {error}"
                    raise RecordingError(self.contents.path, problem) from None
                self._samples[number] = reader


def _grouped(chunks: Iterator[Chunk]) -> Iterator[list[Chunk]]:
    """Group chunks; those with and without a checksum are never in the same group."""
    group: list[Chunk] = []
    size = 0
    for chunk in chunks:
        if group and chunk.checked != group[0].checked:
            yield group
            group, size = [], 0
        group.append(chunk)
        size += len(chunk.content)
        if size >= GROUP_BYTES:
            yield group
            group, size = [], 0
    if group:
        yield group
