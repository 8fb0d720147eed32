# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Finds every intact chunk of an MCAP file, even if the rest is damaged.

The file is read record by record. Where a record is damaged, the reader
searches the following bytes for the head of a chunk. A chunk is used only if
its content has the stated checksum. Nothing is repaired, so a damaged file
yields fewer values but never wrong ones. Indexes are not used, because an
unfinished file has none.

Chunks without a checksum and messages outside of chunks are used and counted,
because damage in them cannot be detected.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.records import Chunk as ChunkRecord

from valveflow_ros.errors import counted
from valveflow_ros.logs import source as limits
from valveflow_ros.logs.mcap.chunk_file import CHUNK_BYTES
from valveflow_ros.logs.mcap.records import (
    FIRST_FOREIGN,
    HEAD_SIZE,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    LayoutError,
    TopicTable,
    Unpacker,
    definition,
    ends_well,
    leading_messages,
    pack,
    summary_damaged,
    unpack,
    unpack_attachment,
)
from valveflow_ros.logs.source import Budget, OverBudgetError, Source

# A chunk record: opcode 6, a length below 64 GiB, four fixed fields, then the
# name of the compression. `_fields_agree` checks the length.
_SHAPE = re.compile(
    rb'\x06.{4}[\x00-\x0f]\x00{3}.{28}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)', re.DOTALL
)
# More than the size of a chunk head.
SHAPE_SIZE = 64
# Times, size and checksum; then come the name of the compression and the packed bytes.
CHUNK_HEAD_SIZE = 28
_WINDOW = 1 << 22


def candidates(source: Source, start: int, end: int) -> Iterator[int]:
    """Yield offsets in ``[start, end)`` where the fields of a chunk head are consistent."""
    while start < end:
        limit = min(_WINDOW, end - start)
        window = source.read(start, limit + SHAPE_SIZE)
        match = _SHAPE.search(window)
        while match is not None and match.start() < limit:
            if _fields_agree(window, match):
                yield start + match.start()
            # Continue at the next byte: a false head may overlap a true one.
            match = _SHAPE.search(window, match.start() + 1)
        start += _WINDOW


def has_chunk_at(source: Source, position: int) -> bool:
    """Return True if the fields of a chunk head at a position are consistent."""
    return next(candidates(source, position, position + 1), None) is not None


def _fields_agree(window: bytes, match: re.Match[bytes] | None) -> bool:
    if match is None or match.end() + 8 > len(window):
        return False
    length = RECORD_HEAD.unpack_from(window, match.start())[1]
    packed = int.from_bytes(window[match.end() : match.end() + 8], 'little')
    return bool(match.end() + 8 - match.start() - RECORD_HEAD.size + packed == length)


def _is_chunk_of_another_kind(raw: bytes) -> bool:
    """Return True if bytes begin a chunk whose opcode is damaged."""
    chunk = bytes([Opcode.CHUNK]) + raw[1:]
    return _fields_agree(chunk, _SHAPE.match(chunk))


def is_foreign(source: Source, position: int) -> bool:
    """Return True if the opcode of a record is unknown to the format; such records are skipped.

    Returns False if the content is that of a chunk or an attachment with a damaged opcode.
    """
    raw = source.read(position, SHAPE_SIZE)
    if len(raw) < RECORD_HEAD.size or raw[0] < FIRST_FOREIGN:
        return False
    _, length = RECORD_HEAD.unpack_from(raw)
    if _is_chunk_of_another_kind(raw):
        return False
    try:
        unpack_attachment(source.read(position + RECORD_HEAD.size, min(length, _WINDOW)))
    except LayoutError:
        return True
    return False


_INDEX_HEAD = struct.Struct('<BQHI')
_INDEX_BLOCK = 4096
KINDS = frozenset(int(op) for op in Opcode)
# Shorter records cannot contain a chunk.
_SMALLEST_CHUNK = RECORD_HEAD.size + CHUNK_HEAD_SIZE + 12


