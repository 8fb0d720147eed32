# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Changes files in ways that a reader has to be ready for: records, chunks, cells and bytes."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from benchmarks.torture.bombs import chunk
from valveflow_ros.logs.mcap.records import MAGIC, RECORD_HEAD
from valveflow_ros.logs.mcap.scan import CHUNK_HEAD_SIZE

ODD = (0, 1, 2, 7, 8, 255, 256, 0x7FFF, 0xFFFF, 1 << 31, (1 << 32) - 1, 1 << 63, (1 << 64) - 1)
LARGEST = 4 << 20
CELLS = (
    'nan', 'inf', '-inf', '1e999', '', ' ', '"', '""', "'", '1,5', '0x10', '1e', '-', '1_000',
    '2024-02-30T00:00:00Z', '2024-01-01T00:00:60Z', '9999999999999999999', '-1', '1970-01-01',
    '24:00', 'null', 'None', '\0', '\ufeff', '\u0661', 'a' * 5000, '#', ';', '\t', '1 2',
)  # fmt: skip

Records = list[tuple[int, bytes]]


def split(raw: bytes, position: int = len(MAGIC)) -> tuple[Records, bytes]:
    """Return kind and content of each record, and what does not fit behind them."""
    found: Records = []
    while position + RECORD_HEAD.size <= len(raw):
        op, length = RECORD_HEAD.unpack_from(raw, position)
        end = position + RECORD_HEAD.size + length
        if end > len(raw):
            break
        found.append((op, raw[position + RECORD_HEAD.size : end]))
        position = end
    return found, raw[position:]


def joined(records: Records) -> bytes:
    """Return records as bytes."""
    return b''.join(RECORD_HEAD.pack(op, len(content)) + content for op, content in records)


class Mutator:
    """Makes mutants; each follows from the generator alone.

    Parameters
    ----------
    generator : random.Random
    seeds : list of bytes
        Whole MCAP files, from which pieces are taken.
    """

    def __init__(self, generator: random.Random, seeds: list[bytes]) -> None:
        self._generator = generator
        self._seeds = seeds

    def recording(self) -> bytes:
        """Return a mutant of an MCAP file."""
        generator = self._generator
        raw = generator.choice(self._seeds)
        for _ in range(generator.choice((1, 1, 2, 3, 6))):
            raw = self._once(raw)[:LARGEST]
        return raw

    def table(self, text: str) -> bytes:
        """Return a mutant of a CSV table."""
        generator = self._generator
        lines = text.split('\n')
        for _ in range(generator.choice((1, 2, 5, 20))):
            place = generator.randrange(len(lines))
            cells = lines[place].split(',')
            kind = generator.randrange(7)
            if kind < 3:
                cells[generator.randrange(len(cells))] = generator.choice(CELLS)
            elif kind == 3:
                cells.insert(generator.randrange(len(cells) + 1), generator.choice(CELLS))
            elif kind == 4:
                cells.pop()
            elif kind == 5:
                lines.insert(place, lines[generator.randrange(len(lines))])
            else:
                generator.shuffle(cells)
            lines[place] = ','.join(cells)
        raw = generator.choice(('\n', '\n', '\r\n', '\r')).join(lines)
        coded = raw.encode(generator.choice(('utf-8', 'utf-8', 'utf-16', 'utf-8-sig', 'utf-7')))
        return self.bytes_of(coded) if generator.random() < 0.3 else coded

    def bytes_of(self, raw: bytes) -> bytes:
        """Return bytes with some flipped, cut out, doubled or replaced."""
        generator = self._generator
        changed = bytearray(raw or b'\0')
        for _ in range(generator.choice((1, 1, 2, 8))):
            place = generator.randrange(len(changed))
            size = min(generator.choice((1, 2, 4, 8, 100)), len(changed) - place)
            kind = generator.randrange(5)
            if kind == 0:
                changed[place] ^= 1 << generator.randrange(8)
            elif kind == 1:
                changed[place : place + size] = generator.randbytes(size)
            elif kind == 2 and len(changed) > size:
                del changed[place : place + size]
            elif kind == 3:
                changed[place:place] = changed[place : place + size]
            else:
                number = struct.pack('<Q', generator.choice(ODD))[: generator.choice((2, 4, 8))]
                changed[place : place + len(number)] = number
        return bytes(changed)

    def _once(self, raw: bytes) -> bytes:
        records, rest = split(raw)
        if not records or self._generator.random() < 0.2:
            return self.bytes_of(raw)
        place = self._generator.randrange(len(records))
        ways: list[Callable[[Records, int], None]] = [
            self._drop, self._double, self._move, self._recode, self._change, self._borrow,
            self._inside, self._inside, self._inside, self._lie,
        ]  # fmt: skip
        self._generator.choice(ways)(records, place)
        return raw[: len(MAGIC)] + joined(records) + rest

    def _drop(self, records: Records, place: int) -> None:
        del records[place]

    def _double(self, records: Records, place: int) -> None:
        records[place:place] = [records[place]] * self._generator.choice((1, 2, 50))

    def _move(self, records: Records, place: int) -> None:
        records.insert(self._generator.randrange(len(records)), records.pop(place))

    def _recode(self, records: Records, place: int) -> None:
        op = self._generator.choice((*range(17), 128, 255))
        records[place] = op, records[place][1]

    def _change(self, records: Records, place: int) -> None:
        op, content = records[place]
        records[place] = op, self.bytes_of(content)

    def _borrow(self, records: Records, place: int) -> None:
        others, _ = split(self._generator.choice(self._seeds))
        records.insert(place, self._generator.choice(others))

    def _lie(self, records: Records, place: int) -> None:
        """Write another length before a record."""
        op, content = records[place]
        length = self._generator.choice((*ODD, len(content) + 1, max(0, len(content) - 1)))
        whole = RECORD_HEAD.pack(op, length) + content
        # The head is put into a record of its own kind, whose content swallows it.
        records[place] = op, whole

    def _inside(self, records: Records, place: int) -> None:
        """Change what is in a chunk and give it a right checksum again."""
        chunks = [k for k, (op, _) in enumerate(records) if op == Opcode.CHUNK]
        if not chunks:
            return
        place = self._generator.choice(chunks)
        opened = _opened(records[place][1])
        if opened is None:
            return
        inner, rest = split(opened, 0)
        if inner and self._generator.random() < 0.8:
            ways = [self._drop, self._double, self._move, self._recode, self._change, self._borrow]
            self._generator.choice(ways)(inner, self._generator.randrange(len(inner)))
            content = joined(inner) + rest
        else:
            content = self.bytes_of(opened)
        packing = self._generator.choice(('', 'zstd', 'lz4'))
        records[place] = Opcode.CHUNK, chunk(content[:LARGEST], packing)[RECORD_HEAD.size :]


def _opened(content: bytes) -> bytes | None:
    """Return what is in a chunk, None if it is damaged already."""
    try:
        size, crc = struct.unpack_from('<QI', content, 16)
        length = int.from_bytes(content[CHUNK_HEAD_SIZE : CHUNK_HEAD_SIZE + 4], 'little')
        name = content[CHUNK_HEAD_SIZE + 4 : CHUNK_HEAD_SIZE + 4 + length]
        packed = content[CHUNK_HEAD_SIZE + 4 + length + 8 :]
        if size > LARGEST:
            return None
        if name == b'zstd':
            opened = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        else:
            opened = lz4.frame.decompress(packed) if name == b'lz4' else packed
    except (struct.error, zstandard.ZstdError, RuntimeError, ValueError):
        return None
    return opened if zlib.crc32(opened) == crc else None
