# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import (
    QUICK_MONITOR,
    START_NS,
    after,
    blocks_of,
    column,
    cuts,
    examples,
    first_difference,
    frozen,
    of_type,
    plant_table,
    story,
    table_harms,
    taken_up,
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
BY_HAND = SETTINGS.changed({'refit_period': 0.0})
N = 700
seeds = st.integers(0, 2**32 - 1)


@cache
def _run():
    monitor = Monitor(SETTINGS)
    return monitor, feed_rows(monitor, plant_table(0, N))


def with_curve():
    """Return a monitor that has run for N rows and has a curve."""
    monitor = taken_up(_run()[0], Monitor(SETTINGS))
    assert monitor.characteristic is not None
    return monitor


def requested(monitor):
    (request,) = of_type(monitor.request_fit(), FitRequested)
    return request.task


# --- relations ------------------------------------------------------------------------------


@examples(20)
@given(seeds, table_harms(N), st.one_of(cuts(N, most=20), st.just(range(N))))
def test_any_cutting_gives_the_same_events_bit_for_bit(seed, harms, places):
    table = plant_table(seed, N, harms)
    whole = story(feed_rows(Monitor(SETTINGS), table))
    monitor, events = Monitor(SETTINGS), []
    for start, end in blocks_of(N, places):
        events += feed_rows(monitor, table.part(start, end))
    assert not first_difference(whole, story(events))


@examples(10)
@given(seeds, table_harms(N))
def test_every_row_is_told_once_with_what_was_measured_and_segments_are_the_segmenters(
    seed, harms
):
    table = plant_table(seed, N, harms)
    monitor = Monitor(SETTINGS)
    events = feed_rows(monitor, table)
    opening, pressure, warm, power = (table.column(s) for s in list(Signal)[:4])
    u = integrated_input(opening, pressure)
    assert (monitor.rows, monitor.last_ns) == (N, table.time_ns[-1])
    for name, measured in (('time_ns', table.time_ns), ('u', u), ('measured_mw', power)):
        assert np.array_equal(column(events, name), measured, equal_nan=True)
    bad = ~(np.isfinite(u) & np.isfinite(power))
    assert np.array_equal(column(events, 'state') == PredictionState.BAD_DATA, bad)
    alone = Segmenter(SETTINGS).feed(table.time_ns, u, power, warm)
    assert [frozen(e.segment) for e in of_type(events, SegmentClosed)] == [
        frozen(f.segment) for _, f in alone.found
    ]


@examples(10)
@given(seeds, table_harms(N))
def test_bad_rows_never_poison_what_comes_later(seed, harms):
    """A calm hour later every number is finite again."""
    monitor = with_curve()
    feed_rows(monitor, after(monitor, seed, N, harms))
    events = feed_rows(monitor, after(monitor, 3, N))
    state, residual, static, average = (
        column(events, name)[200:] for name in ('state', 'residual_mw', 'static_mw', 'average_mw')
    )
    settled = np.isin(state, [PredictionState.STEADY, PredictionState.SLOPE])
    assert settled.any()
    assert np.isfinite(static[state != PredictionState.OUTSIDE]).all()
    assert np.array_equal(np.isfinite(residual), settled)
    assert np.isfinite(average[settled]).all()


@examples(8)
@given(seeds, table_harms(N, most=3), st.integers(-(10**5), 10**5))
def test_shifting_time_shifts_the_stamps_and_nothing_else(seed, harms, seconds):
    table = plant_table(seed, N, harms)
    shift = seconds * NS_PER_S
    later = SampleTable(table.time_ns + shift, table.values, table.quality)
    here, there = (feed_rows(Monitor(SETTINGS), t) for t in (table, later))
    for name in ('static_mw', 'residual_mw', 'average_mw', 'state'):
        assert frozen(column(here, name)) == frozen(column(there, name))
    # Where rows are cut into blocks of predictions depends on the hour; what happens does not.
    kinds = [[type(e) for e in events if not isinstance(e, PredictionBlock)]
             for events in (here, there)]  # fmt: skip
    assert kinds[0] == kinds[1]
    for a, b in zip(of_type(here, AlarmChange), of_type(there, AlarmChange), strict=True):
        assert (a.time_ns + shift, a.state) == (b.time_ns, b.state)


