"""Gathers messages until they are worth a chunk."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.logs.mcap.compression import ZSTD, Packer
from valveflow_ros.logs.mcap.layout import MESSAGE_HEAD, Op, pack_chunk
from valveflow_ros.records import IntArray

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
