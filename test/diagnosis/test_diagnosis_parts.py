# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The parts of the diagnosis, each against an obvious truth."""

from __future__ import annotations

import itertools
import json
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_records import record, rough_model, table, unit
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import null_space
from scipy.signal import lfilter
from scipy.stats import multivariate_normal
from streams import needs_jit

from valveflow_ros.curve.regional_model import respond
from valveflow_ros.diagnosis import kernels, record_faults, search
from valveflow_ros.diagnosis import structure as structures
from valveflow_ros.diagnosis.cause import FittedCause, SentenceValues, Stage
from valveflow_ros.diagnosis.causes import catalogue, causes_for
from valveflow_ros.diagnosis.evidence import chance_of_gain, colour
from valveflow_ros.diagnosis.extended import (
    Extended,
    ExtendedModel,
    answer,
    drive,
    flow_of,
    region_path,
)
from valveflow_ros.diagnosis.fitting import (
    Task,
    base_mask,
    base_tangents,
    cause_tangents,
    held,
    improve,
    whitening,
)
from valveflow_ros.diagnosis.grids import ORDER, SEALED_FOLD, make_grids
from valveflow_ros.diagnosis.result import model_from_json, model_to_json
from valveflow_ros.diagnosis.screening import Screening
from valveflow_ros.diagnosis.search import Rival, SearchResult, _add, simplified
from valveflow_ros.diagnosis.slow import wander_lead
from valveflow_ros.diagnosis.structure import likelier_over_hours, structure, variables, wander
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.records import SampleTable, Signal
from valveflow_ros.signals.static_form import OPENING, StaticForm

pytestmark = needs_jit
NAMES = {
    'temperature', 'exponent', 'choked', 'gain_drift', 'input_drift', 'output_offset_drift',
    'gain_step', 'input_step', 'curve_step', 'intervals', 'diurnal', 'backlash', 'stiction',
    'rate_limit', 'saturation', 'region_lag', 'reheater', 'clock', 'curve_shape',
}  # fmt: skip
TYPICAL = {
    'temperature': (-6e-4,), 'exponent': (0.05,), 'choked': (0.038,), 'gain_drift': (0.01,),
    'input_drift': (0.01,), 'output_offset_drift': (2.0,), 'gain_step': (0.006, 0.2),
    'input_step': (0.006, 0.2), 'curve_step': (-2.5, 1450.0, 1750.0, 0.2), 'intervals': (0.01,),
    'diurnal': (0.005, 5.0), 'backlash': (0.6,), 'stiction': (1.0, 0.7), 'rate_limit': (0.1,),
    'saturation': (84.0,), 'region_lag': (30.0, 5.0, 250.0), 'reheater': (0.3, 20.0),
    'clock': (5.0,), 'curve_shape': (1.5, 1425.0, 150.0),
}  # fmt: skip


HOURS_BEFORE = 'load of hours before'


@pytest.fixture(scope='module')
def grids():
    samples = table(0.4, 2, (), unit())
    bad = np.zeros(samples.values.shape, dtype=bool)
    return make_grids(*record(samples).about, bad)


def test_the_catalogue_holds_what_it_promises():
    assert set(catalogue()) == NAMES == set(TYPICAL)
    for name, cause in catalogue().items():
        assert cause.name == name
        assert set(cause.confusers) <= NAMES - {name}
        assert cause.experiment.endswith('.')
        keys = [u.name for u in cause.unknowns]
        said = cause.sentence(SentenceValues(zip(keys, TYPICAL[name], strict=True)))
        assert said.endswith('.')
        assert said[0].isupper()


@pytest.mark.parametrize('name', sorted(NAMES))
def test_every_cause_changes_the_answer_and_nothing_is_nothing(grids, name):
    plain = Extended(rough_model())
    cause = catalogue()[name]
    extra = (3600.0, 9000.0) if name == 'intervals' else ()
    changed = answer(grids, plain.with_cause(FittedCause(cause, TYPICAL[name], extra)))
    assert np.isfinite(changed).all()
    assert np.abs(changed - answer(grids, plain))[grids.scored].max() > 1e-3


