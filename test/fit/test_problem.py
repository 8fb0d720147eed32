# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from curves import gaps, inputs, models
from hypothesis import given
from hypothesis import strategies as st
from naive_stream import naive_curve, naive_respond
from streams import examples

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.fit import problem as module
from valveflow_ros.fit import whitening
from valveflow_ros.fit.problem import (
    Problem,
    Samples,
    free_parameters,
    move,
    within_bounds,
    within_reach,
)
from valveflow_ros.fit.whitening import normal_equations

seeds = st.integers(0, 2**32 - 1)
N = 3000
AR = np.array([0.5, 0.2, 0.1, -0.1, 0.05])


def plant(rng, group=2):
    """Return rows with gaps, and a model of three pieces, a jump and three regions."""
    u = np.clip(500.0 + np.cumsum(rng.normal(0.0, 3.0, N)), 300.0, 900.0)
    usable = np.ones(N, dtype=np.uint8)
    for _ in range(int(rng.integers(0, 4))):
        at = int(rng.integers(0, N))
        usable[at : at + int(rng.integers(1, 30))] = 0
    knots = np.array([300.0, *np.sort(rng.uniform(400.0, 700.0, 2)), 900.0])
    knots[2] = max(knots[2], knots[1] + 20.0)
    model = RegionalModel(
        knots=knots,
        left=np.array([100.0, 180.0, 255.0]),
        right=np.array([180.0, 250.0, 300.0]),
        levels=np.array([170.0, 230.0]),
        time_constants=rng.uniform(0.5, 4.0, 3),
        delays=rng.uniform(0.0, 6.0, 3),
    )
    power = 200.0 + rng.normal(0.0, 5.0, N)
    return Samples(u, power, usable, step_s=1.0, settle_s=20.0, group=group), model


def samples_of(u, power, usable, settle_s=20.0, group=5, step_s=1.0, scale=None):
    return Samples(
        u=np.where(usable > 0, u, 0.0), power_mw=np.where(usable > 0, power, 0.0), usable=usable,
        step_s=step_s, settle_s=settle_s, group=group, scale=scale,
    )  # fmt: skip


def choked(model, seed, n=300):
    """Return the model as one of p^e F(V) + c that gives about the same power, and p^e."""
    rng = np.random.default_rng(seed)
    scale = np.clip(12.0 + np.cumsum(rng.normal(0.0, 0.1, n)), 8.0, 17.0)
    return replace(
        model, left=(model.left + 9.0) / 12.0, right=(model.right + 9.0) / 12.0, offset_mw=-9.0
    ), scale  # fmt: skip


def naive_means(model, u, usable, step_s, settle, group, scale=None):
    """Return the mean answers and which of them count, by loops."""
    scale = [1.0] * len(u) if scale is None else scale
    x = [
        s * naive_curve(v, model.knots, model.left, model.right) + (model.offset_mw or 0.0)
        for v, s in zip(u, scale, strict=True)
    ]
    answer = naive_respond(x, usable, model.levels, model.time_constants, model.delays, step_s)
    age, settled = 0, []
    for good in usable:
        age = age + 1 if good else 0
        settled.append(age > settle)
    means, counts = [], []
    for start in range(0, len(u) - group + 1, group):
        rows = range(start, start + group)
        counts.append(all(settled[k] for k in rows))
        means.append(sum(answer[k] for k in rows) / group if counts[-1] else None)
    return means, counts


@examples(40)
@given(models(), st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 7]), st.booleans())
def test_means_of_the_response_are_the_slow_ones(model, seed, group, scaled):
    u, usable = inputs(model, seed), gaps(seed, 300)
    power = np.random.default_rng(seed).normal(200.0, 5.0, 300)
    model, scale = choked(model, seed) if scaled else (model, None)
    problem = Problem(samples_of(u, power, usable, group=group, scale=scale))
    residual, weight = problem.answer(model)
    means, counts = naive_means(model, u, usable, 1.0, 20, group, scale)
    assert weight.tolist() == [int(c) for c in counts]
    for k, counted in enumerate(counts):
        measured = power[k * group : (k + 1) * group].mean()
        assert residual[k] == pytest.approx(measured - means[k] if counted else 0.0, abs=1e-8)


