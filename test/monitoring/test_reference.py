# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The curve of health: set by hand or by itself, follows wear, never learns a fault; its alarm."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from alarm_story import judgement
from curves import curve
from streams import QUICK_MONITOR, START_NS, after, of_type, plant_table, taken_up

from valveflow_ros.curve.characteristic import FittedData, RegionDynamics
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
from valveflow_ros.monitoring.monitor import BY_ITSELF, Monitor
from valveflow_ros.monitoring.offline import CLOCK_BACK, JournalReplayer, feed_rows
from valveflow_ros.monitoring.reference import MONTH_NS, ReferenceCurve
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SegmentKind, SpecialSegment

# The residual alarm is out of the way: it would stop refits before the curve can move.
BY_HAND = Settings({**QUICK_MONITOR, 'alarm_limit': 1000.0, 'shift_confidence': 0.99})
BY_TIME = Settings({**QUICK_MONITOR, 'reference_after': 0.01, 'alarm_off_delay': 600.0})
NORMAL, UNACKNOWLEDGED, _, RETURNED, *_ = AlarmState
N = 3000


RUNS = {
    'by hand': (BY_HAND, 700), 'by itself': (BY_TIME, N),
    'never': (BY_TIME.changed({'reference_after': 0.0}), N),
}  # fmt: skip


@cache
def _run(name):
    settings, rows = RUNS[name]
    monitor = Monitor(settings)
    return monitor, feed_rows(monitor, plant_table(1, rows))


def with_curve():
    return taken_up(_run('by hand')[0], Monitor(BY_HAND))


def healthy():
    """Return a monitor that has made a reference by itself."""
    return taken_up(_run('by itself')[0], Monitor(BY_TIME))


def named(events, name):
    return [e for e in of_type(events, AlarmChange) if e.name == name]


# --- by hand ----------------------------------------------------------------------------------


def test_setting_it_is_told_and_journalled_and_a_given_one_stands_there_whole():
    monitor = with_curve()
    curve = monitor.characteristic
    told, entry = monitor.set_reference()
    assert told == ReferenceSet(curve)
    assert entry == JournalEntry(
        monitor.last_ns, JournalKind.SET_REFERENCE, 0, monitor.rows, curve.model_id, ''
    )
    assert monitor.reference.curve is curve
    _, entry = Monitor(BY_HAND).set_reference(curve)
    assert to_json(from_json(json.loads(entry.text))) == to_json(curve)
    broken = replace(entry, text='{"format": 1')
    with pytest.raises(DataError, match='change of reference cannot be read'):
        JournalReplayer(Monitor(BY_HAND), [broken]).feed(plant_table(1, 5))


def test_a_plant_that_stays_is_judged_by_every_later_curve_and_raises_no_alarm():
    monitor = with_curve()
    before = of_type(feed_rows(monitor, after(monitor, 2, 700)), CurveAdopted)
    assert before
    assert all(e.shift is None for e in before)
    monitor.set_reference()
    events = feed_rows(monitor, after(monitor, 3, 2800))
    assert of_type(events, CurveAdopted)
    for event in of_type(events, CurveAdopted):
        assert event.shift.model_id == event.characteristic.model_id
        assert event.shift.reference_id == monitor.reference.curve.model_id
        assert len(event.shift.pieces) == len(event.characteristic.pieces)
    assert not named(events, 'curve_shift')


def test_a_plant_that_moved_raises_the_alarm_once_and_it_can_be_acknowledged():
    monitor = with_curve()
    monitor.set_reference()
    events = feed_rows(monitor, after(monitor, 4, 2800, added_mw=-4.0))
    (change,) = named(events, 'curve_shift')
    assert (change.state, change.previous) == (UNACKNOWLEDGED, NORMAL)
    assert change.value < -BY_HAND.real('shift_least')
    assert change.unit == 'MW'
    assert 'less than the reference of 2023-11-15' in change.sentence
    # A clock that goes back takes neither reference nor alarm.
    other = taken_up(monitor, Monitor(BY_HAND))
    other.restart(CLOCK_BACK)
    assert other.reference.alarm.state == UNACKNOWLEDGED
    later = plant_table(5, 700)
    assert any(e.shift is not None for e in of_type(feed_rows(other, later), CurveAdopted))
    acknowledged, entry = monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)
    assert (acknowledged.name, acknowledged.state) == ('curve_shift', AlarmState.ACKNOWLEDGED)
    assert entry.kind == JournalKind.ACKNOWLEDGE
    # The moved plant is accepted: its curve is the reference now.
    assert [c.state for c in named(monitor.set_reference(), 'curve_shift')] == [NORMAL]
    assert not monitor.reference.alarm.standing


