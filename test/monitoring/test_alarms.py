from __future__ import annotations

import math

import numpy as np
import pytest
from alarm_story import SlowLife, held_in
from hypothesis import given
from hypothesis import strategies as st
from streams import START_NS, blocks_of, cuts, examples, frozen, grid_ns

from valveflow_ros.monitoring.alarm import AlarmAction
from valveflow_ros.monitoring.alarms import AlarmState, Judged, ResidualAlarm
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S

LIMIT = 2.0
QUICK = {'alarm_on_delay': 5.0, 'alarm_off_delay': 7.0, 'alarm_dead_band': 0.25}

runs = st.lists(
    st.tuples(
        st.sampled_from([0.0, 1.4, 1.5, 1.6, 1.9, 2.0, 2.1, 9.0, -2.1, -9.0, math.nan, math.inf]),
        st.integers(1, 12),
        st.sampled_from([1, 1, 1, 1, 2, 30, 86_400, -10, -86_400]),  # step of time before it
    ),
    max_size=25,
)
rules = st.fixed_dictionaries(
    {
        'alarm_on_delay': st.sampled_from([0.0, 1.0, 5.0]),
        'alarm_off_delay': st.sampled_from([0.0, 7.0]),
        'alarm_dead_band': st.sampled_from([0.0, 0.25, 0.9]),
        'alarm_latch': st.booleans(),
        'alarm_shelve_time': st.sampled_from([60.0, 600.0]),
        'alarm_suppress_time': st.sampled_from([1.0, 4.0, 600.0]),
        'alarm_block': st.sampled_from([1.0, 3.0, 60.0]),
        'alarm_flood': st.sampled_from([1, 2, 5]),
    }
)
acts = st.lists(st.sampled_from(['acknowledge', 'shelve', 'unshelve']), max_size=2)


def feed(alarm, time_ns, average):
    """Let the alarm judge a running mean by its share of a limit."""
    return alarm.feed(time_ns, average / LIMIT, average, 'm')


def acknowledged(alarm, shift_mw):
    """Acknowledge while this is what the residual speaks of; return the change, if any."""
    alarm.judged = Judged(START_NS, shift_mw / LIMIT, shift_mw)
    return next(iter(alarm.operate(AlarmAction.ACKNOWLEDGE, START_NS, 'm')[1]), None)


def rows_of(plan):
    time_ns, average, now = [], [], START_NS
    for value, length, step in plan:
        for k in range(length):
            now += (step if k == 0 else 1) * NS_PER_S
            time_ns.append(now)
            average.append(value)
    return np.array(time_ns, dtype=np.int64), np.array(average)


def press(alarm, act, now_ns):
    """Do what an operator does; return whether there was anything to do, and the changes."""
    return alarm.operate(AlarmAction(act), now_ns, 'm')


@examples(100)
@given(runs, rules, st.data())
def test_rows_and_operators_give_what_the_slow_truth_gives_however_cut(plan, values, data):
    settings = Settings(values)
    time_ns, average = rows_of(plan)
    fast, slow = ResidualAlarm(settings), SlowLife(settings)
    for start, end in blocks_of(len(time_ns), data.draw(cuts(len(time_ns)))):
        before = len(slow.changes)
        changes = feed(fast, time_ns[start:end], average[start:end])
        for now_ns, value in zip(time_ns[start:end].tolist(), average[start:end], strict=True):
            slow.take(now_ns, value, LIMIT)
        assert [(start + row, *told(c)) for row, c in changes] == slow_told(slow, before)
        assert all(c.time_ns == time_ns[start + row - 1] for row, c in changes)
        for act in data.draw(acts) if end else ():
            before = len(slow.changes)
            done, pressed = press(fast, act, int(time_ns[end - 1]))
            assert done == getattr(slow, act)()
            assert [(end, *told(c)) for c in pressed] == slow_told(slow, before)
        assert (fast.state.name, fast.active) == (slow.state, slow.alarm.condition)
        assert fast.standing == (slow.alarm.state != 'NORMAL')
        assert (fast.occurrence, fast.held) == (slow.occurrences, slow.held)


def told(change):
    return change.previous.name, change.state.name, change.occurrence, held_in(change)


def slow_told(slow, since):
    return [(row, was, now, n, held) for row, was, now, n, held in slow.changes[since:]]


@examples(60)
@given(runs, st.data())
def test_any_cutting_gives_the_same_changes(plan, data):
    time_ns, average = rows_of(plan)
    whole = feed(ResidualAlarm(Settings(QUICK)), time_ns, average)
    alarm, changes = ResidualAlarm(Settings(QUICK)), []
    for start, end in blocks_of(len(time_ns), data.draw(cuts(len(time_ns)))):
        part = feed(alarm, time_ns[start:end], average[start:end])
        changes += [(start + row, c) for row, c in part]
    assert frozen(changes) == frozen(whole)


@examples(60)
@given(runs, st.sampled_from([0.5, 8.0]))
def test_sign_and_scale_do_not_matter(plan, factor):
    time_ns, average = rows_of(plan)
    here = feed(ResidualAlarm(Settings(QUICK)), time_ns, average)
    there = ResidualAlarm(Settings(QUICK)).feed(time_ns, -average / LIMIT, -factor * average, 'm')
    assert [(r, c.state, c.occurrence) for r, c in here] == [
        (r, c.state, c.occurrence) for r, c in there
    ]


