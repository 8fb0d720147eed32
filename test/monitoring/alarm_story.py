# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Alarms made, fed and operated; and the life of one in obvious steps, the slow truth of them."""

import re

import numpy as np
from naive_stream import NaiveAlarm
from streams import START_NS, grid_ns

from valveflow_ros.curve.shift import PieceShift, Shift
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import Alarms, Judged, ResidualAlarm, ShiftAlarm
from valveflow_ros.parameters import Settings
from valveflow_ros.state import from_bytes, to_bytes

S = 10**9
DAY = 86_400 * S
# As nervous as it can be set.
NERVOUS = {'alarm_on_delay': 0.0, 'alarm_off_delay': 0.0, 'alarm_dead_band': 0.0}


def fed(alarm, shares, start_s=0, beside=()):
    """Let the alarm judge these shares of its limit of 3 MW, a row each second."""
    time_ns = grid_ns(len(shares), start_ns=START_NS + start_s * S)
    shares = np.asarray(shares, dtype=np.float64)
    return alarm.feed(time_ns, shares, 3.0 * shares, 'm', beside)


def restored(alarm, settings):
    """Return another alarm of this kind that goes on where this one is, by way of bytes."""
    other = type(alarm)(settings)
    other.restore(from_bytes(to_bytes(alarm.snapshot())))
    return other


def lived(settings, *steps):
    """Return a residual alarm after these steps, and what it told as (row, change).

    A step is rows ``(share, count)``, where several shares take turns; what an operator
    does; seconds that the clock leaps; new settings; or ``restore``.
    """
    settings = Settings(settings)
    alarm, told, row, second = ResidualAlarm(settings), [], 0, 0
    for step in steps:
        if step == 'restore':
            alarm = restored(alarm, settings)
        elif isinstance(step, str):
            now_ns = START_NS + max(second - 1, 0) * S
            told += [(row, c) for c in alarm.operate(AlarmAction(step), now_ns, 'm')[1]]
        elif isinstance(step, int):
            second += step
        elif isinstance(step, dict):
            settings = settings.changed(step)
            alarm.configure(settings)
        else:
            shares = np.resize(step[0], step[1])
            told += [(row + k, c) for k, c in fed(alarm, shares, second)]
            row, second = row + len(shares), second + len(shares)
    return alarm, told


def judgement(by_mw, p_value=1e-6):
    """Return the judgement of one piece that moved by so much."""
    moved = p_value < 1e-3 and abs(by_mw) >= 0.3
    piece = PieceShift(1e3, 1.2e3, by_mw, by_mw, by_mw, 0.1, np.nan, np.nan, 200.0, p_value,
                       moved, 0.4)  # fmt: skip
    return Shift('then', 'now', START_NS, START_NS, (piece,), 0, 0, 0, f'By {by_mw} MW.')


class Desk:
    """Both alarms in one list, and what they told."""

    def __init__(self, settings):
        self.settings = settings
        self.residual, self.shift = ResidualAlarm(settings), ShiftAlarm(settings)
        self.alarms = Alarms(self.residual, self.shift)
        self.told = []

    def _tell(self, changes):
        self.told += changes
        return changes

    def rows(self, shares, start_s):
        return self._tell([c for _, c in fed(self.residual, shares, start_s, [self.shift])])

    def judge(self, by_mw, second=0):
        now_ns = START_NS + second * S
        return self._tell(self.shift.judge(judgement(by_mw), now_ns, self.settings))

    def press(self, act, second=0, name=None):
        judged = Judged(START_NS + second * S, 0.0, 0.0)
        return self._tell(self.alarms.operate(AlarmAction(act), judged, 'm', name))

    def taken_up(self):
        """Return the desk as a new process restores it."""
        other = Desk(self.settings)
        other.residual = restored(self.residual, self.settings)
        other.shift = restored(self.shift, self.settings)
        other.alarms = Alarms(other.residual, other.shift)
        other.told = self.told
        return other


def held_in(change):
    """Return how many announcements a sentence says were held back."""
    found = re.search(r'(\d+) announcements? w', change.sentence)
    return int(found.group(1)) if found else 0