@pytest.mark.parametrize('factor', [0.1, 10.0])
def test_the_engine_has_no_second_of_its_own(factor):
    """With every time scaled, the same values give the same story: 0.1 s data, 10 s data."""
    times = ('block', 'time_constant', 'delay', 'steady_min', 'slope_min', 'longest_segment',
             'refit_period', 'alarm_average', 'alarm_on_delay', 'alarm_off_delay',
             'alarm_block', 'alarm_suppress_time')  # fmt: skip
    base = SETTINGS.changed({'longest_segment': 600.0, 'window_days': 0.02})
    scaled = {name: base.real(name) * factor for name in times}
    scaled |= {'sample_period': factor, 'window_days': 0.02 * max(1.0, factor)}
    table = plant_table(4, N, [('fault', 300, 80), ('nan_u', 420, 9), ('leap', 500, 40)])
    time_ns = START_NS + np.round((table.time_ns - START_NS) * factor).astype(np.int64)
    here = feed_rows(Monitor(base), table)
    there = feed_rows(Monitor(base.changed(scaled)),
                      SampleTable(time_ns, table.values, table.quality))  # fmt: skip
    assert frozen(column(here, 'state')) == frozen(column(there, 'state'))
    for name in ('static_mw', 'residual_mw', 'average_mw'):
        assert column(there, name) == pytest.approx(column(here, name), rel=1e-9, nan_ok=True)
    told = [
        [e.kind for e in of_type(events, JournalEntry)]
        + [c.state for c in of_type(events, AlarmChange)]
        for events in (here, there)
    ]
    assert told[0] == told[1]
    for a, b in zip(of_type(here, SegmentClosed), of_type(there, SegmentClosed), strict=True):
        assert a.segment.samples == b.segment.samples
        assert b.segment.u_rate_per_s * factor == pytest.approx(a.segment.u_rate_per_s, abs=1e-9)


# --- fits -----------------------------------------------------------------------------------


def test_a_curve_comes_predicts_and_is_the_truth():
    monitor, events = _run()
    u = np.linspace(1200.0, 1800.0, 13)
    found = monitor.characteristic(u)
    inside = np.isfinite(found)
    assert inside.sum() > 5
    assert found[inside] == pytest.approx((20.0 + 0.1 * u)[inside], abs=1.5)
    assert (monitor.status, monitor.cause) == (CurveStatus.FRESH, '')
    at = events.index(of_type(events, CurveAdopted)[0])
    before = sum(len(b) for b in of_type(events[:at], PredictionBlock))
    unknown = column(events, 'state') == PredictionState.UNKNOWN
    assert np.array_equal(unknown, np.arange(N) < before)
    with pytest.raises(DataError, match='no special segment'):
        Monitor(SETTINGS).request_fit()


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({'refit_period': 0.0}, 0),
        ({'min_fit_samples': 1700}, 0),
        ({'refit_segments': 1}, 5),
        ({'refit_segments': 0, 'refit_period': 60.0}, 5),
    ],
)
def test_when_fits_are_asked_for(changes, expected):
    events = feed_rows(Monitor(SETTINGS.changed(changes)), plant_table(0, N))
    asked = len(of_type(events, FitRequested))
    assert asked == 0 if expected == 0 else asked >= expected


def test_a_task_holds_the_window_and_the_noise_of_its_moment_and_no_second_one_comes():
    monitor, table = Monitor(SETTINGS), plant_table(0, N)
    fed = monitor.feed(table)
    (request,) = of_type(fed.events, FitRequested)
    task = request.task
    assert fed.rows < N
    assert task.request_ns == table.time_ns[fed.rows - 1] == monitor.last_ns
    assert task.contents.time_ns.tolist() == table.time_ns[: fed.rows].tolist()
    assert len(task.contents.spans) == len(of_type(fed.events, SegmentClosed))
    assert (task.input_noise, task.power_noise_mw) == (1.0, 0.3)
    before = frozen(task.contents)
    assert not of_type(monitor.feed(table.part(fed.rows, N)).events, FitRequested)
    assert frozen(task.contents) == before
    assert monitor.fit_pending
    assert monitor.adopt(task.request_ns, fit(task))
    assert not monitor.fit_pending


def test_a_refused_fit_leaves_the_old_curve_as_stale_and_says_why():
    monitor = Monitor(BY_HAND)
    monitor.feed(plant_table(0, N))
    assert monitor.refuse(123, 'Nobody waits for this.') == []
    (entry,) = monitor.refuse(requested(monitor).request_ns, 'Because.')
    assert (entry.kind, entry.text) == (JournalKind.FIT_REFUSED, 'Because.')
    assert (monitor.status, monitor.cause) == (CurveStatus.REFUSED, 'Because.')
    task = requested(monitor)
    assert [type(e) for e in monitor.adopt(task.request_ns, fit(task))] == [
        CurveAdopted, JournalEntry,
    ]  # fmt: skip
    curve = monitor.characteristic
    monitor.refuse(requested(monitor).request_ns, 'Again.')
    assert (monitor.status, monitor.cause) == (CurveStatus.STALE, 'Again.')
    assert monitor.characteristic is curve


