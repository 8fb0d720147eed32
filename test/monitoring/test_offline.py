# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from alarm_story import NERVOUS
from hypothesis import given
from hypothesis import strategies as st
from streams import (
    QUICK_MONITOR,
    START_NS,
    blocks_of,
    cuts,
    examples,
    first_difference,
    of_type,
    plant_table,
    story,
    table_harms,
)

from valveflow_ros.errors import DataError, ValveflowError
from valveflow_ros.fit.fit import fit
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.events import FitRequested, JournalEntry, JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import (
    CLOCK_BACK,
    JournalReplayer,
    align_all,
    feed_aligned,
    feed_rows,
)
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, Readings, table_to_readings
from valveflow_ros.signals.align import Aligner

SETTINGS = Settings(QUICK_MONITOR)
N = 700


ACTIONS = [action.value for action in AlarmAction]


class LiveRun:
    """A run as a node has it: fits come back late, people press buttons, clocks go back."""

    def __init__(self, settings, table):
        self.settings = settings
        self.monitor = Monitor(settings)
        self.table = table
        self.done = 0
        self.events = []
        self.waiting = []  # (rows at which the outcome comes back, task)

    def rows(self, count, late):
        """Feed rows; every fit asked for on the way comes back ``late`` rows later."""
        end = min(self.done + count, len(self.table))
        while self.done < end:
            due = min((row for row, _ in self.waiting), default=end)
            until = max(self.done + 1, min(end, due))
            fed = self.monitor.feed(self.table.part(self.done, until))
            self.done += fed.rows
            self.take(fed.events, late)
            self.bring_back()

    def take(self, events, late):
        self.events += events
        self.waiting += [(self.done + late, e.task) for e in events if isinstance(e, FitRequested)]

    def bring_back(self):
        for row, task in list(self.waiting):
            if row <= self.done:
                self.waiting.remove((row, task))
                try:
                    curve = fit(task)
                except DataError as error:
                    self.events += self.monitor.refuse(task.request_ns, str(error))
                else:
                    self.events += self.monitor.adopt(task.request_ns, curve)

    def press(self, button, late):
        """Do what a person, a worker or a clock does between two rows."""
        monitor = self.monitor
        try:
            action, _, name = button.partition(' ')
            if action in ACTIONS:
                self.events += monitor.operate_alarms(AlarmAction(action), name or None)
            elif button == 'set reference':
                self.events += monitor.set_reference()
            elif button == 'request':
                self.take(monitor.request_fit(), late)
            elif button == 'time out' and self.waiting:
                self.events += monitor.refuse(self.waiting[-1][1].request_ns, 'Took too long.')
            elif button == 'restart':
                self.events += monitor.restart(CLOCK_BACK)
            elif button == 'limit':
                before = monitor.settings.real('alarm_limit')
                changes = {'alarm_limit': 4.0 if before == 3.0 else 3.0}
                self.events += monitor.reconfigure(monitor.settings.changed(changes))
            elif button == 'period':
                changes = {'refit_period': 90.0, 'refit_segments': 2}
                self.events += monitor.reconfigure(monitor.settings.changed(changes))
        except DataError as error:
            assert str(error)  # refused with a sentence, and nothing is written down

    def journal(self):
        return of_type(self.events, JournalEntry)


def replayed(settings, table, journal, places=()):
    """Repeat a run from its rows and journal, cut anywhere."""
    replayer = JournalReplayer(Monitor(settings), journal)
    events = []
    for start, end in blocks_of(len(table), list(places)):
        events += replayer.feed(table.part(start, end))
    return events


def same(live, again):
    """Assert that two lists of events tell the same, bit for bit."""
    a, b = story(live), story(again)
    difference = first_difference(a, b)
    assert not difference, difference


BUTTONS = [
    *ACTIONS, 'acknowledge residual', 'shelve residual', 'unshelve curve_shift', 'nothing',
    'set reference', 'request', 'time out', 'restart', 'limit', 'period',
]  # fmt: skip
# Alarms come and go, once there is a curve.
FAULTS = [('fault', 400, 60), ('nan_power', 500, 60), ('fault', 600, 90)]
plan = st.lists(
    st.tuples(st.integers(1, 250), st.integers(0, 120), st.sampled_from(BUTTONS)), max_size=10
)