@pytest.mark.parametrize('switches', [(), (0.3,), (0.2, 0.7), (0.2, 0.4, 0.8)])
def test_what_is_switched_stays_so_after_the_record_in_which_it_was_found(grids, switches):
    act = catalogue()['intervals'].act
    span = 0.5 * grids.reference.span_s
    earlier = replace(grids, reference=replace(grids.reference, span_s=span))
    factor = act((0.01,), earlier, tuple(span * x for x in switches))
    state = np.searchsorted(np.array(switches) * span, grids.time_s, side='right') % 2
    assert factor - factor[0] == pytest.approx(0.01 * state)
    assert factor[grids.time_s < span].mean() == pytest.approx(1.0, abs=1e-4)


def test_an_answer_is_the_same_whatever_was_asked_before(grids):
    stiction = FittedCause(catalogue()['stiction'], TYPICAL['stiction'])
    free = Extended(rough_model()).with_cause(stiction)
    ar = np.zeros(ORDER)
    path = held(replace(grids, cache={}), free, ar)  # the path of the plug as estimated
    used = replace(grids, cache={})
    answer(used, free)
    for model in (path, free, path):
        np.testing.assert_array_equal(answer(used, model), answer(replace(grids, cache={}), model))
    assert np.abs(answer(used, path) - answer(used, free))[grids.scored].max() > 0.01


def test_a_piece_that_only_sealed_blocks_visit_stays_as_it_is(grids):
    model, u = rough_model(), grids.means(grids.u)
    plain = Extended(model)
    task = Task(grids, grids.open_rows & (u > model.knots[2] + 20.0), np.zeros(ORDER))
    # By the lags, the rows above tell something of the pieces below, but not enough.
    found, cost = improve(task, plain, 12)
    assert cost < 0.95 * task.cost(plain)
    assert found.base.left[0] == model.left[0]
    assert found.base.left[1] == pytest.approx(model.left[1], abs=15.0)


def test_a_model_without_a_lag_is_not_worse_than_the_plain_model(grids):
    task = Task(grids, grids.open_rows, np.zeros(ORDER))
    plain, cost = improve(task, Extended(rough_model()), 12)
    reheater = FittedCause(catalogue()['reheater'], TYPICAL['reheater'])
    # Lags that suit the model with the reheater only: three steps do not lead back from them.
    far = replace(plain.base, time_constants=np.array([400.0, 0.5]))
    found = SearchResult(task, Extended(far).with_cause(reheater), plain, plain)
    assert task.cost(found.without('reheater')) <= cost


@pytest.mark.parametrize('name', sorted(NAMES))
def test_tangents_of_causes_predict_small_changes(grids, name):
    cause = catalogue()[name]
    if cause.stage in (Stage.OPENING, Stage.DYNAMICS):
        pytest.skip('not smooth, or it changes regions')
    extra = (3600.0, 9000.0) if name == 'intervals' else ()
    # One region: nothing can flip.
    model = replace(
        rough_model(), levels=np.empty(0), time_constants=np.array([20.0]), delays=np.array([4.0])
    )
    here = Extended(model, (FittedCause(cause, TYPICAL[name], extra),))
    task = Task(grids, grids.whole, np.zeros(ORDER))
    tangent = cause_tangents(task, here)[:, 0]
    values = list(TYPICAL[name])
    by = 0.3 * cause.unknowns[0].step
    values[0] += by
    moved = answer(grids, Extended(model, (FittedCause(cause, tuple(values), extra),)))
    change = moved - answer(grids, here)
    assert np.abs(change - by * tangent).max() <= 0.1 * np.abs(change).max() + 1e-9


@pytest.mark.parametrize('name', ['curve_shape', 'curve_step'])
def test_places_on_the_curve_are_in_the_unit_of_its_axis(grids, name):
    """The same bump in % of opening at a constant pressure gives the same answer and bounds."""
    per_percent = 25.0  # V p^m of one percent
    values = TYPICAL[name]
    opening = replace(
        grids, u=grids.u / per_percent, form=StaticForm(OPENING), scale=np.ones(len(grids.u))
    )
    one, other = causes_for(grids)[name], causes_for(opening)[name]
    places = [u.unit == '% MPa^m' for u in one.unknowns]
    assert [u.unit for u in other.unknowns] == [
        '%' if place else u.unit for u, place in zip(one.unknowns, places, strict=True)
    ]

    def on_opening(of):
        return tuple(v / per_percent if p else v for v, p in zip(of, places, strict=True))

    for attribute in ('low', 'high', 'step'):
        bounds = (getattr(u, attribute) for u in one.unknowns)
        assert [getattr(u, attribute) for u in other.unknowns] == pytest.approx(on_opening(bounds))
    narrow = (1.5, 1425.0, 30.0) if name == 'curve_shape' else (-2.5, 1450.0, 1452.0, 0.2)
    for size in (values, narrow):
        assert other.clipped(on_opening(size)) == on_opening(size)
        np.testing.assert_allclose(
            other.act(opening.u, on_opening(size), opening), one.act(grids.u, size, grids),
            atol=1e-9,
        )  # fmt: skip
        model = Extended(
            replace(rough_model(), offset_mw=0.0), (FittedCause(other, on_opening(size)),)
        )
        kept = model_to_json(ExtendedModel(model, opening.form, 5, grids.reference))
        assert model_from_json(kept).model.active == model.active


