# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reference of a running monitor: decision, journal, judgement and alarm."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from alarm_story import judgement
from streams import (
    QUICK_MONITOR,
    START_NS,
    grid_ns,
    lagged,
    of_type,
    steps_and_ramps,
    table_of,
)

from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import AlarmChange, AlarmState, ShiftAlarm
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    FitRequested,
    JournalEntry,
    JournalKind,
    ReferenceSet,
)
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import CLOCK_BACK, JournalReplayer, feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S
from valveflow_ros.signals.static_form import StaticForm

# The residual alarm is out of the way: it would stop refits before the curve can move.
SETTINGS = Settings({**QUICK_MONITOR, 'alarm_limit': 1000.0, 'shift_confidence': 0.99})
NORMAL, UNACKNOWLEDGED, _, RETURNED, *_ = AlarmState
N = 700


def plant(seed, n, lost_mw=0.0, start_ns=START_NS):
    """Return rows of a small plant that gives so many MW less than it should."""
    rng = np.random.default_rng(seed)
    u = steps_and_ramps(rng, n, hold=(30, 90))
    power = lagged(20.0 + 0.1 * u, 2.0, 1.0) - lost_mw + 0.15 * rng.normal(0.0, 1.0, n)
    return table_of(grid_ns(n, start_ns=start_ns), u + 0.5 * rng.normal(0.0, 1.0, n), power)


def following(monitor, seed, n, lost_mw=0.0):
    return plant(seed, n, lost_mw, monitor.last_ns + NS_PER_S)


def with_curve():
    monitor = Monitor(SETTINGS)
    feed_rows(monitor, plant(1, N))
    assert monitor.characteristic is not None
    return monitor


def changes_of(events):
    return [e for e in of_type(events, AlarmChange) if e.name == ShiftAlarm.NAME]


# --- the decision -----------------------------------------------------------------------------


def test_without_a_curve_there_is_nothing_to_set():
    monitor = Monitor(SETTINGS)
    with pytest.raises(DataError, match=r'could become the reference\. No curve yet'):
        monitor.set_reference()
    assert monitor.reference.curve is None


def test_setting_it_is_told_and_journalled():
    monitor = with_curve()
    told, entry = monitor.set_reference()
    curve = monitor.characteristic
    assert told == ReferenceSet(curve)
    assert entry == JournalEntry(
        monitor.last_ns, JournalKind.SET_REFERENCE, 0, monitor.rows, curve.model_id, ''
    )
    assert monitor.reference.curve is curve


def test_one_that_is_given_stands_in_the_journal_whole():
    curve = with_curve().characteristic
    fresh = Monitor(SETTINGS)
    _, entry = fresh.set_reference(curve)
    again = from_json(json.loads(entry.text))
    assert to_json(again) == to_json(curve)
    assert entry.rows == 0


def test_fits_get_the_form_of_a_reference_with_another_exponent():
    monitor = with_curve()
    other = replace(monitor.characteristic, pressure_exponent=1.0)
    monitor.set_reference(other)
    (task,) = (e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
    assert task.form == StaticForm(exponent=1.0)


def test_every_later_curve_is_judged_and_none_before():
    monitor = with_curve()
    before = feed_rows(monitor, following(monitor, 2, N))
    assert of_type(before, CurveAdopted)
    assert all(e.shift is None for e in of_type(before, CurveAdopted))
    monitor.set_reference()
    after = of_type(feed_rows(monitor, following(monitor, 3, N)), CurveAdopted)
    assert after
    for event in after:
        assert event.shift.model_id == event.characteristic.model_id
        assert event.shift.reference_id == monitor.reference.curve.model_id
        assert len(event.shift.pieces) == len(event.characteristic.pieces)


def test_a_clock_that_goes_back_takes_neither_reference_nor_alarm():
    monitor = with_curve()
    monitor.set_reference()
    feed_rows(monitor, following(monitor, 4, 4 * N, 4.0))
    assert monitor.reference.alarm.active
    monitor.restart(CLOCK_BACK)
    assert monitor.reference.curve is not None
    assert monitor.reference.alarm.state == UNACKNOWLEDGED
    events = feed_rows(monitor, plant(5, N, 4.0))
    assert any(e.shift is not None for e in of_type(events, CurveAdopted))


# --- the alarm --------------------------------------------------------------------------------


def test_a_plant_that_moved_raises_the_alarm_once_and_it_can_be_acknowledged():
    monitor = with_curve()
    monitor.set_reference()
    events = feed_rows(monitor, following(monitor, 4, 4 * N, 4.0))
    (change,) = changes_of(events)
    assert (change.state, change.previous) == (UNACKNOWLEDGED, NORMAL)
    assert change.value < -SETTINGS.real('shift_least')
    assert change.unit == 'MW'
    assert 'less than the reference of 2023-11-15' in change.sentence
    acknowledged, entry = monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)
    assert acknowledged.state == AlarmState.ACKNOWLEDGED
    assert acknowledged.name == 'curve_shift'
    assert entry.kind == JournalKind.ACKNOWLEDGE
    with pytest.raises(DataError, match='no alarm to acknowledge'):
        monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)
    # The moved plant is accepted: its curve is the reference now.
    ended = changes_of(monitor.set_reference())
    assert [c.state for c in ended] == [NORMAL]
    assert not monitor.reference.alarm.standing


