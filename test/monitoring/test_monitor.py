# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import (
    QUICK_MONITOR,
    START_NS,
    blocks_of,
    cuts,
    examples,
    first_difference,
    frozen,
    grid_ns,
    of_type,
    plant_table,
    story,
    table_harms,
    table_of,
)

from valveflow_ros.errors import DataError, ParameterError
from valveflow_ros.fit.fit import fit
from valveflow_ros.fit.residual_chart import ResidualChart
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import AlarmChange, AlarmState
from valveflow_ros.monitoring.curves import CurveStatus
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    FitRequested,
    JournalEntry,
    JournalKind,
    ReferenceSet,
    SegmentClosed,
)
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import CLOCK_BACK, feed_rows
from valveflow_ros.monitoring.prediction import PredictionBlock, PredictionState
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SampleTable, Signal
from valveflow_ros.segments.segmenter import Segmenter
from valveflow_ros.signals.static_form import integrated_input

SETTINGS = Settings(QUICK_MONITOR)
N = 700
seeds = st.integers(0, 2**32 - 1)


def column(events, name):
    blocks = of_type(events, PredictionBlock)
    return np.concatenate([getattr(b, name) for b in blocks])


def with_curve(seed=0, n=N, settings=SETTINGS):
    """Return a monitor that has run for n rows, and its events."""
    monitor = Monitor(settings)
    events = feed_rows(monitor, plant_table(seed, n))
    assert monitor.characteristic is not None
    return monitor, events


def after(monitor, seed, n, harms=(), **more):
    """Return rows that follow on the monitor's last one."""
    return plant_table(seed, n, harms, start_ns=monitor.last_ns + NS_PER_S, **more)


# --- relations ------------------------------------------------------------------------------


@examples(25)
@given(seeds, table_harms(N), st.one_of(cuts(N, most=20), st.just(range(N))))
def test_any_cutting_gives_the_same_events_bit_for_bit(seed, harms, places):
    table = plant_table(seed, N, harms)
    whole = story(feed_rows(Monitor(SETTINGS), table))
    monitor, events = Monitor(SETTINGS), []
    for start, end in blocks_of(N, places):
        events += feed_rows(monitor, table.part(start, end))
    cut = story(events)
    assert not first_difference(whole, cut)
    assert cut == whole


@examples(20)
@given(seeds, table_harms(N))
def test_every_row_is_told_once_with_what_was_measured_and_segments_are_the_segmenters(
    seed, harms
):
    table = plant_table(seed, N, harms)
    monitor = Monitor(SETTINGS)
    events = feed_rows(monitor, table)
    u = integrated_input(
        table.column(Signal.VALVE_OPENING), table.column(Signal.MAIN_STEAM_PRESSURE)
    )
    power = table.column(Signal.GENERATED_POWER)
    assert (monitor.rows, monitor.last_ns) == (N, table.time_ns[-1])
    for name, measured in (('time_ns', table.time_ns), ('u', u), ('measured_mw', power)):
        assert np.array_equal(column(events, name), measured, equal_nan=True)
    bad = ~(np.isfinite(u) & np.isfinite(power))
    assert np.array_equal(column(events, 'state') == PredictionState.BAD_DATA, bad)
    alone = Segmenter(SETTINGS).feed(
        table.time_ns, u, power, table.column(Signal.MAIN_STEAM_TEMPERATURE)
    )
    assert [frozen(e.segment) for e in of_type(events, SegmentClosed)] == [
        frozen(f.segment) for _, f in alone.found
    ]


@examples(20)
@given(seeds, table_harms(N))
def test_bad_rows_never_poison_what_comes_later(seed, harms):
    """Once there is a curve, a calm hour later every number is finite again."""
    monitor = Monitor(SETTINGS)
    feed_rows(monitor, plant_table(1, N))
    feed_rows(monitor, after(monitor, seed, N, harms))
    events = feed_rows(monitor, after(monitor, 3, N))
    assert monitor.characteristic is not None
    late = slice(200, None)
    inside = column(events, 'state')[late] != PredictionState.OUTSIDE
    known = np.isfinite(column(events, 'residual_mw')[late])
    assert np.isfinite(column(events, 'static_mw')[late][inside]).all()
    assert np.isfinite(column(events, 'average_mw')[late][known]).all()
    settled = np.isin(
        column(events, 'state')[late], [PredictionState.STEADY, PredictionState.SLOPE]
    )
    assert np.array_equal(known, settled)
    assert settled.any()