@pytest.mark.parametrize(
    'causes',
    [
        {}, {'reheater': (0.5, 12.0)}, {'clock': (3.0,), 'reheater': (0.3, 20.0)},
        {'gain_step': (0.1, 0.2), 'curve_shape': (2.0, 1450.0, 200.0)},
        {'region_lag': (40.0, 6.0, 150.0), 'output_offset_drift': (5.0,)},
    ],
    ids=lambda causes: '+'.join(causes) or 'none',
)  # fmt: skip
def test_tangents_of_curve_and_dynamics_are_those_of_central_differences(grids, causes):
    usable = grids.usable.copy()
    usable[3000:3020] = usable[9001] = 0
    grids, known = replace(grids, usable=usable, cache={}), causes_for(grids)
    base = rough_model()
    base = replace(
        base, left=base.left + np.append(0.0, np.full(base.pieces - 1, 4.0)),  # with jumps
        delays=np.array([2.7, 12.4]), offset_mw=3.0,
    )  # fmt: skip
    model = Extended(base, tuple(FittedCause(known[n], v) for n, v in causes.items()))
    task = Task(grids, grids.whole, np.zeros(ORDER))
    columns, packed = base_tangents(task, model), base.pack()
    driven = drive(grids, model)
    path = region_path(model, flow_of(model, driven))
    inner = slice(base.pieces + 1, 2 * base.pieces)
    whole = usable.reshape(-1, grids.group).all(axis=1)
    for column, p in zip(columns.T, np.flatnonzero(base_mask(task, model)), strict=True):
        knot = inner.start <= p < inner.stop
        by = 1e-3 * np.ptp(base.knots) if knot else 1e-5 * (1.0 + abs(packed[p]))
        ends = []
        for sign in (1.0, 0.0) if knot else (1.0, -1.0):
            moved = packed.copy()
            moved[p] += sign * by
            moved = replace(model, base=base.unpack(moved))
            ends.append(answer(grids, moved, driven, path))
        true = (ends[0] - ends[1]) / (by if knot else 2.0 * by)
        near = pytest.approx(true[whole], rel=1e-4, abs=1e-4 * np.abs(true).max())
        assert column[whole] == near


def naive_play(v, half):
    out, plug = [], v[0]
    for here in v:
        if here - plug > half:
            plug = here - half
        elif plug - here > half:
            plug = here + half
        out.append(plug)
    return np.array(out)


@given(st.lists(st.floats(0.0, 100.0), min_size=1, max_size=60), st.floats(0.0, 5.0))
def test_play_is_what_one_would_write_down(values, half):
    v = np.array(values)
    out = np.empty(len(v))
    kernels.play(v, half, out)
    np.testing.assert_allclose(out, naive_play(v, half), atol=1e-12)
    assert np.all(np.abs(out - v) <= half + 1e-12)


@given(st.lists(st.floats(0.0, 100.0), min_size=1, max_size=60), st.floats(0.01, 5.0))
def test_sticking_without_a_jump_is_play(values, band):
    v = np.array(values)
    stuck, loose = np.empty(len(v)), np.empty(len(v))
    kernels.stick_slip(v, band, 0.0, stuck)
    kernels.play(v, 0.5 * band, loose)
    np.testing.assert_allclose(stuck, loose, atol=1e-9)


