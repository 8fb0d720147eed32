# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A monitor that is taken up where it was left goes on bit for bit as if it had not been."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import (
    QUICK_MONITOR,
    START_NS,
    examples,
    first_difference,
    plant_table,
    story,
    table_harms,
)

from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarms import ShiftAlarm
from valveflow_ros.monitoring.curves import Refits
from valveflow_ros.monitoring.events import FitRequested
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import CLOCK_BACK, feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S
from valveflow_ros.state import from_bytes, to_bytes

SETTINGS = Settings(QUICK_MONITOR)
N = 700
seeds = st.integers(0, 2**32 - 1)


def again(made, fresh):
    """Return a fresh object that goes on where ``made`` is, by way of bytes."""
    fresh.restore(from_bytes(to_bytes(made.snapshot())))
    return fresh


@examples(25)
@given(seeds, table_harms(N), st.integers(0, N))
def test_a_monitor_taken_up_again_says_the_same(seed, harms, cut):
    table = plant_table(seed, N, harms)
    n = len(table)
    cut = min(cut, n)
    whole = Monitor(SETTINGS)
    expected = feed_rows(whole, table)
    first = Monitor(SETTINGS)
    events = feed_rows(first, table.part(0, cut))
    second = again(first, Monitor(SETTINGS))
    events += feed_rows(second, table.part(cut, n))
    assert first_difference(story(expected), story(events)) == ''
    assert to_bytes(second.snapshot()) == to_bytes(whole.snapshot())


@pytest.mark.parametrize('cut', [N, N + 10, N + 30, N + 31, N + 60])
def test_a_leap_ahead_that_is_taken_back_costs_no_row_whenever_it_is_taken_up(cut):
    settings = SETTINGS.changed({'window_days': 0.03})
    parts = [
        plant_table(3, N),
        plant_table(4, 30, start_ns=START_NS + 40 * 86400 * NS_PER_S),
        plant_table(5, 100, start_ns=START_NS + (N + 30) * NS_PER_S),
    ]

    def run(taken_up):
        monitor, events = Monitor(settings), []
        for k, part in enumerate(parts):
            for row in range(len(part)):
                events += feed_rows(monitor, part.part(row, row + 1))
                if taken_up and monitor.rows == cut:
                    monitor = again(monitor, Monitor(settings))
            if k == 1:
                events += monitor.restart(CLOCK_BACK)
                if taken_up and monitor.rows == cut:
                    monitor = again(monitor, Monitor(settings))
        return monitor, events

    (whole, expected), (other, events) = run(False), run(True)
    assert first_difference(story(expected), story(events)) == ''
    assert to_bytes(other.snapshot()) == to_bytes(whole.snapshot())
    (request,) = [e for e in other.request_fit() if isinstance(e, FitRequested)]
    assert request.task.contents.time_ns.tolist() == [
        *parts[0].time_ns.tolist(), *parts[2].time_ns.tolist(),
    ]  # fmt: skip


def test_a_clock_that_flaps_asks_no_more_fits_than_one_that_stands():
    settings = SETTINGS.changed({'refit_period': 2500.0, 'refit_segments': 0})
    monitor = Monitor(settings)
    events = feed_rows(monitor, plant_table(3, N))
    for k in range(10):
        events += monitor.restart(CLOCK_BACK)
        events += feed_rows(monitor, plant_table(4, 25, start_ns=10**12))
        begun_ns = START_NS + (N + 100 * k) * NS_PER_S
        events += feed_rows(monitor, plant_table(5 + k, 40, start_ns=begun_ns))
    assert not [e for e in events if isinstance(e, FitRequested)]
    later = START_NS + (N + 1000) * NS_PER_S
    events = feed_rows(monitor, plant_table(20, 1000, start_ns=later))
    assert [e for e in events if isinstance(e, FitRequested)]


