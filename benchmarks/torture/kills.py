# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recorders killed at random moments, what a large recovery costs, and files changed at speed."""

from __future__ import annotations

import mmap
import os
import random
import shutil
import signal
import time
from collections import Counter
from pathlib import Path
from statistics import median

import numpy as np
from log_files import FLOAT64, START_NS, STOCK, float64, numbered

from benchmarks.torture.trial import MIB, Options, Outcome, memory, run_bounded
from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import (
    Recorder,
    RecorderSettings,
    RecorderState,
    RecordingWriter,
    open_log,
    recover,
)
from valveflow_ros.records import SIGNALS

KILLS = 200
RATES = (4.0, 400.0, 4000.0)
LONGEST_S = 3.0
MOST_LOST_S = 0.6
ROTATIONS = 100
EVERY_S = 0.5
PATIENCE_S = 60.0
BIG_S = 3600
BIG_RATE = 4000
MOST_BYTES = 200 * MIB
PROMISED_S = 30.0
TOPICS = tuple(f'/{info.topic}' for info in SIGNALS if info.required)
ROOM = 1 << 20
# The other settings are those of the node.
SETTINGS = RecorderSettings(free_floor_bytes=0)


def _recorder(folder: Path) -> Recorder:
    recorder = Recorder(folder, SETTINGS, name='log', definitions=STOCK)
    for topic in TOPICS:
        recorder.add_topic(topic, FLOAT64)
    return recorder


class Account:
    """Log times of all messages handed in, in memory that outlives the process that notes them."""

    def __init__(self) -> None:
        cells = np.frombuffer(mmap.mmap(-1, 8 * (ROOM + 1)), dtype=np.int64)
        self._count, self.stamps = cells[:1], cells[1:]

    @property
    def sent(self) -> int:
        """Return the number of messages handed in."""
        return int(self._count[0])

    def record(self, folder: Path, rate: float) -> None:
        """Record numbered messages on four topics in turn, as many in a second as ``rate``."""
        recorder, begun_s = _recorder(folder), time.monotonic()
        for number in range(ROOM):
            time.sleep(max(0.0, begun_s + number / rate - time.monotonic()))
            stamp_ns = time.time_ns()
            # Noted before it is handed in.
            self.stamps[number] = stamp_ns
            self._count[0] = number + 1
            recorder.record(TOPICS[number % 4], float64(number), stamp_ns, stamp_ns)


def kill9(options: Options) -> Outcome:
    """Kill -9 at uniformly random times at three rates; each next start recovers by itself."""
    outcome, generator = Outcome(), random.Random(options.seed)
    kills = options.many(KILLS, 3)
    for index, rate in enumerate(RATES):
        share = kills * (index + 1) // 3 - kills * index // 3
        losses = [_kill(options.folder, rate, generator, outcome) for _ in range(share)]
        outcome.count('kills', share)
        outcome.measured[f'lost_s_at_{rate:g}_per_s'] = {
            'median': round(median(losses), 3), 'most': round(max(losses), 3),
        }  # fmt: skip
    counts = outcome.counts
    outcome.sentence = (
        f'{counts["kills"]} kills: at most {outcome.measured["most_lost_s"]:.2f} s lost, '
        f'{counts.get("recovered_parts", 0)} files made whole by the next start, '
        f'{counts["messages_found"]} of {counts["messages_sent"]} messages, '
        f'{counts.get("wrong_messages", 0)} wrong'
    )
    return outcome


def _kill(scratch: Path, rate: float, generator: random.Random, outcome: Outcome) -> float:
    """Kill one recorder, start the next, and compare; return the age of the oldest loss."""
    folder, account = scratch / 'recording', Account()
    shutil.rmtree(folder, ignore_errors=True)
    child = os.fork()
    if child == 0:
        try:
            account.record(folder, rate)
        finally:
            os._exit(1)
    wait_s = generator.uniform(0.0, LONGEST_S)
    time.sleep(wait_s)
    os.kill(child, signal.SIGKILL)
    killed_ns = time.time_ns()
    os.waitpid(child, 0)
    what = f'{rate:g} messages a second, killed after {wait_s:.3f} s'
    try:
        left = len(open_log(folder).readings)
    except RecordingError:  # nothing on disk yet
        left = 0
    _start_again(folder, what, outcome)
    found = 0
    if list(folder.glob('*.mcap')):
        contents = open_log(folder)
        outcome.expect(contents.warnings == (), f'{what}: {contents.warnings}')
        found = len(contents.readings)
    outcome.expect(found >= left, f'{what}: {left} messages before the next start, {found} after')
    _compare(folder, found, account, what, outcome)
    outcome.count('messages_sent', account.sent)
    outcome.count('messages_found', found)
    lost_s = (killed_ns - int(account.stamps[found])) / 1e9 if found < account.sent else 0.0
    outcome.worst('most_lost_s', round(lost_s, 3))
    outcome.expect(lost_s <= MOST_LOST_S, f'{what}: {lost_s:.3f} s lost')
    return lost_s


