# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mutants of recordings and tables: whatever reads them ends with a result or a sentence."""

from __future__ import annotations

import random
import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import zstandard
from log_files import (
    SAMPLE,
    START_NS,
    plant_sample,
    wander,
    write_chunks,
    write_messages,
    write_part,
)
from mcap.opcode import Opcode

from benchmarks.torture.hostile import GOOD, chunk, describe, file_of, record
from benchmarks.torture.trial import MIB, Options, Outcome, run_bounded
from valveflow_ros.errors import ValveflowError
from valveflow_ros.logs import Message, open_log, recover, write_samples, write_table
from valveflow_ros.logs.mcap.records import MAGIC, RECORD_HEAD
from valveflow_ros.logs.mcap.scan import CHUNK_HEAD_SIZE

BATCH = 200
# The node reads no tables; a library of theirs may want more for one.
MOST_BYTES = 600 * MIB
PATIENCE_S = 60.0
INFO_EVERY = 4
ODD = (0, 1, 2, 7, 8, 255, 256, 0x7FFF, 0xFFFF, 1 << 31, (1 << 32) - 1, 1 << 63, (1 << 64) - 1)
LARGEST = 4 << 20
CELLS = (
    'nan', 'inf', '-inf', '1e999', '', ' ', '"', '""', "'", '1,5', '0x10', '1e', '-', '1_000',
    '2024-02-30T00:00:00Z', '2024-01-01T00:00:60Z', '9999999999999999999', '-1', '1970-01-01',
    '24:00', 'null', 'None', '\0', '\ufeff', '\u0661', 'a' * 5000, '#', ';', '\t', '1 2',
)  # fmt: skip

Records = list[tuple[int, bytes]]


class Corpus(NamedTuple):
    """The whole files that mutants are made from."""

    recordings: list[bytes]
    csv: str
    parquet: bytes


def fuzz(options: Options) -> Outcome:
    """Read, walk, recover and describe mutants until the time is over; keep what hurts."""
    outcome, corpus = Outcome(), _corpus(options.folder)
    # Libraries that are loaded now need not be loaded by each child.
    for name in ('made.mcap', 'table.csv'):
        for call in _calls(options.folder / name, name.rsplit('.')[-1], 0).values():
            call()
    end_s = time.monotonic() + 60.0 * options.minutes * options.scale
    seed = options.seed
    while time.monotonic() < end_s:
        seed = _batch(seed, corpus, options.folder, outcome)
    counts = outcome.counts
    counts['first_seed'], counts['last_seed'] = options.seed, seed - 1
    hurt = counts.setdefault('seeds_that_hurt', [])
    outcome.sentence = (
        f'{counts["mutants"]} mutants, {counts["calls"]} calls: '
        f'{counts.get("results", 0)} results, {counts.get("sentences", 0)} sentences, '
        f'{len(hurt)} that hurt'
    )
    return outcome


def _batch(seed: int, corpus: Corpus, folder: Path, outcome: Outcome) -> int:
    """Try some mutants in a child; return the seed of the next."""
    mark = folder / 'mark'
    mark.write_text(str(seed))

    def work() -> tuple[Counter[str], list[tuple[int, str]]]:
        counts: Counter[str] = Counter()
        hurt: list[tuple[int, str]] = []
        for number in range(seed, seed + BATCH):
            mark.write_text(str(number))
            _mutant(number, corpus, folder, counts, hurt)
        return counts, hurt

    ended = run_bounded(work, PATIENCE_S, MOST_BYTES)
    counts, hurt = ended.value or ({}, [])
    following = seed + BATCH
    if ended.error:
        # The mutants before this one have been tried, but their counts went with the child.
        at = int(mark.read_text() or seed)
        hurt, following = [(at, ended.error)], at + 1
    for name, count in counts.items():
        outcome.count(name, count)
    outcome.worst('largest_mib', round(ended.bytes / MIB, 1))
    for number, what in hurt:
        outcome.counts.setdefault('seeds_that_hurt', []).append(number)
        outcome.expect(False, f'seed {number}: {what}')
    return following