def test_a_curve_that_cannot_be_compared_says_why():
    monitor = with_curve()
    pieces = tuple(replace(p, u_from=p.u_from + 9e3, u_to=p.u_to + 9e3)
                   for p in monitor.characteristic.pieces)  # fmt: skip
    monitor.set_reference(replace(monitor.characteristic, pieces=pieces))
    events = feed_rows(monitor, after(monitor, 3, 700))
    assert all(e.shift is None for e in of_type(events, CurveAdopted))
    assert 'nothing can be compared' in monitor.reference.problem


# --- by itself --------------------------------------------------------------------------------


def test_a_curve_becomes_the_reference_by_itself_unless_that_is_left_to_the_operator():
    monitor, events = _run('by itself')
    (told, *_) = of_type(events, ReferenceSet)
    assert told.characteristic in [e.characteristic for e in of_type(events, CurveAdopted)]
    assert monitor.predicting is monitor.reference.curve
    assert any(getattr(e, 'text', '') == BY_ITSELF for e in events)
    monitor, events = _run('never')
    assert of_type(events, CurveAdopted)
    assert not of_type(events, ReferenceSet)
    assert monitor.reference.curve is None


@pytest.mark.parametrize('added_mw', [-8.0, 6.0])
def test_a_fault_that_stays_stands_however_long_it_lasts(added_mw):
    """Longer than the window, over many fits and over a restart of the monitor."""
    monitor = healthy()
    reference, began_ns = monitor.reference.curve, monitor.last_ns
    events = feed_rows(monitor, after(monitor, 2, N, added_mw=added_mw))
    monitor = taken_up(monitor, Monitor(BY_TIME))
    events += feed_rows(monitor, after(monitor, 3, N, added_mw=added_mw))
    assert (monitor.alarm.active, monitor.alarm.occurrence) == (True, 1)
    assert monitor.reference.curve.model_id == reference.model_id == monitor.predicting.model_id
    raised_ns = named(events, 'residual')[0].time_ns
    fits = [e.task for e in of_type(events, FitRequested) if e.task.request_ns > raised_ns]
    assert fits
    # A block of the alarm is what its onset may be late or early by.
    assert all(task.contents.time_ns[0] > began_ns - 60 * NS_PER_S for task in fits)
    assert middle_of(monitor) - middle_of(healthy()) == pytest.approx(added_mw, abs=1.0)


def middle_of(monitor):
    at = np.array([float(np.median(healthy().reference.curve.breakpoints))])
    return monitor.characteristic.model.static(at)[0]


# --- the alarm on a shift ---------------------------------------------------------------------

STRICT = Settings({'shift_confidence': 0.999, 'shift_least': 0.3, 'alarm_dead_band': 0.3})
LOOSE = STRICT.changed({'alarm_latch': False})
CALM = (0.0, 1.0)  # moved by so many MW, with this chance that it did not


def told(alarm, *shifts, settings=STRICT, begin_s=0, every_s=600):
    shifts = [judgement(*s) if isinstance(s, tuple) else s for s in shifts]
    return [
        change.state for k, shift in enumerate(shifts)
        for change in alarm.judge(shift, START_NS + (begin_s + k * every_s) * NS_PER_S, settings)
    ]  # fmt: skip


def at(shift, u_from, u_to):
    """Return the judgement as one of another piece."""
    return replace(shift, pieces=(replace(shift.pieces[0], u_from=u_from, u_to=u_to),))


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
        # A small one has to be seen by two curves in a row, at the same place, to the same side.
        (STRICT, [(0.6,), (0.7,), (0.6,)], [UNACKNOWLEDGED]),
        (STRICT, [(0.6,), CALM, (0.6,)], []),
        (STRICT, [(0.6,), (-0.6,), (0.6,)], []),
        (STRICT, [(0.6,), at(judgement(0.6), 1150.0, 2280.0)], []),
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
        assert change.sentence.startswith('Acknowledged. ')
        assert change.sentence.endswith('MW.')
        assert (change.occurrence, change.limit) == (count, 0.4)
    assert alarm.operate(AlarmAction.ACKNOWLEDGE, START_NS, 'now')[1] == []


