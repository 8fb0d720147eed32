# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The life of an alarm by the relations that ISA-18.2 draws, whatever happens to it."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from streams import INTERPRETED, START_NS, frozen

from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import AlarmState, ResidualAlarm
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S

NORMAL, UNACKNOWLEDGED, ACKNOWLEDGED, RETURNED, SHELVED, SUPPRESSED, _ = AlarmState
# What may follow on what. The shelf and suppression may hide any state on the way.
NEXT = {
    NORMAL: {UNACKNOWLEDGED, SUPPRESSED},
    UNACKNOWLEDGED: {ACKNOWLEDGED, RETURNED, NORMAL, SHELVED, SUPPRESSED},
    ACKNOWLEDGED: {NORMAL, SHELVED, SUPPRESSED},
    RETURNED: {NORMAL, UNACKNOWLEDGED, SHELVED, SUPPRESSED},
    SHELVED: {UNACKNOWLEDGED, NORMAL, SUPPRESSED},
    SUPPRESSED: {NORMAL, UNACKNOWLEDGED, ACKNOWLEDGED, RETURNED, SHELVED},
}
DAY_NS = 86_400 * NS_PER_S
SHELF_S = 100
rules_of_life = st.fixed_dictionaries(
    {
        'alarm_on_delay': st.sampled_from([0.0, 3.0]),
        'alarm_off_delay': st.sampled_from([0.0, 3.0]),
        'alarm_latch': st.booleans(),
        'alarm_flood': st.sampled_from([1, 2, 5]),
        'alarm_suppress_time': st.sampled_from([2.0, 10.0]),
        'alarm_block': st.just(5.0),
        'alarm_shelve_time': st.just(float(SHELF_S)),
    }
)


class Living(RuleBasedStateMachine):
    """An alarm, row by row, beside one that is saved and restored again and again."""

    @initialize(values=rules_of_life)
    def begin(self, values):
        self.settings = Settings(values)
        self.alarm = ResidualAlarm(self.settings)
        self.twin = ResidualAlarm(self.settings)
        self.now_ns = START_NS
        self.begun = 0
        self.acknowledged = 0  # the occurrence that was
        self.shelved_for_s = 0
        self.announced_ns = []
        self.told_ns = 0

    def both(self, act, *given):
        """Do the same to both; they say the same."""
        here, there = (getattr(alarm, act)(*given) for alarm in (self.alarm, self.twin))
        assert frozen(here) == frozen(there)
        return here

    def step(self, value, seconds=1):
        """Take a row and look at what it did."""
        before, active = self.alarm.state, self.alarm.active
        self.now_ns += seconds * NS_PER_S
        row = np.array([self.now_ns]), np.array([value]), np.array([3.0 * value]), 'm'
        changes = [change for _, change in self.both('feed', *row)]
        self.begun += int(self.alarm.active and not active)
        if before == SHELVED:
            self.shelved_for_s += max(seconds, 0)
        self.check(before, changes)
        if math.isnan(value):
            assert self.alarm.active == active

    def check(self, before, changes):
        after = self.alarm.state
        assert after == before or after in NEXT[before], (before, after)
        assert len(changes) <= 1
        for change in changes:
            assert (change.state, change.time_ns) == (after, self.now_ns)
            if change.state == change.previous:
                assert self.alarm.standing
                assert self.now_ns - self.told_ns >= DAY_NS
            else:
                assert change.state in NEXT[change.previous]
            self.told_ns = self.now_ns
            assert 'nan' not in change.sentence
            if change.state == UNACKNOWLEDGED != change.previous:
                self.announced_ns.append(self.now_ns)
        if after == ACKNOWLEDGED:
            assert self.acknowledged == self.alarm.occurrence
        if after == UNACKNOWLEDGED and before in (NORMAL, RETURNED):
            assert self.alarm.raised_ns == self.now_ns

    def by_hand(self, act):
        before = self.alarm.state
        _, changes = self.both('operate', AlarmAction(act), self.now_ns, 'm')
        self.check(before, changes)
        return before

    @rule(value=st.sampled_from([0.0, 0.8, 2.0, -2.0, math.nan]), count=st.integers(1, 15))
    def rows(self, value, count):
        for _ in range(count):
            self.step(value)

    @rule(count=st.integers(1, 10))
    def chatter(self, count):
        for k in range(count):
            self.step(2.0 * (k % 2))

    @rule(
        seconds=st.sampled_from([-3000, -1, 0, 30, 3000, 90_000]),
        value=st.sampled_from([0.0, 2.0]),
    )
    def leap(self, seconds, value):
        before = len(self.announced_ns)
        if seconds <= 0:
            self.told_ns += seconds * NS_PER_S
        self.step(value, seconds)
        if seconds <= 0:
            # The clock was set back: what was said before is as long ago as it was.
            self.announced_ns = [
                t + seconds * NS_PER_S if k < before else t
                for k, t in enumerate(self.announced_ns)
            ]

    @rule()
    def acknowledge(self):
        if self.alarm.state == UNACKNOWLEDGED:
            self.acknowledged = self.alarm.occurrence
        before = self.by_hand('acknowledge')
        wanted = {UNACKNOWLEDGED: ACKNOWLEDGED, RETURNED: NORMAL}.get(before, before)
        assert self.alarm.state == wanted

    @rule()
    def shelve(self):
        standing = self.alarm.standing
        before = self.by_hand('shelve')
        if before != SHELVED:
            self.shelved_for_s = 0
        assert self.alarm.state == (SHELVED if standing else before)

    @rule()
    def unshelve(self):
        before = self.by_hand('unshelve')
        if before == SHELVED and self.alarm.state != SUPPRESSED:
            assert self.alarm.state == (UNACKNOWLEDGED if self.alarm.active else NORMAL)

    @rule()
    def save_and_restore(self):
        saved = self.twin.snapshot()
        self.twin = ResidualAlarm(self.settings)
        self.twin.restore(saved)
        assert frozen(self.twin.snapshot()) == frozen(saved)

    @invariant()
    def every_occurrence_is_counted_once(self):
        if hasattr(self, 'alarm'):
            assert self.alarm.occurrence == self.begun

    @invariant()
    def the_shelf_ends(self):
        if hasattr(self, 'alarm') and self.alarm.state == SHELVED:
            assert self.shelved_for_s < SHELF_S

    @invariant()
    def announcements_are_few(self):
        if not hasattr(self, 'alarm'):
            return
        most = self.settings.whole('alarm_flood')
        times = self.announced_ns
        for count, span in ((3, 60), (most + 1, 600)):
            for first, last in zip(times, times[count - 1 :], strict=False):
                assert last - first >= span * NS_PER_S

    @invariant()
    def what_stands_is_told_or_waits(self):
        if hasattr(self, 'alarm') and self.alarm.state == UNACKNOWLEDGED and not self.alarm.held:
            assert self.alarm.due_ns == self.told_ns + DAY_NS

    @invariant()
    def nothing_that_stands_is_told_longer_ago_than_a_day(self):
        if hasattr(self, 'alarm') and self.alarm.standing and not self.alarm.held:
            assert self.now_ns - self.told_ns < DAY_NS


Living.TestCase.settings = hypothesis_settings(
    max_examples=10 if INTERPRETED else 40, stateful_step_count=30, deadline=None
)
TestLiving = Living.TestCase
