# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The residual alarm: against the slow truth, and by relations; its sentences."""

import math
import re

import numpy as np
import pytest
from alarm_story import NERVOUS, SlowLife, held_in, lived, restored
from hypothesis import given
from hypothesis import strategies as st
from streams import START_NS, blocks_of, cuts, examples, grid_ns

from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import AlarmState, ResidualAlarm
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S

NORMAL, UNACKNOWLEDGED, ACKNOWLEDGED, RETURNED, SHELVED, SUPPRESSED, _ = AlarmState
QUICK = {'alarm_on_delay': 5.0, 'alarm_off_delay': 7.0, 'alarm_dead_band': 0.25}
DAY_S, NAN = 86_400, math.nan

runs = st.lists(
    st.tuples(
        st.sampled_from([0.0, 0.7, 0.75, 0.8, 0.95, 1.0, 1.05, 4.5, -1.05, -4.5, NAN, math.inf]),
        st.integers(1, 12),
        st.sampled_from([1, 1, 1, 1, 2, 30, 86_400, -10, -86_400]),  # step of time before it
        st.sampled_from(['', '', '', '', 'acknowledge', 'shelve', 'shelve', 'unshelve']),
    ),
    max_size=25,
)
rules = st.fixed_dictionaries(
    {
        'alarm_on_delay': st.sampled_from([0.0, 1.0, 5.0]),
        'alarm_off_delay': st.sampled_from([0.0, 7.0]),
        'alarm_dead_band': st.sampled_from([0.0, 0.25, 0.9]),
        'alarm_latch': st.booleans(),
        'alarm_shelve_time': st.sampled_from([60.0, 600.0, 604_800.0]),
        'alarm_suppress_time': st.sampled_from([1.0, 4.0, 600.0]),
        'alarm_block': st.sampled_from([1.0, 3.0, 60.0]),
        'alarm_flood': st.sampled_from([1, 2, 5]),
    }
)


def rows_of(plan):
    """Return the rows of a plan, and what an operator does after which of them."""
    time_ns, share, acts, now = [], [], {}, START_NS
    for value, length, step, act in plan:
        for k in range(length):
            now += (step if k == 0 else 1) * NS_PER_S
            time_ns.append(now)
            share.append(value)
        acts[len(share)] = act
    return np.array(time_ns, dtype=np.int64), np.array(share), acts


def feed(alarm, time_ns, share):
    return alarm.feed(time_ns, share, 2.0 * share, 'm')


def told(change):
    return change.previous.name, change.state.name, change.occurrence, held_in(change)


# What may be told after what (ISA-18.2). The shelf and suppression may hide any state on the way.
NEXT = {
    NORMAL: {UNACKNOWLEDGED, SUPPRESSED},
    UNACKNOWLEDGED: {ACKNOWLEDGED, RETURNED, NORMAL, SHELVED, SUPPRESSED},
    ACKNOWLEDGED: {NORMAL, SHELVED, SUPPRESSED},
    RETURNED: {NORMAL, UNACKNOWLEDGED, SHELVED, SUPPRESSED},
    SHELVED: {UNACKNOWLEDGED, NORMAL, SUPPRESSED},
    SUPPRESSED: {NORMAL, UNACKNOWLEDGED, ACKNOWLEDGED, RETURNED, SHELVED},
}


@examples(200)
@given(runs, rules, cuts(100))
def test_rows_and_operators_give_what_the_slow_truth_gives_however_cut_and_restored(
    plan, values, places
):
    settings = Settings(values)
    time_ns, share, acts = rows_of(plan)
    places = sorted({*acts, *(min(at, len(time_ns)) for at in places)})
    fast, slow = ResidualAlarm(settings), SlowLife(settings)
    for start, end in blocks_of(len(time_ns), places):
        before = len(slow.changes)
        changes = feed(fast, time_ns[start:end], share[start:end])
        for now_ns, value in zip(time_ns[start:end].tolist(), share[start:end], strict=True):
            slow.take(now_ns, value, 1.0)
        assert [(start + row, *told(c)) for row, c in changes] == slow.changes[before:]
        for row, change in changes:
            assert change.time_ns == time_ns[start + row - 1]
            assert change.state in {change.previous, *NEXT[change.previous]}
            assert 'nan' not in change.sentence
        act = acts.pop(end, '')
        if act:
            before = len(slow.changes)
            done, pressed = fast.operate(AlarmAction(act), int(time_ns[end - 1]), 'm')
            assert done == getattr(slow, act)()
            assert [(end, *told(c)) for c in pressed] == slow.changes[before:]
        assert (fast.state.name, fast.active) == (slow.state, slow.alarm.condition)
        assert fast.standing == (slow.alarm.state != 'NORMAL')
        assert (fast.occurrence, fast.held) == (slow.occurrences, slow.held)
        fast = restored(fast, settings)


