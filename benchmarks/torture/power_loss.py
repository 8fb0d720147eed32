# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A power cut after each sync, with torn tails: what was synced is there, nothing is invented."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from pathlib import Path

from log_files import FLOAT64, START_NS, STOCK, float64

from benchmarks.torture.stock import stock_count
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import RecordingWriter, open_log
from valveflow_ros.logs.mcap.recover import recover
from valveflow_ros.logs.part_file import PartFile

SECONDS = 120
RATE = 40
FLUSH_S, SYNC_S = 0.5, 5.0
TAILS = 40
SECTORS = (512, 4096)


@dataclass(slots=True)
class Tape:
    """What a disk was told: bytes at the end, and up to where they were synced.

    Attributes
    ----------
    data : bytearray
        All bytes.
    synced : list of (int, int)
        For each sync, the bytes before it, and the messages handed in before it.
    """

    data: bytearray = field(default_factory=bytearray)
    synced: list[tuple[int, int]] = field(default_factory=list)
    messages: int = 0


class TapedFile(PartFile):
    """A real file that also writes the tape."""

    def __init__(self, path: Path, tape: Tape) -> None:
        super().__init__(path)
        self._tape = tape

    def write(self, data: bytes) -> int:
        """Append bytes."""
        taken = super().write(data)
        self._tape.data += data[:taken]
        return taken

    def sync(self) -> None:
        """Note what is safe from now on."""
        super().sync()
        self._tape.synced.append((len(self._tape.data), self._tape.messages))

    def publish(self) -> None:
        """Note that all is safe."""
        super().publish()
        self._tape.synced.append((len(self._tape.data), self._tape.messages))


def power_loss(options: Options) -> Outcome:
    """Cut the power between any two syncs; some of the sectors written since have reached it."""
    outcome = Outcome()
    generator = random.Random(options.seed)
    tape = _recorded(options.folder / 'log', options.many(SECONDS, 20))
    ends = [*[size for size, _ in tape.synced[1:]], len(tape.data)]
    for (size, messages), end in zip(tape.synced, ends, strict=True):
        for number in range(options.many(TAILS, 4)):
            raw = _torn(tape.data, size, end, number, generator)
            what = f'cut after {size} of {len(tape.data)} bytes, tail {number}'
            _judge(options.folder, raw, messages, tape.messages, what, outcome)
    outcome.counts['syncs'] = len(tape.synced)
    outcome.sentence = (
        f'{outcome.counts["cuts"]} power cuts around {len(tape.synced)} syncs: nothing synced was '
        f'lost, {outcome.counts["invented"]} messages invented'
    )
    return outcome


def _recorded(folder: Path, seconds: int) -> Tape:
    tape = Tape()
    writer = RecordingWriter(
        folder, definitions=STOCK, open_file=lambda path: TapedFile(path, tape)
    )
    writer.add_topic('/valve_opening', FLOAT64)
    for number in range(seconds * RATE):
        time_ns = START_NS + number * 10**9 // RATE
        writer.write('/valve_opening', float64(number), time_ns, time_ns)
        tape.messages = number + 1
        if (number + 1) % round(FLUSH_S * RATE) == 0:
            writer.flush()
        if (number + 1) % round(SYNC_S * RATE) == 0:
            writer.sync()
    writer.close()
    return tape


def _torn(data: bytearray, size: int, end: int, number: int, generator: random.Random) -> bytes:
    """Return the file after a cut: whole up to ``size``, then any of the sectors up to ``end``."""
    sector = SECTORS[number % len(SECTORS)]
    length = generator.randint(size, end)
    raw = bytearray(data[:length])
    if number % 4 < 2:
        # The length has reached the disk, some sectors have not: zeros, or what stood there.
        for begin in range(size // sector * sector, length, sector):
            first, last = max(begin, size), min(begin + sector, length)
            if last > first and generator.random() < 0.5:
                stale = generator.random() < 0.5
                raw[first:last] = (
                    generator.randbytes(last - first) if stale else bytes(last - first)
                )
    return bytes(raw)


def _judge(folder: Path, raw: bytes, safe: int, sent: int, what: str, outcome: Outcome) -> None:
    path, copy = folder / 'cut.mcap', folder / 'whole.mcap'
    path.write_bytes(raw)
    copy.unlink(missing_ok=True)
    outcome.count('cuts')
    try:
        values = open_log(path).readings.value.tolist()
        report = recover(path, copy)
    except RecordingError as error:
        outcome.expect(safe == 0, f'{what}: {error}')
        return
    numbers = [int(value) for value in values]
    invented = len(set(numbers) - set(range(sent))) + (numbers != sorted(set(numbers)))
    outcome.count('invented', invented)
    outcome.expect(not invented, f'{what}: values that nobody wrote, or twice')
    outcome.expect(numbers[:safe] == list(range(safe)), f'{what}: synced messages are lost')
    same = report.messages == len(values) == stock_count(copy)
    outcome.expect(same, f'{what}: recovered {report.messages} of {len(values)}')
    outcome.counts['found_beyond_the_sync'] = (
        outcome.counts.get('found_beyond_the_sync', 0) + len(numbers) - safe
    )