@dataclass(frozen=True, slots=True)
class Chunk:
    """An intact chunk: its offset in the file, its raw record and its unpacked content.

    ``end`` is the offset of the next record. ``record`` excludes fields that a later version of
    the format added. If ``record`` is empty, ``content`` is a run of messages outside of chunks.
    If the writer gave no checksum, ``checked`` is False, and ``record`` has the checksum of the
    content.
    """

    offset: int
    record: bytes
    content: bytes
    compression: str
    end: int
    checked: bool = True


@dataclass(slots=True)
class Findings:
    """What a scan found besides the content of intact chunks.

    ``unchecked`` of the ``chunks`` have no checksum; ``bare_messages`` are outside of chunks.
    ``whole`` is True if the checksum of the whole data section is correct, and None if the file
    has none. ``summary_damaged`` is True if the summary of a finished file cannot be used.
    """

    chunks: int = 0
    damaged: int = 0
    unchecked: int = 0
    bare_messages: int = 0
    whole: bool | None = None
    summary_damaged: bool = False
    finished: bool = False
    cut_off_at: int | None = None
    begins_well: bool = True
    over_budget: bool = False
    reasons: list[str] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)

    def add_damage(self, reason: str) -> None:
        """Count a damaged chunk or section; the first eight reasons are kept."""
        self.damaged += 1
        if len(self.reasons) < 8:
            self.reasons.append(reason)


