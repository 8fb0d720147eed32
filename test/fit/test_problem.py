from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import examples

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.fit import problem as module
from valveflow_ros.fit import whitening
from valveflow_ros.fit.problem import Problem, Samples
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


@pytest.fixture
def short_stretches(monkeypatch):
    monkeypatch.setattr(module, '_STRETCH', 200)
    monkeypatch.setattr(whitening, '_STRETCH', 130)


def slow_answer(samples, model):
    """Return the means and weights of the answer, a row at a time and from the definition."""
    taps = model.taps(samples.step_s)
    flow = model.static(samples.u)
    state, age, rows, settled = 0.0, 0, [], []
    for t in range(len(flow)):
        if not samples.usable[t]:
            age = 0
            rows.append(np.nan)
            settled.append(False)
            continue
        a, w0, w1, w2, whole = taps[int(np.searchsorted(model.levels, flow[t], 'right'))][:5]
        if age == 0:
            state = flow[t]
        late = [flow[t - min(int(whole) + k, age)] for k in range(3)]
        state = a * state + w0 * late[0] + w1 * late[1] + w2 * late[2]
        age += 1
        rows.append(state)
        settled.append(age > samples.settle_s / samples.step_s)
    m, g = samples.means, samples.group
    good = np.array(settled)[: m * g].reshape(m, g).all(axis=1)
    return np.array(rows)[: m * g].reshape(m, g).mean(axis=1), good


@examples(10)
@given(seeds, st.sampled_from([1, 2, 3, 7]))
def test_the_residual_is_the_power_less_the_definition(seed, group):
    samples, model = plant(np.random.default_rng(seed), group)
    problem = Problem(samples)
    expected, good = slow_answer(samples, model)
    residual, weight = problem.answer(model)
    assert (weight > 0).tolist() == good.tolist()
    assert residual[good] == pytest.approx((problem.power - expected)[good], abs=1e-9)
    assert not residual[~good].any()


@examples(10)
@given(seeds)
def test_tangents_are_differences_of_the_answer(seed):
    samples, model = plant(np.random.default_rng(seed))
    problem = Problem(samples)
    residual, jacobian, weight = problem.tangents(model)
    again, same = problem.answer(model)
    assert weight.tolist() == same.tolist()
    assert residual == pytest.approx(again, abs=1e-9)
    values, step = model.pack(), 1e-5
    regions = np.searchsorted(model.levels, model.static(samples.u))
    for p in range(len(values)):
        ends = []
        for sign in (0.5, -0.5):
            moved = values.copy()
            moved[p] += sign * step
            ends.append(model.unpack(moved))
        if any((np.searchsorted(model.levels, e.static(samples.u)) != regions).any()
               for e in ends):  # fmt: skip
            continue
        slope = (problem.answer(ends[1])[0] - problem.answer(ends[0])[0]) / step
        good = weight > 0
        # A row at a knot has one slope on each side.
        off = np.abs(slope - jacobian[:, p])[good] > 1e-3 * max(1.0, np.abs(jacobian[:, p]).max())
        assert off.mean() < 0.02


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
