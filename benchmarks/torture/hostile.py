# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files and names that are meant to hurt: a sentence or intact messages, at a bounded price."""

from __future__ import annotations

import contextlib
import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from log_files import FLOAT64, SAMPLE, START_NS, STOCK, float64
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from benchmarks.torture.trial import MIB, Options, Outcome, run_bounded
from valveflow_ros.cli.main import main as valveflow
from valveflow_ros.errors import ValveflowError
from valveflow_ros.logs import open_log, recover
from valveflow_ros.logs.mcap.records import MAGIC, RECORD_HEAD, pack

# A file of up to a mebibyte may cost so much CPU time, a larger one more in proportion.
MOST_S = 2.0
MORE_S_PER_MIB = 0.3
MOST_BYTES = 200 * MIB
PATIENCE_S = 30.0
UNFORESEEN = 'This should not have happened'
HUGE = (1 << 64) - 1
PACKERS: dict[str, Callable[[bytes], bytes]] = {
    '': bytes, 'zstd': zstandard.compress, 'lz4': lz4.frame.compress
}  # fmt: skip


def record(op: int, content: bytes) -> bytes:
    """Return a record of any kind and content."""
    return RECORD_HEAD.pack(op, len(content)) + content


def message(channel: int = 1, number: int = 0, data: bytes | None = None) -> bytes:
    """Return a message record."""
    head = struct.pack('<HIQQ', channel, number, START_NS + number, START_NS + number)
    return record(Opcode.MESSAGE, head + (float64(number) if data is None else data))


def schema(number: int = 1, name: str = FLOAT64, text: str = STOCK.text(FLOAT64)) -> bytes:
    """Return a schema record."""
    return pack(Schema(id=number, name=name, encoding='ros2msg', data=text.encode()))


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
    packed = PACKERS[compression](content) if packed is None else packed
    size = len(content) if size is None else size
    crc = zlib.crc32(content) if crc is None else crc
    head = struct.pack('<QQQI', START_NS, START_NS, size, crc)
    name = struct.pack('<I', len(compression)) + compression.encode()
    return record(Opcode.CHUNK, head + name + struct.pack('<Q', len(packed)) + packed)


def file_of(*parts: bytes) -> bytes:
    """Return a file, ended as a finished one."""
    footer = record(Opcode.FOOTER, struct.pack('<QQI', 0, 0, 0))
    end = record(Opcode.DATA_END, struct.pack('<I', 0))
    return MAGIC + pack(Header('ros2', 'hostile')) + b''.join(parts) + end + footer + MAGIC


def zeros(compression: str, size: int) -> bytes:
    """Return ``size`` zeros, compressed, without ever holding them."""
    block = bytes(MIB)
    if compression == 'zstd':
        packer = zstandard.ZstdCompressor(level=3).compressobj()
        return b''.join(packer.compress(block) for _ in range(size >> 20)) + packer.flush()
    with_lz4 = lz4.frame.LZ4FrameCompressor()
    parts = [with_lz4.begin(), *(with_lz4.compress(block) for _ in range(size >> 20))]
    return b''.join([*parts, with_lz4.flush()])


GOOD = schema() + channel() + b''.join(message(number=n) for n in range(100))


# The files. Each has a name, its bytes, and how many intact messages are in it; -1 is unknown.