class Scanner:
    """Scans a file once; `findings` is complete when `chunks` is exhausted."""

    def __init__(self, source: Source) -> None:
        self.findings = Findings()
        # The records found so far outside of chunks, each once.
        self.outside: list[Schema | Channel] = []
        self._outside_table = TopicTable()
        self._in_summary = False
        self._source = source
        self._budget = Budget(source.size)
        self._attachment_bytes_left = limits.ATTACHMENT_BYTES
        self._unpacker = Unpacker()
        self._before = b''

    def chunks(self) -> Iterator[Chunk]:
        """Yield the intact chunks, and the runs of messages between them, in file order.

        Raises `RecordingError` only if the device fails.
        """
        try:
            yield from self._follow()
        except OverBudgetError:
            self.findings.over_budget = True

    def chunk_at(self, offset: int) -> Chunk:
        """Return the chunk or run of messages at ``offset``; raises `LayoutError`."""
        op, length = self._head(offset)
        return self._chunk(offset, length) if op == Opcode.CHUNK else self._run(offset, length)

    def _follow(self) -> Iterator[Chunk]:
        source, findings = self._source, self.findings
        findings.finished = ends_well(source)
        findings.summary_damaged = findings.finished and summary_damaged(source)
        findings.begins_well = source.read(0, len(MAGIC)) == MAGIC
        position = len(MAGIC) if findings.begins_well else 0
        while position < source.size and not self._is_end(position):
            chunk, position = self._step(position)
            if chunk is not None:
                yield chunk
                position = self._behind_indexes(position)

    def _behind_indexes(self, position: int) -> int:
        """Return the end of the consistent message indexes that follow a chunk.

        They are most of the records in the file of a slow plant. An index is
        consistent if its record length agrees with the length in its content.
        """
        block, place = b'', 0
        while True:
            if place + _INDEX_HEAD.size > len(block):
                # The indexes of large chunks are longer than one block.
                position, place = position + place, 0
                block = self._source.read(position, _INDEX_BLOCK)
                if len(block) < _INDEX_HEAD.size:
                    return position
            op, length, _, inner = _INDEX_HEAD.unpack_from(block, place)
            after = place + RECORD_HEAD.size + length
            consistent = op == Opcode.MESSAGE_INDEX and inner == length - 6
            if not consistent or position + after > self._source.size:
                return position + place
            place = after

    def _step(self, position: int) -> tuple[Chunk | None, int]:
        """Process the record at a position; return its chunk, if any, and the next position."""
        op, length = self._head(position)
        after = position + RECORD_HEAD.size + length
        problem = ''
        if op == Opcode.MESSAGE:
            with suppress(LayoutError):
                run = self._run(position, length)
                return run, run.end
        if op == Opcode.CHUNK:
            try:
                chunk = self._accept(position, length)
            except LayoutError as error:
                if after <= self._source.size:
                    self._budget.spend(length, in_vain=True)
                    problem = f'the chunk at byte {position}: {error}'
                # The length is trusted if it agrees with the fields of the chunk head.
                if has_chunk_at(self._source, position) and self._plausible(after):
                    self.findings.add_damage(problem)
                    return None, after
            else:
                return chunk, chunk.end
        elif self._known(op, position) and after <= self._source.size and self._plausible(after):
            hidden = self._inside(op, position, length)
            return hidden, (after if hidden is None else hidden.end)
        return self._resynchronise(position, problem)

    def _resynchronise(self, position: int, problem: str) -> tuple[Chunk | None, int]:
        chunk = self._seek(position + 1, self._source.size)
        if chunk is None and not problem and not self.findings.finished:
            self.findings.cut_off_at = position
            return None, self._source.size
        self.findings.add_damage(problem or f'the chain of records breaks at byte {position}')
        return chunk, (self._source.size if chunk is None else chunk.end)

    def _seek(self, start: int, end: int) -> Chunk | None:
        """Return the first intact chunk whose record begins in ``[start, end)``."""
        for position in candidates(self._source, start, end):
            _, length = self._head(position)
            try:
                return self._accept(position, length)
            except LayoutError:
                self._budget.spend(length, in_vain=True)
        return None

    def _accept(self, position: int, length: int) -> Chunk:
        chunk = self._chunk(position, length)
        self.findings.chunks += 1
        self.findings.unchecked += not chunk.checked
        return chunk

    def _chunk(self, position: int, length: int) -> Chunk:
        if length > limits.RECORD_BYTES:
            raise LayoutError(f'its length of {length} bytes is beyond all bounds')
        raw = self._source.read(position, RECORD_HEAD.size + length)
        if len(raw) < RECORD_HEAD.size + length:
            raise LayoutError('it is cut off')
        self._budget.spend(length)
        found = unpack(ChunkRecord.read, raw[RECORD_HEAD.size :])
        size, crc, name = found.uncompressed_size, found.uncompressed_crc, found.compression
        exact = CHUNK_HEAD_SIZE + 12 + len(name.encode()) + len(found.data)
        end = position + RECORD_HEAD.size + length
        # A later version of the format may add fields at the end, but a damaged length must not
        # hide the chunks that follow.
        inner_end = position + RECORD_HEAD.size + exact
        hides = exact < length and (self._begins_record(inner_end) or not self._plausible(end))
        if exact > length or hides:
            raise LayoutError('its length disagrees with its content')
        if size > limits.CHUNK_CONTENT_BYTES:
            raise LayoutError(f'it claims to unpack to {size} bytes, which is beyond all bounds')
        self._budget.spend(size)
        content = self._unpacker.unpack(name, found.data, size)
        actual = zlib.crc32(content)
        checked = actual == crc
        # In this format 0 means that there is no checksum.
        if crc and not checked:
            raise LayoutError('its checksum is wrong')
        if exact != length or not checked:
            raw = pack(replace(found, uncompressed_crc=actual))
        self._before = content
        return Chunk(position, raw, content, name, end, checked)

    def _run(self, position: int, length: int) -> Chunk:
        """Return the messages that start at a position, up to about the size of a chunk."""
        if length > limits.RECORD_BYTES:
            raise LayoutError(f'its length of {length} bytes is beyond all bounds')
        raw = self._source.read(position, max(CHUNK_BYTES, RECORD_HEAD.size + length))
        number, size = leading_messages(raw)
        if not number or self._disguised(position, length):
            raise LayoutError('there is no message')
        self._budget.spend(size)
        self.findings.bare_messages += number
        return Chunk(position, b'', raw[:size], '', position + size, checked=False)

    def _disguised(self, position: int, length: int) -> bool:
        """Return True if a message is in fact another record with a damaged opcode.

        Otherwise one wrong bit would add a message without a checksum to an intact file.
        """
        if position <= len(MAGIC) or self._in_summary:
            # The header comes first, and the summary has no messages.
            return True
        raw = self._source.read(position, max(SHAPE_SIZE, HEAD_SIZE))
        if _is_chunk_of_another_kind(raw):
            return True
        if len(raw) >= HEAD_SIZE:
            # A message index holds a channel, a length, and time and offset of a message.
            channel, inner, log_time, place = MESSAGE_HEAD.unpack_from(raw, RECORD_HEAD.size)
            content = self._before[place : place + HEAD_SIZE]
            if inner == length - 6 and len(content) == HEAD_SIZE:
                first = MESSAGE_HEAD.unpack_from(content, RECORD_HEAD.size)
                if (channel, log_time) == (first[0], first[2]):
                    return True
        if length > limits.DEFINITION_BYTES:
            return False
        content = self._source.read(position + RECORD_HEAD.size, length)
        try:
            return pack(unpack(Channel.read, content))[RECORD_HEAD.size :] == content
        except LayoutError:
            return False

    def _inside(self, op: int, position: int, length: int) -> Chunk | None:
        """Process a record other than a chunk; return a chunk that a wrong length would hide."""
        if op == Opcode.MESSAGE:
            large = length > limits.RECORD_BYTES
            why = 'is larger than can be read' if large else 'cannot be one'
            self.findings.add_damage(f'the message at byte {position} {why}')
        if op == Opcode.ATTACHMENT:
            self._attachment(position, length)
            return None
        if op == Opcode.METADATA and length <= limits.DEFINITION_BYTES:
            self._metadata(position, length)
        # The summary, which follows, repeats these records with a checksum.
        if op == Opcode.DATA_END and not self._in_summary:
            self._in_summary = True
            self._data_end(position)
        if op in (Opcode.SCHEMA, Opcode.CHANNEL) and not self._in_summary:
            self._definition(op, position, length)
        start = position + RECORD_HEAD.size
        if length < _SMALLEST_CHUNK:
            return None
        if op == Opcode.MESSAGE_INDEX:
            inner = int.from_bytes(self._source.read(start + 2, 4), 'little')
            if inner == length - 6:
                return None
        return self._seek(start, start + length)

    def _data_end(self, position: int) -> None:
        """Verify the checksum of the data section, which covers records without their own."""
        raw = self._source.read(position + RECORD_HEAD.size, 4)
        wanted = int.from_bytes(raw, 'little')
        if wanted:
            found = 0
            for start in range(0, position, _WINDOW):
                found = zlib.crc32(self._source.read(start, min(_WINDOW, position - start)), found)
            self.findings.whole = found == wanted

    def _attachment(self, position: int, length: int) -> None:
        try:
            if length > self._attachment_bytes_left:
                raise LayoutError(f'the attachment at byte {position} is larger than can be read')
            self._attachment_bytes_left -= length
            content = self._source.read(position + RECORD_HEAD.size, length)
            self.findings.attachments.append(unpack_attachment(content))
        except LayoutError as error:
            self.findings.add_damage(str(error))

    def _metadata(self, position: int, length: int) -> None:
        content = self._source.read(position + RECORD_HEAD.size, length)
        try:
            found = unpack(Metadata.read, content)
        except LayoutError as error:
            self.findings.add_damage(f'the metadata at byte {position}: {error}')
            return
        if len(self.findings.metadata) < limits.MOST_TOPICS:
            self.findings.metadata.append((found.name, found.metadata))

    def _definition(self, op: int, position: int, length: int) -> None:
        """Add a schema or a channel from outside of chunks."""
        kind = 'schema' if op == Opcode.SCHEMA else 'channel'
        try:
            if length > limits.DEFINITION_BYTES:
                raise LayoutError('it is larger than can be read')
            record = definition(op, self._source.read(position + RECORD_HEAD.size, length))
            known = self._outside_table
            before = len(known)
            if record is not None:
                known.take(record, checked=False)
                self.outside += [record] * (len(known) - before)
        except LayoutError as error:
            self.findings.add_damage(f'the {kind} at byte {position}: {error}')

    def _known(self, op: int, position: int) -> bool:
        return op in KINDS or is_foreign(self._source, position)

    def _head(self, position: int) -> tuple[int, int]:
        raw = self._source.read(position, RECORD_HEAD.size)
        if len(raw) < RECORD_HEAD.size:
            return 0, 0
        op, length = RECORD_HEAD.unpack(raw)
        return op, length

    def _is_end(self, position: int) -> bool:
        size = self._source.size
        return position == size - len(MAGIC) and self._source.read(position, 8) == MAGIC

    def _begins_record(self, position: int) -> bool:
        """Return True if a record of a known kind begins here and is not cut off."""
        op, length = self._head(position)
        fits = position + RECORD_HEAD.size + length <= self._source.size
        return fits and self._known(op, position)

    def _plausible(self, position: int) -> bool:
        """Return True if a record, or the end of the file, may begin here."""
        size = self._source.size
        if position == size or self._is_end(position):
            return True
        if not self.findings.finished and 0 <= size - position < SHAPE_SIZE:
            # Too few bytes of the last record to decide.
            return True
        if self._begins_record(position):
            return True
        op, length = self._head(position)
        if position + RECORD_HEAD.size + length <= size or op not in KINDS:
            return False
        # The last chunk of an unfinished file may be cut off, with a consistent head.
        return has_chunk_at(self._source, position)