@given(st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=9), st.floats(0.1, 2.0))
def test_the_hidden_path_is_the_cheapest(costs, penalty):
    cost = np.array(costs)
    path = np.empty(len(cost), dtype=np.uint8)
    kernels.viterbi(cost, penalty, path)

    def price(states):
        switches = int(states[0]) + sum(a != b for a, b in itertools.pairwise(states))
        return float(np.dot(states, cost)) + penalty * switches

    best = min(price(states) for states in itertools.product((0, 1), repeat=len(cost)))
    assert price(path) == pytest.approx(best, abs=1e-9)


@given(
    st.lists(st.floats(0.01, 30.0), min_size=1, max_size=60),
    st.floats(0.5, 240.0), st.sampled_from([0.0, 0.03, 1.0, 1e4]), st.integers(0, 99),
)  # fmt: skip
def test_a_wander_is_whitened_as_by_its_dense_covariance(gaps_h, scale_h, ratio, seed):
    rng, k = np.random.default_rng(seed), len(gaps_h)
    hours = np.cumsum(gaps_h)
    load, noise, table = (
        rng.uniform(0.4, 1.2, k),
        rng.uniform(0.5, 4.0, k),
        rng.normal(size=(k, 3)),
    )
    apart = np.abs(hours[:, None] - hours)
    covariance = np.diag(noise) + ratio * np.exp(-apart / scale_h) * np.outer(load, load)
    factor = np.linalg.cholesky(covariance)
    white = np.empty_like(table)
    level = kernels.whiten_wander(hours, load, noise, ratio, scale_h, table, white)
    assert white == pytest.approx(np.linalg.solve(factor, table), rel=1e-6, abs=1e-8)
    assert level == pytest.approx(np.log(np.diag(factor)).sum(), rel=1e-8, abs=1e-8)


@given(st.integers(1, 40), st.sampled_from([1, 2, 4, 8]), st.integers(1, 5), st.integers(0, 999))
def test_sums_of_knots_are_products_of_dense_matrices(m, corners, width, seed):
    rng, knots = np.random.default_rng(seed), 9
    at = np.array([rng.permutation(knots)[:corners] for _ in range(m)])
    weight = rng.random((m, corners)) * (rng.random((m, corners)) < 0.8)
    band, across, toward = rng.normal(size=(m, width)), rng.normal(size=(m, 3)), rng.normal(size=m)
    basis, dense = np.zeros((m, knots)), np.zeros((m, m))
    np.put_along_axis(basis, at, weight, axis=1)
    for k in range(min(width, m)):
        upper = np.diag(band[: m - k, k], k)
        dense += upper if k == 0 else upper + upper.T
    halves, sums_across, sums_toward = (
        np.zeros(s) for s in ((2, knots, knots), (knots, 3), knots)
    )
    kernels.sums_of_knots(at, weight, band, across, toward, halves, sums_across, sums_toward)
    assert halves[0] + halves[1] + halves[1].T == pytest.approx(basis.T @ dense @ basis, abs=1e-12)
    assert sums_across == pytest.approx(basis.T @ across, abs=1e-12)
    assert sums_toward == pytest.approx(basis.T @ toward, abs=1e-12)


def test_means_are_those_of_the_filter_of_single_rows(grids):
    x = rough_model().static(grids.u)
    path = np.zeros(len(x), dtype=np.uint8)
    taps = rough_model().taps(grids.step_s)
    usable = grids.usable.copy()
    usable[1000:1010] = 0
    rows, means = np.empty(len(x)), np.empty(len(grids.power))
    respond(x, usable, np.empty(0), taps, 0, rows, usable.copy())
    rows[usable == 0] = 0.0
    kernels.respond_means(x, usable, path, taps, grids.group, means)
    np.testing.assert_allclose(means, grids.means(rows), rtol=1e-12)


def test_every_fifth_block_is_sealed_and_in_no_fit(grids):
    assert not np.any(grids.open_rows & grids.sealed_rows)
    assert np.array_equal(grids.open_rows | grids.sealed_rows, grids.whole)
    assert set(grids.fold_of_sub[grids.sub[grids.sealed_rows]]) == {SEALED_FOLD}


