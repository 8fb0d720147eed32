# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files cut at every byte, with flipped bits, without their first chunk: no wrong values."""

from __future__ import annotations

import random
import time
from pathlib import Path

import numpy as np
from damage import against_chunks, chunk_ends, record_heads, records
from log_files import FLOAT64, START_NS, STOCK, float64, read_back, write_chunks

from benchmarks.torture.memory import MIB, peak, resident
from benchmarks.torture.stock import stock_count
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.errors import RecordingError, ValveflowError
from valveflow_ros.logs import RecordingWriter, open_log
from valveflow_ros.logs.mcap.recover import recover

PER_CHUNK = 20
FLIPS = 20_000
LARGE_BYTES = 5_000_000
MOST_S = 1.0
MOST_BYTES = 200 * MIB
EVERY = 25


class Patient:
    """A small intact file, damaged again and again in one place of the disk."""

    def __init__(self, options: Options, outcome: Outcome, close: bool) -> None:
        folder = options.folder / ('whole' if close else 'part')
        path, self.wanted, writer = write_chunks(folder, close=close)
        if not close:
            writer.abandon()
        self.raw = path.read_bytes()
        self.ends = chunk_ends(self.raw) if close else _part_ends(self.raw)
        self.path = options.folder / 'damaged.mcap'
        self.copy = options.folder / 'copy.mcap'
        self._outcome = outcome

    def look(self, raw: bytes, what: str) -> tuple[int, int]:
        """Read a damaged copy; return the chunks lost, and the readings found."""
        self.path.write_bytes(raw)
        begun_s = time.perf_counter()
        try:
            found = read_back(open_log(self.path))
        except RecordingError:
            found = []
        except Exception as error:  # noqa: BLE001 - that is what is looked for
            self._outcome.expect(False, f'{what}: {type(error).__name__}: {error}')
            found = []
        self._outcome.worst('longest_s', round(time.perf_counter() - begun_s, 3))
        missing, wrong = against_chunks(found, self.wanted, PER_CHUNK)
        self._outcome.count('files')
        self._outcome.count('wrong_values', len(wrong))
        self._outcome.count('chunks_lost', missing)
        self._outcome.expect(not wrong, f'{what}: {len(wrong)} values that nobody wrote')
        return missing, len(found)

    def mend(self, what: str) -> None:
        """Recover the copy looked at last; stock readers must find what ours finds."""
        self.copy.unlink(missing_ok=True)
        try:
            report = recover(self.path, self.copy)
            found = read_back(open_log(self.copy))
        except ValveflowError:
            return
        _, wrong = against_chunks(found, self.wanted, PER_CHUNK)
        self._outcome.count('recovered_files')
        stock = stock_count(self.copy)
        same = not wrong and report.messages == len(found) == stock
        self._outcome.expect(same, f'{what}: recovered {len(found)}, stock readers say {stock}')


def _part_ends(raw: bytes) -> list[int]:
    # The walk stops eight bytes before the end, where a finished file has its magic.
    return chunk_ends(raw + bytes(8))


def truncation(options: Options) -> Outcome:
    """Cut a small file at every byte, and a large one at every boundary of a record."""
    outcome = Outcome()
    before = resident()
    patient = Patient(options, outcome, close=True)
    step = max(1, round(1 / options.scale))
    for size in range(0, len(patient.raw) + 1, step):
        _, found = patient.look(patient.raw[:size], f'cut at byte {size}')
        whole = sum(end <= size for end in patient.ends)
        complete = found == whole * PER_CHUNK
        outcome.expect(complete, f'cut at byte {size}: {found} of {whole * PER_CHUNK} values')
        if size % (EVERY * step) == 0:
            patient.mend(f'cut at byte {size}')
    # Most chunks are missing because they were cut away.
    del outcome.counts['chunks_lost']
    outcome.counts['bytes_of_the_small_file'] = len(patient.raw)
    _large(options, outcome, step)
    outcome.measured['memory_mib'] = round((peak() - before) / MIB, 1)
    outcome.expect(peak() - before <= MOST_BYTES, 'took more than 200 MiB')
    outcome.expect(outcome.measured['longest_s'] <= MOST_S, 'a small file took more than a second')
    counts = outcome.counts
    outcome.sentence = (
        f'{counts["files"]} cuts of a file of {len(patient.raw)} bytes and {counts["large_cuts"]} '
        f'of one of {counts["bytes_of_the_large_file"]}: {counts["wrong_values"]} wrong values, '
        'every whole chunk read'
    )
    return outcome


