# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The engine as the node runs it gives what it gives offline, however the data are cut."""

import itertools
from dataclasses import replace

import hurt_jobs
import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from ros_helpers import wait_until
from std_msgs.msg import Float64MultiArray
from valveflow_msgs.msg import Alarm, Diagnosis, FlowCharacteristic
from valveflow_msgs.msg import JournalEntry as JournalMessage

from valveflow_ros.errors import DataError
from valveflow_ros.fit.fit import fit
from valveflow_ros.monitoring.alarm_state import BURIED, AlarmAction
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    Diagnosed,
    DiagnosisRequested,
    DiagnosisTask,
    JournalEntry,
    JournalKind,
)
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import JournalReplayer
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import NS_PER_S, Readings, table_to_readings, zone_of
from valveflow_ros.ros import encoding
from valveflow_ros.ros.decoding import from_time, journal_entry
from valveflow_ros.ros.node.diagnostics import Level
from valveflow_ros.ros.node.engine import LiveEngine, example_curve, example_task
from valveflow_ros.ros.node.health import diagnosis_item
from valveflow_ros.ros.node.outputs import OUTPUTS, Outputs
from valveflow_ros.ros.node.worker import DiagnosisWorker, WorkerResult
from valveflow_ros.ros.simulator_main import effects_of
from valveflow_ros.signals.align import Aligner
from valveflow_ros.signals.static_form import OPENING

SETTINGS = Settings({'refit_period': 3600.0, 'refit_segments': 0, 'alarm_on_delay': 60.0})
TABLE = simulate(0.24, 7, effects=effects_of(['gain_step:g=-0.12,t0_days=0.17'])).table
REFERENCE = example_curve(SETTINGS).with_id()
DEAD = 'The fit process ended unexpectedly (signal SIGKILL).'


class SlowWorker:
    """Gives outcomes a number of looks after they were asked for; may lose one fit."""

    def __init__(self, looks, lost=-1):
        self._looks, self._lost = looks, lost
        self._waiting = []
        self._look = self._count = 0

    def submit(self, task):
        self._count += 1
        try:
            result = DEAD if self._count == self._lost else fit(task)
        except DataError as error:
            result = str(error)
        outcome = WorkerResult(task.request_ns, result, 0.5)
        self._waiting.append((self._look + self._looks, outcome))

    def poll(self):
        self._look += 1
        due = [outcome for look, outcome in self._waiting if look <= self._look]
        self._waiting = [entry for entry in self._waiting if entry[0] > self._look]
        return due


def rows_of(readings):
    columns = (readings.time_ns, readings.signal, readings.value, readings.quality)
    return list(zip(*(column.tolist() for column in columns), strict=True))


ROWS = rows_of(table_to_readings(TABLE))
# At the end the clock goes back by hours.
ROWS[-4000:] = [(t - 10**13, *rest) for t, *rest in ROWS[-4000:]]


def run(engine, size, rows):
    """Feed all rows cut evenly; return the events of each call."""
    calls = []
    for start in range(0, len(rows), size):
        calls += [engine.poll(), engine.feed(rows[start : start + size])]
    return calls


def said(calls, **more):
    outputs = Outputs('u', **more)
    return [*outputs.latched(), *(output for events in calls for output in outputs.of(events))]


def messages(found, kind, name):
    return [deserialize_message(o.data, kind) for o in found if o.name == name]


@pytest.fixture(scope='module')
def live():
    """A fault, a lost fit, an alarm that is acknowledged, two references, a clock set back."""
    engine = LiveEngine(SETTINGS, SlowWorker(3, lost=3))
    calls = [engine.monitor.set_reference(REFERENCE), *run(engine, 500, ROWS[:-5000])]
    calls.append(engine.monitor.operate_alarms(AlarmAction.ACKNOWLEDGE))
    calls.append(engine.monitor.set_reference())
    return engine, [*calls, *run(engine, 500, ROWS[-5000:])]


