"""Writes an MCAP file chunk by chunk and, at the end, the index that stock readers ask for.

It knows after every failure which chunks are whole on disk, because it counts
the bytes that were taken, and it takes chunks as they are, so that `recover`
copies them without touching a message.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.logs.mcap.layout import (
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ZSTD,
    Attachment,
    Op,
    Packer,
    pack_chunk,
    pack_footer,
    pack_header,
    pack_metadata,
    pack_text,
    record,
)
from valveflow_ros.logs.mcap.summary import TopicTable
from valveflow_ros.logs.part_file import Writable
from valveflow_ros.records import IntArray

# Gathers messages until they are worth a chunk.

CHUNK_BYTES = 64 * 1024
_HEAD = struct.Struct('<BQHIQQ')


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A chunk record ready to be written, and what an index says about it.

    Attributes
    ----------
    record : bytes
        The whole record.
    channel : uint16 (n,)
        Channel of each message.
    log_time : int64 (n,)
        Receipt time of each message, ns since the epoch.
    offset : int64 (n,)
        Where each message begins in the unpacked content.
    unpacked_size : int
        Bytes of the content.
    compression : str
        How the record is compressed.
    """

    record: bytes
    channel: NDArray[np.uint16]
    log_time: IntArray
    offset: IntArray
    unpacked_size: int
    compression: str

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.channel)


def pack_content(
    content: bytes,
    channel: NDArray[np.uint16],
    log_time: IntArray,
    offset: IntArray,
    packer: Packer,
) -> PackedChunk:
    """Compress records, of which the messages are described by the arrays, into a chunk."""
    start, end = (int(log_time.min()), int(log_time.max())) if len(log_time) else (0, 0)
    record = pack_chunk(start, end, content, ZSTD, packer.pack(content))
    return PackedChunk(record, channel, log_time, offset, len(content), ZSTD)


class ChunkBuilder:
    """Messages that wait for their chunk, in the order in which they came."""

    def __init__(self) -> None:
        self._records = bytearray()
        self._channels: list[int] = []
        self._log_times: list[int] = []
        self._offsets: list[int] = []
        self._packer = Packer()

    def __len__(self) -> int:
        """Return the number of waiting messages."""
        return len(self._channels)

    @property
    def size(self) -> int:
        """Return the bytes of the waiting messages."""
        return len(self._records)

    @property
    def first_log_ns(self) -> int:
        """Return the log time of the first waiting message."""
        return self._log_times[0]

    def add(
        self, channel: int, sequence: int, log_time_ns: int, publish_time_ns: int, data: bytes
    ) -> None:
        """Append a message."""
        head = _HEAD.pack(
            Op.MESSAGE,
            MESSAGE_HEAD.size + len(data),
            channel,
            sequence & 0xFFFFFFFF,
            log_time_ns,
            publish_time_ns,
        )
        self._offsets.append(len(self._records))
        self._channels.append(channel)
        self._log_times.append(log_time_ns)
        self._records += head
        self._records += data

    def build(self, table: bytes = b'') -> PackedChunk:
        """Return the waiting messages as a chunk, ``table`` standing before them; keep them."""
        offsets = np.array(self._offsets, dtype=np.int64) + len(table)
        return pack_content(
            table + bytes(self._records),
            np.array(self._channels, dtype=np.uint16),
            np.array(self._log_times, dtype=np.int64),
            offsets,
            self._packer,
        )

    def clear(self) -> None:
        """Forget the waiting messages: they are on disk."""
        self._records = bytearray()
        self._channels = []
        self._log_times = []
        self._offsets = []


_INDEX_ROW = np.dtype([('log_time', '<i8'), ('offset', '<i8')])
_CHUNK_INDEX_HEAD = struct.Struct('<QQQQ')
_STATISTICS = struct.Struct('<QHIIIIQQ')
_GROUPS = (
    Op.SCHEMA,
    Op.CHANNEL,
    Op.STATISTICS,
    Op.CHUNK_INDEX,
    Op.ATTACHMENT_INDEX,
    Op.METADATA_INDEX,
)


