# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes an MCAP file chunk by chunk and, at the end, the index for other readers.

It counts the bytes that were written, so after a failure it is known which
chunks are complete on disk. Packed chunks are written unchanged, so `recover`
copies them without decoding their messages.
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
from mcap import records as made
from mcap.opcode import Opcode
from mcap.well_known import Profile
from numpy.typing import NDArray

from valveflow_ros.logs.mcap.records import MAGIC, MESSAGE_HEAD, RECORD_HEAD, TopicTable, pack
from valveflow_ros.logs.part_file import PartFile
from valveflow_ros.records import IntArray

CHUNK_BYTES = 64 * 1024
ZSTD = 'zstd'
_ZSTD_LEVEL = 3
REPEAT_CHUNKS = 256
# Minimum time between two verifications, since a file of 256 MiB takes long to read back.
_READ_BACK_S = 30.0
_HEAD = struct.Struct('<BQHIQQ')
_INDEX_ROW = np.dtype([('log_time', '<i8'), ('offset', '<i8')])


def attachment(name: str, data: bytes) -> made.Attachment:
    """Return the record of an attached file; its media type follows from its suffix."""
    kinds = {'.json': 'application/json', '.yaml': 'application/yaml'}
    kind = kinds.get(PurePath(name).suffix, 'application/octet-stream')
    return made.Attachment(create_time=0, log_time=0, name=name, media_type=kind, data=data)


def compressor() -> zstandard.ZstdCompressor:
    """Return a compressor; use one per thread, because the library is not thread-safe."""
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL)


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A chunk record ready to be written, and the data for its index.

    Arrays of n messages: ``channel`` uint16, ``log_time`` int64 in ns since the epoch, ``offset``
    int64 of each in the unpacked content, which has ``unpacked_size`` bytes.
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
    """Compress records into a chunk; the arrays describe the messages among the records."""
    start, end = (int(log_time.min()), int(log_time.max())) if len(log_time) else (0, 0)
    chunk = made.Chunk(
        compression=ZSTD, data=packer.compress(content), message_start_time=start,
        message_end_time=end, uncompressed_crc=zlib.crc32(content), uncompressed_size=len(content),
    )  # fmt: skip
    return PackedChunk(pack(chunk), channel, log_time, offset, len(content), ZSTD)


class ChunkBuilder:
    """Collects messages for the next chunk, in the order in which they are added."""

    def __init__(self) -> None:
        self._packer = compressor()
        self.clear()

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
        size = MESSAGE_HEAD.size + len(data)
        times = log_time_ns, publish_time_ns
        head = _HEAD.pack(Opcode.MESSAGE, size, channel, sequence & 0xFFFFFFFF, *times)
        self._offsets.append(len(self._records))
        self._channels.append(channel)
        self._log_times.append(log_time_ns)
        self._records += head
        self._records += data

    def build(self, table: bytes = b'') -> PackedChunk:
        """Return ``table`` and the waiting messages as a chunk; the messages are kept."""
        channels = np.array(self._channels, dtype=np.uint16)
        log_times = np.array(self._log_times, dtype=np.int64)
        offsets = np.array(self._offsets, dtype=np.int64) + len(table)
        content = table + bytes(self._records)
        return pack_content(content, channels, log_times, offsets, self._packer)

    def clear(self) -> None:
        """Discard the waiting messages, after they were written."""
        self._records = bytearray()
        self._channels: list[int] = []
        self._log_times: list[int] = []
        self._offsets: list[int] = []


