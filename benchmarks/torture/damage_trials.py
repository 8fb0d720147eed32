# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files cut at every byte, with flipped bits, without their first chunk: no wrong values."""

from __future__ import annotations

import random
import time
from contextlib import suppress

import numpy as np
from log_files import (
    FLOAT64,
    START_NS,
    STOCK,
    against_chunks,
    chunk_ends,
    float64,
    numbers_in_chunks,
    read_back,
    record_heads,
    records,
    stock,
    write_chunks,
    write_part,
)
from mcap.opcode import Opcode

from benchmarks.torture.trial import MIB, Options, Outcome, memory
from valveflow_ros.errors import RecordingError, ValveflowError
from valveflow_ros.logs import RecordingWriter, open_log, recover

PER_CHUNK = 20
FLIPS = 20_000
LARGE_BYTES = 5_000_000
MOST_S = 1.0
MOST_BYTES = 200 * MIB
EVERY = 25


class Patient:
    """A small intact file, finished or not, damaged again and again in one place of the disk."""

    def __init__(self, options: Options, outcome: Outcome, finished: bool) -> None:
        folder = options.folder / ('whole' if finished else 'part')
        write = write_chunks if finished else write_part
        path, self.wanted, *_ = write(folder)
        self.raw = path.read_bytes()
        self.ends = chunk_ends(self.raw)
        self.path = options.folder / 'damaged.mcap'
        self.copy = options.folder / 'copy.mcap'
        self._outcome = outcome

    def look(self, raw: bytes, what: str) -> tuple[int, int]:
        """Read a damaged copy; return the chunks lost, and the readings found."""
        outcome, found = self._outcome, []
        self.path.write_bytes(raw)
        begun_s = time.perf_counter()
        with outcome.surprises(what), suppress(RecordingError):
            found = read_back(open_log(self.path))
        outcome.worst('longest_s', round(time.perf_counter() - begun_s, 3))
        missing, wrong = against_chunks(found, self.wanted, PER_CHUNK)
        outcome.count('files')
        outcome.count('wrong_values', len(wrong))
        outcome.count('chunks_lost', missing)
        outcome.expect(not wrong, f'{what}: {len(wrong)} values that nobody wrote')
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
        told = len(stock(self.copy))
        same = not wrong and report.messages == len(found) == told
        self._outcome.expect(same, f'{what}: recovered {len(found)}, stock readers say {told}')


def _price(outcome: Outcome, before: int) -> None:
    held = memory('VmHWM') - before
    outcome.measured['memory_mib'] = round(held / MIB, 1)
    outcome.expect(held <= MOST_BYTES, 'took more than 200 MiB')
    outcome.expect(outcome.measured['longest_s'] <= MOST_S, 'a small file took more than a second')


def truncation(options: Options) -> Outcome:
    """Cut a small file at every byte, and a large one at every boundary of a record."""
    outcome, before = Outcome(), memory('VmRSS')
    patient = Patient(options, outcome, finished=True)
    for size in range(0, len(patient.raw) + 1, options.step):
        what = f'cut at byte {size}'
        _, found = patient.look(patient.raw[:size], what)
        whole = PER_CHUNK * sum(end <= size for end in patient.ends)
        outcome.expect(found == whole, f'{what}: {found} of {whole} values')
        if size % (EVERY * options.step) == 0:
            patient.mend(what)
    counts = outcome.counts
    # Most chunks are missing because they were cut away.
    del counts['chunks_lost']
    counts['bytes_of_the_small_file'] = len(patient.raw)
    _large(options, outcome)
    _price(outcome, before)
    outcome.sentence = (
        f'{counts["files"]} cuts of a file of {len(patient.raw)} bytes and {counts["large_cuts"]} '
        f'of one of {counts["bytes_of_the_large_file"]}: {counts["wrong_values"]} wrong values, '
        'every whole chunk read'
    )
    return outcome


