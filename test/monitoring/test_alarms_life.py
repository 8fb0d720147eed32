"""The life of an alarm: flood limit, shelf and suppression, one at a time."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from alarm_story import held_in
from streams import START_NS

from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarm import AlarmAction, AlarmStateMachine
from valveflow_ros.monitoring.alarms import AlarmState, Priority, ResidualAlarm
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S
from valveflow_ros.state import from_bytes, to_bytes

DAY_S = 86_400
NORMAL, UNACKNOWLEDGED, _, RETURNED, SHELVED, SUPPRESSED, _ = AlarmState


def test_the_first_occurrence_is_never_held_back():
    alarm = ResidualAlarm(Settings({'alarm_flood': 1, 'alarm_on_delay': 0.0}))
    (change,) = [c for _, c in fed(alarm, [2.0])]
    assert change.state == UNACKNOWLEDGED


def fed(alarm, values, start_s=0):
    time_ns = START_NS + (start_s + np.arange(len(values), dtype=np.int64)) * NS_PER_S
    values = np.asarray(values, dtype=np.float64)
    return alarm.feed(time_ns, values, 3.0 * values, 'm')


NERVOUS = {'alarm_on_delay': 0.0, 'alarm_off_delay': 0.0, 'alarm_dead_band': 0.0}


@pytest.mark.parametrize('latch', [True, False])
@pytest.mark.parametrize('flood', [2, 5])
def test_a_value_that_chatters_is_counted_and_told_in_few_words(latch, flood):
    """Half an hour of coming and going every second, with neither delay nor dead band."""
    given = {**NERVOUS, 'alarm_latch': latch, 'alarm_flood': flood}
    alarm = ResidualAlarm(Settings(given))
    changes = [c for _, c in fed(alarm, [2.0, 0.0] * 900)]
    announced = [c for c in changes if c.state == UNACKNOWLEDGED]
    assert (announced[0], announced[0].occurrence) == (changes[0], 1)
    assert len(announced) == 3 * flood
    assert alarm.occurrence == 900
    assert sum(held_in(c) for c in changes) + len(announced) + alarm.held == 900
    last = announced[-1].time_ns
    assert all(c.time_ns <= last + NS_PER_S for c in changes)


def test_what_is_held_back_and_stands_is_told_as_soon_as_may_be():
    alarm = ResidualAlarm(Settings(NERVOUS))
    changes = fed(alarm, [2.0, 0.0, 2.0, 0.0, *[2.0] * 100])
    assert [(row, c.state) for row, c in changes] == [
        (1, UNACKNOWLEDGED), (2, RETURNED), (3, UNACKNOWLEDGED), (4, RETURNED),
        (61, UNACKNOWLEDGED),
    ]  # fmt: skip
    late = changes[-1][1]
    assert (late.occurrence, late.raised_ns) == (3, START_NS + 4 * NS_PER_S)
    assert 'held back' not in late.sentence
    assert alarm.state == UNACKNOWLEDGED


def test_what_waits_is_counted_once_whatever_else_happens_meanwhile():
    alarm = ResidualAlarm(Settings(NERVOUS))
    fed(alarm, [2.0, 0.0, 2.0, 0.0, 2.0])
    for start_s in (-100, -200, -300):  # the clock is set back: every such row is looked at
        assert fed(alarm, [2.0], start_s) == []
        assert alarm.held == 1


def test_with_its_own_delays_it_cannot_chatter():
    alarm = ResidualAlarm(Settings())
    values = np.where(np.arange(6 * 3600) // 301 % 2, 0.0, 2.0)
    changes = fed(alarm, values)
    assert alarm.occurrence == sum(c.state == UNACKNOWLEDGED for _, c in changes) == 36
    assert not any('held back' in c.sentence for _, c in changes)


def test_a_shelf_ends_in_the_samples_own_time_by_whether_the_cause_is_there():
    for value, wanted in ((2.0, UNACKNOWLEDGED), (0.0, NORMAL)):
        alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_shelve_time': 60.0}))
        fed(alarm, [2.0] * 10)
        done, (change,) = alarm.operate(AlarmAction.SHELVE, START_NS + 9 * NS_PER_S, 'm')
        assert done
        assert (change.state, change.previous) == (SHELVED, UNACKNOWLEDGED)
        assert re.match(r'Put aside until 20\d\d-\d\d-\d\d \d\d:\d\d UTC; ', change.sentence)
        assert alarm.operate(AlarmAction.SHELVE, START_NS + 9 * NS_PER_S, 'm') == (False, [])
        assert alarm.operate(AlarmAction.ACKNOWLEDGE, START_NS + 9 * NS_PER_S, 'm')[1] == []
        ((row, back),) = fed(alarm, [value] * 100, 10)
        assert (row, back.state, back.previous) == (60, wanted, SHELVED)
        assert back.occurrence == 1


def test_an_occurrence_on_the_shelf_is_not_lost():
    alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_shelve_time': 60.0}))
    fed(alarm, [2.0])
    alarm.operate(AlarmAction.SHELVE, START_NS, 'm')
    (_, back), *_ = fed(alarm, [0.0, 2.0] * 50, 1)
    assert (back.state, back.occurrence) == (UNACKNOWLEDGED, 31)


def test_suppression_keeps_what_the_alarm_was_and_counts_nothing():
    given = {**NERVOUS, 'alarm_suppress_time': 30.0, 'alarm_block': 10.0}
    for done in ([], ['acknowledge']):
        alarm = ResidualAlarm(Settings(given))
        fed(alarm, [2.0] * 5)
        for act in done:
            alarm.operate(AlarmAction(act), START_NS + 4 * NS_PER_S, 'm')
        was = alarm.state
        changes = fed(alarm, [*[math.nan] * 100, *[2.0] * 50], 5)
        assert [(row, c.state) for row, c in changes] == [(30, SUPPRESSED), (110, was)]
        assert 'could not be judged for 0.5 min' in changes[0][1].sentence
        assert changes[1][1].sentence.startswith('It can be judged again.')
        assert alarm.occurrence == 1


def test_what_does_not_show_cannot_be_acknowledged():
    alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_suppress_time': 30.0}))
    fed(alarm, [2.0, *[math.nan] * 40])
    assert alarm.state == SUPPRESSED
    assert alarm.operate(AlarmAction.ACKNOWLEDGE, START_NS + 40 * NS_PER_S, 'm')[1] == []
    ((_, back),) = fed(alarm, [2.0] * 100, 41)
    assert back.state == UNACKNOWLEDGED


def test_a_new_occurrence_ends_suppression_at_once():
    alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_suppress_time': 30.0}))
    dark, (row, new) = fed(alarm, [0.0, *[math.nan] * 40, 2.0])
    assert dark[1].state == SUPPRESSED
    assert (row, new.state, new.previous, new.occurrence) == (42, UNACKNOWLEDGED, SUPPRESSED, 1)


def test_a_clock_set_back_gives_the_shelf_no_more_time():
    alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_shelve_time': 60.0}))
    fed(alarm, [2.0], 5000)
    alarm.operate(AlarmAction.SHELVE, START_NS + 5000 * NS_PER_S, 'm')
    ((row, back),) = fed(alarm, [2.0] * 100)
    assert (row, back.state) == (61, UNACKNOWLEDGED)


def test_what_waits_is_told_by_who_takes_over():
    alarm, other = ResidualAlarm(Settings(NERVOUS)), ResidualAlarm(Settings(NERVOUS))
    fed(alarm, [2.0, 0.0, 2.0, 0.0, 2.0])
    other.restore(alarm.snapshot())
    assert other.held == 1
    ((row, late),) = fed(other, [2.0] * 100, 5)
    assert (row, late.state, late.occurrence, held_in(late)) == (56, UNACKNOWLEDGED, 3, 0)


def test_flickering_data_do_not_make_it_chatter():
    """A second of data now and then brings nobody back, nor do holes as long as the sight."""
    given = {'alarm_suppress_time': 30.0, 'alarm_block': 10.0}
    alarm = ResidualAlarm(Settings(given))
    (change,) = [c for _, c in fed(alarm, [0.0, *([math.nan] * 40 + [0.0] * 9) * 50])]
    assert change.state == SUPPRESSED
    patient = ResidualAlarm(Settings(given))
    assert fed(patient, [0.0, *([math.nan] * 29 + [0.0] * 29) * 50]) == []


def test_a_row_now_and_then_decides_nothing():
    """Who sees one row a minute is blind; who misses one a minute sees, and a fault stands."""
    alarm = ResidualAlarm(Settings())
    (change,) = [c for _, c in fed(alarm, [0.0, *([math.nan] * 59 + [0.0]) * 300])]
    assert change.state == SUPPRESSED
    alarm = ResidualAlarm(Settings())
    came = fed(alarm, [2.0] * 3600 + [math.nan] * 3700 + ([2.0] * 59 + [math.nan]) * 300)
    states = [change.state for _, change in came]
    assert states == [UNACKNOWLEDGED, SUPPRESSED, UNACKNOWLEDGED]


@pytest.mark.parametrize('out_min', [10, 30, 59])
@pytest.mark.parametrize('before', [0.0, 2.0])
def test_a_valve_beyond_the_curve_some_times_a_day_is_not_told(out_min, before):
    """By its own defaults an alarm stays what it is, standing or not; and it sees what comes."""
    alarm = ResidualAlarm(Settings())
    came = fed(alarm, [before] * 3600)
    assert len(came) == (before > 1.0)
    beyond, within = [math.nan] * (60 * out_min), [before] * 1200
    assert fed(alarm, [*beyond, *within] * 8, 3600) == []
    now_s = 3600 + 8 * (len(beyond) + len(within))
    ((_, change),) = fed(alarm, [*beyond, *[2.0 - before] * 1200], now_s)
    assert change.state == (RETURNED if before else UNACKNOWLEDGED)


def test_what_was_suppressed_comes_back_as_slowly_as_a_condition_goes():
    alarm = ResidualAlarm(Settings())
    hour, glimpse = [math.nan] * 3600, [0.0] * 299
    (dark,) = fed(alarm, [0.0, *(hour + glimpse) * 5])
    assert dark[1].state == SUPPRESSED
    ((row, back),) = fed(alarm, [*hour, *[0.0] * 400], 100_000)
    assert (row, back.state) == (3600 + 300, NORMAL)


def test_a_silence_without_rows_suppresses_nothing():
    alarm = ResidualAlarm(Settings({'alarm_suppress_time': 30.0}))
    assert fed(alarm, [0.0] * 10) == []
    assert fed(alarm, [*[math.nan] * 20, *[0.0] * 50], 7200) == []


def test_what_does_not_fit_is_not_restored():
    alarm = ResidualAlarm(Settings())
    saved = alarm.snapshot()
    with pytest.raises(DataError, match="'memory'"):
        alarm.restore({**saved, 'memory': np.zeros(3, dtype=np.int64)})


def test_a_life_without_events_is_normal():
    life = AlarmStateMachine()
    assert (life.state, life.standing, life.acknowledge(), life.unshelve(), life.shelve(1)) == (
        NORMAL, False, False, False, False,
    )  # fmt: skip


def test_shelved_again_before_its_return_was_told_it_is_shelved_all_the_same():
    alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_flood': 1}))
    fed(alarm, [2.0])
    alarm.operate(AlarmAction.SHELVE, START_NS, 'm')
    assert alarm.operate(AlarmAction.UNSHELVE, START_NS, 'm') == (True, [])
    assert (alarm.state, alarm.held) == (UNACKNOWLEDGED, 1)
    assert alarm.operate(AlarmAction.SHELVE, START_NS, 'm') == (True, [])
    assert alarm.state == SHELVED


def waiting(flood):
    """Return an alarm whose next announcement waits for the limit, and the second it is at."""
    alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_flood': flood}))
    changes = fed(alarm, [2.0, *[0.0] * 99] * flood + [2.0, 2.0])
    assert sum(c.state == UNACKNOWLEDGED for _, c in changes) == flood
    assert (alarm.state, alarm.held) == (UNACKNOWLEDGED, 1)
    return alarm, 100 * flood + 2


@pytest.mark.parametrize(('before', 'after'), [(1, 2), (1, 5), (2, 3), (4, 100)])
def test_a_limit_that_is_raised_lets_out_what_waits_with_the_next_row(before, after):
    alarm, second = waiting(before)
    alarm.configure(Settings({**NERVOUS, 'alarm_flood': after}))
    ((row, change),) = fed(alarm, [2.0] * 5, second)
    assert (row, change.state, change.occurrence) == (1, UNACKNOWLEDGED, before + 1)
    # It comes late, but nothing was missed.
    assert held_in(change) == 0
    assert alarm.held == 0


def test_a_limit_that_is_raised_does_not_let_it_chatter():
    """Three a minute are too many whatever the limit."""
    alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_flood': 2}))
    fed(alarm, [2.0, 0.0, 2.0, 0.0, 2.0])
    assert alarm.held == 1
    alarm.configure(Settings({**NERVOUS, 'alarm_flood': 100}))
    ((row, change),) = fed(alarm, [2.0] * 100, 5)
    assert (row, change.state) == (56, UNACKNOWLEDGED)


def test_a_limit_that_is_lowered_holds_back_what_would_have_been_due_earlier():
    alarm, second = waiting(4)
    alarm.configure(Settings({**NERVOUS, 'alarm_flood': 1}))
    changes = fed(alarm, [2.0] * 700, second)
    assert [(row + second, c.state) for row, c in changes] == [(901, UNACKNOWLEDGED)]


STANDS = [
    ([], UNACKNOWLEDGED),
    (['acknowledge'], AlarmState.ACKNOWLEDGED),
]


@pytest.mark.parametrize(('acts', 'state'), STANDS)
def test_what_stands_for_a_day_is_told_again_once_a_day(acts, state):
    alarm = ResidualAlarm(Settings({'alarm_suppress_time': 600.0}))
    ((_, raised),) = fed(alarm, [2.0])
    for act in acts:
        alarm.operate(AlarmAction(act), START_NS, 'm')
    changes = fed(alarm, [2.0] * (3 * DAY_S - 1), 1)
    assert [row for row, _ in changes] == [DAY_S, 2 * DAY_S]
    for _, change in changes:
        assert (change.state, change.previous) == (state, state)
        assert (change.occurrence, change.raised_ns) == (1, raised.raised_ns)
        assert change.sentence.startswith('It stands since 20')
    assert alarm.occurrence == 1
    assert alarm.last == changes[-1][1]


def test_what_returned_and_waits_is_told_again_and_what_is_over_is_not():
    alarm = ResidualAlarm(Settings(NERVOUS))
    changes = fed(alarm, [2.0, *[0.0] * (DAY_S + 1)])
    assert [(row, c.state) for row, c in changes] == [
        (1, UNACKNOWLEDGED), (2, RETURNED), (DAY_S + 2, RETURNED),
    ]  # fmt: skip
    alarm.operate(AlarmAction.ACKNOWLEDGE, START_NS, 'm')[1]
    assert alarm.due_ns is None
    assert fed(alarm, [0.0] * (2 * DAY_S), DAY_S + 2) == []


def test_a_clock_set_back_makes_nobody_wait_longer_to_be_told_again():
    alarm = ResidualAlarm(Settings(NERVOUS))
    fed(alarm, [2.0] * 100)
    changes = fed(alarm, [2.0] * DAY_S, -50_000)
    assert [row for row, _ in changes] == [DAY_S - 98]


def test_what_was_told_last_is_saved_with_the_alarm():
    alarm, other = ResidualAlarm(Settings(NERVOUS)), ResidualAlarm(Settings(NERVOUS))
    assert alarm.last is None
    other.restore(from_bytes(to_bytes(alarm.snapshot())))
    assert other.last is None
    ((_, told),) = fed(alarm, [2.0])
    assert alarm.last == told
    other.restore(from_bytes(to_bytes(alarm.snapshot())))
    assert other.last == told
    assert isinstance(other.last.state, AlarmState)
    assert isinstance(other.last.priority, Priority)
