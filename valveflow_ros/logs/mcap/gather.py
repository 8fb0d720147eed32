"""Goes through one MCAP file and collects, chunk by chunk, the values that may matter.

Chunks are handled in groups of about a mebibyte, so that a file of many tiny
chunks, as a slow plant leaves it, costs no more than one of a few large ones.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.limits import DEFAULT_LIMITS, Limits
from valveflow_ros.logs.mcap.found import (
    FileContents,
    Group,
    Placed,
    float_rows,
    merged,
    sample_rows,
)
from valveflow_ros.logs.mcap.layout import LayoutError
from valveflow_ros.logs.mcap.plant_sample import PlantSampleReader
from valveflow_ros.logs.mcap.scan import Chunk, Scanner
from valveflow_ros.logs.mcap.summary import read_summary
from valveflow_ros.logs.mcap.topic_table import TopicTable
from valveflow_ros.logs.mcap.walk import MessageTable, walk
from valveflow_ros.logs.names import FLOAT64, PLANT_SAMPLE, TopicChoice
from valveflow_ros.logs.source import Source

# Larger groups cost memory, smaller ones more calls for the same values.
GROUP_BYTES = 4 << 20


def gather(
    source: Source,
    choice: TopicChoice,
    limits: Limits = DEFAULT_LIMITS,
    unchecked: bool = False,
) -> FileContents:
    """Return what one file holds.

    Raises
    ------
    RecordingError
        If the file contradicts itself or claims what cannot be.
    """
    summary = read_summary(source)
    seed = TopicTable(limits) if summary is None else summary.table
    while True:
        collector = _Collector(source, choice, seed, Scanner(source, limits, unchecked))
        contents = collector.run()
        if not collector.unnamed & collector.known:
            break
        # The chunk that first named a topic is lost, but a later one repeats the name. From the
        # next pass on it is known from the beginning, so there is at most one for each topic.
        seed = contents.table
    contents.announced = None if summary is None else summary.messages
    return contents


class _Collector:
    def __init__(
        self, source: Source, choice: TopicChoice, seed: TopicTable, scanner: Scanner
    ) -> None:
        self.contents = FileContents(source.path, TopicTable(seed.limits), scanner.findings)
        self.known: set[int] = set()
        self.unnamed: set[int] = set()
        self._choice = choice
        self._scanner = scanner
        self._floats = np.zeros(1 << 16, dtype=np.bool_)
        self._samples: dict[int, PlantSampleReader] = {}
        self._take_over(seed)

    def run(self) -> FileContents:
        for chunks in _grouped(self._scanner.chunks()):
            try:
                self._group(chunks)
            except LayoutError:
                # One of them is not what its checksum promises; the others are not to suffer.
                for chunk in chunks:
                    self._single(chunk)
        return self.contents

    def _single(self, chunk: Chunk) -> None:
        try:
            self._group([chunk])
        except LayoutError as error:
            self.contents.findings.blame(f'the chunk at byte {chunk.offset}: {error}')

    def _group(self, chunks: list[Chunk]) -> None:
        content = b''.join(chunk.content for chunk in chunks)
        table, others = walk(content)
        for op, record in others:
            try:
                self.contents.table.add(op, record)
            except LayoutError as error:
                problem = f'cannot be used: {error}'
                raise RecordingError(self.contents.path, problem) from None
        if others:
            self._learn()
        if not len(table):
            return
        per_channel = np.bincount(table.channel)
        present = np.flatnonzero(per_channel)
        counts = per_channel[present]
        for channel, count in zip(present.tolist(), counts.tolist(), strict=True):
            self.contents.counts[channel] = self.contents.counts.get(channel, 0) + count
            if channel not in self.known:
                self.unnamed.add(channel)
        self.contents.groups.append(
            Group(
                tuple(chunk.offset for chunk in chunks),
                int(table.log_time.min()),
                int(table.log_time.max()),
                frozenset(present.tolist()),
            )
        )
        self._values(content, table, present.tolist())

    def _values(self, content: bytes, table: MessageTable, present: list[int]) -> None:
        parts: list[Placed] = []
        if self._floats[present].any():
            mine = np.flatnonzero(self._floats[table.channel])
            part, wrong = float_rows(content, table, mine)
            parts.append(part)
            self._count_misfits(table.channel[wrong])
        for channel in present:
            if channel in self._samples:
                picked = np.flatnonzero(table.channel == channel)
                samples = self._samples[channel].read(content, table, picked)
                parts.append(sample_rows(table, picked, samples))
                self._count_misfits(table.channel[picked[~samples.good]])
        if parts:
            self.contents.rows.append(merged(parts))

    def _count_misfits(self, channels: NDArray[np.uint16]) -> None:
        for channel in channels.tolist():
            self.contents.misfits[channel] = self.contents.misfits.get(channel, 0) + 1

    def _take_over(self, seed: TopicTable) -> None:
        try:
            self.contents.table.take_over(seed)
        except LayoutError as error:
            raise RecordingError(self.contents.path, f'cannot be used: {error}') from None
        self._learn()

    def _learn(self) -> None:
        table = self.contents.table
        for number, channel in table.channels.items():
            if number in self.known or channel.schema_id not in table.schemas:
                continue
            self.known.add(number)
            type_name = table.type_of(channel)
            if channel.encoding != 'cdr' or not self._choice.may_matter(channel.topic, type_name):
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
    group: list[Chunk] = []
    size = 0
    for chunk in chunks:
        group.append(chunk)
        size += len(chunk.content)
        if size >= GROUP_BYTES:
            yield group
            group, size = [], 0
    if group:
        yield group
