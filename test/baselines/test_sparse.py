# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The sparse baseline: library, equations, thresholding, simulation and rest."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from streams import examples, needs_jit

from valveflow_ros.baselines import sparse as library
from valveflow_ros.baselines.sparse import (
    Form,
    SparseModel,
    equations,
    fit_sparse,
    thresholded,
)
from valveflow_ros.fit.problem import Samples

TIME_S, GAIN, OFFSET = 40.0, 0.15, 20.0  # y' = (GAIN u + OFFSET - y) / TIME_S


def linear_xi():
    xi = np.zeros(library.SIZE)
    xi[0], xi[1], xi[2] = OFFSET / TIME_S, -1.0 / TIME_S, GAIN / TIME_S
    return xi


def wave(seconds):
    return 1500.0 + 350.0 * np.sin(seconds / 700.0) + 120.0 * np.sin(seconds / 190.0 + 1.0)


def linear_plant(hours, noise_mw, seed=5):
    """Return the linear plant under a smooth input, with noise."""
    seconds = np.arange(int(hours * 3600.0), dtype=np.float64)
    u = wave(seconds)
    a = np.exp(-1.0 / TIME_S)
    mean = (1.0 - a) * TIME_S
    x = GAIN * u + OFFSET
    y = np.empty(len(u))
    y[0] = x[0]
    for t in range(1, len(u)):  # exact for an input that is straight between rows
        y[t] = a * y[t - 1] + (mean - a) * x[t - 1] + (1.0 - mean) * x[t]
    rng = np.random.default_rng(seed)
    power = y + noise_mw * rng.standard_normal(len(u))
    return Samples(u, power, np.ones(len(u), dtype=np.uint8), 1.0, 210.0, 10), y


def model(xi):
    return SparseModel(xi, 1000.0, 2000.0, 150.0, 330.0, 240.0, 1.0)


@examples(30)
@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_the_library_is_the_papers(y, u):
    wanted = [
        1.0, y, u, y**2, y * u, u**2, y**3, y**2 * u, y * u**2, u**3,
        np.sin(y), np.sin(u), np.cos(y), np.cos(u),
    ]  # fmt: skip
    row = library.columns(np.array([y]), np.array([u]))[0]
    np.testing.assert_allclose(row, wanted, atol=1e-12)
    xi = np.random.default_rng(1).normal(size=library.SIZE)
    assert library.rate(y, u, xi) == pytest.approx(float(row @ xi), abs=1e-9)


def test_a_simulation_is_the_solution_of_the_equation():
    xi = np.zeros(library.SIZE)
    xi[[0, 1, 2, 4, 10]] = [0.5, -0.02, 0.004, -5e-6, 0.03]
    seconds = np.arange(900.0)
    data = Samples(wave(seconds), np.full(900, 200.0), np.ones(900, np.uint8), 1.0, 0.0, 10)
    answer, settled = model(xi).run(data)

    def slope(t, y):
        u = np.interp(t, seconds, data.u)
        return [library.rate(float(y[0]), float(u), xi)]

    exact = solve_ivp(slope, (0.0, 899.0), [200.0], t_eval=seconds, rtol=1e-8, max_step=1.0)
    np.testing.assert_allclose(answer, exact.y[0], atol=1e-4)
    assert settled.all()


def test_a_gap_begins_anew_at_the_measured_power_and_running_away_is_told():
    usable = np.ones(400, dtype=np.uint8)
    usable[200:210] = 0
    power = np.where(np.arange(400) < 205, 100.0, 300.0)
    data = Samples(np.full(400, 1500.0), power, usable, 1.0, 50.0, 10)
    still = model(np.zeros(library.SIZE))
    answer, settled = still.run(data)
    assert np.all(answer[:200] == 100.0)
    assert np.isnan(answer[200:210]).all()
    assert np.all(answer[210:] == 300.0)
    assert settled[:50].sum() == 0
    assert settled[210:260].sum() == 0
    away = np.zeros(library.SIZE)
    away[6] = 1.0  # y' = y^3
    assert np.isinf(model(away).run(data)[0][10:200]).all()


@needs_jit
def test_no_window_holds_a_gap():
    data, _ = linear_plant(0.5, 0.0)
    usable = data.usable.copy()
    usable[900] = 0
    power = data.power_mw.copy()
    power[900] = 1e9  # would be seen from far
    hurt = Samples(data.u, power, usable, 1.0, 210.0, 10)
    for kind in ('derivative', 'weak'):
        rows = equations(hurt, Form(kind, 21.0))
        assert 0 < len(rows) < len(equations(data, Form(kind, 21.0)))
        assert np.abs(rows[:, 1]).max() < 1e4


def test_thresholding_keeps_what_is_large_and_refits():
    rng = np.random.default_rng(8)
    theta = rng.normal(size=(500, 6))
    true = np.array([2.0, 0.0, -1.0, 0.05, 0.0, 0.5])
    target = theta @ true + 0.01 * rng.normal(size=500)
    found = thresholded(theta, target, 0.2)
    assert np.array_equal(found != 0.0, [True, False, True, False, False, True])
    kept = theta[:, [0, 2, 5]]
    np.testing.assert_allclose(
        found[[0, 2, 5]], np.linalg.lstsq(kept, target, rcond=None)[0], rtol=1e-9
    )
    full = np.linalg.lstsq(theta, target, rcond=None)[0]
    np.testing.assert_allclose(thresholded(theta, target, 0.0), full)
    assert not thresholded(theta, target, 10.0).any()


@needs_jit
def test_a_linear_plant_is_found():
    data, clean = linear_plant(12.0, 1.0)
    found = fit_sparse(data)
    answer, settled = found.model.run(data)
    keep = settled > 0
    assert np.sqrt(np.mean((answer - clean)[keep] ** 2)) < 0.3
    u = np.linspace(1100.0, 1900.0, 50)
    # A smooth library near a straight truth; half a MW of 120 is what noise and surplus leave.
    assert np.abs(found.model.static(u) - (GAIN * u + OFFSET)).max() < 0.5
    assert {'u', 'y'} & set(found.model.terms)
    assert all(np.isfinite(mse) or np.isinf(mse) for *_, mse in found.mse_by_form)


@needs_jit
def test_the_curve_is_where_the_equation_rests():
    u = np.linspace(1000.0, 2000.0, 77)
    np.testing.assert_allclose(model(linear_xi()).static(u), GAIN * u + OFFSET, atol=1e-6)
    # Where it rests nowhere within reach, nothing is said.
    never = np.zeros(library.SIZE)
    never[0] = 1.0
    assert np.isnan(model(never).static(u)).all()


@needs_jit
def test_a_rest_that_swings_with_sin_u_is_followed():
    xi = linear_xi()
    xi[library.NAMES.index('sin u')] = 4.0 / TIME_S
    u = np.random.default_rng(4).uniform(1000.0, 2000.0, 500)
    error = model(xi).static(u) - (GAIN * u + OFFSET + 4.0 * np.sin(u))
    # Straight between places 0.25 apart: 4 * 0.25**2 / 8 at most.
    assert np.abs(error).max() < 0.035