@examples(15)
@given(seeds, table_harms(N, most=3), st.integers(-(10**5), 10**5))
def test_shifting_time_shifts_the_stamps_and_nothing_else(seed, harms, seconds):
    table = plant_table(seed, N, harms)
    shift = seconds * NS_PER_S
    here = feed_rows(Monitor(SETTINGS), table)
    there = feed_rows(
        Monitor(SETTINGS), SampleTable(table.time_ns + shift, table.values, table.quality)
    )
    for name in ('static_mw', 'residual_mw', 'average_mw', 'state'):
        assert frozen(column(here, name)) == frozen(column(there, name))
    # Where rows are cut into blocks of predictions depends on the hour; what happens does not.
    kinds = [
        [type(e) for e in events if not isinstance(e, PredictionBlock)] for events in (here, there)
    ]
    assert kinds[0] == kinds[1]
    for a, b in zip(of_type(here, AlarmChange), of_type(there, AlarmChange), strict=True):
        assert (a.time_ns + shift, a.state) == (b.time_ns, b.state)


@pytest.mark.parametrize('factor', [0.1, 10.0])
@pytest.mark.parametrize('harms', [[], [('fault', 300, 80), ('nan_u', 420, 9), ('leap', 500, 40)]])
def test_the_engine_has_no_second_of_its_own(factor, harms):
    """With every time scaled, the same values give the same story: 0.1 s data, 10 s data."""
    times = ('block', 'time_constant', 'delay', 'steady_min', 'slope_min', 'longest_segment',
             'refit_period', 'alarm_average', 'alarm_on_delay', 'alarm_off_delay',
             'alarm_block', 'alarm_suppress_time')  # fmt: skip
    base = SETTINGS.changed({'longest_segment': 600.0, 'window_days': 0.02})
    scaled = {name: base.real(name) * factor for name in times}
    scaled |= {'sample_period': factor, 'window_days': 0.02 * max(1.0, factor)}
    other = base.changed(scaled)
    table = plant_table(4, N, harms)
    since = table.time_ns - START_NS
    stretched = SampleTable(
        START_NS + np.round(since * factor).astype(np.int64), table.values, table.quality
    )
    here, there = feed_rows(Monitor(base), table), feed_rows(Monitor(other), stretched)
    assert frozen(column(here, 'state')) == frozen(column(there, 'state'))
    for name in ('static_mw', 'residual_mw', 'average_mw'):
        assert column(there, name) == pytest.approx(column(here, name), rel=1e-9, nan_ok=True)
    kinds = [[e.kind for e in of_type(events, JournalEntry)] for events in (here, there)]
    states = [[c.state for c in of_type(events, AlarmChange)] for events in (here, there)]
    assert kinds[0] == kinds[1]
    assert states[0] == states[1]
    for a, b in zip(of_type(here, SegmentClosed), of_type(there, SegmentClosed), strict=True):
        assert a.segment.samples == b.segment.samples
        assert b.segment.u_rate_per_s * factor == pytest.approx(a.segment.u_rate_per_s, abs=1e-9)


# --- fits -----------------------------------------------------------------------------------


def test_a_curve_comes_predicts_and_is_the_truth():
    monitor, events = with_curve(n=900)
    curve = monitor.characteristic
    u = np.linspace(1200.0, 1800.0, 13)
    inside = np.isfinite(curve(u))
    assert inside.sum() > 5
    assert curve(u)[inside] == pytest.approx((20.0 + 0.1 * u)[inside], abs=1.5)
    assert monitor.status == CurveStatus.FRESH
    assert monitor.cause == ''
    first = of_type(events, CurveAdopted)[0]
    at = events.index(first)
    before = sum(len(b) for b in of_type(events[:at], PredictionBlock))
    assert (column(events, 'state')[:before] == PredictionState.UNKNOWN).all()
    assert not (column(events, 'state')[before:] == PredictionState.UNKNOWN).any()


def test_fits_are_asked_for_after_so_many_segments_or_so_long_and_never_two_at_once():
    monitor = Monitor(SETTINGS)
    table = plant_table(0, N)
    done, asked = 0, []
    while done < N:
        fed = monitor.feed(table.part(done, N))
        done += fed.rows
        asked += of_type(fed.events, FitRequested)
    assert len(asked) == 1
    assert monitor.fit_pending
    assert monitor.adopt(asked[0].task.request_ns, fit(asked[0].task))
    assert not monitor.fit_pending


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({'refit_period': 0.0}, 0),
        ({'refit_segments': 0, 'refit_period': 864000.0}, 0),
        ({'min_fit_samples': 1700}, 0),
        ({'refit_segments': 1}, 5),
        ({'refit_segments': 0, 'refit_period': 60.0}, 5),
    ],
)
def test_when_fits_are_asked_for(changes, expected):
    monitor = Monitor(SETTINGS.changed(changes))
    events = feed_rows(monitor, plant_table(0, N))
    asked = len(of_type(events, FitRequested))
    assert asked == 0 if expected == 0 else asked >= expected


