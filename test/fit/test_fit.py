# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import (
    INTERPRETED,
    QUICK_MONITOR,
    examples,
    frozen,
    grid_ns,
    lagged,
    needs_jit,
    simulated,
)

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.fit.fit import fit, outline
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.segments.window import WindowContents

STATIC = Settings({**QUICK_MONITOR, 'alarm_average': 10.0})
REFINED = STATIC.changed({'refine': True, 'selection_rule': 'prediction_error', 'max_pieces': 6})
seeds = st.integers(0, 2**32 - 1)


def knee(u):
    """Return the flow of a valve that bends at 1500."""
    return np.where(u < 1500.0, 0.2 * u - 100.0, 0.05 * u + 125.0)


def window(seed=0, n=2400, noise=0.3, flow=knee, time_constant=0.0, temperature=540.0):
    """Return rows in holds of 60, of which the last 45 of each are a special segment."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.permutation(np.linspace(1100.0, 1900.0, n // 60)), 60)
    x = flow(u)
    power = x if time_constant == 0.0 else lagged(x, time_constant, 1.0)
    spans = [[k + 15, k + 60, 1] for k in range(0, n, 60)]
    return WindowContents(
        grid_ns(n), u + 0.2 * rng.normal(0.0, 1.0, n), power + noise * rng.normal(0.0, 1.0, n),
        np.full(n, temperature) + 0.5 * rng.normal(0.0, 1.0, n), np.array(spans, dtype=np.int64),
    )  # fmt: skip


def task(contents, settings=STATIC):
    return FitTask(int(contents.time_ns[-1]) if len(contents.time_ns) else 0, contents, settings,
                   0.7, 0.3)  # fmt: skip


def changed(contents, **columns):
    return dataclasses.replace(contents, **columns)


def usable(characteristic):
    """Assert that every number of a result can be worked with."""
    c = characteristic
    assert isinstance(c, Characteristic)
    assert np.all(np.diff(c.breakpoints) > 0.0)
    assert np.isfinite(c.model.slopes()).all()
    assert np.isfinite(c.model.intercepts()).all()
    assert all(d.time_constant_s > 0.0 and d.delay_s >= 0.0 for d in c.dynamics)
    assert math.isfinite(c.residuals.rmse_mw)
    assert c.residuals.average_sd_mw > 0.0
    assert len(c.model_id) == 12
    assert repr(from_json(to_json(c))) == repr(c)


# --- the static curve -----------------------------------------------------------------------


@examples(15)
@given(seeds)
def test_the_knee_and_both_slopes_are_found_within_their_errors(seed):
    c = fit(task(window(seed)))
    usable(c)
    assert len(c.pieces) == 2
    assert c.breakpoints[1] == pytest.approx(1500.0, abs=60.0)
    for piece, slope in zip(c.pieces, (0.2, 0.05), strict=True):
        assert piece.slope == pytest.approx(slope, abs=max(5.0 * piece.slope_stderr, 1e-3))
    assert sum(p.samples for p in c.pieces) == c.source.samples == 40 * 45
    assert (c.source.steady, c.source.slope_response) == (40, 0)
    assert (c.source.window_start_ns, c.source.window_end_ns) == tuple(grid_ns(2400)[[0, -1]])
    assert c.dynamics == ()
    assert c.partition_pieces == c.pieces
    assert set(c.choice.cost) == {1, 2, 3}
    assert all(c.choice.cost[j] >= c.choice.cost[j + 1] for j in (1, 2))


@examples(10)
@given(seeds)
def test_more_noise_gives_wider_errors_and_correlation_widens_them_further(seed):
    calm = fit(task(window(seed, noise=0.1))).pieces[0].slope_stderr
    rough = fit(task(window(seed, noise=1.0))).pieces[0].slope_stderr
    assert rough > 3.0 * calm
    contents = window(seed, noise=0.0)
    rng = np.random.default_rng(seed)
    slow = lagged(rng.normal(0.0, 1.0, 2400), 8.0, 0.0)
    white = rng.normal(0.0, slow.std(), 2400)
    errors = [
        fit(task(changed(contents, power_mw=contents.power_mw + e))).pieces[0].slope_stderr
        for e in (white, slow)
    ]
    assert errors[1] > 1.5 * errors[0]


@examples(12)
@given(seeds, st.sampled_from([(1.0, -3e3), (1.0, 128.0), (1.0, 1e6), (0.25, 0.0), (8.0, 0.0)]))
def test_shifting_and_scaling_the_power_shifts_and_scales_the_curve(seed, by):
    factor, more = by
    contents = window(seed)
    here = fit(task(contents))
    there = fit(task(changed(contents, power_mw=factor * contents.power_mw + more)))
    assert there.breakpoints == pytest.approx(here.breakpoints, abs=1e-6)
    assert there.values() - more == pytest.approx(factor * here.values(), rel=1e-9, abs=1e-4)
    for of in (lambda c: c.pieces[0].slope_stderr, lambda c: c.residuals.rmse_mw):
        assert of(there) == pytest.approx(factor * of(here), rel=1e-4)


@examples(10)
@given(seeds)
def test_rows_outside_special_segments_do_not_matter_to_the_static_curve(seed):
    contents = window(seed)
    other = contents.power_mw.copy()
    inside = np.zeros(len(other), dtype=bool)
    inside[contents.special_rows()] = True
    other[~inside] = np.random.default_rng(seed).normal(0.0, 500.0, (~inside).sum())
    here = fit(task(contents))
    there = fit(task(changed(contents, power_mw=other)))
    assert here.pieces == there.pieces


def test_the_same_task_gives_the_same_bits_and_is_not_written():
    contents = window(5)
    assert contents.covariates == {}
    before = frozen(contents)
    first, second = fit(task(contents)), fit(task(contents))
    assert frozen(contents) == before
    assert frozen(first) == frozen(second)
    assert first.model_id == second.model_id
    assert fit(task(window(6))).model_id != first.model_id


# --- what goes with it ----------------------------------------------------------------------


@pytest.mark.parametrize(('spread', 'flag'), [(0.0, False), (40.0, True), (math.nan, False)])
def test_a_temperature_that_wandered_is_flagged(spread, flag):
    contents = window()
    warm = 540.0 + spread * np.linspace(-0.5, 0.5, 2400)
    warm[::7] = np.nan
    c = fit(task(changed(contents, temperature_degc=warm)))
    known = math.isfinite(spread)
    assert c.source.temperature_flag == flag
    assert c.source.temperature_mean_degc == pytest.approx(
        540.0 if known else math.nan, abs=0.5, nan_ok=True
    )
    if known:
        assert c.source.temperature_spread_k == pytest.approx(0.95 * spread, rel=0.05)


@pytest.mark.parametrize('sd', [0.2, 1.0])
def test_the_alarms_standard_deviation_is_that_of_the_running_mean(sd):
    """For white noise an exponential mean has sd sqrt((1 - f) / (1 + f)) of it."""
    c = fit(task(window(3, n=6_000 if INTERPRETED else 24_000, noise=sd)))
    f = math.exp(-1.0 / 10.0)
    total = math.hypot(sd, 0.2 * 0.12)
    assert c.residuals.rmse_mw == pytest.approx(total, rel=0.1)
    assert c.residuals.average_sd_mw == pytest.approx(
        total * math.sqrt((1.0 - f) / (1.0 + f)), rel=0.3 if INTERPRETED else 0.15
    )
    assert (c.residuals.input_noise, c.residuals.power_noise_mw) == (0.7, 0.3)
    assert c.residuals.average_s == 10.0


# --- refusals -------------------------------------------------------------------------------


def empty(contents):
    nothing = np.empty(0)
    return WindowContents(grid_ns(0), nothing, nothing, nothing, np.empty((0, 3), dtype=np.int64))


def without(contents, **columns):
    """Return the window with constant columns and without special segments."""
    filled = {name: np.full(2400, value) for name, value in columns.items()}
    return changed(contents, spans=contents.spans[:0], **filled)


def loose(contents):
    rng = np.random.default_rng(1)
    power = np.repeat(rng.uniform(100.0, 300.0, 40), 60) + rng.normal(0.0, 1.0, 2400)
    return changed(contents, power_mw=power)


def constant(name, value):
    return lambda contents: changed(contents, **{name: np.full(2400, value)})


@pytest.mark.parametrize(
    ('harm', 'words'),
    [
        (empty, 'no row'),
        (lambda w: without(w, u=np.nan), 'opening, pressure and power'),
        (lambda w: without(w, power_mw=np.nan), 'opening, pressure and power'),
        (without, '0 found'),
        *((constant('u', value), 'several openings') for value in (0.0, 1500.0, 1e6)),
        *((constant('power_mw', value), 'hardly follows') for value in (0.0, 200.0, -1e6)),
        (loose, 'hardly follows'),
        (loose, '%'),
    ],
)
def test_what_gives_no_curve_is_refused_with_a_sentence(harm, words):
    with pytest.raises(DataError) as caught:
        fit(task(harm(window())))
    sentence = str(caught.value)
    assert words in sentence
    assert sentence.endswith('.')
    assert 'nan' not in sentence


def test_too_few_samples_are_refused_with_both_numbers():
    contents = window()
    few = changed(contents, spans=contents.spans[:1])
    with pytest.raises(TooFewSamplesError, match=r'45\b.*600') as caught:
        fit(task(few, STATIC.changed({'min_fit_samples': 600})))
    assert (caught.value.have, caught.value.need) == (45, 600)


@pytest.mark.parametrize('jitter', [0.0, 0.005])
def test_a_valve_that_stands_still_has_no_characteristic(jitter):
    """The pressure moves u, and the power with it, but that is no property of the valve."""
    r = np.random.default_rng(3)
    pressure = np.repeat(r.uniform(10.0, 16.0, 40), 60)

    def moved(opening):
        u = opening * pressure**1.125
        power = 0.15 * u + 20.0 + 0.3 * r.normal(size=2400)
        return task(changed(window(), u=u, power_mw=power, opening_percent=opening))

    still = 80.0 + jitter * r.normal(size=2400)
    for opening in (still, still.round(1 if jitter else 6)):  # also in the steps of a transmitter
        with pytest.raises(DataError, match=r'The valve did not move: .* transmitter'):
            fit(moved(opening))
    found = fit(moved(80.0 + 10.0 * np.repeat(r.uniform(-1.0, 1.0, 40), 60)))
    assert len(found.pieces) == 1
    assert found.choice.rule == 'paper'
    assert found.support[0].identifiable


# --- refined --------------------------------------------------------------------------------


@needs_jit
def test_a_refined_fit_has_dynamics_intervals_and_the_papers_curve_beside_it():
    c = fit(task(window(2, n=7200, time_constant=4.0), REFINED))
    usable(c)
    assert len(c.pieces) == 2
    assert len(c.dynamics) == 1
    region = c.dynamics[0]
    lag = region.time_constant_s + region.delay_s
    assert lag == pytest.approx(5.0, abs=0.7)
    ((low, high),) = c.breakpoint_intervals
    assert low < c.breakpoints[1] < high
    assert low < 1500.0 < high
    assert c.choice.rule == 'prediction_error'
    assert c.partition_pieces != c.pieces
    assert sum(p.samples for p in c.pieces) == c.source.samples


@needs_jit
def test_a_window_too_short_for_dynamics_keeps_the_static_curve_and_says_so():
    c = fit(task(window(2, n=2400, time_constant=4.0), REFINED))
    usable(c)
    assert c.dynamics == ()
    assert any('not refined' in note for note in c.notes)


def broken_up(contents, run):
    """Return the window with an outage after every ``run`` rows."""
    n = len(contents.time_ns)
    time_ns = contents.time_ns + np.arange(n) // run * 10**12
    return changed(contents, time_ns=time_ns)


def two_openings(contents):
    u = np.where(np.arange(len(contents.u)) // 60 % 2 == 0, 1200.0, 1800.0)
    return changed(contents, u=u, power_mw=knee(u))


HARMS = {
    'noise free': lambda w: changed(w, power_mw=knee(w.u)),
    'two openings': two_openings,
    'power is input': lambda w: changed(w, power_mw=w.u.copy()),
    'gaps shorter than the transient': lambda w: broken_up(w, 10),
    'gaps each minute': lambda w: broken_up(w, 60),
    'half without power': lambda w: changed(
        w, power_mw=np.where(np.arange(len(w.u)) % 120 < 60, w.power_mw, np.nan),
        spans=w.spans[::2],
    ),
    'no temperature': lambda w: changed(w, temperature_degc=np.full(len(w.u), np.nan)),
    'one spike': lambda w: changed(
        w, power_mw=np.where(np.arange(len(w.u)) == 77, 1e6, w.power_mw)
    ),
    'falling': lambda w: changed(w, power_mw=500.0 - w.power_mw),
    'huge offset': lambda w: changed(w, u=w.u + 1e6, power_mw=w.power_mw + 1e6),
    'tiny': lambda w: changed(w, u=w.u * 1e-6, power_mw=w.power_mw * 1e-6),
    'quantised': lambda w: changed(w, u=np.round(w.u, -2), power_mw=np.round(w.power_mw)),
    # A window holds doubles; a kernel for others would only be compiled for this test.
    'single precision': lambda w: changed(
        w, u=w.u.astype(np.float32).astype(float),
        power_mw=w.power_mw.astype(np.float32).astype(float),
    ),
}  # fmt: skip


@needs_jit
@pytest.mark.parametrize('settings', [STATIC, REFINED], ids=['static', 'refined'])
@pytest.mark.parametrize('harm', HARMS)
@pytest.mark.filterwarnings('error::RuntimeWarning')
def test_whatever_the_window_holds_comes_out_as_a_usable_curve_or_a_sentence(harm, settings):
    contents = HARMS[harm](window(4, n=4800))
    try:
        c = fit(task(contents, settings))
    except DataError as error:
        assert str(error).endswith('.')
        return
    usable(c)


# --- the simulated plant --------------------------------------------------------------------


@needs_jit
def test_four_days_of_the_simulated_plant_give_its_curve_and_dynamics():
    log, _ = simulated(4, 21)
    monitor = Monitor(Settings({'refit_period': 0.0}))
    feed_rows(monitor, log.table)
    request = monitor.request_fit()[1]
    c = fit(request.task)
    usable(c)
    truth = log.unit.curve
    assert len(c.pieces) == 4
    for piece, slope in zip(c.pieces, truth.slopes, strict=True):
        assert piece.slope == pytest.approx(slope, abs=4.5 * piece.slope_stderr)
        assert piece.slope_stderr < 0.004
    assert c.breakpoints[1:-1] == pytest.approx(truth.knots[1:-1], abs=30.0)
    for (low, high), knot in zip(c.breakpoint_intervals, truth.knots[1:-1], strict=True):
        assert low - (high - low) < knot < high + (high - low)
    assert len(c.dynamics) == 2
    assert c.dynamics[0].power_to == pytest.approx(240.0, abs=1.5)
    for found, true in zip(c.dynamics, log.unit.regions, strict=True):
        assert found.time_constant_s == pytest.approx(
            true.time_constant_s, abs=4.0 * found.time_constant_stderr_s
        )
        assert found.delay_s == pytest.approx(true.delay_s, abs=4.0 * found.delay_stderr_s)
        assert found.delay_stderr_s < 2.0
    u = np.linspace(c.breakpoints[0], c.breakpoints[-1], 200)
    assert np.abs(c(u) - truth(u)).max() < 2.5
    # The outline is what the fit has before its last step: near, and with the same regions.
    rough, _ = outline(request.task)
    assert rough.regions == len(c.dynamics)
    assert np.abs(rough.static(u) - c(u)).max() < 2.0


def test_an_outline_without_dynamics_is_refused():
    with pytest.raises(TooFewSamplesError, match='follow each other'):
        outline(task(broken_up(window(), 20)))