def test_requests_never_share_a_name_even_when_time_comes_again():
    monitor, table = Monitor(SETTINGS), plant_table(0, N)
    names, curve = set(), None
    for _ in range(3):
        (request,) = of_type(monitor.feed(table).events, FitRequested)
        names.add(request.task.request_ns)
        curve = curve or fit(request.task)
        # The fit that is running is refused.
        refused, reset = monitor.restart(CLOCK_BACK)
        assert (refused.kind, reset.kind) == (JournalKind.FIT_REFUSED, JournalKind.RESET)
        assert refused.request_ns == request.task.request_ns
        assert monitor.adopt(request.task.request_ns, curve) == []
    assert len(names) == 3


# --- alarms ---------------------------------------------------------------------------------


def test_a_fault_raises_one_alarm_which_stays_until_acknowledged_and_no_fit_mixes_it_in():
    monitor = with_curve()
    before = monitor.characteristic
    events = feed_rows(monitor, after(monitor, 7, 400, [('fault', 100, 200)]))
    changes = [c for c in of_type(events, AlarmChange) if c.name == 'residual']
    assert [c.state for c in changes] == [
        AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED_UNACKNOWLEDGED,
    ]  # fmt: skip
    rows = column(events, 'time_ns')
    raised, returned = (int(np.searchsorted(rows, c.time_ns)) for c in changes)
    assert 100 < raised < 160
    assert 300 < returned < 360
    assert monitor.reference.curve is monitor.predicting
    for event in of_type(events, FitRequested):
        if event.task.request_ns > changes[0].time_ns:
            assert event.task.contents.time_ns[0] >= rows[80]
    known = [before, *(e.characteristic for e in of_type(events, CurveAdopted))]
    assert of_type(events, ReferenceSet)[0].characteristic in known
    change, *_, entry = monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)
    assert change.state == AlarmState.NORMAL
    assert entry.kind == JournalKind.ACKNOWLEDGE
    with pytest.raises(DataError, match='no alarm'):
        monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)


def test_the_evidence_is_the_share_of_the_fixed_limit_or_what_the_chart_of_the_curve_says():
    part = plant_table(9, 400, [('fault', 0, 400)])
    events = feed_rows(with_curve(), part)
    average, evidence = column(events, 'average_mw'), column(events, 'evidence')
    assert evidence == pytest.approx(average / 3.0, nan_ok=True)
    monitor = with_curve()
    held = {'alarm_limit': 0.0, 'refit_period': 0.0, 'refit_segments': 0}
    monitor.reconfigure(SETTINGS.changed(held))
    events = feed_rows(monitor, part)
    chart = ResidualChart(monitor.characteristic.residuals.chart, 1.0)
    wanted, _ = chart.feed(part.time_ns, column(events, 'residual_mw'))
    assert np.isfinite(wanted).sum() > 200
    assert column(events, 'evidence')[-200:] == pytest.approx(wanted[-200:])


# --- restarts and settings ------------------------------------------------------------------


@pytest.mark.parametrize('back_s', [20, 200, 2 * N])
def test_a_clock_that_goes_back_costs_the_rows_it_had_passed_and_no_more(back_s):
    monitor = with_curve()
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
    contents = requested(monitor).contents
    earlier = [t for t in plant_table(0, N).time_ns.tolist() if t < first_ns]
    assert contents.time_ns.tolist() == [*earlier, *more.time_ns.tolist()]
    # A segment's rows are those of its time, whatever was let go between.
    for (a, b, _), found in zip(contents.spans.tolist(), monitor.special_segments(), strict=True):
        assert contents.time_ns[[a, b - 1]].tolist() == [found.start_ns, found.end_ns]


def test_live_settings_may_change_and_leave_an_entry_others_may_not():
    monitor = with_curve()
    (entry,) = monitor.reconfigure(SETTINGS.changed({'alarm_limit': 7.0}))
    assert (entry.kind, entry.rows) == (JournalKind.SETTINGS, N)
    assert monitor.settings.real('alarm_limit') == 7.0
    assert monitor.reconfigure(monitor.settings) == []
    for name, changes in (
        ('sample_period', {'sample_period': 2.0, 'block': 2.0}),
        ('time_constant', {'time_constant': 3.0}), ('refine', {'refine': True}),
    ):  # fmt: skip
        with pytest.raises(ParameterError, match=name):
            monitor.reconfigure(monitor.settings.changed(changes))
    assert monitor.settings.real('sample_period') == 1.0