def why_empty(findings: Findings) -> str:
    """Return why no message could be read from a file."""
    if findings.over_budget:
        return 'unpacks to far more than its size justifies and was not read'
    if not findings.begins_well and not findings.damaged:
        return 'is not an MCAP file'
    if findings.damaged:
        return f'holds no intact chunk of messages ({findings.reasons[0]})'
    if findings.cut_off_at is not None:
        return 'is cut off before its first message'
    return 'holds no messages'


def scan_warnings(findings: Findings, what: str) -> tuple[str, ...]:
    """Return one sentence for each problem of the file that a reader should know."""
    sentences = []
    if findings.cut_off_at is not None:
        sentences.append(
            f'The {what} was not finished and ends at byte {findings.cut_off_at}; '
            'everything before it was read.'
        )
    elif not findings.finished:
        sentences.append(f'The {what} was not finished; everything in it was read.')
    if findings.damaged:
        sentences.append(
            f'The {what} is damaged in {counted(findings.damaged, "place")}; the data there were '
            f'left out ({"; ".join(findings.reasons)}).'
        )
    if findings.over_budget:
        sentences.append(
            f'The {what} unpacks to far more than its size justifies; the rest of it was not read.'
        )
    chunks, messages = findings.unchecked, findings.bare_messages
    if findings.whole is False and (chunks or messages):
        sentences.append(
            f'The checksum of all records of the {what} is wrong; damage in what has no checksum '
            'of its own cannot be located.'
        )
    elif findings.whole is False and not findings.damaged:
        sentences.append(
            f'Bytes of the {what} outside of its chunks are damaged (its checksum is wrong); '
            'every chunk of messages is intact.'
        )
    if findings.summary_damaged:
        sentences.append(f'The summary of the {what} is damaged; the messages do not need it.')
    unchecked = []
    if chunks:
        one = f'chunk of the {what} was', f'chunks of the {what} were'
        unchecked.append(f'{counted(chunks, *one)} written without a checksum')
    if messages:
        one = f'message of the {what} stands', f'messages of the {what} stand'
        unchecked.append(f'{counted(messages, *one)} outside of chunks and without a checksum')
    if unchecked and findings.whole is None:
        sentences.append(f'{" and ".join(unchecked)}; damage there cannot be seen.')
    return tuple(sentences)