def test_all_that_happens_is_told(live):
    engine, calls = live
    found = said(calls)
    assert {output.name for output in found} == set(OUTPUTS)
    assert engine.last_fit_s == 0.5
    kinds = [e.kind for events in calls for e in events if isinstance(e, JournalEntry)]
    assert kinds.count(JournalKind.SET_REFERENCE) == 2
    assert kinds.count(JournalKind.RESET) == 1
    assert {JournalKind.FIT_ADOPTED, JournalKind.ACKNOWLEDGE} <= set(kinds)
    # A fit that fails leaves the curve as stale with the sentence.
    curves = messages(found, FlowCharacteristic, 'characteristic')
    stale, *_ = (c for c in curves if c.cause == DEAD)
    assert (stale.status, len(stale.slopes) > 0) == (FlowCharacteristic.STALE, True)
    states = [a.state for a in messages(found, Alarm, 'alarms') if a.name == 'residual']
    assert {Alarm.UNACKNOWLEDGED, Alarm.ACKNOWLEDGED} <= set(states)


@pytest.mark.parametrize('begun_ns', [DEFAULT_START_NS - NS_PER_S, 0])
def test_who_comes_late_finds_everything_with_a_time(live, begun_ns):
    _, calls = live
    outputs = Outputs('u', begun_ns=begun_ns)
    first = list(outputs.latched())
    if not begun_ns:
        # No time yet; they come again with the first row.
        assert {output.time_ns for output in first} == {0}
        later = (output for events in calls[1:] for output in outputs.of(events))
        again = [output for output in itertools.islice(later, 60) if output.name != 'journal']
        assert [o.name for o in again[: len(first)]] == [o.name for o in first]
        first, begun_ns = again[: len(first)], again[len(first)].time_ns
    assert {output.time_ns for output in first} == {begun_ns}
    assert {output.name for output in first} == {n for n, o in OUTPUTS.items() if o.latched}
    for output in first:
        message = deserialize_message(output.data, OUTPUTS[output.name].message_type)
        if output.name not in ('breakpoints', 'slopes'):
            assert from_time(message.header.stamp) == output.time_ns
    told = messages(first, Alarm, 'alarms')
    assert {alarm.name for alarm in told} == {'residual', 'curve_shift'}
    for alarm in told:
        assert alarm.sentence == 'Not raised since the monitor started.'
        assert (alarm.state, alarm.previous_state, alarm.occurrence) == (Alarm.NORMAL,) * 2 + (0,)


def test_replaying_the_journal_says_the_same_byte_for_byte(live):
    _, calls = live
    expected = said(calls)
    # Through messages and back, as a recording keeps the journal.
    journal = [
        journal_entry(encoding.encode(encoding.journal_message(e, 'u')))
        for events in calls for e in events if isinstance(e, JournalEntry)
    ]  # fmt: skip
    table = Aligner(SETTINGS).feed(Readings.of(ROWS)).table
    assert np.diff(table.time_ns).min() < 0
    for size in (len(table), 1777):
        replayer = JournalReplayer(Monitor(SETTINGS), journal)
        again = [
            replayer.feed(table.part(k, min(k + size, len(table))))
            for k in range(0, len(table), size)
        ]
        assert said(again) == expected


def test_what_cannot_be_replayed_is_said():
    for kind, words in (
        (JournalKind.SET_REFERENCE, 'no curve that could become the reference'),
        (JournalKind.DIAGNOSED, 'never asked for'),
    ):
        entry = JournalEntry(0, kind, 5, 0, 'x', '')
        with pytest.raises(DataError, match=words):
            JournalReplayer(Monitor(SETTINGS), [entry]).feed(TABLE.part(0, 3))