@examples(40)
@given(runs, st.sampled_from([0.5, 8.0]))
def test_sign_and_scale_do_not_matter(plan, factor):
    time_ns, share, _ = rows_of(plan)
    here = feed(ResidualAlarm(Settings(QUICK)), time_ns, share)
    there = ResidualAlarm(Settings(QUICK)).feed(time_ns, -share, -factor * share, 'm')
    assert [(r, told(c)) for r, c in here] == [(r, told(c)) for r, c in there]


# --- settings, sentences and state ------------------------------------------------------------

DARK = {**NERVOUS, 'alarm_suppress_time': 30.0, 'alarm_block': 10.0}


@pytest.mark.parametrize(
    ('settings', 'steps', 'wanted'),
    [
        (  # new delays count from now on
            QUICK, [(9.0, 20), {'alarm_off_delay': 1.0}, (0.0, 20)],
            [(6, UNACKNOWLEDGED), (22, RETURNED)],
        ),
        (  # a higher limit does not let it chatter
            {**NERVOUS, 'alarm_flood': 2},
            [([2.0, 0.0], 4), (2.0, 1), {'alarm_flood': 100}, (2.0, 100)],
            [(1, UNACKNOWLEDGED), (2, RETURNED), (3, UNACKNOWLEDGED), (4, RETURNED),
             (61, UNACKNOWLEDGED)],
        ),
    ],
)  # fmt: skip
def test_settings_that_change_act_from_then_on(settings, steps, wanted):
    _, told = lived(settings, *steps)
    assert [(row, c.state) for row, c in told] == wanted


@pytest.mark.parametrize(
    ('steps', 'words'),
    [
        ([(1.07, 1)], r'3\.2 MW more'),
        ([(-1.07, 1)], r'3\.2 MW less'),
        ([(1.07, 1), 'acknowledge'], r'^Acknowledged; .* 3\.2 MW more'),
        ([(2.0, 1), 'shelve'], r'^Shelved until 20\d\d-\d\d-\d\d \d\d:\d\d UTC; '),
        ([(2.0, 1), (NAN, 30)], r'could not be judged for 0\.5 min'),
        ([(2.0, 1 + DAY_S)], r'^Active since 20'),
        ([(0.0, 1), (NAN, 30), (0.0, 10)], r'^The alarm can be judged again\.'),
    ],
)
def test_sentences_say_how_much_which_way_and_until_when(steps, words):
    _, told = lived(DARK, *steps)
    sentence = told[-1][1].sentence
    assert re.search(words, sentence), sentence


def test_the_sentence_names_the_opening_at_which_the_alarm_was_raised():
    settings = Settings(NERVOUS)
    alarm, shares = ResidualAlarm(settings), np.array([0.0, 1.5, 1.5])
    time_ns, opening = grid_ns(3, start_ns=START_NS), np.array([70.0, 86.3, 90.0])
    ((_, raised),) = alarm.feed(time_ns, shares, 3.0 * shares, 'm', opening_percent=opening)
    assert raised.sentence.endswith(' The alarm was raised at 86 % opening.')
    other = restored(alarm, settings)
    (acknowledged,) = other.operate(AlarmAction.ACKNOWLEDGE, int(time_ns[-1]), 'm')[1]
    assert acknowledged.sentence.endswith(' The alarm was raised at 86 % opening.')


def test_what_does_not_fit_is_not_restored():
    alarm = ResidualAlarm(Settings())
    saved = alarm.snapshot()
    with pytest.raises(DataError, match="'memory'"):
        alarm.restore({**saved, 'memory': np.zeros(3, dtype=np.int64)})
