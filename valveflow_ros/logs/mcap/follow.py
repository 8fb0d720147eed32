# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Follows a recording while it is written: each call reads only what was added.

Only the position, the topics of the file and small attachments are kept in memory,
so a recording may grow for months.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.well_known import MessageEncoding

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.cdr import Decoder, PlantSampleReader
from valveflow_ros.logs.mcap.folder import Split, in_order, recording_files
from valveflow_ros.logs.mcap.gather import Rows, float_rows, sample_rows
from valveflow_ros.logs.mcap.records import (
    FOOTER_SIZE,
    MAGIC,
    RECORD_HEAD,
    LayoutError,
    MessageTable,
    TopicTable,
    ends_well,
    unpack_attachment,
    walk,
)
from valveflow_ros.logs.mcap.scan import (
    CHUNK_HEAD_SIZE,
    KINDS,
    Scanner,
    candidates,
    has_chunk_at,
    is_foreign,
)
from valveflow_ros.logs.names import FLOAT64, PLANT_SAMPLE, last_part, signal_of
from valveflow_ros.logs.part_file import PART_SUFFIX, is_held
from valveflow_ros.logs.source import RECORD_BYTES, OverBudgetError, Source
from valveflow_ros.records import NS_PER_S, SIGNALS, Signal

# A monitor publishes its state again within a day, so older messages are not needed.
LOOK_BACK_NS = 25 * 3600 * NS_PER_S


def _final(path: Path) -> Path:
    """Return the name that a file has when it is finished."""
    return path.with_suffix('') if path.suffix == PART_SUFFIX else path


def _files_in(folder: Path) -> list[Path]:
    return in_order({_final(path) for path in recording_files(folder)})


def _first_in(folder: Path) -> Path | None:
    """Return the first file with messages of the last 25 hours; None if there is no file."""
    begin: Path | None = None
    newest = 0
    for path in reversed(_files_in(folder)):
        split = Split.read(path) if path.exists() else None
        if split is not None and split.messages:
            newest = newest or split.end_ns
            if begin is not None and split.end_ns < newest - LOOK_BACK_NS:
                break
        begin = path
    return begin


_MOST_ATTACHED = 1 << 20
_MOST_ADDED = 256  # bytes that a later version of the format may add to a record
_GROUP_BYTES = 1 << 20
_NEAR = 1 << 12
# Records of known length, which distinguishes them from a chunk with a damaged opcode.
_LAST = {int(Opcode.DATA_END): 4, int(Opcode.FOOTER): 20}


@dataclass(frozen=True, slots=True)
class Batch:
    """Messages that were added: content of some chunks, the messages in it, their topics.

    ``share`` is the fraction of the existing files that has been read so far, 0 to 1.
    """

    content: bytes
    messages: MessageTable
    topics: TopicTable
    share: float