class ChunkFile:
    """An MCAP file that is being written.

    Every method raises the `OSError` of the file. After an error, call `abandon`;
    `messages` and `counts` then describe the complete chunks on disk.
    """

    def __init__(self, out: PartFile, library: str) -> None:
        # position: bytes written
        # start_ns, end_ns: first and last log time among them
        # messages: number of messages in complete chunks
        self.messages = self.chunks = self.position = self.start_ns = self.end_ns = 0
        self.counts: dict[int, int] = {}  # messages per channel
        self._out = out
        self._crc = 0
        self._suspect, self._read_back_s = False, 0.0
        self._topics_known = self._since_table = 0
        # Stored packed to save memory: a recording of months has a million chunks.
        self._index: dict[Opcode, list[bytes]] = {
            Opcode.CHUNK_INDEX: [], Opcode.ATTACHMENT_INDEX: [], Opcode.METADATA_INDEX: [],
        }  # fmt: skip
        self._append(MAGIC + pack(made.Header(profile=Profile.ROS2, library=library)))

    def put_attachment(self, attachment: made.Attachment) -> None:
        """Write an attachment."""
        start, packed = self.position, pack(attachment)
        self._append(packed)
        index = made.AttachmentIndex(
            offset=start, length=len(packed), log_time=attachment.log_time,
            create_time=attachment.create_time, data_size=len(attachment.data),
            name=attachment.name, media_type=attachment.media_type,
        )  # fmt: skip
        self._index[Opcode.ATTACHMENT_INDEX].append(pack(index))

    def put_all(self, files: Mapping[str, bytes]) -> None:
        """Write attachments, given by name."""
        for name, data in files.items():
            self.put_attachment(attachment(name, data))

    def put_metadata(self, name: str, items: Mapping[str, str]) -> None:
        """Write a metadata record."""
        start, packed = self.position, pack(made.Metadata(name=name, metadata=dict(items)))
        self._append(packed)
        index = made.MetadataIndex(offset=start, length=len(packed), name=name)
        self._index[Opcode.METADATA_INDEX].append(pack(index))

    def table_due(self, topics: int) -> bool:
        """Return True if the next chunk must contain the records of all ``topics`` topics.

        A lost chunk must not lose the only record of a topic. The records are therefore written
        in the first two chunks after a new topic, and then every `REPEAT_CHUNKS` chunks.
        """
        if topics > self._topics_known:
            # The chunk after this one repeats them.
            self._topics_known, self._since_table = topics, 0
            return True
        due = self._since_table in (0, REPEAT_CHUNKS)
        self._since_table = 1 if due else self._since_table + 1
        return due

    def put_chunk(self, chunk: PackedChunk) -> None:
        """Write a chunk and its message indexes."""
        start = self.position
        self._append(chunk.record)
        # From here on its messages can be recovered even if the index is not written.
        # The library would need one Python call per message to pack an index.
        rows = np.empty(len(chunk), dtype=_INDEX_ROW)
        rows['log_time'], rows['offset'] = chunk.log_time, chunk.offset
        indexes, places, index_at = b'', {}, self.position
        # Not np.unique: its first call imports a part of numpy, which stops the recorder for
        # half a second.
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
        packed_size = len(chunk.record) - RECORD_HEAD.size - 40 - len(chunk.compression)
        index = made.ChunkIndex(
            chunk_length=len(chunk.record), chunk_start_offset=start,
            compression=chunk.compression, compressed_size=packed_size, message_start_time=first,
            message_end_time=last, message_index_length=len(indexes),
            message_index_offsets=places, uncompressed_size=chunk.unpacked_size,
        )  # fmt: skip
        self._index[Opcode.CHUNK_INDEX].append(pack(index))
        self._append(indexes)

    def sync(self) -> None:
        """Flush what was written to disk."""
        self._out.sync()

    def check(self) -> None:
        """Check that the file still is as it was written; raises `AlteredError` if not."""
        self._out.check(self.position)
        self._suspect |= self._out.touched
        if self._suspect and time.monotonic() >= self._read_back_s:
            # Limited in rate: some file systems change the time after every write.
            self._suspect, self._read_back_s = False, time.monotonic() + _READ_BACK_S
            self._out.check_content(self.position, self._crc)

    def rename(self, path: Path) -> None:
        """Change the final name of the file."""
        self._out.path = path

    def finish(self, table: TopicTable) -> None:
        """Write the summary and rename the file to its final name.

        Raises `AlteredError` if the content of the file is not what was written.
        """
        # Later writes of other programs are detected by the check of `touched` below.
        self._out.sync()
        self._out.check(self.position)
        self._out.check_content(self.position, self._crc)
        self._append(pack(made.DataEnd(data_section_crc=self._crc)))
        self._append(self._summary(table))
        self._out.publish()
        if self._out.touched:
            self._out.check_content(self.position, self._crc)
        self._out.close()

    def abandon(self) -> None:
        """Close an unfinished file; it is removed if it has no chunk."""
        if self.chunks:
            self._out.close()
        else:
            self._out.discard()

    def _summary(self, table: TopicTable) -> bytes:
        statistics = made.Statistics(
            attachment_count=len(self._index[Opcode.ATTACHMENT_INDEX]),
            channel_count=len(table.channels), chunk_count=self.chunks,
            channel_message_counts=dict(sorted(self.counts.items())),
            message_count=self.messages, message_start_time=self.start_ns,
            message_end_time=self.end_ns, schema_count=len(table.schemas),
            metadata_count=len(self._index[Opcode.METADATA_INDEX]),
        )  # fmt: skip
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
                offset = made.SummaryOffset(
                    group_opcode=op, group_start=place, group_length=len(group)
                )
                offsets += pack(offset)
                summary += group
        footer = made.Footer(
            summary_start=start, summary_offset_start=start + len(summary), summary_crc=0
        )
        summary += offsets
        footer.summary_crc = zlib.crc32(pack(footer)[:-4], zlib.crc32(summary))
        return summary + pack(footer) + MAGIC

    def _append(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            taken = self._out.write(bytes(left) if len(left) < len(data) else data)
            if taken <= 0:
                raise OSError(5, 'nothing could be written')
            self.position += taken
            left = left[taken:]
        self._crc = zlib.crc32(data, self._crc)