def test_a_task_holds_the_window_and_the_noise_of_its_moment():
    monitor = Monitor(SETTINGS)
    table = plant_table(0, N)
    fed = monitor.feed(table)
    (request,) = of_type(fed.events, FitRequested)
    task = request.task
    assert fed.rows < N
    assert task.request_ns == table.time_ns[fed.rows - 1] == monitor.last_ns
    assert task.contents.time_ns.tolist() == table.time_ns[: fed.rows].tolist()
    assert len(task.contents.spans) == len(of_type(fed.events, SegmentClosed))
    assert (task.input_noise, task.power_noise_mw) == (1.0, 0.3)
    before = frozen(task.contents)
    monitor.feed(table.part(fed.rows, N))
    assert frozen(task.contents) == before


def test_by_hand_only_one_at_a_time_and_only_with_segments():
    monitor = Monitor(SETTINGS.changed({'refit_period': 0.0}))
    with pytest.raises(DataError, match='no special segment'):
        monitor.request_fit()
    monitor.feed(plant_table(0, N))
    entry, request = monitor.request_fit()
    assert (entry.kind, entry.rows) == (JournalKind.FIT_REQUESTED, N)
    assert isinstance(request, FitRequested)
    with pytest.raises(DataError, match='running'):
        monitor.request_fit()


def test_an_outcome_nobody_waits_for_changes_nothing():
    monitor, _ = with_curve()
    curve = monitor.characteristic
    assert monitor.adopt(123, curve) == []
    assert monitor.refuse(123, 'why') == []
    assert monitor.characteristic is curve
    assert monitor.status == CurveStatus.FRESH


def test_a_refused_fit_leaves_the_old_curve_as_stale_and_says_why():
    monitor = Monitor(SETTINGS.changed({'refit_period': 0.0}))
    monitor.feed(plant_table(0, N))
    request = monitor.request_fit()[1]
    (entry,) = monitor.refuse(request.task.request_ns, 'Because.')
    assert (entry.kind, entry.text) == (JournalKind.FIT_REFUSED, 'Because.')
    assert (monitor.status, monitor.cause) == (CurveStatus.REFUSED, 'Because.')
    request = monitor.request_fit()[1]
    adopted = monitor.adopt(request.task.request_ns, fit(request.task))
    assert [type(e) for e in adopted] == [CurveAdopted, JournalEntry]
    request = monitor.request_fit()[1]
    monitor.refuse(request.task.request_ns, 'Again.')
    assert (monitor.status, monitor.cause) == (CurveStatus.STALE, 'Again.')
    assert monitor.characteristic is not None


def test_requests_never_share_a_name_even_when_time_comes_again():
    monitor = Monitor(SETTINGS)
    table = plant_table(0, N)
    names, curve = set(), None
    for _ in range(3):
        fed = monitor.feed(table)
        (request,) = of_type(fed.events, FitRequested)
        assert request.task.request_ns not in names
        names.add(request.task.request_ns)
        curve = curve or fit(request.task)
        monitor.restart(CLOCK_BACK)
        assert monitor.adopt(request.task.request_ns, curve) == []
    assert len(names) == 3


# --- alarms ---------------------------------------------------------------------------------


def test_a_fault_raises_one_alarm_which_stays_until_acknowledged_and_no_fit_mixes_it_in():
    monitor, _ = with_curve()
    before = monitor.characteristic
    events = feed_rows(monitor, after(monitor, 7, 400, [('fault', 100, 200)]))
    changes = [c for c in of_type(events, AlarmChange) if c.name == 'residual']
    assert [c.state for c in changes] == [
        AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED_UNACKNOWLEDGED,
    ]  # fmt: skip
    rows = column(events, 'time_ns')
    raised = int(np.searchsorted(rows, changes[0].time_ns))
    assert 100 < raised < 160
    assert 300 < int(np.searchsorted(rows, changes[1].time_ns)) < 360
    assert monitor.reference.curve is monitor.predicting
    for event in of_type(events, FitRequested):
        if event.task.request_ns > changes[0].time_ns:
            assert event.task.contents.time_ns[0] >= rows[80]
    assert of_type(events, ReferenceSet)[0].characteristic in (
        before,
        *(e.characteristic for e in of_type(events, CurveAdopted)),
    )
    change, *_, entry = monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)
    assert change.state == AlarmState.NORMAL
    assert entry.kind == JournalKind.ACKNOWLEDGE
    with pytest.raises(DataError, match='no alarm'):
        monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)