class Follower:
    """Reads a recording; each call continues where the last one stopped.

    ``path`` is an ``.mcap`` file, an ``.mcap.part`` file, or the folder of a recording, finished
    or growing. A file may be renamed to its final name meanwhile, and a folder may get further
    files. ``attachments`` are small attached files by name, ``damaged`` is the number of places
    where data were left out. Raises `RecordingError` if ``path`` is not a recording.
    """

    def __init__(self, path: Path) -> None:
        self.attachments: dict[str, bytes] = {}
        self.damaged = 0
        self._folder = path if path.is_dir() else None
        self._current: Path | None = None if self._folder else _final(path)
        self._ended = False
        self._started = self._current
        self._order: list[Path] = []
        self._begin()
        if self._folder is None:
            with self._open() as source:
                if source.size >= len(MAGIC) and source.read(0, len(MAGIC)) != MAGIC:
                    raise RecordingError(path, 'is not an MCAP file; only those can be followed')

    def _begin(self) -> None:
        self._topics = TopicTable()
        self._position = len(MAGIC)
        self._ended = False
        self._inode = 0

    @property
    def name(self) -> str:
        """Return the name of the current file; empty if there is none yet."""
        return '' if self._current is None else self._current.name

    @property
    def finished(self) -> bool:
        """Return True if the current file is finished and all of it was read."""
        return self._ended

    @property
    def written(self) -> bool:
        """Return True if a living writer holds the current file."""
        if self._current is not None:
            with suppress(OSError):
                return is_held(self._part)
        return False

    @property
    def _part(self) -> Path:
        """Return the name that the current file has while it is written."""
        return Path(f'{self._current}{PART_SUFFIX}')

    @property
    def size(self) -> int:
        """Return the number of bytes read from the current file."""
        return self._position

    def read(self) -> Iterator[Batch]:
        """Yield what was added since the last call; raises `RecordingError`."""
        while self._find():
            yield from self._rest_of_file()
            following = self._following()
            if following is None:
                return
            self._current = following
            self._begin()

    def _find(self) -> bool:
        if self._current is None and self._folder is not None:
            self._current = self._started = _first_in(self._folder)
        return self._current is not None and not (self._folder is None and self._ended)

    def _following(self) -> Path | None:
        """Return the next file, or None if there is none or the current one may still grow."""
        if self._folder is None or self._current is None or (not self._ended and self.written):
            return None
        later = in_order({*_files_in(self._folder), self._current})
        place = later.index(self._current) + 1
        return later[place] if place < len(later) else None

    def _open(self) -> Source:
        """Open the current file, under its temporary or its final name."""
        assert self._current is not None
        try:
            return Source.open(self._part)
        except RecordingError:
            return Source.open(self._current)

    def _rest_of_file(self) -> Iterator[Batch]:
        if self._ended:
            return
        with self._open() as source:
            inode = os.fstat(source.stream.fileno()).st_ino
            if self._inode and inode != self._inode:
                # It was recovered into a new file, in which the positions differ.
                self._begin()
            self._inode = inode
            scanner = Scanner(source)
            added = bytearray()
            while (content := self._next(source, scanner)) is not None:
                added += content
                if len(added) >= _GROUP_BYTES:
                    yield from self._batch(bytes(added), source)
                    added.clear()
            yield from self._batch(bytes(added), source)

    def _next(self, source: Source, scanner: Scanner) -> bytes | None:
        """Return the content of a chunk or messages, b'' for another record, None at the end."""
        start = self._position
        head = source.read(start, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return None
        op, length = RECORD_HEAD.unpack(head)
        after = start + RECORD_HEAD.size + length
        if op in _LAST and 0 <= length - _LAST[op] < _MOST_ADDED:
            whole = source.size >= after + FOOTER_SIZE
            self._ended = whole and source.read(source.size - len(MAGIC), len(MAGIC)) == MAGIC
            return None
        known = op in KINDS or is_foreign(source, start)
        if not known or op in _LAST or (op == Opcode.CHUNK and length < CHUNK_HEAD_SIZE):
            return self._beyond_damage(source)
        if after > source.size:
            if self.written and length <= RECORD_BYTES:
                return None
            return self._beyond_damage(source, sure=False)
        if op in (Opcode.CHUNK, Opcode.MESSAGE):
            return self._chunk(source, scanner, after)
        self._position = after
        if op == Opcode.ATTACHMENT:
            self._attach(source, start, length)
        elif op in (Opcode.SCHEMA, Opcode.CHANNEL) and length <= _MOST_ATTACHED:
            content = source.read(start + RECORD_HEAD.size, length)
            try:
                self._topics.add(op, content, checked=False)
            except LayoutError:
                self.damaged += 1
        return b''

    def _chunk(self, source: Source, scanner: Scanner, after: int) -> bytes | None:
        start = self._position
        try:
            chunk = scanner.chunk_at(start)
        except OverBudgetError:
            self.damaged += 1
            self._position = source.size
            return None
        except LayoutError:
            # The length is trusted if it agrees with the fields of the chunk head.
            if not has_chunk_at(source, start):
                return self._beyond_damage(source)
            self.damaged += 1
            self._position = after
            return b''
        self._position = chunk.end
        return chunk.content

    def _beyond_damage(self, source: Source, sure: bool = True) -> bytes | None:
        """Skip to the next chunk; without one, wait for more data unless damage is ``sure``."""
        start, size = self._position + 1, source.size
        # Search a short range first, because there may be many false heads side by side.
        near = min(start + _NEAR, size)
        heads = chain(candidates(source, start, near), candidates(source, near, size))
        found = next(heads, None)
        self._ended = found is None and ends_well(source)
        if found is None and not (sure or self._ended):
            return None
        self.damaged += 1
        self._position = source.size if found is None else found
        return None if found is None else b''

    def _attach(self, source: Source, start: int, length: int) -> None:
        if length > _MOST_ATTACHED:
            return
        try:
            found = unpack_attachment(source.read(start + RECORD_HEAD.size, length))
        except LayoutError:
            self.damaged += 1
            return
        self.attachments[found.name] = found.data

    def _batch(self, content: bytes, source: Source) -> Iterator[Batch]:
        if not content:
            return
        try:
            messages, others = walk(content)
            for op, record in others:
                self._topics.add(op, record)
        except LayoutError:
            self.damaged += 1
            return
        yield Batch(content, messages, self._topics, self._share(source))

    def _share(self, source: Source) -> float:
        """Return the fraction that has been read, assuming files of equal size."""
        inside = self._position / max(1, source.size)
        if self._folder is None or self._current is None:
            return min(1.0, inside)
        if self._current not in self._order:
            self._order = in_order({*_files_in(self._folder), self._current})
        begun = self._order.index(self._started) if self._started in self._order else 0
        done = self._order.index(self._current) - begun
        return min(1.0, (done + inside) / max(1, len(self._order) - begun))


_INPUTS = {info.topic for info in SIGNALS}


class Raw(NamedTuple):
    """A message that is decoded only if it is needed."""

    decoder: Decoder
    data: bytes

    @property
    def type(self) -> str:
        """Return the type name."""
        return self.decoder.type_name


class Picker:
    """Decodes messages with the definitions in the recording; counts those that do not match."""

    def __init__(self) -> None:
        self.misfits = 0
        self._decoders: dict[tuple[str, ...], Any] = {}

    def last(self, batch: Batch, wanted: dict[str, int]) -> Iterator[Raw]:
        """Yield the last messages, not decoded yet, in file order.

        ``wanted`` gives, for each type, the maximum number of messages per topic.
        """
        picked: list[tuple[int, Decoder]] = []
        for channel, type_name, definition in _channels(batch):
            if type_name not in wanted:
                continue
            decoder: Decoder | None = self._made(Decoder, type_name, definition)
            mine = np.flatnonzero(batch.messages.channel == channel)[-wanted[type_name] :]
            if decoder is not None:
                picked += [(row, decoder) for row in mine.tolist()]
        for row, decoder in sorted(picked, key=lambda item: item[0]):
            yield Raw(decoder, batch.messages.payload(batch.content, row))

    def fields(self, raw: Raw) -> dict[str, Any] | None:
        """Decode a message; if it does not match its definition, count it and return None."""
        try:
            return raw.decoder.decode(raw.data)
        except RecordingError:
            self.misfits += 1
            return None

    def readings(
        self, batch: Batch, told: Mapping[str, str] | None = None
    ) -> Iterator[tuple[Signal, str, Rows]]:
        """Yield signal, type of the message and rows (in file order) of the inputs.

        ``told`` is the topic of each input that the recording names; see `told_inputs`.
        """
        messages, told = batch.messages, told or {}
        names = {topic: name for name, topic in told.items()}
        for channel, type_name, definition in _channels(batch):
            topic = batch.topics.channels[channel].topic
            mine = np.flatnonzero(messages.channel == channel)
            name = names.get(topic, last_part(topic))
            # Another topic is not an input, even if the last part of its name is that of one.
            if type_name == FLOAT64 and name in _INPUTS and told.get(name, topic) == topic:
                (_, found), wrong = float_rows(batch.content, messages, mine)
                self.misfits += len(wrong)
                yield signal_of(name), type_name, found
            elif type_name == PLANT_SAMPLE:
                reader: PlantSampleReader | None = self._made(PlantSampleReader, definition)
                if reader is None:
                    continue
                samples = reader.read(batch.content, messages, mine)
                self.misfits += int((~samples.good).sum())
                _, found = sample_rows(messages, mine, samples)
                for number in np.unique(found.signal).tolist():
                    keep = found.signal == number
                    yield Signal(number), type_name, Rows(*(column[keep] for column in found))

    def _made(self, make: Callable[..., Any], *key: str) -> Any:
        """Return the cached decoder of a definition; None if it cannot be parsed."""
        if key not in self._decoders:
            try:
                self._decoders[key] = make(*key)
            except (RecordingError, LayoutError):
                self._decoders[key] = None
        return self._decoders[key]


def _channels(batch: Batch) -> Iterator[tuple[int, str, str]]:
    """Yield id, type and definition of the known channels that occur in a batch."""
    for number in np.unique(batch.messages.channel).tolist():
        channel = batch.topics.channels.get(number)
        if channel is not None and channel.message_encoding == MessageEncoding.CDR:
            definition = batch.topics.definition_of(channel)
            yield number, batch.topics.type_of(channel), definition
