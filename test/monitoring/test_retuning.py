# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A state made with other parameters, or by another version, is used as far as it can be."""

from __future__ import annotations

import lzma
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import QUICK_MONITOR, examples, plant_table, table_harms

from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import AlarmState
from valveflow_ros.monitoring.events import FitRequested, JournalKind, ReferenceSet
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import CLOCK_BACK, feed_rows, outcome_of
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.parameters import TABLE, Depends, Settings
from valveflow_ros.records import NS_PER_S
from valveflow_ros.state import from_bytes, to_bytes

SETTINGS = Settings(QUICK_MONITOR)
N = 900
# Other values for which the settings still agree with each other.
ANOTHER = {
    'pressure_exponent': 1.1, 'time_constant': 1.0, 'delay': 2.0, 'block': 2.0,
    'longest_segment': 90.0, 'steady_min': 10.0, 'slope_min': 8.0, 'input_noise': 1.5,
    'power_noise': 0.5, 'break_limit': 6.0, 'steady_limit': 2.0, 'slope_limit': 6.0,
}  # fmt: skip


def saved_after(table, settings=SETTINGS):
    """Return a monitor that took rows, and its state by way of bytes."""
    monitor = Monitor(settings)
    feed_rows(monitor, table)
    return monitor, from_bytes(to_bytes(monitor.snapshot()))


def carried(saved, changes, then=SETTINGS):
    """Return a monitor of other settings that goes on from a state, sentence and entries."""
    monitor = Monitor(then.changed(changes))
    sentence, entries = monitor.carry(saved, then)
    return monitor, sentence, entries


def with_reference():
    """Return a monitor with a reference and an alarm on the residual that stands."""
    monitor = Monitor(SETTINGS)
    feed_rows(monitor, plant_table(3, N))
    assert monitor.characteristic is not None
    monitor.set_reference()
    later = int(monitor.last_ns) + NS_PER_S
    feed_rows(monitor, plant_table(4, 300, [('fault', 40, 260)], start_ns=later))
    assert monitor.alarm.standing
    return monitor


def test_every_parameter_that_segments_depend_on_is_tried_here():
    assert ANOTHER.keys() == {row.name for row in TABLE if row.depends == Depends.SEGMENTS}


