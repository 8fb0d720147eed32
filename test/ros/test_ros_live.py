# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The engine as the node runs it gives what it gives offline, however the data are cut."""

from __future__ import annotations

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from valveflow_msgs.msg import Alarm

from valveflow_ros.curve.shift import PieceShift, Shift
from valveflow_ros.errors import DataError
from valveflow_ros.fit.fit import fit
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import Alarms, ResidualAlarm, ShiftAlarm
from valveflow_ros.monitoring.events import CurveAdopted, Event, JournalEntry, JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import JournalReplayer
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.records import NS_PER_S, Readings, table_to_readings
from valveflow_ros.ros.decoding import Row, from_time
from valveflow_ros.ros.node.engine import LiveEngine
from valveflow_ros.ros.node.outputs import OUTPUTS, Output, Outputs
from valveflow_ros.ros.node.worker import WorkerResult
from valveflow_ros.ros.simulator_main import effects_of
from valveflow_ros.signals.align import Aligner

SETTINGS = Settings({'refit_period': 3600.0, 'refit_segments': 0, 'alarm_on_delay': 60.0})
TABLE = simulate(0.3, 7, effects=effects_of(['gain_step:g=-0.12,t0_days=0.25'])).table


class SlowWorker:
    """Gives outcomes a number of looks after they were asked for."""

    def __init__(self, looks: int) -> None:
        self._looks = looks
        self._waiting: list[tuple[int, WorkerResult]] = []
        self._look = 0
        self.refuse_next = False

    def submit(self, task: object) -> None:
        if self.refuse_next:
            self.refuse_next = False
            result: object = 'The fit process ended unexpectedly (signal SIGKILL).'
        else:
            try:
                result = fit(task)  # type: ignore[arg-type]
            except DataError as error:
                result = str(error)
        outcome = WorkerResult(task.request_ns, result, 0.5)  # type: ignore[attr-defined,arg-type]
        self._waiting.append((self._look + self._looks, outcome))

    def poll(self) -> list[WorkerResult]:
        self._look += 1
        due = [outcome for look, outcome in self._waiting if look <= self._look]
        self._waiting = [entry for entry in self._waiting if entry[0] > self._look]
        return due


def rows_of(readings: Readings) -> list[Row]:
    columns = (readings.time_ns, readings.signal, readings.value, readings.quality)
    return list(zip(*(column.tolist() for column in columns), strict=True))


ROWS = rows_of(table_to_readings(TABLE))


def run(
    cuts: list[int], worker: SlowWorker, engine: LiveEngine, rows: list[Row] = ROWS
) -> list[list[Event]]:
    """Feed all rows cut at ``cuts``; return the events of each call."""
    calls: list[list[Event]] = []
    for start, end in zip([0, *cuts], [*cuts, len(rows)], strict=True):
        calls += [engine.poll(), engine.feed(rows[start:end])]
    return calls


def said(calls: list[list[Event]]) -> list[Output]:
    outputs = Outputs('u')
    found = list(outputs.latched())
    for events in calls:
        found += outputs.of(events)
    return found


def evenly(size: int, rows: list[Row] = ROWS) -> list[int]:
    return list(range(size, len(rows), size))


@pytest.fixture(scope='module')
def live() -> tuple[LiveEngine, list[list[Event]]]:
    worker = SlowWorker(3)
    engine = LiveEngine(SETTINGS, worker)
    return engine, run(evenly(500), worker, engine)


def test_it_does_what_it_is_for(live: tuple[LiveEngine, list[list[Event]]]) -> None:
    engine, calls = live
    events = [event for call in calls for event in call]
    assert any(isinstance(event, CurveAdopted) for event in events)
    assert engine.monitor.rows == len(TABLE)
    assert engine.last_fit_s == 0.5
    names = {output.name for output in said(calls)}
    assert names == set(OUTPUTS)


@pytest.mark.parametrize('begun_ns', [DEFAULT_START_NS - NS_PER_S, 0])
def test_who_comes_late_finds_everything_with_a_time(
    live: tuple[LiveEngine, list[list[Event]]], begun_ns: int
) -> None:
    _, calls = live
    outputs = Outputs('u', begun_ns=begun_ns)
    first = list(outputs.latched())
    later = [output for events in calls for output in outputs.of(events)]
    if not begun_ns:
        # No time yet; they come again with the first row.
        assert {output.time_ns for output in first} == {0}
        again, later = later[: len(first)], later[len(first) :]
        assert [output.name for output in again] == [output.name for output in first]
        first = again
    assert {output.time_ns for output in first} == {begun_ns or later[0].time_ns}
    assert {output.name for output in first} == {n for n, o in OUTPUTS.items() if o.latched}
    for output in first:
        message = deserialize_message(output.data, OUTPUTS[output.name].message_type)
        if output.name not in ('breakpoints', 'slopes'):
            assert from_time(message.header.stamp) == output.time_ns
    told = [deserialize_message(o.data, Alarm) for o in first if o.name == 'alarms']
    assert {alarm.name for alarm in told} == {'residual', 'curve_shift'}
    assert {alarm.sentence for alarm in told} == {'The alarm was not raised since the start.'}
    assert {(a.state, a.previous_state, a.occurrence) for a in told} == {
        (Alarm.NORMAL,) * 2 + (0,)
    }