# --- derivatives ----------------------------------------------------------------------------


@examples(10)
@given(seeds, st.booleans())
def test_tangents_are_differences_of_the_answer(seed, scaled):
    samples, model = plant(np.random.default_rng(seed))
    if scaled:
        model, scale = choked(model, seed, N)
        samples = replace(samples, scale=scale)
    problem = Problem(samples)
    residual, jacobian, weight = problem.tangents(model)
    again, same = problem.answer(model)
    assert weight.tolist() == same.tolist()
    assert residual == pytest.approx(again, abs=1e-9)
    values, step = model.pack(), 1e-5
    scale = samples.scale_or_ones
    regions = np.searchsorted(model.levels, model.static(samples.u, scale))
    assert jacobian.shape[1] == len(values) == model.size
    for p in range(len(values)):
        ends = []
        for sign in (0.5, -0.5):
            moved = values.copy()
            moved[p] += sign * step
            ends.append(model.unpack(moved))
        if any((np.searchsorted(model.levels, e.static(samples.u, scale)) != regions).any()
               for e in ends):  # fmt: skip
            continue
        slope = (problem.answer(ends[1])[0] - problem.answer(ends[0])[0]) / step
        good = weight > 0
        # A row at a knot has one slope on each side.
        off = np.abs(slope - jacobian[:, p])[good] > 1e-3 * max(1.0, np.abs(jacobian[:, p]).max())
        assert off.mean() < 0.02


# --- stretches and threads ------------------------------------------------------------------


@pytest.fixture
def short_stretches(monkeypatch):
    monkeypatch.setattr(module, '_STRETCH', 200)
    monkeypatch.setattr(whitening, '_STRETCH', 130)


def test_how_the_rows_are_cut_does_not_matter(short_stretches):
    for seed in range(8):
        samples, model = plant(np.random.default_rng(seed))
        cut = Problem(samples)
        residual, jacobian, weight = cut.tangents(model)
        sums, rows = cut.normal(model, AR)
        assert len(cut._stretches(model)) > 1
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, '_STRETCH', N)
            patch.setattr(whitening, '_STRETCH', N)
            whole = Problem(samples)
            assert len(whole._stretches(model)) == 1
            expected, table, counted = whole.tangents(model)
            products, _, count = normal_equations(table, expected, counted, AR)
            answer = whole.answer(model)[0]
            cost = whole.cost(model, AR)
        assert weight.tolist() == counted.tolist()
        assert residual == pytest.approx(expected, abs=1e-9)
        assert cut.answer(model)[0] == pytest.approx(answer, abs=1e-9)
        good = weight > 0
        assert jacobian[good] == pytest.approx(table[good], abs=1e-9)
        assert rows == count
        assert sums == pytest.approx(products, rel=1e-9, abs=1e-6)
        assert cut.cost(model, AR) == pytest.approx(cost, rel=1e-12)


def test_the_bits_do_not_depend_on_the_threads(short_stretches, monkeypatch):
    samples, model = plant(np.random.default_rng(3))
    found = []
    for threads in (1, 2, 5):
        monkeypatch.setattr(module, 'cores', lambda n=threads: n)
        monkeypatch.setattr(whitening, 'cores', lambda n=threads: n)
        problem = Problem(samples)
        residual, jacobian, weight = problem.tangents(model)
        sums, scores, _ = normal_equations(jacobian, residual, weight, AR, 7)
        parts = (residual, jacobian, weight, sums, scores, problem.normal(model, AR)[0])
        found.append((*(part.tobytes() for part in parts), problem.cost(model, AR)))
    assert found[0] == found[1] == found[2]


# --- hostile --------------------------------------------------------------------------------