def _bombs() -> Iterator[tuple[str, bytes, int]]:
    for name in ('zstd', 'lz4'):
        packed = zeros(name, 1 << 30)
        for claim in (1 << 30, 100, 1 << 26, 0):
            bomb = chunk(b'', name, packed, claim, 1)
            yield f'{name} bomb of 1 GiB that claims {claim}', file_of(chunk(GOOD), bomb), 100
        small = chunk(bytes(1 << 26), name)
        yield f'forty {name} bombs of 64 MiB', file_of(chunk(GOOD), *[small] * 40), 100
        many = chunk(GOOD + message(data=bytes(MIB)) * 60, name)
        yield f'twenty {name} chunks of large messages', file_of(*[many] * 20), -1
    for number, found in ((700_000, 700_000), (1_400_000, 0)):
        full = chunk(schema() + channel() + message() * number, 'zstd')
        yield f'a chunk of {number} messages', file_of(full), found
    yield '200,000 empty chunks', file_of(chunk(GOOD), chunk(b'') * 200_000), 100


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
    footer = record(Opcode.FOOTER, struct.pack('<QQI', 9, 9, 0))
    pointing = MAGIC + pack(Header('ros2', 'x')) + good + footer + MAGIC
    yield 'a summary that points into the header', pointing, 100
    cut = good[:-1]
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
    late = struct.pack('<HIQQ', 1, 0, HUGE, HUGE) + float64(1)
    for name, content in {
        'one channel id for two topics': schema() + channel() + channel(topic='/generated_power')
        + message(),
        'one schema id for two types': schema() + schema(name='std_msgs/msg/Bool') + channel()
        + message(),
        'messages before their channel': message() + schema() + channel(),
        'messages without a channel': message() * 1000,
        'channel without a schema': channel() + message(),
        'schema zero': channel(schema_id=0) + message(),
        'a time in the year 2554': GOOD + record(Opcode.MESSAGE, late),
    }.items():  # fmt: skip
        yield name, file_of(chunk(content)), -1
    bare = MAGIC + pack(Header('ros2', 'x')) + GOOD + message() * 50_000
    yield 'messages without chunks', bare, 50_100
    odd = chunk(GOOD, 'brotli', b'x' * 100)
    yield 'an unknown compression', file_of(odd, chunk(GOOD)), 100
    yield 'a chunk without a checksum', file_of(chunk(GOOD, crc=0)), 100


def _texts() -> Iterator[tuple[str, bytes, int]]:
    line = f'{"=" * 80}\nMSG: x/'
    for name, text in {
        'a type within itself': 'x/A a\n' + f'{line}A\nx/A a\n' * 3,
        'an endless type': 'float64 a\n' * 200_000,
        'a type of garbage': '\x00\xff[[[[' * 1000,
        'a huge array': 'float64[4294967295] a\n',
        'sizes multiplied': ''.join(f'x/T{n}[1000] a\n{line}T{n}\n' for n in range(50))
        + 'float64 x\n',
        'a default of a megabyte': 'string s "' + 'x' * MIB + '"\n',
    }.items():
        parts = schema(name=SAMPLE, text=text) + channel(topic='/plant_sample') + message()
        yield name, file_of(chunk(parts, 'zstd')), -1
    wrong = record(Opcode.CHANNEL, struct.pack('<HHI', 1, 1, 4) + b'\xff\xfe\xfd\xfc')
    for name, odd in {
        'a topic of 100,000 letters': channel(topic='/' + 'a' * 100_000),
        'a topic of control characters': channel(topic='/../../etc/passwd\n\x1b[31m\0'),
        'a topic that is no text': wrong,
    }.items():
        yield name, file_of(chunk(schema() + odd + message())), -1
    notes = b''.join(pack(Metadata(f'n{k}', {'k': 'v' * 100})) for k in range(20_000))
    yield '20,000 metadata records', file_of(chunk(GOOD), notes), 100
    content = struct.pack('<QQ', 0, 0) + b'\1\0\0\0a' * 2 + struct.pack('<Q', 1 << 62)
    big = record(Opcode.ATTACHMENT, content)
    yield 'an attachment of 2^62 bytes', file_of(chunk(GOOD), big), 100


def hostile(options: Options) -> Outcome:
    """Read, walk, recover and describe each file in a child that may take 200 MiB."""
    outcome, home = Outcome(), options.folder
    good = home / 'good.mcap'
    good.write_bytes(file_of(chunk(GOOD, 'zstd'), chunk(GOOD, 'lz4')))
    # Loads what is loaded lazily, so that each child is measured for its own work.
    for work in works(good).values():
        work()
    for kind in (_bombs, _lengths, _contradictions, _texts):
        for name, raw, messages in kind():
            (home / 'hostile.mcap').write_bytes(raw)
            _try(name, home / 'hostile.mcap', messages, outcome)
    for path in _places(home / 'places'):
        _try(repr(path.name[:20]) if home in path.parents else str(path), path, 0, outcome)
    (home / 'to_whole.mcap').symlink_to(good)
    _try('a link to a whole file', home / 'to_whole.mcap', 200, outcome)
    outcome.measured['largest_mib'] = round(outcome.measured['largest_mib'], 1)
    outcome.sentence = (
        f'{outcome.counts["files"]} files and names: longest '
        f'{outcome.measured["longest_cpu_s"]:.2f} s of CPU ({outcome.measured["longest"]}), '
        f'largest {outcome.measured["largest_mib"]:.0f} MiB'
    )
    return outcome