def test_replaying_the_journal_says_the_same_byte_for_byte(
    live: tuple[LiveEngine, list[list[Event]]],
) -> None:
    _, calls = live
    expected = said(calls)
    journal = [e for call in calls for e in call if isinstance(e, JournalEntry)]
    table = Aligner(SETTINGS).feed(table_to_readings(TABLE)).table
    for size in (len(table), 1777):
        replayer = JournalReplayer(Monitor(SETTINGS), journal)
        again = [
            replayer.feed(table.part(k, min(k + size, len(table))))
            for k in range(0, len(table), size)
        ]
        assert said(again) == expected


def test_the_cutting_of_the_stream_leaves_no_trace() -> None:
    # With an outcome at the next look, a call per row or many rows differ in the boundary at
    # which it is adopted; without fits nothing may differ at all.
    settings = SETTINGS.changed({'refit_period': 0.0})
    rows = ROWS[: len(ROWS) // 2]
    found = []
    for size in (7, 5000, len(rows), 500):
        worker = SlowWorker(0)
        engine = LiveEngine(settings, worker)
        found.append(said(run(evenly(size, rows), worker, engine, rows)))
    assert all(one == found[0] for one in found[1:])
    assert len(found[0]) >= len(TABLE) // 2


def test_a_fit_that_fails_leaves_the_curve_as_stale_with_the_sentence() -> None:
    worker = SlowWorker(1)
    engine = LiveEngine(SETTINGS, worker)
    outputs = Outputs('u')
    cuts = evenly(5 * 600)
    for k, (start, end) in enumerate(zip([0, *cuts], [*cuts, len(ROWS)], strict=True)):
        for events in (engine.poll(), engine.feed(ROWS[start:end])):
            list(outputs.of(events))
        if outputs.curve is not None and k % 2 == 0:
            worker.refuse_next = True
        if outputs.cause and outputs.curve is not None:
            break
    assert 'ended unexpectedly' in outputs.cause
    assert (outputs.status, outputs.cause) == (engine.monitor.status, engine.monitor.cause)
    assert outputs.status.name == 'STALE'


def test_a_clock_that_goes_back_restarts_the_engine_and_is_journaled() -> None:
    worker = SlowWorker(0)
    engine = LiveEngine(SETTINGS, worker)
    calls = [engine.feed(ROWS[:20_000]), engine.poll(), engine.feed(ROWS[20_000:30_000])]
    again = [(t - 10**13, *rest) for t, *rest in ROWS[30_000:34_000]]
    calls += [engine.poll(), engine.feed(again)]  # type: ignore[arg-type]
    journal = [e for call in calls for e in call if isinstance(e, JournalEntry)]
    resets = [entry for entry in journal if entry.kind == JournalKind.RESET]
    assert len(resets) == 1
    aligned = Aligner(SETTINGS)
    table = aligned.feed(Readings.of([*ROWS[:30_000], *again])).table  # type: ignore[list-item]
    replayer = JournalReplayer(Monitor(SETTINGS), journal)
    assert said([replayer.feed(table)]) == said(calls)
    assert np.diff(table.time_ns).min() < 0


def test_who_comes_late_finds_every_alarm_that_stands_among_what_is_kept() -> None:
    """One stands and nothing happens to it; the other comes and goes for an hour."""
    nervous = Settings({'alarm_on_delay': 0.0, 'alarm_off_delay': 0.0, 'alarm_flood': 10})
    residual, shift = ResidualAlarm(nervous), ShiftAlarm(nervous)
    Alarms(residual, shift)
    nan, start_ns = float('nan'), DEFAULT_START_NS
    piece = PieceShift(1e3, 2e3, 2.0, 2.0, 2.0, 0.1, nan, nan, 200.0, 1e-6, True, 0.4)
    moved = Shift('then', 'now', start_ns, start_ns, (piece,), 0, 0, 0, 'It moved.')
    events: list[Event] = [*shift.judge(moved, start_ns, nervous)]
    time_ns = DEFAULT_START_NS + NS_PER_S * np.arange(1, 3601)
    values = np.where(np.arange(3600) % 2, 0.0, 2.0)
    events += [c for _, c in residual.feed(time_ns, values, values, 'm', [shift])]
    told = [deserialize_message(o.data, Alarm) for o in Outputs('u').of(events)]
    kept = OUTPUTS['alarms'].kept
    assert len(told) > 5 * kept
    for k in range(2, len(told)):
        newest = {a.name: a.state for a in told[max(0, k - kept) : k]}
        assert newest['curve_shift'] == Alarm.UNACKNOWLEDGED
        assert newest['residual'] == [a.state for a in told[:k] if a.name == 'residual'][-1]


def test_nothing_in_nothing_out() -> None:
    engine = LiveEngine(SETTINGS, SlowWorker(0))
    assert engine.feed([]) == []
    assert engine.poll() == []
    with pytest.raises(DataError):
        engine.request_fit()
    with pytest.raises(DataError):
        engine.monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)
