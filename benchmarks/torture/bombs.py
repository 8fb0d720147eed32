# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files made to hurt a reader, byte by byte."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import lz4.frame
import zstandard
from log_files import FLOAT64, START_NS, STOCK, float64
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from valveflow_ros.logs.mcap.records import MAGIC, RECORD_HEAD, pack

GIB = 1 << 30
HUGE = (1 << 64) - 1


def record(op: int, content: bytes) -> bytes:
    """Return a record of any kind and content."""
    return RECORD_HEAD.pack(op, len(content)) + content


def pack_header(library: str) -> bytes:
    """Return the first record of a file."""
    return pack(Header('ros2', library))


def message(channel: int = 1, number: int = 0, data: bytes | None = None) -> bytes:
    """Return a message record."""
    head = struct.pack('<HIQQ', channel, number, START_NS + number, START_NS + number)
    return record(Opcode.MESSAGE, head + (float64(number) if data is None else data))


def schema(number: int = 1, name: str = FLOAT64, text: str | None = None) -> bytes:
    """Return a schema record."""
    body = (STOCK.text(FLOAT64) if text is None else text).encode()
    return pack(Schema(id=number, name=name, encoding='ros2msg', data=body))


def channel(number: int = 1, topic: str = '/valve_opening', schema_id: int = 1) -> bytes:
    """Return a channel record."""
    return pack(Channel(number, topic, 'cdr', {}, schema_id))


def chunk(
    content: bytes,
    compression: str = '',
    packed: bytes | None = None,
    size: int | None = None,
    crc: int | None = None,
) -> bytes:
    """Return a chunk record; each part may lie."""
    if packed is None:
        packers = {'': bytes, 'zstd': zstandard.ZstdCompressor().compress}
        packed = {**packers, 'lz4': lz4.frame.compress}[compression](content)
    size = len(content) if size is None else size
    crc = zlib.crc32(content) if crc is None else crc
    head = struct.pack('<QQQI', START_NS, START_NS, size, crc)
    name = struct.pack('<I', len(compression)) + compression.encode()
    tail = name + struct.pack('<Q', len(packed)) + packed
    return record(Opcode.CHUNK, head + tail)


def file_of(*parts: bytes) -> bytes:
    """Return a file, ended as a finished one."""
    footer = record(Opcode.FOOTER, struct.pack('<QQI', 0, 0, 0))
    end = record(Opcode.DATA_END, struct.pack('<I', 0))
    return MAGIC + pack_header('hostile') + b''.join(parts) + end + footer + MAGIC


def zeros(compression: str, size: int) -> bytes:
    """Return ``size`` zeros, compressed, without ever holding them."""
    block = bytes(1 << 20)
    if compression == 'zstd':
        packer = zstandard.ZstdCompressor(level=3).compressobj()
        parts = [packer.compress(block) for _ in range(size >> 20)]
        return b''.join([*parts, packer.flush()])
    with_lz4 = lz4.frame.LZ4FrameCompressor()
    parts = [with_lz4.begin(), *(with_lz4.compress(block) for _ in range(size >> 20))]
    return b''.join([*parts, with_lz4.flush()])


GOOD = schema() + channel() + b''.join(message(number=n) for n in range(100))


def hostile_files() -> Iterator[tuple[str, bytes, int]]:
    """Yield a name, the bytes, and how many intact messages are in them."""
    yield from _bombs()
    yield from _lengths()
    yield from _contradictions()
    yield from _texts()


def _bombs() -> Iterator[tuple[str, bytes, int]]:
    for name in ('zstd', 'lz4'):
        packed = zeros(name, GIB)
        for claim in (GIB, 100, 1 << 26, 0):
            bomb = chunk(b'', name, packed, claim, 1)
            yield f'{name} bomb of 1 GiB that claims {claim}', file_of(chunk(GOOD), bomb), 100
        small = chunk(bytes(1 << 26), name)
        yield f'forty {name} bombs of 64 MiB', file_of(chunk(GOOD), *[small] * 40), 100
        many = chunk(GOOD + message(data=bytes(1 << 20)) * 60, name)
        yield f'twenty {name} chunks of large messages', file_of(*[many] * 20), -1
    for number, found in ((700_000, 700_000), (1_400_000, 0)):
        full = chunk(schema() + channel() + message() * number, 'zstd')
        yield f'a chunk of {number} messages', file_of(full), found
    tiny = chunk(b'')
    yield '200,000 empty chunks', file_of(chunk(GOOD), tiny * 200_000), 100