class SlowLife:
    """Judge a row, then look at the shelf, then decide what an operator is told."""

    def __init__(self, settings):
        self.alarm = NaiveAlarm(settings)  # delays, dead band, latch, acknowledgement
        self.suppress_after = round(settings['alarm_suppress_time'] * S)
        block = settings['alarm_block']
        lasting = max(block, min(settings['alarm_off_delay'], 5.0 * block))
        self.come_back_after = round(lasting * S)
        self.shelf_time = round(settings['alarm_shelve_time'] * S)
        self.most = settings['alarm_flood']
        self.gap = self.alarm.gap
        self.blind = self.seeing = 0  # ns watched without, and again with, anything to judge
        self.suppressed = False
        self.shelf_left = None  # ns
        self.now = None
        self.told_ago = 0  # ns since anything was announced
        self.announced_ago = []  # ns since each announcement, newest last
        self.occurrences = 0
        self.told = self.shown = self.before = 'NORMAL'
        self.held = 0
        self.holding = False
        self.changes = []  # (row, state before, state, occurrences, held back)

    @property
    def state(self):
        if self.shelf_left is not None:
            return 'SHELVED'
        return 'SUPPRESSED' if self.suppressed else self.alarm.state

    def take(self, time, value, limit):
        step = 0 if self.now is None else time - self.now
        self.now = time
        passed = max(step, 0)
        self.told_ago += passed
        self.announced_ago = [ago + passed for ago in self.announced_ago]
        if self.shelf_left is not None:
            self.shelf_left -= passed
        held_before = self.alarm.condition
        self.alarm.take(time, value, limit)
        turned = self.alarm.condition != held_before
        self.occurrences += int(turned and self.alarm.condition)
        self.look(value, step if 0 < step <= self.gap else 0, turned)
        if self.shelf_left is not None and self.shelf_left <= 0:
            self.off_the_shelf()
        self.tell()

    def look(self, value, watched, turned):
        if value != value:
            self.seeing = max(self.seeing - watched, 0)
            self.blind += watched
            if not self.suppressed and self.blind >= self.suppress_after:
                self.suppressed, self.seeing = True, 0
            return
        self.seeing = min(self.seeing + watched, self.come_back_after)
        enough = self.seeing == self.come_back_after
        self.blind = 0 if enough else max(self.blind - watched, 0)
        if self.suppressed and (turned or enough):
            self.suppressed, self.blind = False, 0

    def off_the_shelf(self):
        self.shelf_left = None
        self.alarm.state = 'UNACKNOWLEDGED' if self.alarm.condition else 'NORMAL'

    def acknowledge(self):
        done = self.state == self.alarm.state and self.alarm.acknowledge()
        self.tell()
        return done

    def shelve(self):
        if self.shelf_left is not None or self.alarm.state == 'NORMAL':
            return False
        self.shelf_left = self.shelf_time
        self.tell()
        return True

    def unshelve(self):
        if self.shelf_left is None:
            return False
        self.off_the_shelf()
        self.tell()
        return True

    def tell(self):
        if self.state != self.shown:
            self.before, self.shown = self.shown, self.state
        stands = self.alarm.state != 'NORMAL'
        again = self.state == self.told and stands and self.told_ago >= DAY
        if self.state == self.told and not again:
            self.holding = False
            return
        if again:
            self.before = self.told
        elif self.state == 'UNACKNOWLEDGED':
            lately = sum(ago < 600 * S for ago in self.announced_ago)
            just_now = sum(ago < 60 * S for ago in self.announced_ago)
            if lately >= self.most or just_now >= 2:
                self.held += int(not self.holding)
                self.holding = True
                return
            self.held -= int(self.holding)
        if self.state == 'UNACKNOWLEDGED' and not again:
            self.announced_ago.append(0)
        row = self.alarm.row
        self.changes.append((row, self.before, self.state, self.occurrences, self.held))
        self.told, self.held, self.holding = self.state, 0, False
        self.told_ago = 0
