"""The life of one alarm as a story, row by row, in obvious steps: the slow truth of the alarms."""

from __future__ import annotations

import re

from naive_stream import NaiveAlarm

S = 10**9
DAY = 86_400 * S


def held_in(change):
    """Return how many announcements a sentence says were held back."""
    found = re.search(r'(\d+) announcements? of it', change.sentence)
    return int(found.group(1)) if found else 0


class SlowLife:
    """Judge a row, then look at the shelf, then decide what an operator is told."""

    def __init__(self, settings):
        self.alarm = NaiveAlarm(settings)  # delays, dead band, latch, acknowledgement
        self.suppress_after = round(settings['alarm_suppress_time'] * S)
        lasting = max(settings['alarm_block'], settings['alarm_off_delay'])
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