def test_the_cutting_of_the_stream_leaves_no_trace():
    # With an outcome at the next look, a call per row or many rows differ in the boundary at
    # which it is adopted; without fits nothing may differ at all.
    settings = SETTINGS.changed({'refit_period': 0.0})
    rows = ROWS[: len(ROWS) // 4]
    found = []
    for size in (7, 500, len(rows)):
        engine = LiveEngine(settings, SlowWorker(0))
        found.append(said(run(engine, size, rows)))
    assert all(one == found[0] for one in found[1:])
    assert len(found[0]) >= len(TABLE) // 4


def test_of_the_alarms_so_many_are_kept_that_none_that_stands_is_buried():
    assert OUTPUTS['alarms'].kept > BURIED + 1


def test_plain_arrays_say_their_unit():
    for axis, units in (
        ('integrated_input', ['% MPa^e', 'MW / (% MPa^e)']), (OPENING, ['%', 'MW / (% MPa^s)']),
    ):  # fmt: skip
        curve = example_curve(SETTINGS)
        object.__setattr__(curve, 'axis', axis)
        told = list(Outputs('u').of([CurveAdopted(curve)]))
        for name, unit in zip(('breakpoints', 'slopes'), units, strict=True):
            (message,) = messages(told, Float64MultiArray, name)
            assert message.layout.dim[0].label.endswith(f'[{unit}]')


def test_what_a_replay_reads_of_the_journal_is_not_told_in_a_zone():
    entry = JournalEntry(0, JournalKind.RESET, 0, 1, '', 'since 2024-01-02 00:30 UTC')
    told = [*Outputs('u', zone=zone_of('+05:00')).of([entry])]
    assert messages(told, JournalMessage, 'journal')[0].text == entry.text


# Diagnoses; what they find is tested where a real one is computed

STEP_S = 10.0
DAILY = Settings(
    {'sample_period': STEP_S, 'refit_period': 28800.0, 'refit_segments': 0, 'diagnosis_hour': 2}
)


def test_no_diagnosis_is_unknown_and_says_why():
    contents, curve = example_task(Settings()).contents, REFERENCE
    task = DiagnosisTask(5, contents, Settings(), curve, int(contents.time_ns[-1]))
    given = [*Outputs('unit 1').of([Diagnosed(task, '', 'Because.')])], [*Outputs('u').latched()]
    for told, sentence, model_id, tag in (
        (given[0], 'Because.', curve.model_id, 'unit 1'), (given[1], encoding.NOT_YET, '', 'u')
    ):  # fmt: skip
        (message,) = messages(told, Diagnosis, 'diagnosis')
        assert (message.verdict, message.sentence) == (Diagnosis.UNKNOWN, sentence)
        assert (message.model_id, message.header.frame_id) == (model_id, tag)
        assert np.isnan(message.rmse_simulation)


@pytest.mark.usefixtures('jobs_on_path')
def test_the_night_and_a_hand_bring_a_diagnosis_that_a_replay_repeats():
    unit = replace(UnitDescription(), sample_period_s=STEP_S)
    readings = table_to_readings(simulate(1.25, 5, unit).table)
    worker = DiagnosisWorker(300.0, 'hurt_jobs:diagnosed')
    engine = LiveEngine(DAILY, SlowWorker(1), worker)
    with pytest.raises(DataError, match='no curve'):
        engine.request_diagnosis()
    rows = rows_of(readings)
    calls = run(engine, 3000, rows[:24_000])
    with pytest.raises(DataError, match='A diagnosis needs a day of data; the'):
        engine.request_diagnosis()
    calls += run(engine, 3000, rows[24_000:])
    calls.append(wait_until(engine.poll, 'the diagnosis of the night'))
    calls += [engine.request_diagnosis(), wait_until(engine.poll, 'the diagnosis')]
    worker.close()
    asked = [e.task for events in calls for e in events if isinstance(e, DiagnosisRequested)]
    found = [e for events in calls for e in events if isinstance(e, Diagnosed)]
    assert [e.task.request_ns for e in found] == [task.request_ns for task in asked]
    told = said(calls, begun_ns=1)
    assert len(found) == len(messages(told, Diagnosis, 'diagnosis')) - 1 >= 2
    assert found[-1].task.window_end_ns == engine.monitor.last_ns
    assert found[-1].content, found[-1].reason
    assert len(found[-1].task.contents.time_ns) == 0
    item = diagnosis_item(engine.monitor, worker, engine.last_diagnosis_s)
    assert (item.level, item.sentence) == (Level.OK, 'The model explains the unit.')
    assert (item.values['Verdict'], item.values['Running']) == ('nothing', False)
    journal = [e for events in calls for e in events if isinstance(e, JournalEntry)]

    def again(task):
        return hurt_jobs.diagnosed(task).text

    replayer = JournalReplayer(Monitor(DAILY), journal, again)
    repeated = replayer.feed(Aligner(DAILY).feed(readings).table)
    assert said([repeated], begun_ns=1) == told
