# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A year of a plant through the engine: what grows."""

from __future__ import annotations

import gc
import multiprocessing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.torture.trial import MIB, Options, Outcome, memory
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import DataError
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.events import DiagnosisRequested, Event, FitRequested, SegmentClosed
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SampleTable
from valveflow_ros.ros.node.worker import release_memory

DAYS = 365
PERIOD_DAYS = 30
LOG_DAYS = 10
LOGS = 3
DAY_S = 86400
START_NS = 1_700_006_400 * NS_PER_S  # a midnight
BLOCK_ROWS = 900
REFIT_S = 6 * 3600.0
FIT_EVERY_DAYS = 30
MOST_GROWTH = MIB
MOST_BYTES = 250 * MIB
NOT_TRIED = 'This trial computes one fit a month.'


def soak(options: Options) -> Outcome:
    """Feed 365 days of 1 Hz rows, one fit a month adopted, every other one refused."""
    outcome = Outcome()
    days = options.many(DAYS, 2)
    period = max(1, round(PERIOD_DAYS * min(1.0, days / DAYS * 4)))
    logs = _logs_apart(options)
    walk = _Walk(Monitor(Settings().changed({'refit_period': REFIT_S, 'refit_segments': 0})))
    held: list[tuple[int, float]] = []
    kept = set()
    for day in range(days):
        for block in _blocks(logs, day):
            walk.feed(block)
        if (day + 1) % period == 0:
            gc.collect()
            held.append((day + 1, round(memory('VmRSS') / MIB, 2)))
            kept.add((_entries('fd'), _entries('task')))
    walk.close()
    _judge(outcome, held, kept, walk, days)
    return outcome


def _entries(kind: str) -> int:
    """Return the number of descriptors ('fd') or threads ('task') of this process."""
    return len(list(Path('/proc/self', kind).iterdir()))


class _Walk:
    """Feeds the engine and answers it as the node does; fits are computed by another process."""

    def __init__(self, monitor: Monitor) -> None:
        self.monitor = monitor
        self.counts: dict[str, int] = {}
        self._fitter = multiprocessing.get_context('spawn').Pool(1)
        self._next_fit_row = 3 * DAY_S

    def feed(self, table: SampleTable) -> None:
        """Take rows."""
        done = 0
        while done < len(table):
            fed = self.monitor.feed(table.part(done, len(table)))
            done += fed.rows
            self._take(fed.events)
            asked = any(isinstance(event, FitRequested) for event in fed.events)
            del fed
            if asked:
                # As the node does when a task has its outcome.
                release_memory()

    def close(self) -> None:
        """End the other process."""
        self._fitter.terminate()
        self._fitter.join()

    def _take(self, events: list[Event]) -> None:
        for event in events:
            self._count(type(event).__name__)
            if isinstance(event, FitRequested):
                self._take(self._answer(event.task))
            elif isinstance(event, DiagnosisRequested):
                diagnosing = self.monitor.diagnosing
                self._take(diagnosing.refuse(event.task.request_ns, NOT_TRIED))
            elif not isinstance(event, PredictionBlock | SegmentClosed):
                self._acknowledge()

    def _answer(self, task: FitTask) -> list[Event]:
        if self.monitor.rows < self._next_fit_row:
            return self.monitor.refuse(task.request_ns, NOT_TRIED)
        found = self._fitter.apply(_fitted, (task,))
        if isinstance(found, Characteristic):
            self._next_fit_row = self.monitor.rows + FIT_EVERY_DAYS * DAY_S
            return self.monitor.adopt(task.request_ns, found)
        return self.monitor.refuse(task.request_ns, str(found))

    def _acknowledge(self) -> None:
        try:
            self._take_quietly(self.monitor.operate_alarms(AlarmAction.ACKNOWLEDGE))
        except DataError:
            return

    def _take_quietly(self, events: list[Event]) -> None:
        for event in events:
            self._count(type(event).__name__)

    def _count(self, name: str) -> None:
        self.counts[name] = self.counts.get(name, 0) + 1


def _fitted(task: FitTask) -> Any:
    # Loaded in the other process alone, as in the node.
    from valveflow_ros.fit.fit import fit

    try:
        return fit(task)
    except DataError as error:
        return str(error)


def _logs_apart(options: Options) -> list[list[Path]]:
    """Return the days of a few plants as files, made by another process."""
    context = multiprocessing.get_context('spawn')
    with context.Pool(1) as pool:
        seeds = [options.seed + k for k in range(LOGS)]
        return [pool.apply(_simulate, (options.folder, seed)) for seed in seeds]


def _simulate(folder: Path, seed: int) -> list[Path]:
    from valveflow_ros.plant.simulator import simulate_parts

    paths = []
    for number, part in enumerate(simulate_parts(LOG_DAYS, seed)):
        path = folder / f'{seed}_{number}.npz'
        np.savez(path, values=part.table.values, quality=part.table.quality)
        paths.append(path)
    return paths


def _blocks(logs: list[list[Path]], day: int) -> Iterator[SampleTable]:
    """Yield a day's rows in blocks; ten days of one plant follow ten of another."""
    log = logs[day // LOG_DAYS % len(logs)]
    with np.load(log[day % LOG_DAYS]) as held:
        values, quality = held['values'], held['quality']
    start_ns = START_NS + day * DAY_S * NS_PER_S
    time_ns = start_ns + np.arange(len(values), dtype=np.int64) * NS_PER_S
    table = SampleTable(time_ns, values, quality)
    for begin in range(0, len(values), BLOCK_ROWS):
        yield table.part(begin, min(begin + BLOCK_ROWS, len(values)))


def _judge(
    outcome: Outcome, held: list[tuple[int, float]], kept: set[Any], walk: _Walk, days: int
) -> None:
    # The window fills for ten days, and its arrays may be turned over once more.
    steady = [(day, mib) for day, mib in held if day > 2 * LOG_DAYS]
    growth = 0.0
    if len(steady) > 1:
        slope = np.polyfit([d for d, _ in steady], [m for _, m in steady], 1)[0]
        growth = float(slope) * PERIOD_DAYS
        outcome.expect(growth * MIB < MOST_GROWTH, f'grows {growth:.2f} MiB in 30 days')
    most = max(mib for _, mib in held)
    outcome.expect(most * MIB <= MOST_BYTES, f'{most:.0f} MiB were held')
    outcome.expect(len(kept) == 1, f'descriptors and threads changed: {sorted(kept)}')
    outcome.counts = {'days': days, 'rows': walk.monitor.rows, **dict(sorted(walk.counts.items()))}
    outcome.measured = {
        'resident_mib_after_day': dict(held),
        'peak_mib': round(memory('VmHWM') / MIB, 1),
        'growth_mib_in_30_days': round(growth, 3),
        'descriptors_and_threads': sorted(kept),
    }
    outcome.sentence = (
        f'{days} days, {walk.monitor.rows} rows: {most:.0f} MiB held, {growth:+.2f} MiB in 30 days'
    )