def test_taking_a_snapshot_changes_nothing_and_it_does_not_change_any_more():
    table = plant_table(5, N)
    monitor = Monitor(SETTINGS)
    feed_rows(monitor, table.part(0, 400))
    taken = monitor.snapshot()
    before = to_bytes(taken)
    assert to_bytes(monitor.snapshot()) == before
    feed_rows(monitor, table.part(400, N))
    assert to_bytes(taken) == before


def test_a_state_of_other_settings_is_refused():
    monitor = Monitor(SETTINGS)
    feed_rows(monitor, plant_table(1, N))
    other = Monitor(Settings({**QUICK_MONITOR, 'block': 2.0 * SETTINGS.real('block')}))
    with pytest.raises(DataError, match='saved state'):
        other.restore(monitor.snapshot())


def test_an_empty_monitor_has_a_state_too():
    monitor = again(Monitor(SETTINGS), Monitor(SETTINGS))
    assert monitor.rows == 0
    assert story(feed_rows(monitor, plant_table(2, 50))) == story(
        feed_rows(Monitor(SETTINGS), plant_table(2, 50))
    )


def test_what_was_being_computed_is_asked_for_again_although_no_segment_is_new():
    settings = Settings({**QUICK_MONITOR, 'refit_segments': 0})
    refits = Refits()
    refits.segments_seen = 5
    refits.ask(10)
    assert not refits.due(20, False, True, settings, 5)
    saved = from_bytes(to_bytes(refits.snapshot()))
    again_there = Refits()
    again_there.restore(saved)
    again_there.ask_again()
    assert again_there.pending_ns is None
    assert again_there.due(20, False, True, settings, 5)
    assert again_there.ask(15) > refits.pending_ns


def test_a_restored_alarm_keeps_to_the_settings_of_the_monitor():
    nervous = Settings({**QUICK_MONITOR, 'alarm_latch': False, 'alarm_shelve_time': 60.0})
    monitor = again(Monitor(nervous), Monitor(nervous))
    fresh, default = ShiftAlarm(nervous), ShiftAlarm(Settings())
    for name, value in vars(fresh).items():
        if isinstance(value, bool | int | float):
            assert vars(monitor.reference.alarm)[name] == value
    assert vars(fresh) != vars(default)


def scalars(state, at=()):
    """Yield the places of single values in a state; of a list, the first and the last entry."""
    ends = {0, len(state) - 1}
    items = state.items() if isinstance(state, dict) else enumerate(state)
    for key, value in items:
        if isinstance(state, list) and key not in ends:
            continue
        if isinstance(value, dict | list):
            yield from scalars(value, (*at, key))
        elif not isinstance(value, np.ndarray):
            yield (*at, key)


@pytest.mark.parametrize(
    ('number', 'value'),
    list(enumerate([np.nan, np.inf, -1, 0, 10**400, 'x', None, [], True])),
    ids=lambda value: repr(value)[:9],
)
@pytest.mark.parametrize('every', [3, pytest.param(1, marks=pytest.mark.long)])
def test_a_state_with_one_value_changed_is_refused_or_goes_on(number, value, every):
    """What is refused is so before the first row; the restart catches these errors."""
    caught = (DataError, LookupError, TypeError, ValueError, AttributeError)
    table = plant_table(2, 1560)
    first = Monitor(SETTINGS)
    feed_rows(first, table.part(0, 1500))
    saved, refused, tried = first.snapshot(), 0, 0
    for path in list(scalars(saved))[number % every :: every]:
        state = copy.deepcopy(saved)
        inside = state
        for key in path[:-1]:
            inside = inside[key]
        inside[path[-1]] = value
        second = Monitor(SETTINGS)
        tried += 1
        try:
            second.restore(from_bytes(to_bytes(state)))
        except caught:
            refused += 1
            continue
        feed_rows(second, table.part(1500, 1560))
        assert from_bytes(to_bytes(second.snapshot())), path
    assert tried > 100 / every
    if value in (10**400, 'x'):
        assert refused > 0.3 * tried
    if value == 10**400:
        assert refused == tried
