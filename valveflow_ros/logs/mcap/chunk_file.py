# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes an MCAP file chunk by chunk and, at the end, the index that stock readers ask for.

It knows after every failure which chunks are whole on disk, because it counts
the bytes that were taken, and it takes chunks as they are, so that `recover`
copies them without touching a message.
"""

from __future__ import annotations

import struct
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)
from mcap.well_known import Profile
from numpy.typing import NDArray

from valveflow_ros.logs.mcap.records import MAGIC, MESSAGE_HEAD, RECORD_HEAD, TopicTable, pack
from valveflow_ros.logs.part_file import Writable
from valveflow_ros.records import IntArray

CHUNK_BYTES = 64 * 1024
ZSTD = 'zstd'
_ZSTD_LEVEL = 3
REPEAT_CHUNKS = 256
# A file of 256 MiB is not to be read back at every flush.
_READ_BACK_S = 30.0
_HEAD = struct.Struct('<BQHIQQ')
_INDEX_ROW = np.dtype([('log_time', '<i8'), ('offset', '<i8')])


def attachment(name: str, data: bytes) -> Attachment:
    """Return the record of an attached file; its media type is that of its suffix."""
    kinds = {'.json': 'application/json', '.yaml': 'application/yaml'}
    kind = kinds.get(PurePath(name).suffix, 'application/octet-stream')
    return Attachment(create_time=0, log_time=0, name=name, media_type=kind, data=data)


def compressor() -> zstandard.ZstdCompressor:
    """Return what compresses chunks; one for each thread, because its library keeps state."""
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL)


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A chunk record ready to be written, and what an index says about it.

    Arrays of n messages: ``channel`` uint16, ``log_time`` int64 in ns since the epoch, ``offset``
    int64 where each begins in the unpacked content, which has ``unpacked_size`` bytes.
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
    packer: zstandard.ZstdCompressor,
) -> PackedChunk:
    """Compress records, of which the messages are described by the arrays, into a chunk."""
    start, end = (int(log_time.min()), int(log_time.max())) if len(log_time) else (0, 0)
    chunk = Chunk(
        compression=ZSTD,
        data=packer.compress(content),
        message_start_time=start,
        message_end_time=end,
        uncompressed_crc=zlib.crc32(content),
        uncompressed_size=len(content),
    )
    return PackedChunk(pack(chunk), channel, log_time, offset, len(content), ZSTD)


class ChunkBuilder:
    """Messages that wait for their chunk, in the order in which they came."""

    def __init__(self) -> None:
        self._records = bytearray()
        self._channels: list[int] = []
        self._log_times: list[int] = []
        self._offsets: list[int] = []
        self._packer = compressor()

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
            Opcode.MESSAGE,
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
        self._suspect, self._read_back_s = False, 0.0
        self._topics_known = self._since_table = 0
        # Packed at once: a recording of months has a million chunks.
        self._index: dict[Opcode, list[bytes]] = {
            Opcode.CHUNK_INDEX: [], Opcode.ATTACHMENT_INDEX: [], Opcode.METADATA_INDEX: [],
        }  # fmt: skip
        self._append(MAGIC + pack(Header(profile=Profile.ROS2, library=library)))

    def put_attachment(self, attachment: Attachment) -> None:
        """Write a file into the file."""
        start, packed = self.position, pack(attachment)
        self._append(packed)
        index = AttachmentIndex(
            offset=start,
            length=len(packed),
            log_time=attachment.log_time,
            create_time=attachment.create_time,
            data_size=len(attachment.data),
            name=attachment.name,
            media_type=attachment.media_type,
        )
        self._index[Opcode.ATTACHMENT_INDEX].append(pack(index))

    def put_all(self, files: Mapping[str, bytes], notes: Mapping[str, Mapping[str, str]]) -> None:
        """Write attachments and metadata by their names."""
        for name, data in files.items():
            self.put_attachment(attachment(name, data))
        for name, items in notes.items():
            self.put_metadata(name, items)

    def put_metadata(self, name: str, items: Mapping[str, str]) -> None:
        """Write a metadata record."""
        start, packed = self.position, pack(Metadata(name=name, metadata=dict(items)))
        self._append(packed)
        index = MetadataIndex(offset=start, length=len(packed), name=name)
        self._index[Opcode.METADATA_INDEX].append(pack(index))

    def table_due(self, topics: int) -> bool:
        """Tell whether the records of so many topics are to stand in the next chunk.

        A chunk may be lost, and with it the only mention of a topic; so they stand in the first
        two chunks that could hold a new one, and then in one of `REPEAT_CHUNKS`.
        """
        due = topics > self._topics_known or self._since_table in (0, REPEAT_CHUNKS)
        if topics > self._topics_known:
            # The next chunk repeats what is new.
            self._topics_known, self._since_table = topics, 0
        else:
            self._since_table = 1 if due else self._since_table + 1
        return due

    def put_chunk(self, chunk: PackedChunk) -> None:
        """Write a chunk and its message indexes."""
        start = self.position
        self._append(chunk.record)
        # From here on its messages can be found again, whatever happens next.
        # The library would pack an index in one Python step per message.
        rows = np.empty(len(chunk), dtype=_INDEX_ROW)
        rows['log_time'], rows['offset'] = chunk.log_time, chunk.offset
        indexes, places, index_at = b'', {}, self.position
        # Not np.unique: its first call loads a part of numpy for half a second, in which a
        # recorder would write nothing.
        for channel in np.flatnonzero(np.bincount(chunk.channel)).tolist():
            mine = rows[chunk.channel == channel].tobytes()
            self.counts[channel] = self.counts.get(channel, 0) + len(mine) // _INDEX_ROW.itemsize
            places[channel] = index_at + len(indexes)
            head = struct.pack('<BQHI', Opcode.MESSAGE_INDEX, len(mine) + 6, channel, len(mine))
            indexes += head + mine
        first = last = 0
        if len(chunk):
            first, last = int(chunk.log_time.min()), int(chunk.log_time.max())
            self.start_ns = min(self.start_ns, first) if self.messages else first
            self.end_ns = max(self.end_ns, last) if self.messages else last
        self.messages += len(chunk)
        self.chunks += 1
        index = ChunkIndex(
            chunk_length=len(chunk.record),
            chunk_start_offset=start,
            compression=chunk.compression,
            compressed_size=len(chunk.record) - RECORD_HEAD.size - 40 - len(chunk.compression),
            message_start_time=first,
            message_end_time=last,
            message_index_length=len(indexes),
            message_index_offsets=places,
            uncompressed_size=chunk.unpacked_size,
        )
        self._index[Opcode.CHUNK_INDEX].append(pack(index))
        self._append(indexes)

    def sync(self) -> None:
        """Bring what was written to the disk."""
        self._out.sync()

    def check(self) -> None:
        """See that the file is there as it was written; raises `AlteredError` if not."""
        self._out.check(self.position)
        self._suspect |= self._out.touched
        if self._suspect and time.monotonic() >= self._read_back_s:
            # A file system may put the time of every write right afterwards.
            self._suspect, self._read_back_s = False, time.monotonic() + _READ_BACK_S
            self._out.check_content(self.position, self._crc)

    def rename(self, path: Path) -> None:
        """Let the finished file have another name."""
        self._out.path = path

    def finish(self, table: TopicTable) -> None:
        """Write the summary and give the file its own name.

        Raises
        ------
        AlteredError
            What is in the file is not what was written.
        """
        # Whatever somebody else writes from now on counts as done by the look after it.
        self._out.sync()
        self._out.check(self.position)
        self._out.check_content(self.position, self._crc)
        self._append(pack(DataEnd(data_section_crc=self._crc)))
        self._append(self._summary(table))
        self._out.publish()
        if self._out.touched:
            self._out.check_content(self.position, self._crc)
        self._out.close()

    def abandon(self) -> None:
        """Let go of an unfinished file; it stays as it is, unless no chunk is in it."""
        if self.chunks:
            self._out.close()
        else:
            self._out.discard()

    def _summary(self, table: TopicTable) -> bytes:
        statistics = Statistics(
            attachment_count=len(self._index[Opcode.ATTACHMENT_INDEX]),
            channel_count=len(table.channels),
            channel_message_counts=dict(sorted(self.counts.items())),
            chunk_count=self.chunks,
            message_count=self.messages,
            message_start_time=self.start_ns,
            message_end_time=self.end_ns,
            metadata_count=len(self._index[Opcode.METADATA_INDEX]),
            schema_count=len(table.schemas),
        )
        groups = {
            Opcode.SCHEMA: pack(*table.schemas.values()),
            Opcode.CHANNEL: pack(*table.channels.values()),
            Opcode.STATISTICS: pack(statistics),
            **{op: b''.join(records) for op, records in self._index.items()},
        }
        start, summary, offsets = self.position, b'', b''
        for op, group in groups.items():
            if group:
                place = start + len(summary)
                offsets += pack(
                    SummaryOffset(group_opcode=op, group_start=place, group_length=len(group))
                )
                summary += group
        footer = Footer(
            summary_start=start, summary_offset_start=start + len(summary), summary_crc=0
        )
        summary += offsets
        footer.summary_crc = zlib.crc32(pack(footer)[:-4], zlib.crc32(summary))
        return summary + pack(footer) + MAGIC

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