def _start_again(folder: Path, what: str, outcome: Outcome) -> None:
    def next_start() -> int:
        recorder, end_s = _recorder(folder), time.monotonic() + 10.0
        while list(folder.glob('*.part')) and time.monotonic() < end_s:
            time.sleep(0.005)
        status = recorder.close()
        ended_well = status.reason in ('', 'nothing could be recorded')
        healthy = status.state == RecorderState.STOPPED and ended_well
        return len(status.recovered) if healthy else -1

    ended = run_bounded(next_start, 20.0)
    outcome.expect(not ended.error and ended.value >= 0, f'{what}: the next start: {ended}')
    outcome.count('recovered_parts', max(0, ended.value or 0))
    left = [path.name for path in folder.iterdir() if not path.name.endswith(('.mcap', '.yaml'))]
    outcome.expect(not left, f'{what}: left over: {left}')
    outcome.worst('longest_next_start_s', round(ended.seconds, 3))


def _compare(folder: Path, found: int, account: Account, what: str, outcome: Outcome) -> None:
    told = [m for path in sorted(folder.glob('*.mcap')) for m in numbered(path)]
    outcome.expect(len(told) == found, f'{what}: we find {found}, stock readers {len(told)}')
    told.sort(key=lambda pair: (pair[0].log_ns, pair[1]))
    wrong = 0
    for number, (message, sequence) in enumerate(told):
        stamp_ns = int(account.stamps[number])
        wanted = (TOPICS[number % 4], stamp_ns, stamp_ns, float64(number))
        wrong += message != wanted or sequence != number // 4 + 1
    outcome.count('wrong_messages', wrong)
    outcome.expect(wrong == 0, f'{what}: {wrong} messages are not those sent')


def recover_big(options: Options) -> Outcome:
    """Recover an hour at 4,000 a second that nobody finished, in a process of 200 MiB."""
    outcome, target = Outcome(), options.folder / 'whole.mcap'
    sent = options.many(BIG_S) * BIG_RATE
    writer = RecordingWriter(options.folder / 'log', definitions=STOCK)
    for topic in TOPICS:
        writer.add_topic(topic, FLOAT64)
    for number in range(sent):
        time_ns = START_NS + number * (10**9 // BIG_RATE)
        writer.write(TOPICS[number % 4], float64(number), time_ns, time_ns)
        # As the recorder does, hand over every half second.
        if number % (BIG_RATE // 2) == BIG_RATE // 2 - 1:
            writer.flush()
    writer.abandon()
    (part,) = (options.folder / 'log').glob('*.part')

    def work() -> tuple[int, int, int]:
        report = recover(part, target)
        return report.messages, report.damaged_chunks, memory('VmHWM')

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
    outcome.expect(messages == sent, f'{messages} of {sent} messages')
    outcome.expect(held <= MOST_BYTES, f'{held / MIB:.0f} MiB were held')
    outcome.sentence = (
        f'{messages} messages recovered in {ended.seconds:.0f} s, {held / MIB:.0f} MiB held'
    )
    return outcome


def rotation(options: Options) -> Outcome:
    """Ask for a new file every half second while four topics run at 1 kHz each."""
    outcome, folder = Outcome(), options.folder / 'log'
    rotations, recorder = options.many(ROTATIONS, 3), _recorder(folder)
    begun_s = asked_s = time.monotonic()
    sent, asked = 0, 0
    while recorder.status().files_finished < rotations:
        now_s = time.monotonic()
        while sent < int((now_s - begun_s) * BIG_RATE):
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
    contents = open_log(folder)
    outcome.counts = {
        'rotations': status.files_finished, 'asked': asked, 'sent': sent,
        'received': status.received, 'written': status.written, 'lost': status.lost,
        'dropped': sum(status.dropped.values()), 'on_disk': len(contents.readings),
    }  # fmt: skip
    outcome.expect(status.files_finished >= rotations, f'{status.files_finished} files')
    outcome.expect(status.written == sent, f'{status.written} of {sent} written: {status}')
    outcome.expect(contents.warnings == (), str(contents.warnings))
    found = Counter(contents.readings.value.astype(int).tolist())
    outcome.expect(found == Counter(range(sent)), f'{len(found)} messages of {sent} on disk')
    told = [m for path in folder.glob('*.mcap') for m in numbered(path)]
    for topic in TOPICS:
        numbers = sorted(sequence for message, sequence in told if message.topic == topic)
        gapless = numbers == list(range(1, len(numbers) + 1))
        outcome.expect(gapless, f'{topic}: the sequence numbers have gaps')
    outcome.sentence = (
        f'{status.files_finished} files under {BIG_RATE} messages a second: '
        f'{sent} sent, {outcome.counts["on_disk"]} on disk'
    )
    return outcome
