# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parses and packs the records of an MCAP file with the library `mcap`, within our own limits.

Sizes that a file states are not trusted: a length never allocates more than the available bytes,
and a chunk is refused if it does not unpack to the stated size. Two steps do not use the library,
because it would need one Python call per message: finding the messages of a chunk (`walk`) and
packing messages with their index (`chunk_file`).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Footer, McapRecord, Schema, Statistics
from mcap.well_known import SchemaEncoding
from numpy.typing import NDArray

from valveflow_ros.logs.source import DEFINITION_BYTES, MOST_TOPICS, RECORD_BYTES, Source
from valveflow_ros.records import IntArray

MAGIC = b'\x89MCAP0\r\n'
RECORD_HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
FOOTER_SIZE = RECORD_HEAD.size + 20
Record = TypeVar('Record')


class LayoutError(ValueError):
    """Bytes do not have the expected layout; caught within the package."""


class _Content(ReadDataStream):
    """Content of one record; raises on a short read, which the library does not detect."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def unpack(read: Callable[[ReadDataStream], Record], content: bytes) -> Record:
    """Return a record, as in ``unpack(Schema.read, content)``; raises `LayoutError`."""
    try:
        return read(_Content(BytesIO(content)))
    except (EndOfFile, OverflowError):
        raise LayoutError('a record is shorter than what it says it holds') from None
    except UnicodeDecodeError:
        raise LayoutError('a name is not UTF-8') from None


def unpack_attachment(content: bytes) -> Attachment:
    """Return an attachment; raises `LayoutError`, also if it has a wrong checksum."""
    found: Attachment = unpack(Attachment.read, content)
    # The library does not verify the checksum: an intact attachment packs to the same bytes.
    whole = pack(found)[RECORD_HEAD.size :]
    if content not in (whole, whole[:-4] + bytes(4)):
        raise LayoutError(f"the checksum of the attachment '{found.name}' is wrong")
    return found


def pack(*records: McapRecord) -> bytes:
    """Return the bytes of the records, one after the other."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


