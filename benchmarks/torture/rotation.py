# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A hundred new files under 4,000 messages a second: no message is lost or repeated."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path

from log_files import FLOAT64, STOCK, float64

from benchmarks.torture.kill_child import TOPICS
from benchmarks.torture.stock import stock_messages
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.logs import Recorder, RecorderSettings, open_log

ROTATIONS = 100
RATE = 4000
EVERY_S = 0.5
PATIENCE_S = 60.0


def rotation(options: Options) -> Outcome:
    """Ask for a new file every half second while four topics run at 1 kHz each."""
    outcome = Outcome()
    folder = options.folder / 'log'
    rotations = options.many(ROTATIONS, 3)
    recorder = Recorder(folder, RecorderSettings(free_floor_bytes=0), definitions=STOCK)
    for topic in TOPICS:
        recorder.add_topic(topic, FLOAT64)
    begun_s = asked_s = time.monotonic()
    sent, asked = 0, 0
    while recorder.status().files_finished < rotations:
        now_s = time.monotonic()
        while sent < int((now_s - begun_s) * RATE):
            stamp_ns = time.time_ns()
            recorder.record(TOPICS[sent % 4], float64(sent), stamp_ns, stamp_ns)
            sent += 1
        if now_s - asked_s >= EVERY_S and not recorder.is_rotating:
            recorder.rotate()
            asked, asked_s = asked + 1, now_s
        if now_s - begun_s > rotations * 5 * EVERY_S + PATIENCE_S:
            break
        time.sleep(0.002)
    status = recorder.close(PATIENCE_S)
    outcome.counts = {
        'rotations': status.files_finished, 'asked': asked, 'sent': sent,
        'received': status.received, 'written': status.written, 'lost': status.lost,
        'dropped': sum(status.dropped.values()),
    }  # fmt: skip
    outcome.expect(status.files_finished >= rotations, f'{status.files_finished} files')
    outcome.expect(status.written == sent, f'{status.written} of {sent} written: {status}')
    _read(folder, sent, outcome)
    outcome.sentence = (
        f'{status.files_finished} files under {RATE} messages a second: '
        f'{sent} sent, {outcome.counts["on_disk"]} on disk'
    )
    return outcome


def _read(folder: Path, sent: int, outcome: Outcome) -> None:
    contents = open_log(folder)
    outcome.expect(contents.warnings == (), str(contents.warnings))
    found = Counter(int(value) for value in contents.readings.value)
    outcome.counts['on_disk'] = sum(found.values())
    whole = found == Counter(range(sent))
    outcome.expect(whole, f'{len(found)} different messages of {sent} on disk')
    sequences: dict[str, list[int]] = {topic: [] for topic in TOPICS}
    for path in folder.glob('*.mcap'):
        for topic, sequence, _, _ in stock_messages(path):
            sequences[topic].append(sequence)
    for topic, numbers in sequences.items():
        gapless = sorted(numbers) == list(range(1, len(numbers) + 1))
        outcome.expect(gapless, f'{topic}: the sequence numbers have gaps')
