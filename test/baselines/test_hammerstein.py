# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The Hammerstein baseline: its kernels against obvious loops, and plants of its own class."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import examples, needs_jit

from valveflow_ros.baselines.hammerstein import (
    HammersteinModel,
    fit_hammerstein,
    knots_to_try,
    tangents,
)
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.fit.problem import Samples


def samples(u, power, usable=None, group=1, settle_s=0.0, step_s=1.0):
    usable = np.ones(len(u), dtype=np.uint8) if usable is None else usable
    return Samples(u, power, usable, step_s, settle_s, group)


def naive_run(model, u, usable):
    """Simulate with the difference equation as it is written, one row at a time."""
    b, f = model.b, model.denominator
    y = np.full(len(u), np.nan)
    start = 0
    for t in range(len(u)):
        if not usable[t]:
            start = t + 1
            continue
        rest = float(model.static(u[start : start + 1])[0])
        total = 0.0
        for j in range(len(b)):
            past = t - model.delay - j
            total += b[j] * (float(model.static(u[past : past + 1])[0]) if past >= start else rest)
        for i in range(len(f)):
            past = t - 1 - i
            total -= f[i] * (y[past] if past >= start else rest)
        y[t] = total
    return y


@st.composite
def models(draw):
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    pieces = draw(st.integers(1, 4))
    knots = 100.0 + np.cumsum(rng.uniform(20.0, 60.0, pieces + 1))
    poles = rng.uniform(0.2, 0.95, draw(st.integers(1, 3)))
    f = np.array([1.0])
    for pole in poles:
        f = np.convolve(f, [1.0, -pole])
    return HammersteinModel(
        knots, np.cumsum(rng.uniform(1.0, 20.0, pieces + 1)),
        rng.normal(0.0, 0.3, draw(st.integers(0, 2))), f[1:], draw(st.integers(0, 5)), 1.0,
    )  # fmt: skip


def inputs(model, seed, n=60):
    rng = np.random.default_rng(seed)
    u = rng.uniform(model.knots[0] - 10.0, model.knots[-1] + 10.0, n)
    usable = (rng.random(n) > 0.06).astype(np.uint8)
    return u, usable


@examples(30)
@given(models(), st.integers(0, 1000))
def test_the_simulation_is_the_difference_equation(model, seed):
    u, usable = inputs(model, seed)
    answer, settled = model.run(samples(u, u, usable, settle_s=4.0))
    np.testing.assert_allclose(answer, naive_run(model, u, usable), rtol=1e-9, atol=1e-9)
    assert model.b.sum() == pytest.approx(1.0 + model.denominator.sum(), abs=1e-9)
    ages = np.zeros(len(u), dtype=int)
    for t in range(len(u)):
        ages[t] = (ages[t - 1] if t else 0) + 1 if usable[t] else 0
    assert np.array_equal(settled > 0, ages > 4)


@examples(20)
@given(models(), st.integers(0, 1000), st.sampled_from([1, 3]))
def test_tangents_are_the_derivatives_of_the_simulated_means(model, seed, group):
    u, usable = inputs(model, seed)
    # Away from the knots, where the curve has a derivative.
    near = np.abs(u[:, None] - model.knots[None, :]).min(axis=1) < 0.01
    u = np.where(near, u + 0.05, u)
    data = samples(u, np.zeros(len(u)), usable, group=group)
    residual, jacobian, weight = tangents(data, model)
    packed = model.pack()
    for p in range(len(packed)):
        h = 1e-5 * max(1.0, abs(packed[p]))
        ends = []
        for sign in (1.0, -1.0):
            moved = packed.copy()
            moved[p] += sign * h
            ends.append(-tangents(data, model.unpack(moved), columns=0)[0])
        slope = (ends[0] - ends[1]) / (2.0 * h)
        good = weight > 0
        scale = max(1.0, float(np.abs(slope[good]).max())) if good.any() else 1.0
        np.testing.assert_allclose(jacobian[good, p] / scale, slope[good] / scale, atol=2e-4)
    answer = model.run(data)[0]
    means = answer[: len(residual) * group].reshape(-1, group).mean(axis=1)
    np.testing.assert_allclose(-residual[weight > 0], means[weight > 0], rtol=1e-9)