class Unpacker:
    """Decompresses chunks; use one per thread, because the library is not thread-safe."""

    def __init__(self) -> None:
        self._decompressor = zstandard.ZstdDecompressor()

    def unpack(self, compression: str, packed: bytes, size: int) -> bytes:
        """Return exactly ``size`` bytes or raise `LayoutError`.

        ``size`` is stated by the chunk and already checked against the limit; no more than that
        is allocated for the result.
        """
        try:
            content = self._unpacked(compression, packed, size)
        except LayoutError:
            raise
        except (zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:
            raise LayoutError(f'a chunk cannot be unpacked ({error})') from None
        if len(content) == size:
            return content
        if not compression:
            raise LayoutError('an uncompressed chunk differs from the size it claims')
        raise LayoutError('a chunk unpacks to another size than it claims')

    def _unpacked(self, compression: str, packed: bytes, size: int) -> bytes:
        if compression == 'zstd':
            # The library allocates the size that a frame states, so this size is first compared
            # with that of the chunk.
            stated = zstandard.frame_content_size(packed)
            if stated not in (-1, size):
                raise LayoutError('a chunk unpacks to another size than it claims')
            unpack = self._decompressor.decompress
            return bytes(unpack(packed, max_output_size=size)) if size else b''
        if compression == 'lz4':
            unpacker = lz4.frame.LZ4FrameDecompressor()
            return bytes(unpacker.decompress(packed, max_length=size + 1))
        if compression:
            raise LayoutError(f"unknown compression '{compression[:16]}'")
        return packed


@dataclass(slots=True)
class TopicTable:
    """Schemas and channels in the order in which they are read, each with a unique id.

    Records outside of chunks have no checksum (``unchecked``). They are used until a record with
    a checksum differs from them (``replaced``).
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    definition_bytes: int = 0
    unchecked: set[tuple[str, int]] = field(default_factory=set)
    replaced: bool = False

    def __len__(self) -> int:
        """Return the number of schemas and channels."""
        return len(self.schemas) + len(self.channels)

    def add(self, op: int, content: bytes, checked: bool = True) -> None:
        """Add a raw schema or channel record; raises `LayoutError` as `take`, or if malformed."""
        if record := definition(op, content):
            self.take(record, checked)

    def take(self, record: Schema | Channel, checked: bool = True) -> None:
        """Add a schema or a channel.

        Raises `LayoutError` if it contradicts an earlier one, or a limit is exceeded.
        """
        is_schema = isinstance(record, Schema)
        known: dict[int, Any] = self.schemas if is_schema else self.channels
        key = ('schema' if is_schema else 'channel', record.id)
        before = known.get(record.id)
        if before != record:
            if before is not None and (not checked or key not in self.unchecked):
                raise LayoutError(f'it defines {key[0]} {key[1]} twice, differently')
            self._check_size(len(known) - (before is not None), record)
            self.replaced |= before is not None
            known[record.id] = record
            if not checked:
                self.unchecked.add(key)
        if checked:
            self.unchecked.discard(key)

    def take_over(self, other: TopicTable) -> None:
        """Add all records of another table; raises `LayoutError` like `take`."""
        for kind, known in (('schema', other.schemas), ('channel', other.channels)):
            for number, record in known.items():
                self.take(record, (kind, number) not in other.unchecked)

    def type_of(self, channel: Channel) -> str:
        """Return the type of a channel; empty if the file does not state it."""
        schema = self.schemas.get(channel.schema_id)
        return '' if schema is None else schema.name

    def definition_of(self, channel: Channel) -> str:
        """Return the text of a channel's ros2msg definition; empty if there is none."""
        schema = self.schemas.get(channel.schema_id)
        if schema is None or schema.encoding != SchemaEncoding.ROS2:
            return ''
        return schema.data.decode(errors='replace')

    def _check_size(self, count: int, record: Schema | Channel) -> None:
        if isinstance(record, Schema):
            self.definition_bytes += len(record.data)
            if self.definition_bytes > DEFINITION_BYTES:
                raise LayoutError('its definitions of messages are larger than can be read')
        if count >= MOST_TOPICS:
            raise LayoutError(f'it has more than {MOST_TOPICS} topics')


def definition(op: int, content: bytes) -> Schema | Channel | None:
    """Return a schema or a channel, ``None`` for another record; raises `LayoutError`."""
    readers: dict[int, Any] = {Opcode.SCHEMA: Schema.read, Opcode.CHANNEL: Channel.read}
    record: Schema | Channel | None = unpack(readers[op], content) if op in readers else None
    return record


@dataclass(slots=True)
class Summary:
    """The summary section of a finished file."""

    table: TopicTable = field(default_factory=TopicTable)
    messages: int = 0
    start_ns: int = 0
    end_ns: int = 0
    counts: dict[int, int] = field(default_factory=dict)


def ends_well(source: Source) -> bool:
    """Return True if a file was finished: it ends with a footer and the magic bytes."""
    start = source.size - len(MAGIC) - FOOTER_SIZE
    if start < len(MAGIC):
        return False
    raw = source.read(start, FOOTER_SIZE + len(MAGIC))
    return raw.startswith(RECORD_HEAD.pack(Opcode.FOOTER, 20)) and raw.endswith(MAGIC)


def summary_damaged(source: Source) -> bool:
    """Return True if a finished file has a summary that cannot be read or has a wrong checksum."""
    footer_at = source.size - len(MAGIC) - FOOTER_SIZE
    raw = source.read(footer_at, FOOTER_SIZE)
    footer = unpack(Footer.read, raw[RECORD_HEAD.size :])
    if footer.summary_start == 0:
        return footer.summary_crc not in (0, zlib.crc32(raw[:-4]))
    # A summary that is too large to be read was not damaged.
    return footer_at - footer.summary_start <= RECORD_BYTES and read_summary(source) is None


def read_summary(source: Source) -> Summary | None:
    """Return the summary, or ``None`` if there is none or its checksum is wrong."""
    if not ends_well(source):
        return None
    footer_at = source.size - len(MAGIC) - FOOTER_SIZE
    raw_footer = source.read(footer_at, FOOTER_SIZE)
    footer = unpack(Footer.read, raw_footer[RECORD_HEAD.size :])
    size = footer_at - footer.summary_start
    if footer.summary_start == 0 or not 0 < size <= RECORD_BYTES:
        return None
    raw = source.read(footer.summary_start, size)
    checked = zlib.crc32(raw_footer[:-4], zlib.crc32(raw)) == footer.summary_crc
    if footer.summary_crc and not checked:
        return None
    summary, position = Summary(), 0
    try:
        while position < len(raw):
            op, content = _record_at(raw, position)
            position += RECORD_HEAD.size + len(content)
            if op == Opcode.STATISTICS:
                found = unpack(Statistics.read, content)
                summary.messages = found.message_count
                summary.counts = found.channel_message_counts
                summary.start_ns, summary.end_ns = found.message_start_time, found.message_end_time
            else:
                summary.table.add(op, content, checked)
    except LayoutError:
        return None
    return summary


def _record_at(raw: bytes, position: int) -> tuple[int, bytes]:
    start = position + RECORD_HEAD.size
    op, length = RECORD_HEAD.unpack_from(raw, position) if start <= len(raw) else (0, 0)
    if start + length > len(raw):
        raise LayoutError('a record is shorter than what it says it holds')
    return op, raw[start : start + length]


# Most chunks of a plant are one run of records of equal size (four Float64 topics: 43 bytes each).
# Such a run is found in one step; anything else is read record by record.
HEAD_SIZE = RECORD_HEAD.size + MESSAGE_HEAD.size
HEAD_DTYPE = np.dtype([
    ('op', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
    ('log_time', '<i8'), ('publish_time', '<i8'),
])  # fmt: skip
RUN_PROBE = 64
_FEW_BREAKS = 64
MAX_TOPIC_RECORDS = 1 << 16
# Later versions of the format and private extensions may use opcodes from here on.
FIRST_FOREIGN = max(Opcode) + 1


@dataclass(frozen=True, slots=True)
class MessageTable:
    """The messages of one run of records, in file order.

    Arrays of n: ``channel`` uint16, ``sequence`` uint32 of the writer, ``log_time`` and
    ``publish_time`` int64 in ns since the epoch, ``offset`` int64 of the start of each record,
    ``size`` int64 bytes of each payload, which begins `HEAD_SIZE` after the offset.
    """

    channel: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    log_time: IntArray
    publish_time: IntArray
    offset: IntArray
    size: IntArray

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.channel)

    def payload(self, content: bytes, row: int) -> bytes:
        """Return the raw payload of one message."""
        start = int(self.offset[row]) + HEAD_SIZE
        return content[start : start + int(self.size[row])]


def walk(content: bytes) -> tuple[MessageTable, list[tuple[int, bytes]]]:
    """Return the messages and the schema and channel records of chunk contents.

    Opcodes unknown to the format are skipped. Raises `LayoutError` if a record is cut off, or of
    a kind that is not allowed in a chunk.
    """
    starts, others, _ = _boundaries(content)
    heads = rows(content, HEAD_DTYPE, 0, starts)
    channel, sequence, log_time, publish_time = (
        np.ascontiguousarray(heads[name])
        for name in ('channel', 'sequence', 'log_time', 'publish_time')
    )
    sizes = heads['length'].astype(np.int64) - MESSAGE_HEAD.size
    table = MessageTable(channel, sequence, log_time, publish_time, starts, sizes)
    if len(table) and min(table.log_time.min(), table.publish_time.min()) < 0:
        raise LayoutError('a message claims a time after the year 2262')
    return table, others


def leading_messages(content: bytes) -> tuple[int, int]:
    """Return the number of messages at the beginning of ``content``, and where they end."""
    starts, _, end = _boundaries(content, leading=True)
    heads = rows(content, HEAD_DTYPE, 0, starts)
    late = np.flatnonzero((heads['log_time'] < 0) | (heads['publish_time'] < 0))
    return (int(late[0]), int(starts[late[0]])) if len(late) else (len(starts), end)


def rows(
    content: bytes, dtype: np.dtype[np.void], shift: int, starts: IntArray
) -> NDArray[np.void]:
    """Return a structured row for each of ``starts + shift``.

    The caller ensures that every row lies within ``content``.
    """
    if not len(starts):
        return np.empty(0, dtype)
    runs = _evenly(starts)
    if runs is not None:
        # Equidistant rows are a view, which is ten times as fast as indexing them.
        parts: list[NDArray[np.void]] = [
            np.ndarray((count,), dtype, content, first + shift, (step,))
            for first, step, count in runs
        ]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, dtype=dtype)
    places = len(content) - shift - dtype.itemsize + 1
    view: NDArray[np.void] = np.ndarray((places,), dtype, content, shift, (1,))
    return view[starts]