def fed(alarm, value, seconds, start_s=0):
    time_ns = grid_ns(seconds, start_ns=START_NS + start_s * NS_PER_S)
    return feed(alarm, time_ns, np.full(seconds, value))


def test_the_delay_is_the_time_beyond_the_limit():
    alarm = ResidualAlarm(Settings(QUICK))
    assert fed(alarm, 3.0, 5) == []
    ((row, change),) = fed(alarm, 3.0, 1, 5)
    assert row == 1
    assert change.state == AlarmState.UNACKNOWLEDGED
    assert change.time_ns == START_NS + 5 * NS_PER_S == change.raised_ns
    assert (change.value, change.limit, change.unit, change.occurrence) == (1.5, 1.0, '', 1)


def test_a_value_on_the_limit_is_not_beyond_it_and_one_on_the_dead_band_has_not_returned():
    alarm = ResidualAlarm(Settings(QUICK))
    assert fed(alarm, LIMIT, 60) == []
    assert len(fed(alarm, -LIMIT - 1e-9, 60, 60)) == 1
    assert fed(alarm, 1.5, 60, 120) == []
    assert len(fed(alarm, 1.5 - 1e-9, 60, 180)) == 1


def test_latched_it_stays_until_returned_and_acknowledged_in_either_order():
    for first_back in (True, False):
        alarm = ResidualAlarm(Settings(QUICK))
        fed(alarm, 9.0, 20)
        if first_back:
            fed(alarm, 0.0, 20, 20)
            assert alarm.state == AlarmState.RETURNED_UNACKNOWLEDGED
            acknowledged(alarm, 0.0)
        else:
            acknowledged(alarm, 9.0)
            assert alarm.state == AlarmState.ACKNOWLEDGED
            fed(alarm, 0.0, 20, 20)
        assert alarm.state == AlarmState.NORMAL
        assert acknowledged(alarm, 0.0) is None


def test_without_latch_it_clears_by_itself():
    alarm = ResidualAlarm(Settings({**QUICK, 'alarm_latch': False}))
    fed(alarm, 9.0, 20)
    fed(alarm, 0.0, 20, 20)
    assert alarm.state == AlarmState.NORMAL


def test_two_exceeding_rows_far_apart_do_not_raise():
    """Nobody watched in between, so the delay has not been seen to pass."""
    alarm = ResidualAlarm(Settings({'alarm_on_delay': 120.0}))
    time_ns = START_NS + np.array([0, 7200, 14_400], dtype=np.int64) * NS_PER_S
    assert feed(alarm, time_ns, np.full(3, 9.0)) == []


def test_a_clock_set_back_does_not_silence_it():
    alarm = ResidualAlarm(Settings(QUICK))
    assert fed(alarm, 9.0, 3, 86_400) == []
    ((row, _),) = fed(alarm, 9.0, 20, 0)
    assert row == 6


def test_bad_data_neither_raise_nor_clear():
    alarm = ResidualAlarm(Settings(QUICK))
    assert fed(alarm, math.nan, 100) == []
    fed(alarm, 9.0, 20, 100)
    ((_, change),) = fed(alarm, math.nan, 4000, 120)
    assert change.state == AlarmState.SUPPRESSED
    assert alarm.active


def test_new_delays_count_from_now_on_and_the_state_stays():
    alarm = ResidualAlarm(Settings(QUICK))
    fed(alarm, 9.0, 20)
    alarm.configure(Settings({**QUICK, 'alarm_off_delay': 1.0}))
    assert alarm.state == AlarmState.UNACKNOWLEDGED
    ((row, change),) = fed(alarm, 0.0, 20, 20)
    assert (row, change.occurrence) == (2, 1)


@pytest.mark.parametrize('value', [3.21, -3.21])
def test_sentences_say_how_much_and_which_way(value):
    alarm = ResidualAlarm(Settings(QUICK))
    ((_, raised),) = fed(alarm, value, 20)
    assert '3.2 MW' in raised.sentence
    assert ('more' if value > 0 else 'less') in raised.sentence
    assert '3.2 MW' in acknowledged(alarm, value).sentence


def test_no_sentence_ever_says_nan():
    alarm = ResidualAlarm(Settings(QUICK))
    changes = [c for _, c in fed(alarm, 9.0, 20)]
    changes.append(acknowledged(alarm, math.nan))
    changes += [c for _, c in fed(alarm, 0.0, 20, 20)]
    assert len(changes) == 3
    assert not any('nan' in c.sentence for c in changes)


def test_infinite_evidence_is_beyond_the_limit_and_unknown_evidence_raises_nothing():
    alarm = ResidualAlarm(Settings(QUICK))
    time_ns = grid_ns(50)
    assert alarm.feed(time_ns, np.full(50, math.nan), np.full(50, math.nan), 'm') == []
    assert len(feed(alarm, time_ns + 10**12, np.full(50, math.inf))) == 1


def test_no_rows():
    alarm = ResidualAlarm(Settings())
    assert feed(alarm, np.empty(0, dtype=np.int64), np.empty(0)) == []
