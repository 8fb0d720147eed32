# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the page keeps of a unit: bounded, in the plant's time, each alarm's change told once."""

from __future__ import annotations

import math

import pytest
from page_units import alarm, predict, shown_now, told

from valveflow_ros.page.unit import MINUTES, MOST_UNITS, Day, Unit
from valveflow_ros.report.terminal.frame import SampleView

MINUTE = 60 * 10**9


def sample(second: float, measured: float, residual: float = 1.0) -> SampleView:
    nan = math.nan
    return SampleView(round(second * 1e9), 2, 1.0, measured, residual, nan, nan, nan, nan)


def test_a_minute_is_its_mean_and_its_extremes():
    day = Day()
    for second, measured in enumerate((10.0, 30.0, 20.0)):
        day.add(sample(second, measured, residual=float(second)))
    assert day.view() == ()
    day.add(sample(61, 1.0))
    (minute,) = day.view()
    assert (minute.start_ns, minute.measured_mw, minute.predicted_mw) == (0, 20.0, 19.0)
    assert (minute.low_mw, minute.high_mw) == (10.0, 30.0)


def test_a_day_is_kept_and_no_more():
    day = Day()
    for second in range(0, 3 * 86400, 30):
        day.add(sample(second, 1.0))
    view = day.view()
    assert len(view) <= MINUTES
    assert view[-1].start_ns - view[0].start_ns < 24 * 3600 * 10**9
    assert day.view() is view


def test_what_is_older_than_a_day_goes_also_after_a_gap():
    day = Day()
    day.add(sample(0, 1.0))
    day.add(sample(25 * 3600, 2.0))
    assert day.view() == ()


def test_a_clock_that_goes_back_begins_anew():
    day = Day()
    for second in (600, 700, 800, 0, 61):
        day.add(sample(second, 1.0))
    assert [m.start_ns for m in day.view()] == [0]


def test_bad_data_leave_a_minute_without_numbers():
    day = Day()
    day.add(sample(0, math.nan, math.nan))
    day.add(sample(60, 5.0, math.nan))
    day.add(sample(120, 5.0))
    nothing, unpredicted = day.view()
    assert math.isnan(nothing.measured_mw)
    assert (unpredicted.measured_mw, math.isnan(unpredicted.predicted_mw)) == (5.0, True)


def test_of_what_was_latched_only_what_stands_is_told():
    unit = Unit('m')
    for state in (1, 2, 0):
        alarm(unit, state, name='gone')
        alarm(unit, state or 1, name='stands')
    (change,) = unit.changes()
    assert (change.alarm.name, change.alarm.state, change.previous) == ('stands', 1, None)


def test_later_each_change_is_told_once_with_the_state_before():
    unit = Unit('m')
    predict(unit, 0)
    for _ in range(4):
        assert unit.changes() == []
    # A monitor that starts tells of each alarm that it is normal, which is no change.
    for state in (0, 1, 1, 2, 0):
        alarm(unit, state, second=7)
    found = unit.changes()
    assert [(c.previous, c.alarm.state) for c in found] == [(0, 1), (1, 2), (2, 0)]
    assert found[0].time_ns % 10**10 == 7 * 10**9
    alarm(unit, 0, second=9)
    assert unit.changes() == []


def test_alarms_and_changes_are_bounded():
    unit = Unit('m')
    for k in range(3000):
        alarm(unit, 1, name=f'alarm {k}')
    assert len(unit.changes()) <= 64
    assert len(unit.frame('m').alarms) <= 64


def test_a_page_has_so_many_units():
    units = [told(f'/m{k}', seconds=1) for k in range(MOST_UNITS + 3)]
    assert len(shown_now(*units).units) == MOST_UNITS


@pytest.mark.parametrize('tag', ['U1', ''])
def test_a_unit_without_a_tag_has_the_name_of_its_monitor(tag):
    (unit,) = shown_now(told('/m', tag)).units
    assert unit.title == (tag or '/m')
