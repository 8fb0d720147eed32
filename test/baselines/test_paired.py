# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tests of a mean difference: the paper's, and those that count what samples are worth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from streams import needs_jit

from valveflow_ros.baselines.judged import (
    over_blocks,
    over_samples,
    widening_of,
)


def ar1(n, phi, rng):
    e = rng.standard_normal(n + 200)
    for t in range(1, len(e)):
        e[t] += phi * e[t - 1]
    return e[200:]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 60), st.floats(-2.0, 2.0))
def test_counting_each_sample_is_the_textbooks_paired_test(seed, n, shift):
    rng = np.random.default_rng(seed)
    y, predicted = rng.normal(shift, 1.0, n), rng.normal(0.0, 1.0, n)
    ours, theirs = over_samples(y - predicted), stats.ttest_rel(y, predicted)
    assert ours.t == pytest.approx(theirs.statistic, rel=1e-9)
    assert ours.p_value == pytest.approx(theirs.pvalue, rel=1e-6, abs=1e-12)
    low, high = ours.interval()
    wanted = theirs.confidence_interval(0.95)
    np.testing.assert_allclose([low, high], [wanted.low, wanted.high], rtol=1e-8)


@needs_jit
def test_correlated_noise_fools_the_one_and_not_the_other():
    """Under the null, a zero mean is rejected ever so often at 5 %."""
    rng = np.random.default_rng(12)
    naive = counted = 0
    for _ in range(150):
        segments = [ar1(400, 0.97, rng) for _ in range(12)]
        edges = np.arange(13) * 400
        spans = np.column_stack([edges[:-1], edges[1:]])
        widening = widening_of(np.concatenate(segments), spans, 1.0)
        naive += over_samples(segments[0]).zero_is_rejected()
        counted += over_samples(segments[0], widening).zero_is_rejected()
    assert naive > 100
    # A dozen short segments teach the correlation roughly; 5 % becomes 5 to 15 %.
    assert counted < 23


def test_means_of_blocks_hold_their_level():
    rng = np.random.default_rng(13)
    rejected = sum(over_blocks(ar1(80, 0.4, rng)).zero_is_rejected() for _ in range(300))
    assert rejected < 45
    plain = sum(over_samples(ar1(80, 0.4, rng)).zero_is_rejected() for _ in range(300))
    assert plain > rejected


def test_independent_blocks_are_worth_nearly_all_of_them():
    rng = np.random.default_rng(14)
    worth = [over_blocks(rng.standard_normal(200)).effective for _ in range(50)]
    assert 140.0 < np.median(worth) <= 200.0


@needs_jit
@pytest.mark.parametrize('phi', [0.0, 0.8, 0.95])
def test_the_widening_of_a_known_noise(phi):
    rng = np.random.default_rng(15)
    edges = np.arange(101) * 600
    spans = np.column_stack([edges[:-1], edges[1:]])
    found = widening_of(ar1(60_000, phi, rng), spans, 1.0)
    assert found == pytest.approx((1.0 + phi) / (1.0 - phi), rel=0.3)


@needs_jit
def test_rows_between_stretches_do_not_matter():
    rng = np.random.default_rng(16)
    residual = rng.standard_normal(3000)
    spans = np.array([[0, 1000], [2000, 3000]])
    before = widening_of(residual, spans, 1.0)
    residual[1000:2000] = 1e9
    assert widening_of(residual, spans, 1.0) == before
    assert widening_of(residual, np.empty((0, 2), dtype=np.int64), 1.0) == 1.0


def test_what_cannot_be_tested_says_so():
    for difference, widening in ((np.array([1.0]), 1.0), (np.arange(5.0), 4.0), (np.empty(0), 1)):
        test = over_samples(difference, widening)
        assert np.isnan(test.p_value)
        assert not test.zero_is_rejected()
        assert np.isnan(test.interval()).all()
    assert np.isnan(over_blocks(np.array([3.0])).p_value)
    assert np.isnan(over_blocks(np.empty(0)).mean)


def test_no_scatter_at_all():
    same = over_samples(np.full(10, 2.0))
    assert (same.p_value, same.t) == (0.0, np.inf)
    assert over_samples(np.zeros(10)).p_value == 1.0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.floats(0.1, 50.0))
def test_scaling_changes_no_verdict(seed, scale):
    values = np.random.default_rng(seed).normal(0.3, 1.0, 40)
    for test in (over_samples, over_blocks):
        a, b = test(values), test(scale * values)
        assert b.t == pytest.approx(a.t, rel=1e-6)
        assert b.mean == pytest.approx(scale * a.mean, rel=1e-6)
        assert test(-values).t == pytest.approx(-a.t, rel=1e-9)