def step_response(model, seconds):
    """Return how much of a unit step of the flow the power has followed, shape (n,)."""
    rows = int(np.ceil(seconds.max() / model.step_s)) + model.delay + 2
    # One row of rest before the step; equilibrium is where `run` begins.
    flat = replace(model, knots=np.array([0.0, 1.0]), values=np.array([0.0, 1.0]))
    u = np.ones(rows + 1)
    u[0] = 0.0
    answer, _ = flat.run(samples(u, u))
    return np.interp(seconds, np.arange(rows) * model.step_s, answer[1:])


def ramps(hours, seed, low=1000.0, high=2000.0):
    """Return an input that rests and moves over its whole range."""
    rng = np.random.default_rng(seed)
    targets = np.repeat(rng.uniform(low, high, int(hours * 6) + 1), 2)
    times = np.cumsum(np.tile([420.0, 180.0], len(targets) // 2))
    seconds = np.arange(int(hours * 3600.0))
    return np.interp(seconds, np.concatenate([[0.0], times[:-1]]), targets)


@pytest.fixture(scope='module')
def own_class():
    """Return a plant that is a Hammerstein model, and 12 h of it under noise."""
    plant = HammersteinModel(
        np.array([950.0, 1300.0, 1650.0, 2050.0]), np.array([140.0, 220.0, 262.0, 282.0]),
        np.empty(0), np.array([-np.exp(-1.0 / 30.0)]), 8, 1.0,
    )  # fmt: skip
    u = ramps(12.0, 3)
    power = plant.run(samples(u, u))[0]
    power = power + np.random.default_rng(4).normal(0.0, 1.0, len(u))
    return plant, samples(u, power, group=10, settle_s=410.0)


@needs_jit
def test_a_plant_of_its_own_class_is_found(own_class):
    plant, data = own_class
    fitted = fit_hammerstein(data, 3)
    model = fitted.model
    u = np.linspace(1010.0, 1990.0, 300)
    # 1 MW of white noise over 43200 rows: a tenth of a MW is far more than chance leaves.
    assert np.abs(model.static(u) - plant.static(u)).max() < 0.15
    assert np.abs(model.knots[1:-1] - plant.knots[1:-1]).max() < 4.0
    seconds = np.arange(300.0)
    assert np.abs(step_response(model, seconds) - step_response(plant, seconds)).max() < 0.03
    assert len(fitted.tried) == 6
    assert all(1.0 <= mse < 1.1 for *_, mse in fitted.tried)


@pytest.mark.parametrize('pieces', [1, 5])
@pytest.mark.parametrize('kind', ['even', 'levels', 'one'])
def test_knots_to_try_rise_whatever_the_input(pieces, kind):
    rng = np.random.default_rng(2)
    u = {
        'even': rng.uniform(5.0, 9.0, 500),
        'levels': rng.choice([5.0, 5.0, 5.0, 9.0], 500),
        'one': np.append(np.full(499, 5.0), 9.0),
    }[kind]
    for knots in knots_to_try(u, pieces):
        assert len(knots) == pieces + 1
        assert np.all(np.diff(knots) > 0.0)
        assert (knots[0], knots[-1]) == (u.min(), u.max())


def test_too_little_data_is_refused_in_a_sentence():
    u = np.linspace(0.0, 1.0, 500)
    with pytest.raises(TooFewSamplesError, match='500 found, at least 3600 needed'):
        fit_hammerstein(samples(u, u), 2)


@pytest.mark.parametrize('gaps', [slice(0, 8400, 200), slice(8400, None, 200)])
def test_gaps_closer_than_the_transient_are_refused(gaps):
    """In the part to learn from, or in the part to choose by."""
    rng = np.random.default_rng(5)
    u = rng.uniform(1000.0, 2000.0, 12000)
    usable = np.ones(len(u), dtype=np.uint8)
    usable[gaps] = 0
    with pytest.raises(TooFewSamplesError, match='for longer than the transient'):
        fit_hammerstein(samples(u, u, usable, group=10, settle_s=210.0), 2)