@examples(25)
@given(
    st.integers(0, 2**32 - 1), st.one_of(table_harms(N), st.just(FAULTS)), plan, st.booleans(),
    st.data(),
)  # fmt: skip
def test_rows_and_journal_repeat_any_run_bit_for_bit(seed, harms, steps, nervous, data):
    settings = SETTINGS.changed(NERVOUS if nervous else {})
    live = LiveRun(settings, plant_table(seed, N, harms))
    for count, late, button in steps:
        live.rows(count, late)
        live.press(button, late)
    live.rows(N, 40)
    places = data.draw(cuts(N, most=8))
    same(live.events, replayed(settings, live.table, live.journal(), places))


def test_a_run_with_every_button_pressed_is_repeated():
    given = LiveRun(SETTINGS, plant_table(1, N))
    given.rows(N, 0)
    live = LiveRun(SETTINGS.changed({'alarm_shelve_time': 60.0}), plant_table(3, 900, FAULTS))
    live.events += live.monitor.set_reference(given.monitor.characteristic)
    story_of = [
        (300, 'request'), (0, 'time out'), (135, 'set reference'), (0, 'shelve'), (10, 'unshelve'),
        (5, 'acknowledge'), (0, 'limit'), (50, 'acknowledge'), (150, 'restart'),
    ]  # fmt: skip
    for count, button in story_of:
        live.rows(count, 30)
        live.press(button, 20)
    live.rows(300, 10)
    others = {k for k in JournalKind if 'DIAGNOS' in k.name}  # not in an hour
    others |= {JournalKind.MISMATCH, JournalKind.RESUMED}
    assert {e.kind for e in live.journal()} >= set(JournalKind) - others
    same(live.events, replayed(live.settings, live.table, live.journal(), range(0, 900, 37)))


@pytest.mark.parametrize(
    ('damage', 'words'),
    [
        # The rows before are missing, so the requests of the journal never come.
        ({'request_ns': 7}, 'a request that never came'),
        # A replay that is not the live run must not pass for it.
        ({'model_id': '000000000000'}, '000000000000'),
        *(({'kind': JournalKind.SETTINGS, 'text': text}, words) for text, words in [
            ('', 'cannot be read'), ('{', 'cannot be read'), ('[]', 'cannot be read'),
            ('{"sample_period": 2.0}', 'sample_period'), ('{"nonsense": 1}', 'nonsense'),
        ]),
    ],
)  # fmt: skip
def test_a_journal_that_is_not_of_these_rows_is_told_with_a_sentence(damage, words):
    table = plant_table(2, N)
    broken = [
        dataclasses.replace(e, **damage) if e.kind == JournalKind.FIT_ADOPTED else e
        for e in of_type(feed_rows(Monitor(SETTINGS), table), JournalEntry)
    ]
    with pytest.raises(ValveflowError, match=words) as caught:
        replayed(SETTINGS, table, broken)
    assert str(caught.value).endswith('.')


# --- readings to events ---------------------------------------------------------------------


def through_aligner(settings, readings, places=()):
    aligner, monitor, events = Aligner(settings), Monitor(settings), []
    for start, end in blocks_of(len(readings), list(places)):
        events += feed_aligned(monitor, aligner.feed(readings.part(start, end)))
    return events + feed_aligned(monitor, aligner.finish())


def joined(*tables):
    """Return the readings of tables one after the other, whatever their times."""
    parts = [table_to_readings(t) for t in tables]
    return Readings(*(np.concatenate([getattr(p, name) for p in parts])
                      for name in ('time_ns', 'signal', 'value', 'quality')))  # fmt: skip


