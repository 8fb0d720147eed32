"""What stands is told again: after a day, and when another alarm's announcements bury it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import START_NS, blocks_of, cuts, examples, frozen, grid_ns

from valveflow_ros.curve.shift import PieceShift, Shift
from valveflow_ros.monitoring.alarm import BURIED, AlarmAction
from valveflow_ros.monitoring.alarms import (
    Alarms,
    AlarmState,
    Judged,
    ResidualAlarm,
    ShiftAlarm,
)
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S
from valveflow_ros.state import from_bytes, to_bytes

DAY_S = 86_400
NORMAL, UNACKNOWLEDGED, ACKNOWLEDGED, RETURNED, SHELVED, SUPPRESSED, _ = AlarmState
NERVOUS = {
    'alarm_on_delay': 0.0, 'alarm_off_delay': 0.0, 'alarm_dead_band': 0.0,
    'alarm_shelve_time': 604_800.0,
}  # fmt: skip


def fed(alarm, values, start_s=0, beside=()):
    time_ns = grid_ns(len(values), start_ns=START_NS + start_s * NS_PER_S)
    values = np.asarray(values, dtype=np.float64)
    return alarm.feed(time_ns, values, 3.0 * values, 'm', beside)


# --- after a day ----------------------------------------------------------------------------


@given(st.data())
@examples(3)
def test_what_is_shelved_for_days_is_told_again_once_a_day_however_cut(data):
    alarm = ResidualAlarm(Settings(NERVOUS))
    fed(alarm, [2.0])
    _, (aside,) = alarm.operate(AlarmAction.SHELVE, START_NS, 'm')
    count, told = 3 * DAY_S - 1, []
    for start, end in blocks_of(count, data.draw(cuts(count))):
        told += [(start + k, c) for k, c in fed(alarm, [2.0] * (end - start), 1 + start)]
    assert [row for row, _ in told] == [DAY_S, 2 * DAY_S]
    for _, change in told:
        assert (change.state, change.previous, change.occurrence) == (SHELVED, SHELVED, 1)
        assert change.sentence == aside.sentence


@pytest.mark.parametrize('acts', [[], ['acknowledge']])
def test_what_is_suppressed_for_days_is_told_again_if_it_stands(acts):
    for value, days in ((2.0, [1, 2]), (0.0, [])):
        alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_suppress_time': 60.0}))
        fed(alarm, [value])
        for act in acts:
            alarm.operate(AlarmAction(act), START_NS, 'm')
        (dark, *told) = fed(alarm, [math.nan] * (3 * DAY_S), 1)
        assert (dark[0], dark[1].state) == (60, SUPPRESSED)
        assert [row for row, _ in told] == [60 + day * DAY_S for day in days]
        assert all(c.state == c.previous == SUPPRESSED for _, c in told)
        assert all(c.sentence == dark[1].sentence for _, c in told)


def test_on_the_shelf_what_is_over_is_not_told_again():
    for latch in (True, False):
        alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_latch': latch}))
        fed(alarm, [2.0])
        alarm.operate(AlarmAction.SHELVE, START_NS, 'm')
        told = fed(alarm, [0.0] * (2 * DAY_S), 1)
        # Latched, it waits below the shelf for who has not acknowledged it.
        assert len(told) == (2 if latch else 0)
        assert alarm.standing == latch


@pytest.mark.parametrize('flood', [1, 2])
def test_what_is_told_again_holds_nothing_new_back(flood):
    alarm = ResidualAlarm(Settings({**NERVOUS, 'alarm_flood': flood}))
    fed(alarm, [2.0])
    ((again, _),) = fed(alarm, [2.0] * DAY_S, 1)
    assert again == DAY_S
    new = [(row, c.state, c.occurrence) for row, c in fed(alarm, [0.0, 2.0], DAY_S + 1)]
    assert new == [(1, RETURNED, 1), (2, UNACKNOWLEDGED, 2)]
    assert alarm.held == 0


# --- behind another -------------------------------------------------------------------------

LONG = Settings({**NERVOUS, 'alarm_suppress_time': 60.0})
HOURS_S = 3 * 3600


def moved(by_mw):
    piece = PieceShift(1e3, 2e3, by_mw, by_mw, by_mw, 0.1, np.nan, np.nan, 200.0, 1e-6,
                       by_mw != 0.0, 0.4)  # fmt: skip
    return Shift('then', 'now', START_NS, START_NS, (piece,), 0, 0, 0, f'By {by_mw} MW.')


class Two:
    """Both alarms in one list, and what they told."""

    def __init__(self):
        self.residual, self.shift = ResidualAlarm(LONG), ShiftAlarm(LONG)
        self.alarms = Alarms(self.residual, self.shift)
        self.told = []

    def rows(self, values, start_s):
        self.told += [c for _, c in fed(self.residual, values, start_s, [self.shift])]

    def judge(self, by_mw, second):
        self.told += self.shift.judge(moved(by_mw), START_NS + second * NS_PER_S, LONG)

    def press(self, act, second=0):
        self.told += self.alarms.operate(
            AlarmAction(act), Judged(START_NS + second * NS_PER_S, 0.0, 0.0), 'm'
        )

    def go_on_elsewhere(self):
        """Be saved, and restored in a new process."""
        other = Two()
        other.residual.restore(from_bytes(to_bytes(self.residual.snapshot())))
        other.shift.restore(from_bytes(to_bytes(self.shift.snapshot())))
        other.told = self.told
        return other


def check_newest(told):
    """Who comes late at any time learns from the newest announcements what is not over."""
    states = {}
    for k, change in enumerate(told):
        states[change.name] = change.state
        newest = {c.name: c.state for c in told[max(0, k - BURIED - 1) : k + 1]}
        assert newest.items() >= {n: s for n, s in states.items() if s != NORMAL}.items()


CHATTER = np.where(np.arange(HOURS_S) % 2, 2.0, 0.0)


@pytest.mark.parametrize('act', [None, 'acknowledge', 'shelve', 'suppress'])
def test_hours_of_chatter_of_the_residual_do_not_bury_a_shift(act):
    two = Two()
    two.judge(2.0, 0)
    if act == 'suppress':
        two.told += two.shift.unjudged('Nothing can be compared.', START_NS, 'm', LONG)
    elif act:
        two.press(act)
    first = two.told[-1]
    two.rows(CHATTER, 1)
    check_newest(two.told)
    chatter = [c for c in two.told if c.name == 'residual']
    again = [c for c in two.told if c.name == 'curve_shift' and c.state == c.previous]
    assert len(chatter) > 10 * BURIED
    # No oftener than it must be.
    assert len(again) == len(chatter) // BURIED
    assert {(c.state, c.occurrence, c.raised_ns) for c in again} == {
        (first.state, first.occurrence, first.raised_ns)
    }


@pytest.mark.parametrize('act', [None, 'acknowledge', 'shelve'])
def test_many_curves_that_come_and_go_do_not_bury_the_residual(act):
    two = Two()
    two.rows([2.0], 0)
    if act:
        two.press(act)
    state = two.residual.state
    for k in range(100):
        two.judge(2.0 * (k % 2), 1 + 60 * k)
        two.rows([2.0] * 60, 1 + 60 * k)
    check_newest(two.told)
    assert sum(c.name == 'curve_shift' for c in two.told) > 5 * BURIED
    again = [c for c in two.told if c.name == 'residual' and c.state == c.previous]
    assert len(again) > 4
    assert {c.state for c in again} == {state}


def test_an_alarm_alone_and_one_that_is_over_are_not_told_again():
    two = Two()
    two.judge(2.0, 0)
    two.judge(0.0, 0)
    two.press('acknowledge')
    before = len(two.told)
    two.rows(CHATTER, 1)
    assert all(c.name == 'residual' and c.state != c.previous for c in two.told[before:])
    alone = fed(ResidualAlarm(LONG), CHATTER)
    assert all(c.state != c.previous for _, c in alone)


@examples(20)
@given(st.data())
def test_cutting_and_starting_again_leave_no_trace(data):
    count = 1200
    values = np.where(np.arange(count) // data.draw(st.integers(1, 30)) % 2, 2.0, 0.0)
    acts = data.draw(st.dictionaries(st.integers(0, count), st.booleans(), max_size=4))
    stories = []
    for cut in (False, True):
        two = Two()
        two.judge(2.0, 0)
        places = data.draw(cuts(count)) if cut else []
        for start, end in blocks_of(count, sorted({*acts, *places})):
            two.rows(values[start:end], 1 + start)
            if end in acts:
                two.judge(2.0 * acts[end], end)
            two = two.go_on_elsewhere() if cut else two
        check_newest(two.told)
        stories.append(two.told)
    assert frozen(stories[0]) == frozen(stories[1])