def _large(options: Options, outcome: Outcome, step: int) -> None:
    path, values = _write_large(options.folder / 'large')
    raw = path.read_bytes()
    marks = [end for _, _, end in records(raw)]
    counts = dict(zip(chunk_ends(raw), np.cumsum(_per_chunk(raw)), strict=True))
    damaged = options.folder / 'large.mcap'
    whole = done = 0
    for number, mark in enumerate(marks):
        whole = int(counts.get(mark, whole))
        if number % step:
            continue
        damaged.write_bytes(raw[:mark])
        try:
            found = open_log(damaged).readings.value
        except RecordingError:
            found = np.empty(0)
        same = np.array_equal(found, values[:whole])
        outcome.expect(same, f'large file cut at byte {mark}: {len(found)} of {whole} values')
        done += 1
    outcome.counts['large_cuts'] = done
    outcome.counts['bytes_of_the_large_file'] = len(raw)


def _write_large(folder: Path) -> tuple[Path, np.ndarray]:
    generator = np.random.default_rng(1)
    values = generator.normal(size=400_000)
    sent = 0
    with RecordingWriter(folder, definitions=STOCK) as writer:
        writer.add_topic('/valve_opening', FLOAT64)
        while writer.file_bytes < LARGE_BYTES:
            time_ns = START_NS + sent
            writer.write('/valve_opening', float64(float(values[sent])), time_ns, time_ns)
            sent += 1
    return folder / f'{folder.name}_0.mcap', values[:sent]


def _per_chunk(raw: bytes) -> list[int]:
    """Return the messages of each chunk, by the indexes that follow it."""
    counts: list[int] = []
    for op, begin, end in records(raw):
        if op == 6:
            counts.append(0)
        elif op == 7:
            counts[-1] += (end - begin - 9 - 6) // 16
    return counts


def flips(options: Options) -> Outcome:
    """Flip single bits: anywhere, and all in the heads of all records."""
    outcome = Outcome()
    before = resident()
    generator = random.Random(options.seed)
    for close in (True, False):
        patient = Patient(options, outcome, close)
        for number in range(options.many(FLIPS // 2)):
            _flip(patient, generator.randrange(8 * len(patient.raw)), number, outcome)
        heads = record_heads(patient.raw if close else patient.raw + bytes(8))
        bits = [8 * place + bit for place in heads for bit in range(8)]
        if options.scale < 1:
            bits = generator.sample(bits, options.many(len(bits)))
        outcome.count('flips_in_heads', len(bits))
        for number, bit in enumerate(bits):
            _flip(patient, bit, number, outcome)
    counts = outcome.counts
    counts['flips'] = counts['files']
    outcome.measured['memory_mib'] = round((peak() - before) / MIB, 1)
    outcome.expect(peak() - before <= MOST_BYTES, 'took more than 200 MiB')
    outcome.expect(outcome.measured['longest_s'] <= MOST_S, 'a file took more than a second')
    outcome.sentence = (
        f'{counts["flips"]} flipped bits, {counts["flips_in_heads"]} of them in heads of records: '
        f'{counts["wrong_values"]} wrong values, at most {counts.get("most_lost", 0)} chunk lost'
    )
    return outcome


def _flip(patient: Patient, bit: int, number: int, outcome: Outcome) -> None:
    damaged = bytearray(patient.raw)
    damaged[bit // 8] ^= 1 << bit % 8
    missing, _ = patient.look(bytes(damaged), f'bit {bit}')
    outcome.counts['most_lost'] = max(outcome.counts.get('most_lost', 0), missing)
    outcome.expect(missing <= 1, f'bit {bit}: {missing} chunks lost')
    if number % EVERY == 0:
        patient.mend(f'bit {bit}')


def first_chunk(options: Options) -> Outcome:
    """Overwrite each byte of the first chunk: all others are read, with their topics."""
    outcome = Outcome()
    generator = random.Random(options.seed)
    for close in (True, False):
        patient = Patient(options, outcome, close)
        begin = next(b for op, b, _ in records(patient.raw + bytes(8)) if op == 6)
        places = range(begin, patient.ends[0], max(1, round(1 / options.scale)))
        for place in places:
            damaged = bytearray(patient.raw)
            damaged[place] ^= generator.randrange(1, 256)
            _, found = patient.look(bytes(damaged), f'byte {place}')
            rest = len(patient.wanted) - PER_CHUNK
            outcome.expect(found >= rest, f'byte {place}: {found} of {rest} values')
        wiped = bytearray(patient.raw)
        wiped[begin : patient.ends[0]] = bytes(patient.ends[0] - begin)
        _, found = patient.look(bytes(wiped), 'wiped')
        outcome.expect(found == len(patient.wanted) - PER_CHUNK, f'wiped: {found} values')
    outcome.sentence = (
        f'{outcome.counts["files"]} files without a sound first chunk: all others were read, '
        f'{outcome.counts["wrong_values"]} wrong values'
    )
    return outcome