@pytest.mark.parametrize(('n', 'usable', 'means'), [(0, 1, 0), (1, 1, 0), (4, 1, 0), (50, 0, 10)])
def test_where_no_mean_counts_nothing_is_scored(n, usable, means):
    model = RegionalModel(*(np.array(a) for a in (
        [0.0, 10.0], [0.0], [10.0], [], [5.0], [1.0])))  # fmt: skip
    power = np.full(n, 7.0 if usable else np.nan)
    problem = Problem(samples_of(np.full(n, 5.0), power, np.full(n, usable, dtype=np.uint8)))
    residual, jacobian, weight = problem.tangents(model)
    assert jacobian.shape == (means, 4)
    assert residual.tolist() == weight.tolist() == [0.0] * means
    assert problem.cost(model, np.zeros(4)) == 0.0


@given(seeds)
@examples(40)
def test_any_parameters_become_a_model_that_can_be_run(seed):
    rng = np.random.default_rng(seed)
    _, model = plant(rng)
    wild = model.pack() * rng.normal(1.0, 3.0, model.size)
    found = within_bounds(model, wild, 60.0)
    assert np.diff(found.knots).min() > 0.0039 * 600.0
    assert found.knots[[0, -1]].tolist() == [300.0, 900.0]
    assert np.all((found.time_constants >= 5.999) & (found.time_constants <= 3601.0))
    assert np.all((found.delays >= 0.0) & (found.delays <= 600.0))
    again = within_bounds(model, found.pack(), 60.0)
    assert again.pack() == pytest.approx(found.pack(), rel=1e-12)


@pytest.mark.parametrize('early', [3, 6])
def test_a_delay_that_ends_at_0_does_not_keep_the_others_from_their_best(early):
    rng = np.random.default_rng(early)
    u = np.clip(500.0 + np.cumsum(rng.normal(0.0, 3.0, N + early)), 300.0, 900.0)
    true = RegionalModel(
        np.array([300.0, 520.0, 900.0]), np.array([100.0, 190.0]), np.array([190.0, 260.0]),
        np.empty(0), np.array([12.0]), np.zeros(1),
    )  # fmt: skip
    usable = np.ones(N, dtype=np.uint8)
    # The power is ahead of the opening: only a delay below 0 could show it.
    power = naive_respond(true.static(u), np.ones(N + early), [], [12.0], [0.0], 1.0)[early:]
    problem = Problem(samples_of(u[:N], np.array(power) + rng.normal(0.0, 0.3, N), usable))
    start = replace(
        true, knots=np.array([300.0, 600.0, 900.0]), left=np.array([110.0, 200.0]),
        right=np.array([200.0, 250.0]), time_constants=np.array([30.0]), delays=np.array([4.0]),
    )  # fmt: skip
    free = free_parameters(start)
    found, cost = move(problem, start, np.zeros(4), free, 40)
    free[found.delay_places] = False
    _, least = move(problem, replace(start, delays=np.zeros(1)), np.zeros(4), free, 40)
    assert found.delays[0] == 0.0
    assert cost == pytest.approx(least, rel=1e-4)


@pytest.mark.parametrize(('slopes', 'held'), [
    ((1, -1), [True, True]), ((1, 0), [True, True]), ((-1, -1), [False, False]),
    ((-1, 1), [False, False]),
])  # fmt: skip
def test_breakpoints_as_close_as_they_may_be_do_not_push_each_other(slopes, held):
    model = RegionalModel(
        np.array([0.0, 500.0, 504.0, 1000.0]), np.array([0.0, 50.0, 51.0]),
        np.array([50.0, 51.0, 90.0]), np.empty(0), np.array([9.0]), np.array([3.0]),
    )  # fmt: skip
    free = free_parameters(model)
    slope = np.ones(free.sum())
    slope[4:6] = slopes
    _, left = within_reach(model, free, np.eye(len(slope)), slope, 1.0)
    # One whose cost is flat cannot be told from one that is held.
    assert [bool(x == 0.0) for x in left[4:6]] == [
        h or not s for h, s in zip(held, slopes, strict=True)
    ]