@pytest.mark.parametrize('name', ANOTHER)
def test_segments_are_those_that_the_other_settings_find_in_the_same_rows(name):
    table, changes = plant_table(11, N), {name: ANOTHER[name]}
    before, saved = saved_after(table)
    monitor, sentence, _ = carried(saved, changes)
    fresh = Monitor(SETTINGS.changed(changes))
    feed_rows(fresh, table)
    assert fresh.segments > 3
    mine, theirs = (
        [(s.kind, s.start_ns, s.end_ns, s.samples) for s in m.special_segments()]
        for m in (monitor, fresh)
    )
    assert mine == theirs
    found, wanted = (
        np.array([[s.u_start, s.u_end, s.power_start_mw] for s in m.special_segments()])
        for m in (monitor, fresh)
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    assert monitor.rows == before.rows
    # What is open goes on: later rows give the same segments too.
    later = plant_table(12, 300, start_ns=int(table.time_ns[-1]) + NS_PER_S)
    for each in (monitor, fresh):
        feed_rows(each, later)
    assert [s.end_ns for s in monitor.special_segments()] == [
        s.end_ns for s in fresh.special_segments()
    ]
    assert f'{name} changed. Segments were found again in {N} rows.' in sentence
    numbers = [s.number for s in monitor.special_segments()]
    assert numbers == sorted(set(numbers))
    assert numbers[0] > max(s.number for s in before.special_segments())


@examples(20)
@given(st.integers(0, 2**32 - 1), table_harms(N), st.integers(1, N - 1))
def test_hostile_rows_are_segmented_anew_as_from_the_start(seed, harms, cut):
    table = plant_table(seed, N, harms)
    cut = min(cut, len(table))
    _, saved = saved_after(table.part(0, cut))
    monitor, _, _ = carried(saved, {'steady_min': 10.0})
    fresh = Monitor(SETTINGS.changed({'steady_min': 10.0}))
    feed_rows(fresh, table.part(0, cut))
    for each in (monitor, fresh):
        feed_rows(each, table.part(cut, len(table)))
    mine, theirs = (
        [(s.start_ns, s.end_ns) for s in m.special_segments()] for m in (monitor, fresh)
    )
    assert mine == theirs


def test_no_segment_goes_on_over_rows_that_were_thrown_out():
    monitor = Monitor(SETTINGS)
    table = plant_table(5, 600)
    feed_rows(monitor, table)
    monitor.restart(CLOCK_BACK)
    back_ns = int(table.time_ns[400])
    feed_rows(monitor, plant_table(6, 400, start_ns=back_ns))
    kept, _, _ = carried(from_bytes(to_bytes(monitor.snapshot())), {'steady_min': 8.0})
    assert kept.segments > 5
    for s in kept.special_segments():
        assert s.end_ns < back_ns or s.start_ns >= back_ns
        assert s.samples == (s.end_ns - s.start_ns) // NS_PER_S + 1


def same_curves(one, other):
    return (
        one.characteristic == other.characteristic and one.predicting == other.predicting
        and one.reference.curve == other.reference.curve
        and one.reference.first == other.reference.first
    )  # fmt: skip


@pytest.mark.parametrize(
    'changes',
    [
        {'max_pieces': 5}, {'window_days': 0.03}, {'clock_jump': 20.0, 'lateness': 1.0},
        {'valve_opening_high': 110.0}, {'steady_min': 10.0}, {'time_constant': 3.0},
        {'sample_period': 2.0, 'block': 2.0},
    ],
    ids=lambda c: next(iter(c)),
)  # fmt: skip
def test_curve_reference_and_alarm_outlast_every_change_that_is_no_other_unit(changes):
    before = with_reference()
    monitor, sentence, (entry,) = carried(from_bytes(to_bytes(before.snapshot())), changes)
    assert same_curves(monitor, before)
    assert monitor.alarm.last == before.alarm.last
    assert monitor.alarm.state == before.alarm.state
    assert entry.kind == JournalKind.SETTINGS
    assert sentence.startswith('Since the state was saved ')
    assert all(name in sentence and name in entry.text for name in changes)
    assert sentence.endswith('The curve, the reference and the alarms stay.')
    assert ('The window of rows is empty and fills again.' in sentence) == (
        'sample_period' in changes
    )
    # It goes on, with alarm and predictions.
    later = int(before.last_ns) + NS_PER_S
    events = feed_rows(monitor, plant_table(9, 400, start_ns=later))
    assert monitor.rows == before.rows + 400
    assert monitor.segments > 0
    assert events


def test_a_shorter_window_keeps_its_newest_rows():
    then = SETTINGS.changed({'window_days': 0.03})
    before, saved = saved_after(plant_table(3, 2500), then)
    monitor, _, _ = carried(saved, {'window_days': 0.02}, then)
    assert monitor.numbers().tolist() == before.numbers().tolist()[-1728:]
    newest = before.special_segments()[-monitor.segments :]
    assert monitor.special_segments() == newest
    assert 0 < monitor.segments < before.segments


@pytest.mark.parametrize(
    'changes',
    [{'main_steam_pressure_unit': 'bar'}, {'unit_tag': 'another'}, {'model_file': 'x.json'}],
    ids=lambda c: next(iter(c)),
)
def test_nothing_of_another_unit_is_used(changes):
    _, saved = saved_after(plant_table(3, N))
    with pytest.raises(DataError, match='No part of it can be used'):
        carried(saved, changes)


def test_a_reference_over_an_axis_that_is_no_longer_asked_for_is_let_go():
    before = with_reference()
    monitor, sentence, _ = carried(from_bytes(to_bytes(before.snapshot())), {'axis': 'opening'})
    assert monitor.reference.curve is None
    assert 'Discarded: the reference.' in sentence
    assert monitor.predicting == before.characteristic


def test_evidence_goes_on_over_a_change_of_segments():
    """A plant that has nearly raised its alarm is not given another day."""
    chart = SETTINGS.changed({'alarm_limit': 0.0, 'alarm_block': 10.0, 'refine': False})
    monitor = Monitor(chart)
    table = plant_table(3, N)
    feed_rows(monitor, table)
    monitor.set_reference()
    later = int(monitor.last_ns) + NS_PER_S
    feed_rows(monitor, plant_table(4, 40, [('fault', 10, 30)], start_ns=later))
    saved = from_bytes(to_bytes(monitor.snapshot()))
    other = Monitor(chart.changed({'steady_min': 10.0}))
    other.carry(saved, chart)
    for name in ('place', 'state', 'sums'):
        mine, theirs = (
            m.snapshot()['force']['predictor']['chart'][name] for m in (other, monitor)
        )
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize(
    'key', ['force', 'diagnosing', 'reference', 'alarm', 'segmenter', 'refits']
)
@pytest.mark.parametrize('how', ['absent', 'empty', 'other'])
def test_a_part_of_another_version_costs_that_part_alone(key, how):
    before = with_reference()
    saved = from_bytes(to_bytes(before.snapshot()))
    if how == 'absent':
        del saved[key]
    else:
        saved[key] = {} if how == 'empty' else ['of', 'another', 'kind']
    monitor, sentence, entries = carried(saved, {})
    assert entries == []
    assert monitor.rows == before.rows
    assert len(monitor.numbers()) == len(before.numbers())
    assert (monitor.reference.curve == before.reference.curve) == (key != 'reference')
    assert (monitor.characteristic == before.characteristic) == (key != 'force')
    assert (monitor.alarm.last == before.alarm.last) == (key != 'alarm')
    assert ('Discarded' in sentence) == (key not in ('segmenter', 'refits'))
    assert monitor.predicting is not None
    feed_rows(monitor, plant_table(9, 100, start_ns=int(before.last_ns) + NS_PER_S))
    assert monitor.rows == before.rows + 100


OLD = {path.stem: path for path in sorted(Path(__file__).parent.glob('state_of_*.xz'))}


@pytest.mark.parametrize('name', OLD)
@pytest.mark.parametrize('changes', [{}, {'steady_min': 8.0, 'alarm_floor': 2.0}], ids=['', 'new'])
def test_a_state_that_an_earlier_version_wrote_is_gone_on_with(name, changes):
    """Window, curve, reference and the alarm that stood then; it takes them where they were."""
    saved = from_bytes(lzma.decompress(OLD[name].read_bytes()))
    then = Settings.earlier(saved['settings'])
    assert saved['settings'].keys() < then.keys()
    # Today's name of the unit; it was '%' by default.
    changes = {'valve_opening_unit': 'percent', **changes}
    kept = saved['engine']['monitor']
    monitor, sentence, _ = carried(kept, changes, then)
    assert sentence.endswith('The curve, the reference and the alarms stay.')
    assert monitor.rows == len(monitor.numbers()) == 900
    assert monitor.characteristic.model_id == kept['force']['curve']['model_id']
    assert monitor.reference.curve.model_id == kept['reference']['curve']['model_id']
    assert (monitor.alarm.state, monitor.alarm.occurrence) == (AlarmState.UNACKNOWLEDGED, 1)
    assert monitor.segments == 18 or 'steady_min' in changes
    assert monitor.segments > 10
    change, *_ = monitor.operate_alarms(AlarmAction.ACKNOWLEDGE, 'residual')
    assert change.state == AlarmState.ACKNOWLEDGED
    later = int(monitor.last_ns) + NS_PER_S
    events = feed_rows(monitor, plant_table(5, 600, start_ns=later))
    assert monitor.rows == 1500
    assert [e for e in events if isinstance(e, FitRequested)]
    # It writes a state of today.
    again = Monitor(then.changed(changes))
    again.restore(from_bytes(to_bytes(monitor.snapshot())))


def test_a_shift_alarm_of_another_version_costs_no_reference():
    before = with_reference()
    saved = from_bytes(to_bytes(before.snapshot()))
    saved['reference']['alarm'] = {'of': 'another version'}
    monitor, sentence, _ = carried(saved, {})
    assert same_curves(monitor, before)
    assert 'Discarded: the alarm on its shift.' in sentence


def test_a_memory_of_the_predictor_of_another_version_costs_its_evidence_alone():
    before = with_reference()
    saved = from_bytes(to_bytes(before.snapshot()))
    saved['force']['predictor'] = {'of': 'another version'}
    saved['diagnosing']['mismatch'] = {}
    monitor, sentence, _ = carried(saved, {})
    assert same_curves(monitor, before)
    assert 'Discarded' not in sentence


@pytest.mark.parametrize('lost', [('rows',), ('window', 'force', 'reference')])
def test_of_what_nothing_can_be_used_says_so(lost):
    _, saved = saved_after(plant_table(3, N))
    for key in lost:
        saved[key] = 'x'
    with pytest.raises(DataError, match='No part of it can be used'):
        carried(saved, {})


def test_a_fit_is_asked_for_after_a_change_of_segments_although_none_is_new():
    settings = {**QUICK_MONITOR, 'refit_segments': 0, 'refit_period': 150.0, 'refit_share': 1.0}
    then = Settings(settings)
    before, saved = saved_after(plant_table(3, N), then)
    assert before.segments > 3
    monitor, _, _ = carried(saved, {'steady_min': 10.0}, then)
    later = int(before.last_ns) + NS_PER_S
    events = feed_rows(monitor, plant_table(9, 200, start_ns=later))
    assert [e for e in events if isinstance(e, FitRequested)]


# --- parameters of the alarms, while the monitor runs ----------------------------------------

WATCHED = SETTINGS.changed({'alarm_limit': 0.0, 'alarm_block': 10.0, 'refit_segments': 0})


def watched():
    """Return a monitor whose reference watches its residual by a chart, and that reference."""
    monitor = Monitor(WATCHED)
    feed_rows(monitor, plant_table(3, N))
    monitor.set_reference()
    return monitor, monitor.reference.curve


def predicted(events):
    """Return the running mean and the residual of the rows in events."""
    blocks = [e for e in events if isinstance(e, PredictionBlock)]
    return (np.concatenate([getattr(b, n) for b in blocks]) for n in ('average_mw', 'residual_mw'))


def charts(monitor):
    return [c.residuals.chart for c in (monitor.reference.curve, monitor.predicting)]


@pytest.mark.parametrize(
    'changes', [{'alarm_floor': 20.0}, {'alarm_run_length': 300.0}, {'alarm_block': 20.0}],
    ids=lambda c: next(iter(c)),
)  # fmt: skip
def test_the_next_fit_brings_the_reference_a_chart_of_other_parameters(changes):
    monitor, before = watched()
    monitor.reconfigure(WATCHED.changed({'refit_share': 1.0}))
    quiet = feed_rows(monitor, plant_table(4, 200, start_ns=int(monitor.last_ns) + NS_PER_S))
    assert not [e for e in quiet if isinstance(e, FitRequested)]
    assert charts(monitor) == [before.residuals.chart] * 2
    monitor.reconfigure(monitor.settings.changed(changes))
    later = int(monitor.last_ns) + NS_PER_S
    events = feed_rows(monitor, plant_table(5, 200, start_ns=later))
    assert [e for e in events if isinstance(e, FitRequested)]
    chart = monitor.characteristic.residuals.chart
    assert charts(monitor) == [chart, chart]
    assert chart != before.residuals.chart
    if 'alarm_block' in changes:
        assert chart.block_s == 20.0
    # The curve itself is what it was.
    assert monitor.reference.curve.model_id == before.model_id
    assert monitor.reference.curve.pieces == before.pieces


def test_a_fit_under_way_brings_no_chart_of_parameters_that_changed_meanwhile():
    monitor, before = watched()
    (asked,) = [e for e in monitor.request_fit() if isinstance(e, FitRequested)]
    monitor.reconfigure(monitor.settings.changed({'alarm_floor': 20.0}))
    outcome_of(monitor, asked.task)
    assert charts(monitor) == [before.residuals.chart] * 2
    feed_rows(monitor, plant_table(4, 300, start_ns=int(monitor.last_ns) + NS_PER_S))
    assert charts(monitor)[0].innovation_mw > before.residuals.chart.innovation_mw


def test_a_reference_of_before_weather_was_known_learns_it_from_the_next_fit():
    monitor, before = watched()
    saved = from_bytes(to_bytes(monitor.snapshot()))
    for part in ('curve', 'first'):
        del saved['reference'][part]['residuals']['wander_mw']
    other = Monitor(WATCHED)
    other.restore(saved)
    assert math.isnan(other.reference.curve.residuals.wander_mw)
    feed_rows(other, plant_table(4, 300, start_ns=int(monitor.last_ns) + NS_PER_S))
    assert other.reference.curve.residuals.wander_mw > 0.0
    assert other.reference.curve.model_id == before.model_id


def test_no_later_reference_brings_the_old_chart_back():
    """A curve that waits to be the reference was fitted with the old parameters."""
    soon = WATCHED.changed({'reference_after': 0.003})  # 259 s
    monitor = Monitor(soon)
    events = feed_rows(monitor, plant_table(3, N))
    monitor.reconfigure(soon.changed({'alarm_floor': 20.0, 'refit_period': 100.0}))
    for seed in range(4, 10):
        later = int(monitor.last_ns) + NS_PER_S
        events += feed_rows(monitor, plant_table(seed, 200, start_ns=later))
        for chart in (monitor.characteristic.residuals.chart, *charts(monitor)):
            # Half of the floor is not beyond one innovation.
            assert chart.innovation_mw >= 0.999 * 10.0 * (1.0 - chart.correlation)
    assert [e for e in events if isinstance(e, ReferenceSet)]


def test_no_chart_is_taken_from_a_plant_in_which_something_is_wrong():
    monitor, before = watched()
    monitor.reconfigure(WATCHED.changed({'refit_period': 0.0}))
    later = int(monitor.last_ns) + NS_PER_S
    feed_rows(monitor, plant_table(4, 300, [('fault', 40, 260)], start_ns=later))
    assert monitor.alarm.active
    monitor.reconfigure(monitor.settings.changed({'alarm_floor': 20.0, 'refit_period': 150.0}))
    later = int(monitor.last_ns) + NS_PER_S
    feed_rows(monitor, plant_table(5, 400, [('fault', 0, 400)], start_ns=later))
    assert monitor.alarm.active
    assert charts(monitor) == [before.residuals.chart] * 2


def test_the_running_mean_has_another_time_constant_at_once():
    monitor, _ = watched()
    rows = plant_table(4, 300, start_ns=int(monitor.last_ns) + NS_PER_S)
    average, residual = predicted(feed_rows(watched()[0], rows))
    at = int(np.flatnonzero(np.isfinite(residual[1:]) & np.isfinite(average[:-1]))[-1]) + 1
    feed_rows(monitor, rows.part(0, at))
    monitor.reconfigure(WATCHED.changed({'alarm_average': 100.0}))
    (changed, _) = predicted(feed_rows(monitor, rows.part(at, at + 1)))
    forget = np.exp(-1.0 / 100.0)
    expected = forget * average[at - 1] + (1.0 - forget) * residual[at]
    np.testing.assert_allclose(changed[0], expected, rtol=1e-12)


def test_other_parameters_of_the_chart_at_the_start_are_in_force_after_the_next_fit_too():
    monitor, before = watched()
    saved = from_bytes(to_bytes(monitor.snapshot()))
    other, sentence, _ = carried(saved, {'alarm_floor': 20.0, 'max_pieces': 4}, WATCHED)
    assert sentence.startswith('Since the state was saved max_pieces changed.')
    assert charts(other) == [before.residuals.chart] * 2
    feed_rows(other, plant_table(4, 300, start_ns=int(monitor.last_ns) + NS_PER_S))
    assert charts(other)[0] != before.residuals.chart