@pytest.mark.parametrize('cut', [[], [700], list(range(0, 4800, 111))])
def test_a_clock_set_back_restarts_the_engine_once_at_the_right_row(cut):
    first = plant_table(1, 300)
    second = plant_table(2, N, start_ns=START_NS - 7200 * NS_PER_S)
    events = through_aligner(SETTINGS, joined(first, second), cut)
    resets = [e for e in of_type(events, JournalEntry) if e.kind == JournalKind.RESET]
    assert [(e.rows, e.text) for e in resets] == [(300, CLOCK_BACK)]
    monitor, times = Monitor(SETTINGS), []
    told = feed_rows(monitor, first) + monitor.restart(CLOCK_BACK)
    told += feed_rows(monitor, second, tell=lambda time_ns, what: times.append(time_ns))
    same(told, events)
    # Progress has the time of the newest row.
    assert times
    assert set(times) <= set(second.time_ns.tolist())


def held(monitor):
    """Return times and segments of what a fit would see."""
    task = next(e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
    return task.contents.time_ns.tolist(), monitor.special_segments()


@examples(10)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([-3e8, -7200.0, -60.0, 60.0, 3600.0, 1e5, 2.6e6]),
    st.integers(1, 50),
)
def test_a_clock_that_is_wrong_for_seconds_costs_no_row_before_or_after(seed, off_s, seconds):
    """Stamps of a gateway that has not heard the time yet, or was told a wrong one."""
    table = plant_table(seed, N)
    settings = SETTINGS.changed({'window_days': 1.0, 'refit_period': 0.0})
    readings = table_to_readings(table)
    border = len(readings) * 4 // 7
    slip = 5 * seconds  # five signals a row
    time_ns = readings.time_ns.copy()
    time_ns[border : border + slip] += round(off_s * NS_PER_S)
    wrong = Readings(time_ns, readings.signal, readings.value, readings.quality)
    monitor, true = Monitor(settings), Monitor(settings)
    for part, to in ((wrong, monitor), (readings, true)):
        aligner = Aligner(settings)
        for aligned in align_all(aligner, part):
            feed_aligned(to, aligned)
    times, segments = held(monitor)
    begun = readings.time_ns[border]
    # What was special then may have closed earlier or later, since the rows were broken off.
    safe_ns = begun - round((settings.settle_s + 60.0) * NS_PER_S)
    expected, before = held(true)
    assert [t for t in times if t < safe_ns] == [t for t in expected if t < safe_ns]
    assert [s for s in segments if s.end_ns < safe_ns] == [s for s in before if s.end_ns < safe_ns]
    assert times == sorted(set(times))
    after_ns = readings.time_ns[border + slip]
    assert set(times) >= {t for t in expected if t < begun or t > after_ns + 5 * NS_PER_S}


@pytest.mark.parametrize('late', [0, 25])
def test_a_recording_with_a_clock_set_back_is_repeated_from_its_readings(late):
    """The journal knows the restart; the replay's aligner finds it too, and must not count."""
    readings = joined(plant_table(1, 300), plant_table(2, 350, start_ns=START_NS - 10**13))
    aligner, live = Aligner(SETTINGS), LiveRun(SETTINGS, plant_table(0, 0))
    for aligned in (aligner.feed(readings), aligner.finish()):
        start = 0
        for end in [*aligned.resets.tolist(), len(aligned.table)]:
            live.table, live.done = aligned.table.part(start, end), 0
            live.waiting = [(row - start, task) for row, task in live.waiting]
            live.rows(end - start, late)
            if end < len(aligned.table):
                live.press('restart', 0)
            start = end
    replayer = JournalReplayer(Monitor(SETTINGS), live.journal())
    events = []
    for aligned in align_all(Aligner(SETTINGS), readings):
        events += replayer.feed(aligned.table)
    same(live.events, events)
    assert any(e.kind == JournalKind.RESET for e in live.journal())
    # With the line of the journal or, after a kill, without it: the rows tell it too.
    for journal in (live.journal(), [e for e in live.journal() if e.kind != JournalKind.RESET]):
        replayer, again = JournalReplayer(Monitor(SETTINGS), journal, left=[]), []
        for aligned in align_all(Aligner(SETTINGS), readings):
            again += replayer.feed_aligned(aligned)
        assert sum(e.kind == JournalKind.RESET for e in of_type(again, JournalEntry)) == 1