def _mutant(
    seed: int, corpus: Corpus, folder: Path, counts: Counter[str], hurt: list[tuple[int, str]]
) -> None:
    """Make the mutant of a seed and hand it to everything that reads."""
    generator = random.Random(seed)
    mutator = Mutator(generator, corpus.recordings)
    kind = generator.choice(('mcap', 'mcap', 'mcap', 'csv', 'parquet'))
    if kind == 'mcap':
        raw = mutator.recording()
    else:
        raw = mutator.table(corpus.csv) if kind == 'csv' else mutator.bytes_of(corpus.parquet)
    path = folder / f'mutant.{kind}'
    path.write_bytes(raw)
    counts.update(('mutants', kind))
    for name, call in _calls(path, kind, seed).items():
        counts['calls'] += 1
        try:
            call()
            counts['results'] += 1
        except ValveflowError:
            counts['sentences'] += 1
        except BaseException as error:  # noqa: BLE001 - that is what is looked for
            hurt.append((seed, f'{name} of {path.name}: {type(error).__name__}: {error}'[:300]))


def _calls(path: Path, kind: str, seed: int) -> dict[str, Callable[[], object]]:
    copy = path.with_name('copy.mcap')

    def read() -> None:
        log = open_log(path)
        for _ in log.iter_messages():
            pass
        for topic in list(log.topics)[:3]:
            first = next(log.iter_messages([topic]), None)
            if first is not None:
                log.decoder(topic).decode(first.data)

    def mend() -> None:
        copy.unlink(missing_ok=True)
        report = recover(path, copy)
        found = sum(1 for _ in open_log(copy).iter_messages())
        if found > report.messages:
            raise AssertionError(f'recovered {report.messages}, then read {found}')

    calls: dict[str, Callable[[], object]] = {'read': read}
    if kind == 'mcap':
        calls['recover'] = mend
    if seed % INFO_EVERY == 0:
        calls['info'] = lambda: describe(path)
    return calls


def _corpus(folder: Path) -> Corpus:
    whole, *_ = write_chunks(folder / 'floats', chunks=6)
    part, _ = write_part(folder / 'parts', chunks=6)
    sent = [plant_sample(START_NS + k, [1.0, 2.0, 3.0, 4.0], [0] * 4) for k in range(40)]
    samples = write_messages(
        folder / 'samples', {'/plant_sample': SAMPLE, '/note': 'std_msgs/msg/String'},
        [Message('/plant_sample', m, START_NS + k, START_NS + k) for k, m in enumerate(sent)],
    )  # fmt: skip
    table = wander(200, 5)
    made = write_samples(table, folder / 'made.mcap').path
    for suffix in ('csv', 'parquet'):
        write_table(table, folder / f'table.{suffix}')
    recordings = [path.read_bytes() for path in (whole, part, samples, made)]
    recordings.append(file_of(chunk(GOOD, 'lz4'), chunk(GOOD)))
    csv, parquet = (folder / f'table.{suffix}' for suffix in ('csv', 'parquet'))
    return Corpus(recordings, csv.read_text(), parquet.read_bytes())


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
    return b''.join(record(op, content) for op, content in records)


class Mutator:
    """Makes mutants of ``seeds``, whole MCAP files; each follows from the generator alone."""

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
        kind = self._generator.randrange(10)
        if kind < 6:
            self._change(records, kind)
        elif kind < 9:
            self._inside(records)
        else:
            # Another length before a record: the head is put into a record of its own kind.
            place = self._generator.randrange(len(records))
            op, content = records[place]
            lies = (*ODD, len(content) + 1, max(0, len(content) - 1))
            records[place] = op, RECORD_HEAD.pack(op, self._generator.choice(lies)) + content
        return raw[: len(MAGIC)] + joined(records) + rest

    def _change(self, records: Records, kind: int) -> None:
        """Drop, double, move, rename or damage a record, or borrow one from another file."""
        generator = self._generator
        place = generator.randrange(len(records))
        op, content = records[place]
        if kind == 0:
            del records[place]
        elif kind == 1:
            records[place:place] = [records[place]] * generator.choice((1, 2, 50))
        elif kind == 2:
            records.insert(generator.randrange(len(records)), records.pop(place))
        elif kind == 3:
            records[place] = generator.choice((*range(17), 128, 255)), content
        elif kind == 4:
            records[place] = op, self.bytes_of(content)
        else:
            others, _ = split(generator.choice(self._seeds))
            records.insert(place, generator.choice(others))

    def _inside(self, records: Records) -> None:
        """Change what is in a chunk and give it a right checksum again."""
        chunks = [k for k, (op, _) in enumerate(records) if op == Opcode.CHUNK]
        place = self._generator.choice(chunks) if chunks else -1
        opened = _opened(records[place][1]) if chunks else None
        if opened is None:
            return
        inner, rest = split(opened, 0)
        if inner and self._generator.random() < 0.8:
            self._change(inner, self._generator.randrange(6))
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