@pytest.mark.parametrize('variable', ['ramp', 'u'])
def test_the_size_of_a_remaining_structure_is_that_of_the_effect(grids, variable):
    # Noise that lasts for minutes, and an effect that comes and goes or lasts for hours.
    plain, ar = Extended(rough_model()), np.array([0.95, 0.0, 0.0, 0.0])
    task = Task(grids, grids.open_rows, ar)
    x = variables(task, plain)[variable]
    effect = 1.5 * np.sign(x - np.median(x[grids.open_rows]))
    noise = np.random.default_rng(5).normal(0.0, 0.1, len(x))
    for k in range(1, len(noise)):
        noise[k] += 0.95 * noise[k - 1]
    seen = Task(replace(grids, power=answer(grids, plain) + effect + noise), task.rows, ar)
    found = structure(seen, plain, Screening(seen, plain))
    assert variable in found.variables
    true_mw2 = float(np.var(effect[grids.open_rows]))
    assert 0.3 * true_mw2 < found.explained_mw2 < 2.0 * true_mw2


@given(
    st.lists(st.sampled_from([3, 4, 5]), min_size=1, max_size=3), st.floats(-0.3, 0.9),
    st.floats(0.0, 0.2), st.floats(0.0, 3.0), st.integers(0, 999),
)  # fmt: skip
def test_a_gain_is_that_of_the_dense_marginal_likelihood(counts, ar, gaps, size, seed):
    m, rng = 250, np.random.default_rng(seed)
    rows = rng.random(m) >= gaps
    rows[:ORDER] = False
    task = Task(SimpleNamespace(mean_s=10.0), rows, np.array([ar, -0.1, 0.05, 0.02]))
    path = {f'x{k}': np.cumsum(rng.normal(size=m)) for k in range(len(counts))}
    pairs = list(zip(path.items(), counts, strict=True))
    parts = tuple(structures._part(*named, rows, count) for named, count in pairs)
    nuisance = rng.normal(size=(rows.sum(), 3))
    series = size * np.tanh(path['x0']) + rng.normal(size=m)
    whitening_matrix = np.eye(m) - sum(
        a * np.eye(m, k=-lag) for lag, a in enumerate(task.ar, start=1)
    )
    basis = np.ones((m, 1))
    for (_, values), count in pairs:
        knots = np.quantile(values[rows], np.linspace(0.01, 0.99, count))
        hats = np.column_stack([np.interp(values, knots, hat) for hat in np.eye(count)])
        basis = np.einsum('ni,nj->nij', basis, hats).reshape(m, -1)
    beside = null_space(nuisance.T)
    white, e = (
        beside.T @ (whitening_matrix @ basis)[rows],
        beside.T @ (whitening_matrix @ series)[rows],
    )
    left = beside @ e
    noise = left @ left / len(left) * colour(task, left)
    without = multivariate_normal.logpdf(e, cov=noise * np.eye(len(e)))
    gains = [
        multivariate_normal.logpdf(e, cov=noise * np.eye(len(e)) + variance * white @ white.T)
        - without
        for variance in (np.array(structures._PRIORS) * np.std(series[rows])) ** 2
    ]
    test = structures._FunctionTest(task, nuisance, series)
    assert test.gain(parts) == pytest.approx(max(gains), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_a_valve_that_power_control_moves_by_the_noise_is_no_structure(grids, monkeypatch, seed):
    plain = Extended(rough_model())
    noise = np.random.default_rng(seed).normal(0.0, 1.0, len(grids.power))
    control = np.repeat(lfilter([-10.0], [1.0, -0.98], noise), grids.group)
    share = 1.0 + control / np.maximum(grids.u, 1.0)
    v = grids.v * np.repeat(share, len(grids.v) // len(grids.u))
    moved = replace(grids, u=grids.u * share, v=v, cache={})
    seen = replace(moved, power=answer(moved, plain) + noise)
    task = Task(seen, seen.open_rows, np.zeros(ORDER))
    assert structure(task, plain, Screening(task, plain)).gain < structures.LEAST_GAIN
    monkeypatch.setattr(structures, '_moves', lambda task, u: np.empty((task.rows.sum(), 0)))
    assert structure(task, plain, Screening(task, plain)).gain > structures.LEAST_GAIN


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_what_depends_on_two_variables_is_found_in_noise(grids, seed):
    plain, rng = Extended(rough_model()), np.random.default_rng(seed)
    task = Task(grids, grids.open_rows, np.zeros(ORDER))
    noise, values = rng.normal(0.0, 1.0, len(grids.power)), variables(task, plain)
    x, y = (values[name] - np.median(values[name]) for name in ('temperature', 'ramp'))
    both = 0.6 * np.tanh(3.0 * x / np.std(x)) * np.tanh(3.0 * y / np.std(y))
    found = []
    for power in (noise, noise + both):
        seen = replace(task, grids=replace(grids, power=answer(grids, plain) + power))
        found.append(structure(seen, plain, Screening(seen, plain)))
    assert [s.there for s in found] == [False, True]
    assert found[1].variables == ('temperature', 'ramp')
    assert found[1].explained_mw2 == pytest.approx(float(np.var(both[task.rows])), rel=0.5)


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_what_follows_the_load_of_hours_before_is_told_from_a_wander(seed):
    samples = table(2.0, 1, (), unit())
    grids = make_grids(*record(samples).about, np.zeros(samples.values.shape, dtype=bool))
    plain = Extended(rough_model())
    x = variables(Task(grids, grids.open_rows, np.zeros(4)), plain)[HOURS_BEFORE]
    rng, keep = np.random.default_rng(seed), np.exp(-grids.mean_s / (6.0 * 3600.0))
    slow = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.normal(0.0, 0.5, len(x)))
    noise = slow + rng.normal(0.0, 1.0, len(x))
    daily = np.cos(2.0 * np.pi * grids.means(grids.time_s) / 86_400.0)
    for size, there in ((0.0, False), (0.8, True)):
        power = answer(grids, plain) + noise + size * np.sign(x - np.median(x))
        seen = replace(grids, power=power)
        task = Task(seen, grids.open_rows, whitening(seen, noise))
        screening = Screening(task, plain)
        level = wander(screening).level[grids.sub] * screening.here
        found = structure(task, plain, screening, level)
        assert found.there == there
        assert not there or HOURS_BEFORE in found.variables
        # A plant with a daily programme repeats it each day.
        assert bool(likelier_over_hours(task, plain, daily, 2)) == there
    # A cause that moves with the load of hours before, alone and beside more of that load.
    load, other = np.sign(x - np.median(x)), rng.permutation(np.repeat([-1.0, 1.0], 24))
    cause = 1.5 * load + np.repeat(other, -(-len(x) // 48))[: len(x)]
    for of_cause, of_load in ((0.8, 0.0), (0.3, 0.8)):
        power = answer(grids, plain) + noise + of_cause * cause + of_load * load
        task = replace(task, grids=replace(grids, power=power))
        told = likelier_over_hours(task, plain, cause, 1)
        assert told == (HOURS_BEFORE if of_load else '')
    task = replace(task, grids=replace(grids, power=answer(grids, plain) + noise + 2.0 * daily))
    assert likelier_over_hours(task, plain, daily, 2) == ''


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_a_slow_disturbance_exceeds_a_step_in_it_and_no_true_step(seed):
    samples = table(2.0, 1, (), unit())
    grids = make_grids(*record(samples).about, np.zeros(samples.values.shape, dtype=bool))
    plain, rng, m = Extended(rough_model()), np.random.default_rng(seed), len(grids.power)
    added = FittedCause(catalogue()['gain_step'], (0.01, 0.9))
    keep = np.exp(-grids.mean_s / (6.0 * 3600.0))
    slow = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.normal(0.0, 2.0, m))
    noise, leads = rng.normal(0.0, 1.0, m), []
    for power in (answer(grids, plain) + slow, answer(grids, plain.with_cause(added))):
        task = Task(replace(grids, power=power + noise), grids.open_rows, np.zeros(ORDER))
        fitted, _ = improve(task, plain.with_cause(added), 4)
        sealed = replace(task.grids, power=power + noise + 9.0 * ~grids.open_rows, cache={})
        leads.append(wander_lead(task, fitted))
        # The blocks kept out of the search have no part in it.
        assert wander_lead(replace(task, grids=sealed), fitted) == pytest.approx(leads[-1])
    assert leads[0] > 0.0 > leads[1]


def test_changes_that_are_none_have_even_chances_and_true_ones_small_ones():
    rng = np.random.default_rng(4)
    part = np.arange(4800) // 100
    effect = np.where(rng.random(48) < 0.1, 1.0, 0.1)[part] * rng.normal(size=4800)
    chances = np.array([
        chance_of_gain(noise, noise - 0.2 * effect, part)
        for noise in rng.normal(size=(1000, 4800))
    ])  # fmt: skip
    for level in (0.01, 0.05, 0.5):
        spread = np.sqrt(level * (1.0 - level) / len(chances))
        assert np.mean(chances < level) < level + 3.0 * spread
    assert np.mean(chances < 0.5) > 0.4
    noise = rng.normal(size=4800)
    # It acts in a tenth of the parts: their signs alone would tell less.
    assert chance_of_gain(noise + effect, noise, part) < 1e-6
    assert chance_of_gain(noise + effect, noise + 2.0 * effect, part) > 0.5


def test_where_something_else_acts_a_gain_is_held_against_all_that_was_tried():
    rng = np.random.default_rng(5)
    part = np.arange(4800) // 100
    effect, other = rng.normal(size=(2, 4800))
    alone = chance_of_gain(other + 0.04 * effect, other, part, tried=1)
    assert 1e-4 < alone < 0.05
    assert chance_of_gain(other + 0.04 * effect, other, part, tried=18) == alone
    assert chance_of_gain(other + 0.04 * effect, other, part, tested=2) == 2 * alone
    there = other + rng.normal(size=48)[part] * effect  # it follows the effect by half hours
    few = chance_of_gain(there + 0.9 * effect, there, part)
    assert chance_of_gain(there + 0.9 * effect, there, part, tried=18) == min(1.0, 18 * few)


@pytest.mark.parametrize('step_s', [2.0, 5.0, 10.0])
def test_readings_that_repeat_by_chance_are_no_flatline_and_longer_ones_are(step_s):
    rng = np.random.default_rng(7)
    samples = table(0.4, 2, (), unit(step_s=step_s))
    values = samples.values.copy()
    for share in (0.1, 0.3, 0.5):  # of rows that read as the row before
        fresh = rng.random(len(values)) >= share
        place = np.maximum.accumulate(np.where(fresh, np.arange(len(values)), 0))
        values[:, Signal.MAIN_STEAM_TEMPERATURE] = rng.normal(540.0, 1.0, len(values))[place]
        _, found = record_faults.faults(replace(samples, values=values), step_s)
        assert 'flatline' not in {f.name for f in found}
        held = values.copy()
        held[1000:1060, Signal.MAIN_STEAM_TEMPERATURE] = 541.0
        bad, found = record_faults.faults(replace(samples, values=held), step_s)
        assert [f.name for f in found] == ['flatline']
        assert set(np.flatnonzero(bad[:, Signal.MAIN_STEAM_TEMPERATURE])) >= set(range(1002, 1059))


def test_faults_are_masked_where_they_are():
    samples = table(0.4, 2, (), unit())
    bad, found = record_faults.faults(samples, 2.0)
    assert found == ()
    assert not bad.any()
    values = samples.values.copy()
    places = np.array([3000, 5001, 9000, 12000, 15000])
    values[places, Signal.GENERATED_POWER] += 60.0
    values[7000:8000, Signal.MAIN_STEAM_PRESSURE] = values[7000, Signal.MAIN_STEAM_PRESSURE]
    bad, found = record_faults.faults(SampleTable(samples.time_ns, values, samples.quality), 2.0)
    assert {(f.name, f.signal.signal) for f in found} == {
        ('spikes', Signal.GENERATED_POWER), ('flatline', Signal.MAIN_STEAM_PRESSURE),
    }  # fmt: skip
    assert set(np.flatnonzero(bad[:, Signal.GENERATED_POWER])) == set(places)
    assert bad[7001:8000, Signal.MAIN_STEAM_PRESSURE].all()


def test_shallow_knees_are_taken_out_and_steep_ones_stay():
    model = rough_model()
    split = replace(
        model, knots=np.insert(model.knots, 2, 1400.0),
        left=np.insert(model.left, 2, 225.5), right=np.insert(model.right, 1, 225.5),
    )  # fmt: skip
    assert simplified(split).pieces == model.pieces
    assert simplified(model).pieces == model.pieces


@pytest.mark.parametrize('unit_of_curve', [1.0, 0.04, 1000.0])
def test_a_jump_stays_in_whatever_unit_the_curve_is(unit_of_curve):
    """p^e F(V) holds MW / MPa^e, where a jump of a MW is a small number."""
    model = rough_model()
    jumps = replace(
        model, knots=np.insert(model.knots, 2, 1400.0),
        left=np.insert(model.left, 2, 226.5), right=np.insert(model.right, 1, 225.9),
    )  # fmt: skip
    for curve in (model, jumps):
        scaled = replace(curve, left=unit_of_curve * curve.left, right=unit_of_curve * curve.right)
        assert simplified(scaled).pieces == simplified(curve).pieces == curve.pieces


def test_the_extended_model_comes_back_from_its_file(grids):
    model = Extended(
        rough_model(),
        (FittedCause(catalogue()['gain_step'], (0.006, 0.2)),
         FittedCause(catalogue()['intervals'], (0.01,), (3600.0, 9000.0))),
    )  # fmt: skip
    raw = json.loads(
        json.dumps(model_to_json(ExtendedModel(model, StaticForm(), 5, grids.reference)))
    )
    given = model_from_json(raw)
    back, exponent = given.model, given.pressure_exponent
    start_ns, reference = given.start_ns, given.reference
    assert (exponent, start_ns, reference) == (1.125, 5, grids.reference)
    np.testing.assert_array_equal(answer(grids, back), answer(grids, model))


def test_a_model_of_the_first_version_is_read_unless_a_step_is_in_it(grids):
    for name, values, old in (('gain_drift', (0.01,), True), ('gain_step', (0.01, 0.2), False)):
        model = Extended(rough_model(), (FittedCause(catalogue()[name], values),))
        raw = model_to_json(ExtendedModel(model, StaticForm(), 5, grids.reference))
        assert model_from_json(raw).model.names == (name,)
        with nullcontext() if old else pytest.raises(DataError, match='Make it anew'):
            assert model_from_json({**raw, 'version': 1}).model.names == (name,)


@pytest.mark.parametrize('raw', [None, {}, {'format': 'valveflow/extended_model', 'version': 9}])
def test_what_is_no_extended_model_is_refused(raw):
    with pytest.raises(DataError):
        model_from_json(raw)


def test_a_record_of_minutes_is_refused():
    samples = table(0.4, 2, (), unit()).part(0, 600)
    with pytest.raises(TooFewSamplesError, match='longer record'):
        make_grids(*record(samples).about, np.zeros(samples.values.shape, dtype=bool))


@pytest.mark.parametrize(('onset', 'early'), [(0.01, True), (0.2, False)])
def test_a_change_that_begins_with_the_record_is_in_doubt(grids, onset, early):
    added = FittedCause(catalogue()['gain_step'], (0.01, onset))
    model = Extended(rough_model()).with_cause(added)
    noise = np.random.default_rng(1).normal(0.0, 1.0, len(grids.power))
    task = Task(replace(grids, power=answer(grids, model) + noise), grids.whole, np.zeros(ORDER))
    assert bool(search._doubt(task, Rival(model, added, 0.0))) == early


@pytest.mark.parametrize(('doubted', 'weighed'), [
    ({'curve_shape'}, ['choked', 'exponent']),  # saturation explains too much less
    (set(), ['curve_shape']),
])  # fmt: skip
def test_a_cause_in_doubt_hides_no_other(
    monkeypatch: pytest.MonkeyPatch, doubted: set[str], weighed: list[str]
) -> None:
    """The best candidate is in doubt, and the next one explains much less."""
    model, seen = Extended(rough_model()), []
    scores = {'curve_shape': 0.0, 'choked': 50.0, 'exponent': 55.0, 'saturation': 70.0}
    rivals = [
        Rival(Extended(model.base, (added,)), added, score)
        for name, score in scores.items()
        for added in [FittedCause(catalogue()[name], (0.0,) * len(catalogue()[name].unknowns))]
    ]

    def weigh(task: object, without: object, rival: Extended, size: int) -> SimpleNamespace:
        seen.extend(rival.names)
        return SimpleNamespace(enough=False, reason=lambda: 'it is too small')

    def doubt(task: object, rival: Rival) -> str:
        return 'it is in doubt' if rival.added.name in doubted else ''

    monkeypatch.setattr(search, '_rivals', lambda *_: rivals)
    monkeypatch.setattr(search, '_visible', lambda found, rivals, barred: rivals)
    monkeypatch.setattr(search, '_without_onset', lambda *_: '')
    monkeypatch.setattr(search, '_small', doubt)
    monkeypatch.setattr(search, 'weigh', weigh)
    monkeypatch.setattr(search, 'improve', lambda task, model, steps: (model, 1.0))
    task = SimpleNamespace(cost=lambda model: 1.0)
    assert not _add(SearchResult(task, model, model, model), set())  # type: ignore[arg-type]
    assert seen == weighed