def _lengths() -> Iterator[tuple[str, bytes, int]]:
    good = chunk(GOOD)
    for op in Opcode:
        for length in (HUGE, 1 << 63, (1 << 32) - 1, 0):
            lying = RECORD_HEAD.pack(op, length)
            yield f'{op.name} of {length} bytes', file_of(good, lying, good), -1
    yield 'no bytes', b'', 0
    yield 'magic alone', MAGIC, 0
    yield 'magic twice', MAGIC * 2, 0
    yield 'footer without data', file_of(), 0
    short = file_of(chunk(schema() + channel() + RECORD_HEAD.pack(Opcode.MESSAGE, 3) + b'abc'))
    yield 'a message shorter than its head', short, 0
    inner = chunk(schema() + channel() + RECORD_HEAD.pack(Opcode.MESSAGE, HUGE))
    yield 'a message of 2^64 bytes in a sound chunk', file_of(inner), 0
    half = struct.pack('<QQI', 9, 9, 0)
    pointing = MAGIC + pack_header('x') + good + record(Opcode.FOOTER, half) + MAGIC
    yield 'a summary that points into the header', pointing, 100
    cut = chunk(GOOD)[:-1]
    yield 'chunks overlapping', file_of(cut, *[cut] * 2000), -1


def _contradictions() -> Iterator[tuple[str, bytes, int]]:
    nested = chunk(GOOD)
    for _ in range(30):
        nested = chunk(nested)
    yield 'chunks within chunks', file_of(nested), 0
    many = b''.join(channel(n & 0xFFFF, f'/t{n}') for n in range(1_000_000))
    yield 'a million channels', file_of(chunk(schema() + many, 'zstd')), 0
    parts = [chunk(schema() + channel(n, f'/t{n}') + message(n)) for n in range(1, 3000)]
    yield '3,000 channels, one a chunk', file_of(*parts), -1
    twice = channel() + channel(topic='/generated_power')
    yield 'one channel id for two topics', file_of(chunk(schema() + twice + message())), -1
    types = schema() + schema(name='std_msgs/msg/Bool') + channel() + message()
    yield 'one schema id for two types', file_of(chunk(types)), -1
    yield 'messages before their channel', file_of(chunk(message() + schema() + channel())), -1
    yield 'messages without a channel', file_of(chunk(message() * 1000)), -1
    yield 'channel without a schema', file_of(chunk(channel() + message())), -1
    yield 'schema zero', file_of(chunk(channel(schema_id=0) + message())), -1
    bare = MAGIC + pack_header('x') + GOOD + message() * 50_000
    yield 'messages without chunks', bare, 50_100
    late = struct.pack('<HIQQ', 1, 0, HUGE, HUGE) + float64(1)
    yield 'a time in the year 2554', file_of(chunk(GOOD + record(Opcode.MESSAGE, late))), -1
    odd = chunk(GOOD, 'brotli', b'x' * 100)
    yield 'an unknown compression', file_of(odd, chunk(GOOD)), 100
    yield 'a chunk without a checksum', file_of(chunk(GOOD, crc=0)), 100


def _texts() -> Iterator[tuple[str, bytes, int]]:
    sample = 'valveflow_msgs/msg/PlantSample'
    deep = 'x/A a\n' + ''.join(f'{"=" * 80}\nMSG: x/A\nx/A a\n' for _ in range(3))
    texts = {
        'a type within itself': deep,
        'an endless type': 'float64 a\n' * 200_000,
        'a type of garbage': '\x00\xff[[[[' * 1000,
        'a huge array': 'float64[4294967295] a\n',
        'sizes multiplied': ''.join(
            f'x/T{n}[1000] a\n{"=" * 80}\nMSG: x/T{n}\n' for n in range(50)
        ) + 'float64 x\n',
        'a default of a megabyte': 'string s "' + 'x' * (1 << 20) + '"\n',
    }  # fmt: skip
    for name, text in texts.items():
        parts = schema(name=sample, text=text) + channel(topic='/plant_sample') + message()
        yield name, file_of(chunk(parts, 'zstd')), -1
    long_topic = channel(topic='/' + 'a' * 100_000)
    yield 'a topic of 100,000 letters', file_of(chunk(schema() + long_topic + message())), -1
    odd_topic = channel(topic='/../../etc/passwd\n\x1b[31m\0')
    yield 'a topic of control characters', file_of(chunk(schema() + odd_topic + message())), -1
    wrong = record(Opcode.CHANNEL, struct.pack('<HHI', 1, 1, 4) + b'\xff\xfe\xfd\xfc')
    yield 'a topic that is no text', file_of(chunk(schema() + wrong + message())), -1
    notes = b''.join(pack(Metadata(f'n{k}', {'k': 'v' * 100})) for k in range(20_000))
    yield '20,000 metadata records', file_of(chunk(GOOD), notes), 100
    big = record(Opcode.ATTACHMENT, struct.pack('<QQ', 0, 0) + b'\1\0\0\0a' * 2
                 + struct.pack('<Q', 1 << 62))  # fmt: skip
    yield 'an attachment of 2^62 bytes', file_of(chunk(GOOD), big), 100