class ChunkFile:
    """One file being written.

    Every method raises `OSError` as the file does; after one the file is to
    be abandoned, and `messages` and `counts` say what is whole on disk.

    Attributes
    ----------
    messages : int
        Messages in whole chunks.
    counts : dict[int, int]
        The same by channel.
    start_ns, end_ns : int
        First and last log time among them.
    position : int
        Bytes written.
    """

    def __init__(self, out: Writable, library: str) -> None:
        self.messages = 0
        self.chunks = 0
        self.counts: dict[int, int] = {}
        self.start_ns = 0
        self.end_ns = 0
        self.position = 0
        self._out = out
        self._crc = 0
        self._index: dict[Op, list[bytes]] = {op: [] for op in _GROUPS}
        self._append(MAGIC + pack_header(library))

    def put_attachment(self, attachment: Attachment) -> None:
        """Write a file into the file."""
        start, packed = self.position, attachment.pack()
        self._append(packed)
        times = struct.pack('<QQQQ', start, len(packed), attachment.log_time_ns, 0)
        size = struct.pack('<Q', len(attachment.data))
        names = pack_text(attachment.name) + pack_text(attachment.media_type)
        self._index[Op.ATTACHMENT_INDEX].append(record(Op.ATTACHMENT_INDEX, times + size + names))

    def put_metadata(self, name: str, items: Mapping[str, str]) -> None:
        """Write a metadata record."""
        start, packed = self.position, pack_metadata(name, items)
        self._append(packed)
        place = struct.pack('<QQ', start, len(packed)) + pack_text(name)
        self._index[Op.METADATA_INDEX].append(record(Op.METADATA_INDEX, place))

    def put_chunk(self, chunk: PackedChunk) -> None:
        """Write a chunk and its message indexes."""
        start = self.position
        self._append(chunk.record)
        # From here on its messages can be found again, whatever happens next.
        rows = np.empty(len(chunk), dtype=_INDEX_ROW)
        rows['log_time'], rows['offset'] = chunk.log_time, chunk.offset
        indexes: list[bytes] = []
        places: list[bytes] = []
        index_at = self.position
        # Not np.unique: its first call loads a part of numpy for half a second, in which a
        # recorder would write nothing.
        for channel in np.flatnonzero(np.bincount(chunk.channel)).tolist():
            mine = rows[chunk.channel == channel].tobytes()
            self.counts[channel] = self.counts.get(channel, 0) + len(mine) // _INDEX_ROW.itemsize
            places.append(struct.pack('<HQ', channel, index_at))
            head = struct.pack('<HI', channel, len(mine))
            indexes.append(record(Op.MESSAGE_INDEX, head + mine))
            index_at += len(indexes[-1])
        self._account(chunk, start, b''.join(places), index_at - self.position)
        self._append(b''.join(indexes))

    def sync(self) -> None:
        """Bring what was written to the disk."""
        self._out.sync()

    def finish(self, table: TopicTable) -> None:
        """Write the summary and give the file its own name."""
        self._append(record(Op.DATA_END, struct.pack('<I', self._crc)))
        summary = self._summary(table)
        self._write(summary)
        self._out.publish()
        self._out.close()

    def abandon(self) -> None:
        """Let go of an unfinished file; it stays as it is, unless no chunk is in it."""
        if self.chunks:
            self._out.close()
        else:
            self._out.discard()

    def _account(self, chunk: PackedChunk, start: int, places: bytes, index_size: int) -> None:
        if len(chunk):
            first, last = int(chunk.log_time.min()), int(chunk.log_time.max())
            self.start_ns = min(self.start_ns, first) if self.messages else first
            self.end_ns = max(self.end_ns, last) if self.messages else last
        else:
            first = last = 0
        self.messages += len(chunk)
        self.chunks += 1
        head = _CHUNK_INDEX_HEAD.pack(first, last, start, len(chunk.record))
        packed_size = len(chunk.record) - RECORD_HEAD.size - 40 - len(chunk.compression)
        tail = pack_text(chunk.compression) + struct.pack('<QQ', packed_size, chunk.unpacked_size)
        middle = struct.pack('<I', len(places)) + places + struct.pack('<Q', index_size)
        self._index[Op.CHUNK_INDEX].append(record(Op.CHUNK_INDEX, head + middle + tail))

    def _summary(self, table: TopicTable) -> bytes:
        index = self._index
        index[Op.SCHEMA] = [schema.pack() for schema in table.schemas.values()]
        index[Op.CHANNEL] = [channel.pack() for channel in table.channels.values()]
        index[Op.STATISTICS] = [self._statistics(table)]
        start, groups, offsets = self.position, b'', b''
        for op in _GROUPS:
            group = b''.join(index[op])
            if group:
                place = struct.pack('<BQQ', op, start + len(groups), len(group))
                offsets += record(Op.SUMMARY_OFFSET, place)
            groups += group
        crc = zlib.crc32(offsets, zlib.crc32(groups))
        return groups + offsets + pack_footer(start, start + len(groups), crc)

    def _statistics(self, table: TopicTable) -> bytes:
        counts = b''.join(struct.pack('<HQ', *item) for item in sorted(self.counts.items()))
        head = _STATISTICS.pack(
            self.messages,
            len(table.schemas),
            len(table.channels),
            len(self._index[Op.ATTACHMENT_INDEX]),
            len(self._index[Op.METADATA_INDEX]),
            self.chunks,
            self.start_ns,
            self.end_ns,
        )
        return record(Op.STATISTICS, head + struct.pack('<I', len(counts)) + counts)

    def _append(self, data: bytes) -> None:
        self._write(data)
        self._crc = zlib.crc32(data, self._crc)

    def _write(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            taken = self._out.write(bytes(left) if len(left) < len(data) else data)
            if taken <= 0:
                raise OSError(5, 'nothing could be written')
            self.position += taken
            left = left[taken:]
