# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""An hour at 4,000 messages a second that nobody finished: what its recovery costs."""

from __future__ import annotations

from pathlib import Path

from log_files import FLOAT64, START_NS, STOCK, float64

from benchmarks.torture.bounded import run_bounded
from benchmarks.torture.kill_child import TOPICS
from benchmarks.torture.memory import MIB, peak
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.logs import RecordingWriter
from valveflow_ros.logs.mcap.recover import recover

SECONDS = 3600
RATE = 4000
MOST_BYTES = 200 * MIB
PROMISED_S = 30.0


def recover_big(options: Options) -> Outcome:
    """Recover the hour in a process that may not hold more than 200 MiB."""
    outcome = Outcome()
    seconds = options.many(SECONDS)
    part = _write(options.folder / 'log', seconds)
    target = options.folder / 'whole.mcap'

    def work() -> tuple[int, int, int]:
        report = recover(part, target)
        return report.messages, report.damaged_chunks, peak()

    ended = run_bounded(work, 900.0)
    outcome.expect(not ended.error, ended.error)
    messages, damaged, held = ended.value or (0, 0, 0)
    outcome.counts = {'messages': messages, 'damaged': damaged, 'bytes': part.stat().st_size}
    outcome.measured = {
        'recover_s': round(ended.seconds, 1), 'memory_mib': round(held / MIB),
        'memory_of_the_recovery_mib': round(ended.bytes / MIB),
        'within_promised_s': ended.seconds <= PROMISED_S,
    }  # fmt: skip
    outcome.wish(ended.seconds <= PROMISED_S, f'{ended.seconds:.0f} s instead of {PROMISED_S:g}')
    outcome.expect(messages == seconds * RATE, f'{messages} of {seconds * RATE} messages')
    outcome.expect(held <= MOST_BYTES, f'{held / MIB:.0f} MiB were held')
    outcome.sentence = (
        f'{messages} messages recovered in {ended.seconds:.0f} s, {held / MIB:.0f} MiB held'
    )
    return outcome


def _write(folder: Path, seconds: int) -> Path:
    writer = RecordingWriter(folder, definitions=STOCK)
    for topic in TOPICS:
        writer.add_topic(topic, FLOAT64)
    period_ns = 10**9 // RATE
    # As the recorder does, hand over every half second.
    for begin in range(0, seconds * RATE, RATE // 2):
        for number in range(begin, begin + RATE // 2):
            time_ns = START_NS + number * period_ns
            writer.write(TOPICS[number % 4], float64(number), time_ns, time_ns)
        writer.flush()
    writer.abandon()
    (part,) = folder.glob('*.part')
    return part
