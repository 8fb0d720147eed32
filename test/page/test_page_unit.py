# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the page keeps of a unit, bounded and in the plant's time; its metrics for Prometheus."""

import json
import math
import re
from pathlib import Path

import pytest
from monitor_recording import START_NS
from page_units import alarm, predict, shown_now, told

from valveflow_ros.page.unit import MINUTES, MOST_UNITS, Day, Shown, Unit
from valveflow_ros.report.terminal.frame import SampleView

BOARD = Path(__file__).resolve().parents[2] / 'config' / 'grafana_board.json'


def day_of(*samples):
    """Return a day with samples of (second, measured, residual)."""
    day, nan = Day(), math.nan
    for second, mw, residual in samples:
        day.add(SampleView(round(second * 1e9), 2, 1.0, mw, residual, nan, nan, nan, nan))
    return day


def test_a_minute_is_its_mean_and_its_extremes():
    samples = [(second, mw, float(second)) for second, mw in enumerate((10.0, 30.0, 20.0))]
    assert day_of(*samples).view() == ()
    (minute,) = day_of(*samples, (61, 1.0, 1.0)).view()
    assert (minute.start_ns, minute.measured_mw, minute.predicted_mw) == (0, 20.0, 19.0)
    assert (minute.low_mw, minute.high_mw) == (10.0, 30.0)


def test_a_day_is_kept_and_no_more_also_after_a_gap_or_a_clock_that_goes_back():
    day = day_of(*((second, 1.0, 1.0) for second in range(0, 3 * 86400, 30)))
    view = day.view()
    assert len(view) <= MINUTES
    assert view[-1].start_ns - view[0].start_ns < 24 * 3600 * 10**9
    assert day.view() is view
    assert day_of((0, 1.0, 1.0), (25 * 3600, 2.0, 1.0)).view() == ()
    back = day_of(*((second, 1.0, 1.0) for second in (600, 700, 800, 0, 61)))
    assert [m.start_ns for m in back.view()] == [0]


def test_bad_data_leave_a_minute_without_numbers():
    nan = math.nan
    nothing, unpredicted = day_of((0, nan, nan), (60, 5.0, nan), (120, 5.0, 1.0)).view()
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


def test_alarms_changes_and_units_are_bounded():
    unit = Unit('m')
    for k in range(3000):
        alarm(unit, 1, name=f'alarm {k}')
    assert len(unit.changes()) <= 64
    assert len(unit.frame('m').alarms) <= 64
    units = [told(f'/m{k}', seconds=1) for k in range(MOST_UNITS + 3)]
    assert len(shown_now(*units).units) == MOST_UNITS


def test_a_unit_without_a_tag_has_the_name_of_its_monitor():
    units = shown_now(told('/m', 'U1', seconds=1), told('/n', '', seconds=1)).units
    assert [unit.title for unit in units] == ['U1', '/n']


# Its metrics.


@pytest.fixture(scope='module')
def text_of():
    pytest.importorskip('prometheus_client', reason='the page is an extra')
    from valveflow_ros.page.metrics import Metrics

    return lambda shown, *counters: Metrics(shown, *counters).text().decode()


@pytest.fixture(scope='module')
def values(text_of):
    """Return a function: each metric as the values by their labels' contents, the unit's first."""
    from prometheus_client.parser import text_string_to_metric_families as families

    def read(shown):
        found = {}
        for s in (s for family in families(text_of(shown)) for s in family.samples):
            labels = dict(s.labels)
            key = (labels.pop('unit', ''), *(labels[k] for k in sorted(labels)))
            found.setdefault(s.name, {})[key] = s.value
        return found

    return read


def test_the_metrics_say_what_is_known_of_a_unit(values):
    unit = told()
    alarm(unit, 2)
    found = values(shown_now(unit))
    for name, expected in {
        'monitor_up': 1.0, 'power_measured_watts': 254e6, 'power_residual_watts': 1.5e6,
        'power_predicted_watts': 252.5e6, 'alarm_evidence_ratio': 0.25,
        'sample_timestamp_seconds': START_NS / 1e9 + 199, 'curve_age_seconds': 431.5,
        'curve_pieces': 2.0, 'samples_total': 200.0,
    }.items():  # fmt: skip
        assert found[f'valveflow_{name}'] == {('U1',): pytest.approx(expected)}, name
    assert found['valveflow_input_messages_lost_total'] == {
        ('U1', 'valve_opening'): 4.0, ('U1', 'generated_power'): 0.0,
    }  # fmt: skip
    assert found['valveflow_health_level'][('U1', 'input valve_opening')] == 3.0
    states = found['valveflow_alarm_state']
    assert [key[2] for key, value in states.items() if value] == ['acknowledged']
    # 'unknown' is no number.
    assert 'valveflow_recorder_messages_dropped_total' not in found


def test_a_number_that_is_not_known_is_left_out_and_a_monitor_that_has_gone_is_down(values):
    unit = Unit('/m')
    predict(unit, 0, math.nan, math.nan)
    found = values(shown_now(unit))
    assert 'valveflow_power_measured_watts' not in found
    assert found['valveflow_monitor_up'] == {('U1',): 1.0}
    shown = Shown()
    shown.put([unit.snapshot(unit.frame('m'), present=False)])
    assert values(shown)['valveflow_monitor_up'] == {('U1',): 0.0}


def test_two_units_with_the_same_tag_are_told_apart_and_labels_are_escaped(values):
    odd = told('/b', tag='U"2\\\n')
    found = values(shown_now(told('/a'), told('/c'), odd))
    assert set(found['valveflow_monitor_up']) == {('/a',), ('/c',), ('U"2\\\n',)}


def test_names_follow_the_rules_of_prometheus_and_the_board_asks_for_no_others(text_of):
    unit, text = told(), BOARD.read_text()
    alarm(unit, 1)
    counters = {
        f'valveflow_notices_{name}': ('Told.', 1.0) for name in ('sent', 'failed', 'dropped')
    }
    there = set(re.findall(r'^# TYPE (\w+)', text_of(shown_now(unit), lambda: counters), re.M))
    assert [name for name in there if not re.fullmatch('valveflow(_[a-z]+)+', name)] == []
    targets = (t for panel in json.loads(text)['panels'] for t in panel.get('targets', ()))
    asked = {name for t in targets for name in re.findall(r'valveflow_\w+', t['expr'])}
    assert len(asked) >= 8
    assert {n.removesuffix('_total') for n in asked} <= {n.removesuffix('_total') for n in there}
    assert 'http://' not in text
