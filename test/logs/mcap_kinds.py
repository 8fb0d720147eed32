# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Legal MCAP recordings of all kinds: where topics are told, what is packed, what is left out."""

import struct
import zlib
from dataclasses import dataclass

import lz4.frame
import zstandard
from hypothesis import strategies as st
from log_files import FLOAT64, START_NS, Told, float64
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from valveflow_ros.logs.mcap.records import MAGIC, RECORD_HEAD, pack

TOPICS = ('/valve_opening', '/main_steam_pressure', '/main_steam_temperature', '/generated_power')
SCHEMA = Schema(data=b'float64 data', encoding='ros2msg', id=1, name=FLOAT64)
UNTYPED = Channel(id=9, topic='/notes', message_encoding='json', metadata={}, schema_id=0)
CHANNELS = [
    *(Channel(id=k, topic=topic, message_encoding='cdr', metadata={'k': str(k)}, schema_id=1)
      for k, topic in enumerate(TOPICS, 1)), UNTYPED,
]  # fmt: skip
FOREIGN = struct.pack('<BQ', 0x80, 5) + b'later' + struct.pack('<BQ', 0x10, 0)


@dataclass(frozen=True)
class Kind:
    """The switches that the writers of the format have.

    ``topics``: where schemas and channels stand: 'before' the chunks, 'between' them where first
    needed, in the 'first' chunk, in 'every' one, in a chunk of their 'own', after the chunks in
    the 'summary' alone. ``outside``: which chunks are not made, so that their messages stand
    outside: 'none', 'some', 'all'.
    """

    topics: str = 'first'
    outside: str = 'none'
    compression: str = 'zstd'
    chunks: int = 3
    chunk_crc: bool = True
    summary: bool = True
    summary_topics: bool = True
    summary_crc: bool = True
    statistics: bool = True
    offsets: bool = True
    chunk_index: bool = True
    message_index: bool = True
    data_crc: bool = False
    attachment_crc: bool = True
    extras: bool = False
    foreign: bool = False
    longer: bool = False
    empty: bool = False
    shuffled: bool = False

    def messages(self):
        chunks = []
        for chunk in range(self.chunks):
            steps = list(range(4 * chunk, 4 * chunk + 4))
            steps = [steps[k] for k in (2, 0, 3, 1)] if self.shuffled else steps
            # Out of order also from chunk to chunk.
            shift = -6 if self.shuffled and chunk % 2 else 0
            chunks.append([
                Message(
                    channel_id=channel.id, sequence=step,
                    data=b'{}' if channel is UNTYPED else float64(50.0 + step + 0.1 * channel.id),
                    log_time=START_NS + (step + shift) * 10**9 + channel.id,
                    publish_time=START_NS + (step + shift) * 10**9,
                )
                for step in steps for channel in CHANNELS
            ])  # fmt: skip
        return chunks

    def truth(self):
        """Return what a reader gives, in the order of the log times."""
        names = {channel.id: channel.topic for channel in CHANNELS}
        told = [
            Told(names[m.channel_id], m.log_time, m.publish_time, bytes(m.data))
            for chunk in self.messages() for m in chunk
        ]  # fmt: skip
        return sorted(told, key=lambda message: message.log_ns)

    def legal(self):
        """Return whether a reader may hope to learn the topics at all."""
        told_late = self.topics == 'summary'
        return not told_late or (self.outside == 'none' and self.summary and self.summary_topics)

    def is_chunk(self, number):
        """Return whether the messages of this number stand in a chunk."""
        return self.outside == 'none' or (self.outside == 'some' and number % 2 == 1)

    def unchecked(self):
        """Return how many chunks have no checksum, and how many messages stand outside."""
        made = [self.is_chunk(number) for number in range(self.chunks)]
        chunks = 0 if self.chunk_crc else sum(made) + (self.topics == 'own')
        return chunks, 4 * len(CHANNELS) * (len(made) - sum(made))

    def write(self):
        return _File(self).whole()