def test_a_plant_that_stays_raises_none():
    monitor = with_curve()
    feed_rows(monitor, following(monitor, 2, N))
    monitor.set_reference()
    assert not changes_of(feed_rows(monitor, following(monitor, 6, 4 * N)))


STRICT = Settings({'shift_confidence': 0.999, 'shift_least': 0.3, 'alarm_dead_band': 0.3})


LOOSE = STRICT.changed({'alarm_latch': False})
CALM = (0.0, 1.0)  # moved by so many MW, with this chance that it did not


def told(alarm, *shifts, settings=STRICT, begin_s=0, every_s=600):
    shifts = [judgement(*s) if isinstance(s, tuple) else s for s in shifts]
    return [
        change.state for k, shift in enumerate(shifts)
        for change in alarm.judge(shift, START_NS + (begin_s + k * every_s) * NS_PER_S, settings)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ('settings', 'shifts', 'states'),
    [
        (STRICT, [CALM, (2.0,), (2.1,), CALM, (-2.0,)],
         [UNACKNOWLEDGED, RETURNED, UNACKNOWLEDGED]),
        (LOOSE, [(2.0,), CALM], [UNACKNOWLEDGED, NORMAL]),
        # Near the limit it does not come and go: doubtful, or smaller than what is said.
        (STRICT, [(2.0, 5e-3), (0.25,)], []),
        (STRICT, [(2.0,), (2.0, 5e-3), (0.25,)], [UNACKNOWLEDGED]),
        (STRICT, [(2.0,), (2.0, 2e-2)], [UNACKNOWLEDGED, RETURNED]),
    ],
)  # fmt: skip
def test_its_states_are_those_of_the_standard(settings, shifts, states):
    alarm = ShiftAlarm()
    assert told(alarm, *shifts, settings=settings) == states
    count = states.count(UNACKNOWLEDGED)
    assert alarm.occurrence == count
    _, changes = alarm.operate(AlarmAction.ACKNOWLEDGE, START_NS, 'now')
    assert len(changes) == (bool(states) and states[-1] != NORMAL)
    for change in changes:
        assert change.sentence.endswith('MW.')
        assert change.sentence.startswith('Acknowledged. ')
        assert (change.occurrence, change.limit) == (count, 0.4)
    assert alarm.operate(AlarmAction.ACKNOWLEDGE, START_NS, 'now')[1] == []


def at(shift, u_from, u_to):
    """Return the judgement as one of another piece."""
    return replace(shift, pieces=(replace(shift.pieces[0], u_from=u_from, u_to=u_to),))


