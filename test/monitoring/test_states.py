# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A monitor that is taken up where it was left: as if it had not been, or as far as can be.

A state made with other parameters, or by another version, costs only what depends on them.
"""

import copy
import lzma
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import (
    QUICK_MONITOR,
    START_NS,
    after,
    examples,
    first_difference,
    of_type,
    plant_table,
    story,
    table_harms,
    taken_up,
)

from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import AlarmState
from valveflow_ros.monitoring.events import FitRequested, JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import CLOCK_BACK, feed_rows, outcome_of
from valveflow_ros.parameters import TABLE, Depends, Settings
from valveflow_ros.records import NS_PER_S
from valveflow_ros.state import from_bytes, to_bytes

SETTINGS = Settings(QUICK_MONITOR)
N = 900
seeds = st.integers(0, 2**32 - 1)
OLD = {path.stem: path for path in sorted(Path(__file__).parent.glob('state_of_*.xz'))}
STAY = 'The curve, the reference and the alarms stay.'


def state_of(monitor):
    return from_bytes(to_bytes(monitor.snapshot()))


def fed(*tables, settings=SETTINGS):
    monitor = Monitor(settings)
    for table in tables:
        feed_rows(monitor, table)
    return monitor


@cache
def _calm():
    return to_bytes(fed(plant_table(3, N)).snapshot())


@cache
def _standing():
    monitor = fed(plant_table(3, N))
    assert monitor.characteristic is not None
    monitor.set_reference()
    feed_rows(monitor, after(monitor, 4, 300, [('fault', 40, 260)]))
    assert monitor.alarm.standing
    return to_bytes(monitor.snapshot())


def with_reference():
    """Return a monitor with a reference and a standing alarm on the residual, and its state."""
    monitor, saved = Monitor(SETTINGS), from_bytes(_standing())
    monitor.restore(saved)
    return monitor, from_bytes(_standing())


def carried(saved, changes, then=SETTINGS):
    """Return a monitor of other settings that goes on from a state, sentence and entries."""
    monitor = Monitor(then.changed(changes))
    return monitor, *monitor.carry(saved, then)


# --- the same settings ----------------------------------------------------------------------


@examples(20)
@given(seeds, table_harms(N), st.integers(0, N))
def test_a_monitor_taken_up_again_says_the_same(seed, harms, cut):
    table = plant_table(seed, N, harms)
    whole, first = Monitor(SETTINGS), Monitor(SETTINGS)
    expected = feed_rows(whole, table)
    events = feed_rows(first, table.part(0, cut))
    second = taken_up(first, Monitor(SETTINGS))
    kept = first.snapshot()
    before = to_bytes(kept)
    events += feed_rows(second, table.part(cut, N))
    assert first_difference(story(expected), story(events)) == ''
    assert to_bytes(second.snapshot()) == to_bytes(whole.snapshot())
    # A snapshot does not change when more rows come.
    feed_rows(first, table.part(cut, N))
    assert to_bytes(kept) == before


@pytest.mark.parametrize('cut', [N, N + 10, N + 30, N + 31, N + 60])
def test_a_leap_ahead_that_is_taken_back_costs_no_row_whenever_it_is_taken_up(cut):
    settings = SETTINGS.changed({'window_days': 0.03})
    parts = [
        plant_table(3, N), plant_table(4, 30, start_ns=START_NS + 40 * 86400 * NS_PER_S),
        plant_table(5, 100, start_ns=START_NS + (N + 30) * NS_PER_S),
    ]  # fmt: skip

    def run(cut):
        monitor, events = Monitor(settings), []
        for k, part in enumerate(parts):
            for row in range(len(part)):
                events += feed_rows(monitor, part.part(row, row + 1))
                monitor = taken_up(monitor, Monitor(settings)) if monitor.rows == cut else monitor
            if k == 1:
                events += monitor.restart(CLOCK_BACK)
                monitor = taken_up(monitor, Monitor(settings)) if monitor.rows == cut else monitor
        return monitor, events

    (whole, expected), (other, events) = run(-1), run(cut)
    assert first_difference(story(expected), story(events)) == ''
    assert to_bytes(other.snapshot()) == to_bytes(whole.snapshot())
    (request,) = of_type(other.request_fit(), FitRequested)
    assert request.task.contents.time_ns.tolist() == [
        *parts[0].time_ns.tolist(), *parts[2].time_ns.tolist(),
    ]  # fmt: skip


def test_a_clock_that_flaps_asks_no_more_fits_than_one_that_stands():
    monitor = Monitor(SETTINGS.changed({'refit_period': 2500.0, 'refit_segments': 0}))
    events = feed_rows(monitor, plant_table(3, 700))
    for k in range(10):
        events += monitor.restart(CLOCK_BACK)
        events += feed_rows(monitor, plant_table(4, 25, start_ns=10**12))
        begun_ns = START_NS + (700 + 100 * k) * NS_PER_S
        events += feed_rows(monitor, plant_table(5 + k, 40, start_ns=begun_ns))
    assert not of_type(events, FitRequested)
    later = START_NS + 1700 * NS_PER_S
    assert of_type(feed_rows(monitor, plant_table(20, 1000, start_ns=later)), FitRequested)


def scalars(state, at=()):
    """Yield the places of single values in a state; of a list, the first and the last entry."""
    ends = {0, len(state) - 1}
    for key, value in state.items() if isinstance(state, dict) else enumerate(state):
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
@pytest.mark.parametrize('every', [6, pytest.param(1, marks=pytest.mark.long)])
def test_a_state_with_one_value_changed_is_refused_or_goes_on(number, value, every):
    """What is refused is so before the first row; the restart catches these errors."""
    caught = (DataError, LookupError, TypeError, ValueError, AttributeError)
    saved = from_bytes(_calm())
    refused, tried = 0, 0
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
        feed_rows(second, plant_table(2, 60, start_ns=START_NS + N * NS_PER_S))
        assert from_bytes(to_bytes(second.snapshot())), path
    assert tried > 100 / every
    if value in (10**400, 'x'):
        assert refused > 0.3 * tried
    if value == 10**400:
        assert refused == tried


# --- other settings -------------------------------------------------------------------------

# Other values for which the settings still agree with each other.
ANOTHER = {
    'pressure_exponent': 1.1, 'time_constant': 1.0, 'delay': 2.0, 'block': 2.0,
    'longest_segment': 90.0, 'steady_min': 10.0, 'slope_min': 8.0, 'input_noise': 1.5,
    'power_noise': 0.5, 'break_limit': 6.0, 'steady_limit': 2.0, 'slope_limit': 6.0,
}  # fmt: skip


def test_every_parameter_that_segments_depend_on_is_tried_here():
    assert ANOTHER.keys() == {row.name for row in TABLE if row.depends == Depends.SEGMENTS}


def ranges(monitor):
    return [(s.kind, s.start_ns, s.end_ns, s.samples) for s in monitor.special_segments()]


@pytest.mark.parametrize('name', ANOTHER)
def test_segments_are_those_that_the_other_settings_find_in_the_same_rows(name):
    before, changes = Monitor(SETTINGS), {name: ANOTHER[name]}
    before.restore(from_bytes(_calm()))
    monitor, sentence, _ = carried(from_bytes(_calm()), changes)
    fresh = fed(plant_table(3, N), settings=SETTINGS.changed(changes))
    assert fresh.segments > 3
    assert f'{name} changed. Segments were found again in {N} rows.' in sentence
    numbers = [s.number for s in monitor.special_segments()]
    assert numbers == sorted(set(numbers))
    assert numbers[0] > max(s.number for s in before.special_segments())
    assert ranges(monitor) == ranges(fresh)
    found, wanted = (
        [[s.u_start, s.u_end, s.power_start_mw] for s in m.special_segments()]
        for m in (monitor, fresh)
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    # What is open goes on: later rows give the same segments too.
    for each in (monitor, fresh):
        feed_rows(each, after(each, 12, 300))
    assert ranges(monitor) == ranges(fresh)


@examples(10)
@given(seeds, table_harms(N), st.integers(1, N - 1))
def test_hostile_rows_are_segmented_anew_as_from_the_start(seed, harms, cut):
    table = plant_table(seed, N, harms)
    monitor, _, _ = carried(state_of(fed(table.part(0, cut))), {'steady_min': 10.0})
    fresh = fed(table.part(0, cut), settings=SETTINGS.changed({'steady_min': 10.0}))
    for each in (monitor, fresh):
        feed_rows(each, table.part(cut, N))
    assert ranges(monitor) == ranges(fresh)


def same_curves(one, other):
    return (
        one.characteristic == other.characteristic and one.predicting == other.predicting
        and one.reference.curve == other.reference.curve
        and one.reference.first == other.reference.first
    )  # fmt: skip


@pytest.mark.parametrize(
    'changes',
    [
        {'max_pieces': 5}, {'clock_jump': 20.0, 'lateness': 1.0}, {'time_constant': 3.0},
        {'sample_period': 2.0, 'block': 2.0},
    ],
    ids=lambda c: next(iter(c)),
)  # fmt: skip
def test_curve_reference_and_alarm_outlast_every_change_that_is_no_other_unit(changes):
    before, saved = with_reference()
    monitor, sentence, (entry,) = carried(saved, changes)
    assert same_curves(monitor, before)
    assert (monitor.alarm.last, monitor.alarm.state) == (before.alarm.last, before.alarm.state)
    assert entry.kind == JournalKind.SETTINGS
    assert sentence.startswith('Since the state was saved ')
    assert all(name in sentence and name in entry.text for name in changes)
    assert sentence.endswith(STAY)
    emptied = 'The window of rows is empty and fills again.' in sentence
    assert emptied == ('sample_period' in changes)
    # It goes on, with alarm and predictions.
    assert feed_rows(monitor, after(monitor, 9, 400))
    assert monitor.rows == before.rows + 400
    assert monitor.segments > 0


def test_a_shorter_window_keeps_its_newest_rows():
    then = SETTINGS.changed({'window_days': 0.03})
    before = fed(plant_table(3, 2500), settings=then)
    monitor, _, _ = carried(state_of(before), {'window_days': 0.02}, then)
    assert monitor.numbers().tolist() == before.numbers().tolist()[-1728:]
    assert monitor.special_segments() == before.special_segments()[-monitor.segments :]
    assert 0 < monitor.segments < before.segments


def test_a_reference_over_an_axis_that_is_no_longer_asked_for_is_let_go():
    before, saved = with_reference()
    monitor, sentence, _ = carried(saved, {'axis': 'opening'})
    assert monitor.reference.curve is None
    assert 'Discarded: the reference.' in sentence
    assert monitor.predicting == before.characteristic


# --- another version ------------------------------------------------------------------------


@pytest.mark.parametrize(
    'key', ['force', 'diagnosing', 'reference', 'alarm', 'segmenter', 'refits']
)
@pytest.mark.parametrize('part', [None, {}, ['of', 'another', 'kind']])
def test_a_part_of_another_version_costs_that_part_alone(key, part):
    before, saved = with_reference()
    saved[key] = part
    if part is None:
        del saved[key]
    monitor, sentence, entries = carried(saved, {})
    assert entries == []
    assert monitor.rows == before.rows
    assert len(monitor.numbers()) == len(before.numbers())
    assert (monitor.reference.curve == before.reference.curve) == (key != 'reference')
    assert (monitor.characteristic == before.characteristic) == (key != 'force')
    assert (monitor.alarm.last == before.alarm.last) == (key != 'alarm')
    assert ('Discarded' in sentence) == (key not in ('segmenter', 'refits'))
    assert monitor.predicting is not None
    feed_rows(monitor, after(monitor, 9, 100))
    assert monitor.rows == before.rows + 100


def test_inside_a_part_another_version_costs_the_smaller_one():
    before, saved = with_reference()
    saved['reference']['alarm'] = saved['force']['predictor'] = {'of': 'another version'}
    saved['diagnosing']['mismatch'] = {}
    monitor, sentence, _ = carried(saved, {})
    assert same_curves(monitor, before)
    assert sentence.count('Discarded') == sentence.count('Discarded: the alarm on its shift.') == 1


@pytest.mark.parametrize(
    ('lost', 'changes'),
    [
        (['rows'], {}), (['window', 'force', 'reference'], {}), ([], {'unit_tag': 'another'}),
        ([], {'main_steam_pressure_unit': 'bar'}), ([], {'model_file': 'x.json'}),
    ],
)  # fmt: skip
def test_of_what_nothing_can_be_used_or_of_another_unit_says_so(lost, changes):
    saved = {**from_bytes(_calm()), **dict.fromkeys(lost, 'x')}
    with pytest.raises(DataError, match='No part of it can be used'):
        carried(saved, changes)


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
    assert sentence.endswith(STAY)
    assert monitor.rows == len(monitor.numbers()) == 900
    assert monitor.characteristic.model_id == kept['force']['curve']['model_id']
    assert monitor.reference.curve.model_id == kept['reference']['curve']['model_id']
    assert (monitor.alarm.state, monitor.alarm.occurrence) == (AlarmState.UNACKNOWLEDGED, 1)
    assert monitor.segments == 18 or (monitor.segments > 10 and 'steady_min' in changes)
    change, *_ = monitor.operate_alarms(AlarmAction.ACKNOWLEDGE, 'residual')
    assert change.state == AlarmState.ACKNOWLEDGED
    assert of_type(feed_rows(monitor, after(monitor, 5, 600)), FitRequested)
    assert monitor.rows == 1500
    # It writes a state of today.
    taken_up(monitor, Monitor(then.changed(changes)))


# --- parameters of the chart, while the monitor runs -----------------------------------------

WATCHED = SETTINGS.changed({'alarm_limit': 0.0, 'alarm_block': 10.0, 'refit_segments': 0})


@cache
def _watched():
    monitor = fed(plant_table(3, N), settings=WATCHED)
    monitor.set_reference()
    return to_bytes(monitor.snapshot())


def watched():
    """Return a monitor whose reference watches its residual by a chart, and that reference."""
    monitor = Monitor(WATCHED)
    monitor.restore(from_bytes(_watched()))
    return monitor, monitor.reference.curve


def charts(monitor):
    return [c.residuals.chart for c in (monitor.reference.curve, monitor.predicting)]


@pytest.mark.parametrize(
    'changes', [{'alarm_floor': 20.0}, {'alarm_run_length': 300.0}, {'alarm_block': 20.0}],
    ids=lambda c: next(iter(c)),
)  # fmt: skip
def test_the_next_fit_brings_the_reference_a_chart_of_other_parameters(changes):
    monitor, before = watched()
    monitor.reconfigure(WATCHED.changed({'refit_share': 1.0}))
    assert not of_type(feed_rows(monitor, after(monitor, 4, 200)), FitRequested)
    assert charts(monitor) == [before.residuals.chart] * 2
    monitor.reconfigure(monitor.settings.changed(changes))
    assert of_type(feed_rows(monitor, after(monitor, 5, 200)), FitRequested)
    chart = monitor.characteristic.residuals.chart
    assert charts(monitor) == [chart, chart]
    assert chart != before.residuals.chart
    assert chart.block_s == changes.get('alarm_block', 10.0)
    # The curve itself is what it was.
    assert monitor.reference.curve.model_id == before.model_id
    assert monitor.reference.curve.pieces == before.pieces


def test_a_fit_under_way_brings_no_chart_of_parameters_that_changed_meanwhile():
    monitor, before = watched()
    (asked,) = of_type(monitor.request_fit(), FitRequested)
    monitor.reconfigure(monitor.settings.changed({'alarm_floor': 20.0}))
    outcome_of(monitor, asked.task)
    assert charts(monitor) == [before.residuals.chart] * 2
    feed_rows(monitor, after(monitor, 4, 300))
    assert charts(monitor)[0].innovation_mw > before.residuals.chart.innovation_mw


def test_a_reference_of_before_weather_was_known_learns_it_from_the_next_fit():
    monitor, before = watched()
    saved = state_of(monitor)
    for part in ('curve', 'first'):
        del saved['reference'][part]['residuals']['wander_mw']
    other = Monitor(WATCHED)
    other.restore(saved)
    assert math.isnan(other.reference.curve.residuals.wander_mw)
    feed_rows(other, after(other, 4, 300))
    assert other.reference.curve.residuals.wander_mw > 0.0
    assert other.reference.curve.model_id == before.model_id


def test_no_chart_is_taken_from_a_plant_in_which_something_is_wrong():
    monitor, before = watched()
    monitor.reconfigure(WATCHED.changed({'refit_period': 0.0}))
    feed_rows(monitor, after(monitor, 4, 300, [('fault', 40, 260)]))
    assert monitor.alarm.active
    monitor.reconfigure(monitor.settings.changed({'alarm_floor': 20.0, 'refit_period': 150.0}))
    feed_rows(monitor, after(monitor, 5, 400, [('fault', 0, 400)]))
    assert monitor.alarm.active
    assert charts(monitor) == [before.residuals.chart] * 2