class _File:
    def __init__(self, kind):
        self.kind = kind
        self.out = bytearray(MAGIC)
        self.indexes = {
            Opcode.CHUNK_INDEX: [], Opcode.ATTACHMENT_INDEX: [], Opcode.METADATA_INDEX: [],
        }  # fmt: skip

    def whole(self):
        kind, tables = self.kind, pack(SCHEMA, *CHANNELS)
        self.put(Header(profile='', library='test'))
        self.extra('a')
        if kind.topics == 'before':
            self.put(SCHEMA, *CHANNELS)
        if kind.topics == 'own':
            self.chunk(tables, [])
        for number, messages in enumerate(kind.messages()):
            if kind.empty:
                self.chunk(b'', [])
            if kind.topics == 'between' and number == 0:
                self.put(SCHEMA, *CHANNELS)
            here = kind.topics == 'every' or (kind.topics == 'first' and number == 0)
            (self.chunk if kind.is_chunk(number) else self.bare)(tables if here else b'', messages)
            self.extra(f'b{number % 2}')
        data_crc = zlib.crc32(self.out) if kind.data_crc else 0
        self.put(DataEnd(data_section_crc=data_crc))
        self.finish()
        return bytes(self.out)

    def put(self, *records):
        for record in records:
            raw = pack(record)
            if self.kind.longer:
                # As a later version of the format may add fields at the end of a record.
                op, length = RECORD_HEAD.unpack_from(raw)
                raw = RECORD_HEAD.pack(op, length + 3) + raw[RECORD_HEAD.size :] + b'new'
            self.out += raw
            self.out += FOREIGN if self.kind.foreign else b''

    def extra(self, name):
        if not self.kind.extras:
            return
        start, attached = len(self.out), Attachment(
            create_time=1, log_time=2, name=name, media_type='text/plain', data=name.encode()
        )  # fmt: skip
        raw = pack(attached)
        self.out += raw if self.kind.attachment_crc else raw[:-4] + bytes(4)
        self.indexes[Opcode.ATTACHMENT_INDEX].append(pack(AttachmentIndex(
            offset=start, length=len(raw), create_time=1, log_time=2, data_size=len(name),
            name=name, media_type='text/plain',
        )))  # fmt: skip
        start = len(self.out)
        self.put(Metadata(name=name, metadata={'of': name}))
        index = MetadataIndex(offset=start, length=len(self.out) - start, name=name)
        self.indexes[Opcode.METADATA_INDEX].append(pack(index))

    def bare(self, head, messages):
        self.out += head
        for message in messages:
            self.out += FOREIGN if self.kind.foreign else b''
            self.out += pack(message)

    def chunk(self, head, messages):
        kind, places, content = self.kind, {}, bytearray(head)
        for message in messages:
            content += FOREIGN if kind.foreign else b''
            place = message.log_time, len(content)
            places.setdefault(message.channel_id, []).append(place)
            content += pack(message)
        packers = {'': bytes, 'lz4': lz4.frame.compress, 'zstd': zstandard.compress}
        times = [message.log_time for message in messages] or [0]
        start = len(self.out)
        self.put(Chunk(
            compression=kind.compression, data=packers[kind.compression](bytes(content)),
            message_start_time=min(times), message_end_time=max(times),
            uncompressed_crc=zlib.crc32(content) if kind.chunk_crc else 0,
            uncompressed_size=len(content),
        ))  # fmt: skip
        length, index_at, offsets = len(self.out) - start, len(self.out), {}
        for channel, found in places.items() if kind.message_index else ():
            offsets[channel] = len(self.out)
            self.put(MessageIndex(channel_id=channel, records=found))
        self.indexes[Opcode.CHUNK_INDEX].append(pack(ChunkIndex(
            chunk_length=length, chunk_start_offset=start, compression=kind.compression,
            compressed_size=len(packers[kind.compression](bytes(content))),
            message_end_time=max(times), message_index_length=len(self.out) - index_at,
            message_index_offsets=offsets, message_start_time=min(times),
            uncompressed_size=len(content),
        )))  # fmt: skip

    def finish(self):
        kind, start, groups = self.kind, len(self.out), {}
        if kind.summary_topics:
            groups[Opcode.SCHEMA], groups[Opcode.CHANNEL] = pack(SCHEMA), pack(*CHANNELS)
        if kind.statistics:
            counts = {channel.id: 4 * kind.chunks for channel in CHANNELS}
            times = [message.log_ns for message in kind.truth()]
            groups[Opcode.STATISTICS] = pack(Statistics(
                attachment_count=len(self.indexes[Opcode.ATTACHMENT_INDEX]),
                channel_count=len(CHANNELS), channel_message_counts=counts,
                chunk_count=len(self.indexes[Opcode.CHUNK_INDEX]),
                message_count=sum(counts.values()), message_start_time=min(times),
                message_end_time=max(times), schema_count=1,
                metadata_count=len(self.indexes[Opcode.METADATA_INDEX]),
            ))  # fmt: skip
        for op, records in self.indexes.items():
            groups[op] = b''.join(records) if op != Opcode.CHUNK_INDEX or kind.chunk_index else b''
        summary, offsets = b'', b''
        for op, group in groups.items():
            if group and kind.summary:
                place = start + len(summary)
                offset = SummaryOffset(group_opcode=op, group_start=place, group_length=len(group))
                offsets += pack(offset) if kind.offsets else b''
                summary += group + (FOREIGN if kind.foreign else b'')
        footer = Footer(
            summary_start=start if summary else 0,
            summary_offset_start=start + len(summary) if offsets else 0,
            summary_crc=0,
        )
        summary += offsets
        if kind.summary_crc:
            footer.summary_crc = zlib.crc32(pack(footer)[:-4], zlib.crc32(summary))
        self.out += summary + pack(footer) + MAGIC


SWITCHES = [name for name, default in Kind.__dataclass_fields__.items() if default.type == 'bool']
KINDS = st.builds(
    Kind,
    topics=st.sampled_from(['before', 'between', 'first', 'every', 'own', 'summary']),
    outside=st.sampled_from(['none', 'some', 'all']),
    compression=st.sampled_from(['', 'lz4', 'zstd']),
    chunks=st.integers(1, 4),
    **dict.fromkeys(SWITCHES, st.booleans()),
).filter(Kind.legal)