def test_what_confirms_is_of_this_reference_and_of_another_time():
    alarm = ShiftAlarm()
    assert told(alarm, (0.6,)) == []
    assert alarm.reset('There is a new reference.', START_NS, 'now', STRICT) == []
    assert told(alarm, (0.7,), begin_s=600) == []
    quick = ShiftAlarm()
    assert told(quick, CALM, (0.6,), (0.6,), every_s=60) == []
    assert told(quick, (0.6,), begin_s=500) == []
    assert told(quick, (0.6,), begin_s=720) == [UNACKNOWLEDGED]
    back = ShiftAlarm()
    assert told(back, (0.6,), begin_s=86_400) == []
    back.shift_time(-86_400 * NS_PER_S)
    assert told(back, (0.6,), begin_s=600) == [UNACKNOWLEDGED]


def test_what_the_last_curve_saw_outlives_a_restart():
    first = ShiftAlarm()
    assert told(first, (0.6,)) == []
    assert told(taken_up(first, ShiftAlarm()), (0.7,), begin_s=600) == [UNACKNOWLEDGED]
    earlier = ShiftAlarm()
    saved = first.snapshot()
    del saved['seen'], saved['seen_ns']
    earlier.restore(saved)
    assert told(earlier, (0.7,), begin_s=600) == []


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


# --- wear -------------------------------------------------------------------------------------

DAY_NS = 86_400 * NS_PER_S
BEGUN_NS = 20_000 * DAY_NS
KNOTS, SLOPES = np.array([1000.0, 1500.0, 2200.0]), np.array([0.2, 0.1])
BUDGET = Settings({'wear_budget': 3.0})


def months_of_wear(mw_per_month, months, every_days=4):
    """Run a reference over curves and segments of windows of ten days; return it and what came."""
    reference, rng = ReferenceCurve(BUDGET), np.random.default_rng(1)
    begun = []
    for day in range(10, round(30 * months), every_days):
        now_ns = BEGUN_NS + day * DAY_NS
        found = curve(
            KNOTS, SLOPES, start=150.0 + mw_per_month * (day - 5.0) / 30.0, stderr=2e-4,
            samples=1000, model_id=f'day {day}',
            source=FittedData(now_ns - 10 * DAY_NS, now_ns, 1, 1, 1000, 540.0, 1.0, False),
            dynamics=(RegionDynamics(100.0, 400.0, 60.0, 5.0, 1.0, 1.0),),
        )  # fmt: skip
        segments = []
        for k, at in enumerate(np.sort(rng.uniform(day - 10.0, day, 80))):
            u, start_ns = rng.uniform(1050.0, 2150.0), BEGUN_NS + round(at * DAY_NS)
            mw = float(np.interp(u, KNOTS, [150.0, 250.0, 320.0]))
            mw += mw_per_month * at / 30.0 + rng.normal(0.0, 0.5)
            segments.append(SpecialSegment(
                k + 1, SegmentKind.STEADY, start_ns, start_ns + 400 * NS_PER_S, 400, u, u, 0.0,
                1.0, mw, mw, 1.0, 540.0,
            ))  # fmt: skip
        reference.judge(found, segments, now_ns)
        if reference.follow(None, False, now_ns):
            begun.append(now_ns)
        renewed = reference.renewed(found, now_ns)
        if renewed is not None:
            reference.renew(renewed, segments, now_ns)
    return reference, begun


@pytest.mark.parametrize('mw_per_month', [1.0, -1.0])
def test_a_year_of_wear_is_followed_without_an_alarm_and_told(mw_per_month):
    reference, begun = months_of_wear(mw_per_month, 12)
    assert begun == []
    wear = reference.wear
    assert wear.mw_per_month == pytest.approx(mw_per_month, rel=0.2)
    # What is behind is the mean of a window, which is some days old.
    assert wear.total_mw == pytest.approx(11.5 * mw_per_month, rel=0.2)
    assert wear.since_ns - BEGUN_NS < MONTH_NS
    again = taken_up(reference, ReferenceCurve(BUDGET))
    assert again.wear == wear
    assert again.curve.model_id == reference.curve.model_id


def test_wear_beyond_its_budget_raises_the_alarm_on_a_shift():
    reference, begun = months_of_wear(-6.0, 6)
    assert begun
    assert reference.alarm.active