@pytest.mark.parametrize(
    ('shifts', 'states'),
    [
        ([(0.6,), (0.7,), (0.6,)], [UNACKNOWLEDGED]),
        ([(0.6,), CALM, (0.6,)], []),
        ([(0.6,), (-0.6,), (0.6,)], []),
        ([(0.6,), at(judgement(0.6), 1600.0, 2280.0)], []),
        ([(0.6,), at(judgement(0.6), 1150.0, 2280.0)], []),
        ([(-0.9,)], [UNACKNOWLEDGED]),
    ],
)
def test_a_small_shift_has_to_be_seen_by_two_curves_in_a_row(shifts, states):
    alarm = ShiftAlarm()
    assert told(alarm, *shifts) == states
    assert bool(alarm.ranges) == bool(states)


def test_what_was_seen_against_another_reference_confirms_nothing():
    alarm = ShiftAlarm()
    assert told(alarm, (0.6,)) == []
    assert alarm.reset('There is a new reference.', START_NS, 'now', STRICT) == []
    assert told(alarm, (0.7,), begin_s=600) == []


def test_curves_asked_for_one_after_another_are_one_judgement():
    alarm = ShiftAlarm()
    assert told(alarm, (0.6,), (0.6,), (0.6,), every_s=60) == []
    assert told(alarm, (0.6,), begin_s=600) == [UNACKNOWLEDGED]
    calm = ShiftAlarm()
    assert told(calm, CALM, (0.6,), (0.6,), every_s=60) == []
    assert told(calm, (0.6,), begin_s=500) == []
    assert told(calm, (0.6,), begin_s=720) == [UNACKNOWLEDGED]


def test_a_clock_that_was_set_back_does_not_keep_a_shift_from_being_confirmed():
    alarm = ShiftAlarm()
    assert told(alarm, (0.6,), begin_s=86_400) == []
    alarm.shift_time(-86_400 * NS_PER_S)
    assert told(alarm, (0.6,), begin_s=600) == [UNACKNOWLEDGED]


def test_what_the_last_curve_saw_outlives_a_restart():
    first, second = ShiftAlarm(), ShiftAlarm()
    assert told(first, (0.6,)) == []
    second.restore(first.snapshot())
    assert told(second, (0.7,), begin_s=600) == [UNACKNOWLEDGED]
    new = ('seen', 'seen_ns')
    earlier = {key: value for key, value in first.snapshot().items() if key not in new}
    third = ShiftAlarm()
    third.restore(earlier)
    assert told(third, (0.7,), begin_s=600) == []


def test_it_stands_while_what_moved_is_out_of_the_window():
    alarm, calm = ShiftAlarm(), judgement(*CALM)
    assert told(alarm, judgement(-5.0)) == [UNACKNOWLEDGED]
    unknown = replace(calm, pieces=(replace(calm.pieces[0], smallest_mw=np.nan),))
    elsewhere = [at(calm, 1600.0, 2280.0), at(calm, 1150.0, 2280.0), unknown]
    assert told(alarm, *elsewhere) == []
    assert alarm.ranges == ((1000.0, 1200.0),)
    assert told(alarm, at(judgement(-4.5), 1010.0, 1190.0), *elsewhere) == []
    assert alarm.ranges == ((1010.0, 1190.0),)
    assert told(alarm, at(calm, 1005.0, 1400.0)) == [RETURNED]
    assert alarm.ranges == ()


def test_a_curve_that_cannot_be_compared_says_why():
    monitor = with_curve()
    far = replace(
        monitor.characteristic,
        pieces=tuple(
            replace(p, u_from=p.u_from + 9e3, u_to=p.u_to + 9e3)
            for p in monitor.characteristic.pieces
        ),
    )
    monitor.set_reference(far)
    events = feed_rows(monitor, following(monitor, 3, N))
    assert all(e.shift is None for e in of_type(events, CurveAdopted))
    assert 'nothing can be compared' in monitor.reference.problem


# --- replay -----------------------------------------------------------------------------------


def test_a_reference_that_cannot_be_read_stops_a_replay_with_a_sentence():
    entry = JournalEntry(0, JournalKind.SET_REFERENCE, 0, 0, 'x', '{"format": 1')
    with pytest.raises(DataError, match='change of reference cannot be read'):
        JournalReplayer(Monitor(SETTINGS), [entry]).feed(plant(1, 5))