def describe(path: Path) -> None:
    """Run `valveflow info` and raise if it does not end as it should."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        status = valveflow(['info', os.fspath(path)])
    if UNFORESEEN in out.getvalue() or status not in (0, 1):
        raise RuntimeError(f'status {status}: {out.getvalue()[-300:]}')


def works(path: Path) -> dict[str, Callable[[], int]]:
    """Return what is done with a file; each returns a number of messages, -1 if unknown."""
    copy = path.with_name('copy.mcap')

    def mend() -> int:
        copy.unlink(missing_ok=True)
        return recover(path, copy).messages

    return {
        'read': lambda: sum(1 for _ in open_log(path).iter_messages()),
        'recover': mend,
        'info': lambda: describe(path) or -1,
    }


def _try(name: str, path: Path, messages: int, outcome: Outcome) -> None:
    outcome.count('files')
    try:
        size = path.stat().st_size
    except (OSError, ValueError):
        size = 0
    most_s = MOST_S + MORE_S_PER_MIB * max(0.0, size / MIB - 1.0)
    for what, work in works(path).items():
        ended = run_bounded(lambda work=work: _timed(work), PATIENCE_S, MOST_BYTES)
        kind, value, cpu_s = ended.value or ('none', 0, ended.seconds)
        outcome.count(f'{what}: {kind}')
        label = f'{name}, {what}'
        outcome.expect(not ended.error, f'{label}: {ended.error}')
        outcome.expect(cpu_s <= most_s, f'{label}: {cpu_s:.1f} s of CPU, {size} bytes')
        outcome.expect(ended.bytes <= MOST_BYTES, f'{label}: {ended.bytes / MIB:.0f} MiB')
        if kind == 'messages' and value >= 0 and messages >= 0:
            outcome.expect(value == messages, f'{label}: {value} messages, not {messages}')
        if kind == 'sentence':
            outcome.expect(messages <= 0, f'{label}: {messages} messages not read: {value}')
        if cpu_s >= outcome.measured.get('longest_cpu_s', 0.0):
            outcome.measured |= {'longest_cpu_s': round(cpu_s, 3), 'longest': label}
        if ended.bytes / MIB >= outcome.measured.get('largest_mib', 0.0):
            outcome.measured |= {'largest_mib': ended.bytes / MIB, 'largest': label}


def _timed(work: Callable[[], int]) -> tuple[str, Any, float]:
    """Return what came of it, and the CPU time: other programs may hold the machine."""
    before = os.times()
    try:
        kind, value = 'messages', work()
    except ValveflowError as error:
        kind, value = 'sentence', str(error)
        if '\n' in value or not value.endswith(('.', ')')):
            raise
    after = os.times()
    return kind, value, after.user + after.system - before.user - before.system


def _places(home: Path) -> list[Path]:
    """Return names that are no ordinary files."""
    (home / 'empty_folder').mkdir(parents=True)
    os.mkfifo(home / 'pipe.mcap')
    (home / 'loop.mcap').symlink_to(home / 'loop.mcap')
    (home / 'zero.mcap').symlink_to('/dev/zero')
    (home / 'nowhere.mcap').symlink_to(home / 'missing')
    (home / 'folder.mcap').mkdir()
    os.mkfifo(home / 'folder.mcap' / 'inner.mcap')
    names = [
        'empty_folder', 'pipe.mcap', 'loop.mcap', 'zero.mcap', 'nowhere.mcap', 'folder.mcap',
        'missing.mcap', 'a' * 300 + '.mcap', 'line\nbreak.mcap', 'nul\0byte.mcap', '',
    ]  # fmt: skip
    return [*(home / name for name in names), Path('/dev/zero'), Path('/proc/self/mem')]