def _evenly(starts: IntArray) -> list[tuple[int, int, int]] | None:
    """Return start, step and length of equidistant runs; ``None`` if there are too many runs."""
    if len(starts) < RUN_PROBE:
        return None
    steps = np.diff(starts)
    breaks = np.flatnonzero(steps != steps[0])
    if len(breaks) > _FEW_BREAKS:
        return None
    ends = np.r_[breaks + 1, len(starts)]
    begins = np.r_[0, ends[:-1]]
    return [
        (int(starts[begin]), int(steps[0]), int(end - begin))
        for begin, end in zip(begins, ends, strict=True)
        if end > begin
    ]


def _boundaries(
    content: bytes, leading: bool = False
) -> tuple[IntArray, list[tuple[int, bytes]], int]:
    """Return where messages begin, the schema and channel records, and the end.

    If only ``leading`` messages are wanted, the end is before anything else.
    """
    parts: list[IntArray] = []
    singles: list[int] = []
    others: list[tuple[int, bytes]] = []
    position, end, probe = 0, len(content), True
    unpack = RECORD_HEAD.unpack_from
    while position < end:
        whole = position + RECORD_HEAD.size <= end
        op, length = unpack(content, position) if whole else (0, end)
        after = position + RECORD_HEAD.size + length
        if leading and (op != 5 or length < MESSAGE_HEAD.size or after > end):
            break
        if after > end:
            raise LayoutError('a chunk ends in the middle of a record')
        if op == 5:
            if length < MESSAGE_HEAD.size:
                raise LayoutError('a message is shorter than its own head')
            count = _run(content, position, after - position) if probe else 1
            probe = count >= RUN_PROBE
            if count > 1:
                parts += [np.array(singles, dtype=np.int64)]
                parts += [position + (after - position) * np.arange(count, dtype=np.int64)]
                singles = []
                position += count * (after - position)
                continue
            singles.append(position)
        elif op in (Opcode.SCHEMA, Opcode.CHANNEL):
            others.append((op, content[position + RECORD_HEAD.size : after]))
            if len(others) > MAX_TOPIC_RECORDS:
                raise LayoutError('a chunk mentions topics without end')
            probe = True
        elif op < FIRST_FOREIGN:
            raise LayoutError(f'a chunk holds a record of kind {op}')
        position = after
    return np.concatenate([*parts, np.array(singles, dtype=np.int64)]), others, position


def _run(content: bytes, position: int, stride: int) -> int:
    """Return how many successive records from ``position`` have the same opcode and length.

    The look-ahead doubles, so the work is proportional to the length of the run.
    """
    count = (len(content) - position) // stride
    op, length = RECORD_HEAD.unpack_from(content, position)
    known, limit = 0, RUN_PROBE
    while known < count:
        taken = min(limit, count) - known
        first = position + known * stride
        ops: NDArray[np.uint8] = np.ndarray((taken,), 'u1', content, first, (stride,))
        lengths: NDArray[np.uint64] = np.ndarray((taken,), '<u8', content, first + 1, (stride,))
        same = (ops == op) & (lengths == length)
        if not same.all():
            return known + int(same.argmin())
        known, limit = known + taken, 2 * limit
    return count