def test_an_outage_without_rows_raises_no_alarm():
    """The load was another one afterwards: nothing is wrong with the valve."""
    c = {'refit_period': 0.0}
    monitor, _ = with_curve()
    monitor.reconfigure(SETTINGS.changed(c))
    curve = monitor.characteristic
    low, high = curve.breakpoints[0] + 20.0, curve.breakpoints[-1] - 20.0
    n = 300
    u = np.where(np.arange(n) < 150, low, high)
    time_ns = grid_ns(n, start_ns=monitor.last_ns + NS_PER_S)
    time_ns[150:] += 3600 * NS_PER_S
    events = feed_rows(monitor, table_of(time_ns, u, 20.0 + 0.1 * u))
    assert of_type(events, AlarmChange) == []
    residual = column(events, 'residual_mw')
    assert np.nanmax(np.abs(residual)) < 3.0


def test_the_evidence_is_the_share_of_the_fixed_limit_or_what_the_chart_of_the_curve_says():
    monitor, _ = with_curve()
    part = plant_table(9, 400, [('fault', 0, 400)])
    events = feed_rows(monitor, part)
    average, evidence = column(events, 'average_mw'), column(events, 'evidence')
    assert evidence == pytest.approx(average / 3.0, nan_ok=True)
    other, _ = with_curve()
    held = {'alarm_limit': 0.0, 'refit_period': 0.0, 'refit_segments': 0}
    other.reconfigure(SETTINGS.changed(held))
    events = feed_rows(other, part)
    chart = ResidualChart(other.characteristic.residuals.chart, 1.0)
    wanted, _ = chart.feed(part.time_ns, column(events, 'residual_mw'))
    known = np.isfinite(wanted)
    assert known.sum() > 200
    assert column(events, 'evidence')[-200:] == pytest.approx(wanted[-200:])


# --- restarts and settings ------------------------------------------------------------------


@pytest.mark.parametrize('back_s', [20, 200, 2 * N])
def test_a_clock_that_goes_back_costs_the_rows_it_had_passed_and_no_more(back_s):
    monitor, _ = with_curve()
    curve, before = monitor.characteristic, monitor.special_segments()
    (entry,) = monitor.restart(CLOCK_BACK)
    assert (entry.kind, entry.text, entry.rows) == (JournalKind.RESET, CLOCK_BACK, N)
    assert monitor.characteristic is curve
    assert (monitor.status, monitor.cause) == (CurveStatus.STALE, CLOCK_BACK)
    assert monitor.special_segments() == before
    first_ns = monitor.last_ns - back_s * NS_PER_S
    more = plant_table(5, N, start_ns=first_ns)
    monitor.feed(more.part(0, 1))
    kept = monitor.special_segments()
    whole = tuple(s for s in before if s.end_ns < first_ns)
    assert kept[: len(whole)] == whole
    # What the step cuts is a segment up to there.
    cut = kept[len(whole) :]
    assert len(cut) == (back_s == 200)
    assert all(s.end_ns == first_ns - NS_PER_S for s in cut)
    events = feed_rows(monitor, more.part(1, N))
    assert monitor.status == CurveStatus.FRESH
    assert of_type(events, CurveAdopted)
    assert monitor.rows == 2 * N
    (_, request) = monitor.request_fit() if not monitor.fit_pending else (None, None)
    held = request.task.contents
    table = plant_table(0, N)
    assert held.time_ns.tolist() == [
        *(t for t in table.time_ns.tolist() if t < first_ns),
        *more.time_ns.tolist(),
    ]
    # A segment's rows are those of its time, whatever was let go between.
    for (a, b, _), found in zip(held.spans.tolist(), monitor.special_segments(), strict=True):
        assert (held.time_ns[a], held.time_ns[b - 1]) == (found.start_ns, found.end_ns)


def test_a_restart_refuses_the_fit_that_is_running():
    monitor = Monitor(SETTINGS)
    fed = monitor.feed(plant_table(0, N))
    (request,) = of_type(fed.events, FitRequested)
    refused, reset = monitor.restart(CLOCK_BACK)
    assert (refused.kind, reset.kind) == (JournalKind.FIT_REFUSED, JournalKind.RESET)
    assert refused.request_ns == request.task.request_ns
    assert not monitor.fit_pending


