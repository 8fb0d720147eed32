# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import examples, needs_jit

from valveflow_ros.curve.regional_model import lagged_products
from valveflow_ros.fit.kernels import square_sum
from valveflow_ros.fit.whitening import (
    ORDER,
    fit_ar,
    inflation,
    normal_equations,
    whitened,
    yule_walker,
)

seeds = st.integers(0, 2**32 - 1)


def coloured(rng, n, ar, sd=1.0):
    """Return an autoregressive series with the given coefficients."""
    x = np.zeros(n + 200)
    e = sd * rng.normal(0.0, 1.0, n + 200)
    for t in range(len(ar), n + 200):
        x[t] = e[t] + sum(a * x[t - 1 - k] for k, a in enumerate(ar))
    return x[200:]


def weights(rng, n, holes=4):
    weight = np.ones(n, dtype=np.uint8)
    for _ in range(holes):
        at = int(rng.integers(0, n))
        weight[at : at + int(rng.integers(1, 10))] = 0
    return weight


@examples(40)
@given(seeds, st.integers(0, 6), st.integers(1, 60))
def test_lagged_products_are_means_over_pairs_of_weighted_rows(seed, order, n):
    rng = np.random.default_rng(seed)
    x, w = rng.normal(0.0, 1.0, n), weights(rng, n)
    got = lagged_products(x, w, order)
    for k in range(order + 1):
        pairs = [x[t] * x[t - k] for t in range(k, n) if w[t] and w[t - k]]
        assert got[k] == pytest.approx(sum(pairs) / len(pairs) if pairs else 0.0, abs=1e-12)


@examples(40)
@given(seeds, st.integers(1, 80), st.integers(1, 3))
def test_whitening_is_the_filter_where_the_history_is_complete(seed, n, columns):
    rng = np.random.default_rng(seed)
    table, w = rng.normal(0.0, 1.0, (n, columns)), weights(rng, n)
    ar = rng.normal(0.0, 0.3, ORDER)
    expected = [
        [table[t, c] - sum(ar[k] * table[t - 1 - k, c] for k in range(ORDER))
         for c in range(columns)]
        for t in range(ORDER, n)
        if w[t - ORDER : t + 1].all()
    ]  # fmt: skip
    got = whitened(table, w, ar)
    assert got.shape == (len(expected), columns)
    if expected:
        assert got == pytest.approx(np.array(expected), abs=1e-12)


@needs_jit
@pytest.mark.parametrize('true', [[0.7], [0.5, 0.3], [0.6, -0.3, 0.2, 0.1], [0.0]])
def test_the_coefficients_are_found_and_the_rest_is_white(true):
    rng = np.random.default_rng(11)
    x, w = coloured(rng, 40_000, true), weights(rng, 40_000, 50)
    ar = fit_ar(x, w)
    padded = np.zeros(ORDER)
    padded[: len(true)] = true
    assert ar == pytest.approx(padded, abs=0.03)
    rest = whitened(x, w, ar)[:, 0]
    assert rest.std() == pytest.approx(1.0, rel=0.03)
    for k in range(1, 6):
        assert abs(np.corrcoef(rest[k:], rest[:-k])[0, 1]) < 0.03


@needs_jit
def test_white_noise_is_not_inflated_and_correlated_noise_as_theory_says():
    rng = np.random.default_rng(3)
    w = np.ones(60_000, dtype=np.uint8)
    assert inflation(rng.normal(0, 1, 60_000), w, 100) == pytest.approx(1.0, abs=0.1)
    a = 0.9
    theory = (1.0 + a) / (1.0 - a)
    assert inflation(coloured(rng, 60_000, [a]), w, 300) == pytest.approx(theory, rel=0.15)
    assert inflation(coloured(rng, 60_000, [-0.5]), w, 100) == 1.0


@pytest.mark.parametrize('n', [0, 1, 4, 5, 100])
@pytest.mark.parametrize(('value', 'weight'), [(0.0, 1), (3.0, 1), (3.0, 0)])
def test_a_residual_without_information_gives_finite_numbers(n, value, weight):
    x, w = np.full(n, value), np.full(n, weight, dtype=np.uint8)
    ar = fit_ar(x, w)
    assert np.isfinite(ar).all()
    left = whitened(x, w, ar)
    assert np.isfinite(left).all()
    assert len(left) == weight * max(0, n - ORDER)
    assert 1.0 <= inflation(x, w, min(20, n + 1)) < math.inf


@examples(40)
@given(seeds, st.integers(0, 60), st.integers(1, 4), st.integers(0, 5), st.integers(1, 7))
def test_normal_equations_are_the_products_of_whitened_columns(seed, rows, columns, order, blocks):
    rng = np.random.default_rng(seed)
    table = rng.normal(0.0, 1.0, (rows, columns))
    residual = rng.normal(0.0, 1.0, rows)
    weight = (rng.random(rows) < 0.9).astype(np.uint8)
    ar = rng.normal(0.0, 0.3, order)
    sums, scores, count = normal_equations(table, residual, weight, ar, blocks)
    both = whitened(np.column_stack([table, residual]), weight, ar)
    assert count == len(both)
    assert sums == pytest.approx(both.T @ both, abs=1e-9)
    assert scores.shape == (blocks, columns)
    assert scores.sum(axis=0) == pytest.approx(sums[:-1, -1], abs=1e-9)
    assert square_sum(residual, weight, ar) == pytest.approx((sums[-1, -1], count), abs=1e-9)


def test_yule_walker_says_where_there_is_no_one_solution():
    with pytest.raises(np.linalg.LinAlgError):
        yule_walker(np.ones(3))