def _large(options: Options, outcome: Outcome) -> None:
    values, sent = np.random.default_rng(1).normal(size=400_000), 0
    with RecordingWriter(options.folder / 'large', definitions=STOCK) as writer:
        writer.add_topic('/valve_opening', FLOAT64)
        while writer.file_bytes < LARGE_BYTES:
            time_ns = START_NS + sent
            writer.write('/valve_opening', float64(float(values[sent])), time_ns, time_ns)
            sent += 1
    raw = (options.folder / 'large' / 'large_0.mcap').read_bytes()
    whole = dict(zip(chunk_ends(raw), np.cumsum(numbers_in_chunks(raw)).tolist(), strict=True))
    damaged, expected = options.folder / 'large.mcap', 0
    for number, (_, _, mark) in enumerate(records(raw)):
        expected = whole.get(mark, expected)
        if number % options.step:
            continue
        damaged.write_bytes(raw[:mark])
        try:
            found = open_log(damaged).readings.value
        except RecordingError:
            found = np.empty(0)
        same = np.array_equal(found, values[:expected])
        outcome.expect(same, f'large file cut at byte {mark}: {len(found)} of {expected} values')
        outcome.count('large_cuts')
    outcome.counts['bytes_of_the_large_file'] = len(raw)


def flips(options: Options) -> Outcome:
    """Flip single bits: anywhere, and all in the heads of all records."""
    outcome, before = Outcome(), memory('VmRSS')
    generator = random.Random(options.seed)
    for finished in (True, False):
        patient = Patient(options, outcome, finished)
        size = 8 * len(patient.raw)
        anywhere = [generator.randrange(size) for _ in range(options.many(FLIPS // 2))]
        bits = [8 * place + bit for place in record_heads(patient.raw) for bit in range(8)]
        if options.scale < 1:
            bits = generator.sample(bits, options.many(len(bits)))
        outcome.count('flips_in_heads', len(bits))
        for number, bit in enumerate([*anywhere, *bits]):
            damaged = bytearray(patient.raw)
            damaged[bit // 8] ^= 1 << bit % 8
            missing, _ = patient.look(bytes(damaged), f'bit {bit}')
            outcome.counts['most_lost'] = max(outcome.counts.get('most_lost', 0), missing)
            outcome.expect(missing <= 1, f'bit {bit}: {missing} chunks lost')
            if number % EVERY == 0:
                patient.mend(f'bit {bit}')
    counts = outcome.counts
    counts['flips'] = counts['files']
    _price(outcome, before)
    outcome.sentence = (
        f'{counts["flips"]} flipped bits, {counts["flips_in_heads"]} of them in heads of records: '
        f'{counts["wrong_values"]} wrong values, at most {counts["most_lost"]} chunk lost'
    )
    return outcome


def first_chunk(options: Options) -> Outcome:
    """Overwrite each byte of the first chunk: all others are read, with their topics."""
    outcome, generator = Outcome(), random.Random(options.seed)
    for finished in (True, False):
        patient = Patient(options, outcome, finished)
        rest = len(patient.wanted) - PER_CHUNK
        begin = next(b for op, b, _ in records(patient.raw) if op == Opcode.CHUNK)
        for place in range(begin, patient.ends[0], options.step):
            damaged = bytearray(patient.raw)
            damaged[place] ^= generator.randrange(1, 256)
            _, found = patient.look(bytes(damaged), f'byte {place}')
            outcome.expect(found >= rest, f'byte {place}: {found} of {rest} values')
        wiped = bytearray(patient.raw)
        wiped[begin : patient.ends[0]] = bytes(patient.ends[0] - begin)
        _, found = patient.look(bytes(wiped), 'wiped')
        outcome.expect(found == rest, f'wiped: {found} values')
    outcome.sentence = (
        f'{outcome.counts["files"]} files without a sound first chunk: all others were read, '
        f'{outcome.counts["wrong_values"]} wrong values'
    )
    return outcome
