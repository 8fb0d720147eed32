# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recorders killed at random moments: how much is lost, and whether the next start mends it."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from pathlib import Path
from statistics import median

from log_files import STOCK, float64

from benchmarks.torture.bounded import run_bounded
from benchmarks.torture.kill_child import TOPICS, Account, start
from benchmarks.torture.stock import stock_messages
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.logs import Recorder, RecorderSettings, RecorderState, open_log

KILLS = 200
RATES = (4.0, 400.0, 4000.0)
LONGEST_S = 3.0
MOST_LOST_S = 0.6
SETTINGS = RecorderSettings(free_floor_bytes=0)


def kill9(options: Options) -> Outcome:
    """Kill -9 at uniformly random times at three rates; each next start recovers by itself."""
    outcome = Outcome()
    generator = random.Random(options.seed)
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
    folder = scratch / 'recording'
    shutil.rmtree(folder, ignore_errors=True)
    account = Account()
    child = start(folder, rate, account)
    wait_s = generator.uniform(0.0, LONGEST_S)
    time.sleep(wait_s)
    os.kill(child, signal.SIGKILL)
    killed_ns = time.time_ns()
    os.waitpid(child, 0)
    what = f'{rate:g} messages a second, killed after {wait_s:.3f} s'
    left = _part_messages(folder)
    _start_again(folder, what, outcome)
    found = _found(folder, what, outcome)
    outcome.expect(found >= left, f'{what}: {left} messages before the next start, {found} after')
    _compare(folder, found, account, what, outcome)
    outcome.count('messages_sent', account.sent)
    outcome.count('messages_found', found)
    lost_s = (killed_ns - int(account.stamps[found])) / 1e9 if found < account.sent else 0.0
    outcome.worst('most_lost_s', round(lost_s, 3))
    outcome.expect(lost_s <= MOST_LOST_S, f'{what}: {lost_s:.3f} s lost')
    return lost_s


def _part_messages(folder: Path) -> int:
    """Return how many messages our reader finds before anything was recovered."""
    try:
        return len(open_log(folder).readings)
    except Exception:  # noqa: BLE001 - nothing on disk yet
        return 0


def _start_again(folder: Path, what: str, outcome: Outcome) -> None:
    def next_start() -> int:
        recorder = Recorder(folder, SETTINGS, name='log', definitions=STOCK)
        end_s = time.monotonic() + 10.0
        while list(folder.glob('*.part')) and time.monotonic() < end_s:
            time.sleep(0.005)
        status = recorder.close()
        healthy = status.state == RecorderState.STOPPED and status.reason in (
            '', 'nothing could be recorded',
        )  # fmt: skip
        return len(status.recovered) if healthy else -1

    ended = run_bounded(next_start, 20.0)
    outcome.expect(not ended.error and ended.value >= 0, f'{what}: the next start: {ended}')
    outcome.count('recovered_parts', max(0, ended.value or 0))
    left = [path.name for path in folder.iterdir() if not path.name.endswith(('.mcap', '.yaml'))]
    outcome.expect(not left, f'{what}: left over: {left}')
    outcome.worst('longest_next_start_s', round(ended.seconds, 3))


def _found(folder: Path, what: str, outcome: Outcome) -> int:
    """Return the messages in the recovered file; all readers must agree about it."""
    files = list(folder.glob('*.mcap'))
    if not files:
        return 0
    contents = open_log(folder)
    outcome.expect(contents.warnings == (), f'{what}: {contents.warnings}')
    return len(contents.readings)


def _compare(folder: Path, found: int, account: Account, what: str, outcome: Outcome) -> None:
    stock = [m for path in sorted(folder.glob('*.mcap')) for m in stock_messages(path)]
    outcome.expect(len(stock) == found, f'{what}: we find {found}, stock readers {len(stock)}')
    stock.sort(key=lambda message: (message[2], message[1]))
    wrong = 0
    for number, message in enumerate(stock):
        stamp_ns = int(account.stamps[number])
        wanted = (TOPICS[number % 4], number // 4 + 1, stamp_ns, float64(number))
        wrong += message != wanted
    outcome.count('wrong_messages', wrong)
    outcome.expect(wrong == 0, f'{what}: {wrong} messages are not those sent')