def test_an_alarm_is_raised_after_the_clock_went_back_too():
    monitor, _ = with_curve()
    feed_rows(monitor, after(monitor, 7, 60, [('fault', 57, 3)]))
    assert monitor.alarm.state == AlarmState.NORMAL
    monitor.restart(CLOCK_BACK)
    events = feed_rows(monitor, plant_table(8, 300, [('fault', 0, 300)]))
    assert AlarmState.UNACKNOWLEDGED in [c.state for c in of_type(events, AlarmChange)]


def test_live_settings_may_change_and_leave_an_entry_others_may_not():
    monitor, _ = with_curve()
    (entry,) = monitor.reconfigure(SETTINGS.changed({'alarm_limit': 7.0}))
    assert (entry.kind, entry.rows) == (JournalKind.SETTINGS, N)
    assert monitor.settings.real('alarm_limit') == 7.0
    assert monitor.reconfigure(monitor.settings) == []
    for name, value in (('sample_period', 2.0), ('time_constant', 3.0), ('refine', True)):
        changes = {name: value}
        if name == 'sample_period':
            changes['block'] = 2.0
        with pytest.raises(ParameterError, match=name):
            monitor.reconfigure(monitor.settings.changed(changes))
    assert monitor.settings.real('sample_period') == 1.0


# --- hostile --------------------------------------------------------------------------------


def test_no_rows_and_one_row():
    monitor = Monitor(SETTINGS)
    assert monitor.feed(plant_table(0, 0)).events == []
    fed = monitor.feed(plant_table(0, 1))
    assert fed.rows == 1
    assert column(fed.events, 'state').tolist() == [PredictionState.UNKNOWN]


@pytest.mark.parametrize('what', ['no_pressure', 'nan_u', 'nan_power', 'inf'])
def test_rows_without_a_usable_value_are_bad_from_beginning_to_end(what):
    monitor = Monitor(SETTINGS)
    events = feed_rows(monitor, plant_table(0, 300, [(what, 0, 300)]))
    assert (column(events, 'state') == PredictionState.BAD_DATA).all()
    assert all(isinstance(e, PredictionBlock) for e in events)
    with pytest.raises(DataError):
        monitor.request_fit()


def test_a_valve_that_never_moves_is_refused_with_the_reason():
    n = 400
    rng = np.random.default_rng(0)
    table = table_of(grid_ns(n), np.full(n, 1500.0), 170.0 + 0.15 * rng.normal(0.0, 1.0, n))
    monitor = Monitor(SETTINGS)
    events = feed_rows(monitor, table)
    refused = [e for e in of_type(events, JournalEntry) if e.kind == JournalKind.FIT_REFUSED]
    assert refused
    assert 'several openings' in refused[0].text
    assert monitor.status == CurveStatus.REFUSED


@pytest.mark.parametrize('offset', [1e6, -1e6])
def test_a_huge_offset_of_the_power_only_shifts_the_curve(offset):
    table = plant_table(0, N)
    shifted = SampleTable(table.time_ns, table.values.copy(), table.quality)
    shifted.values[:, Signal.GENERATED_POWER] += offset
    here, there = Monitor(SETTINGS), Monitor(SETTINGS)
    events = feed_rows(here, table), feed_rows(there, shifted)
    knots = here.characteristic.breakpoints
    assert there.characteristic.breakpoints == pytest.approx(knots, abs=1e-3)
    u = 0.5 * (knots[1:] + knots[:-1])
    assert there.characteristic(u) - offset == pytest.approx(here.characteristic(u), abs=1e-3)
    residual = [column(e, 'residual_mw') for e in events]
    assert residual[1] == pytest.approx(residual[0], abs=1e-3, nan_ok=True)


def test_read_only_tables_are_taken_and_not_written():
    table = plant_table(0, 300)
    for array in (table.time_ns, table.values, table.quality):
        array.setflags(write=False)
    events = feed_rows(Monitor(SETTINGS), table)
    assert not first_difference(story(events), story(feed_rows(Monitor(SETTINGS),
                                                               plant_table(0, 300))))  # fmt: skip


def test_events_do_not_change_when_more_rows_come():
    monitor = Monitor(SETTINGS)
    table = plant_table(0, N)
    first = feed_rows(monitor, table.part(0, 400))
    before = frozen(first)
    feed_rows(monitor, table.part(400, N))
    assert frozen(first) == before
    assert of_type(first, PredictionBlock)[0].time_ns[0] == START_NS
