# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One change of a mean: found where obvious loops find it, and rarely where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import examples

from valveflow_ros.curve.segment_residual import LEAST_SIDE, moment_of, scan


def series(seed, n, at=None, size=0.0):
    rng = np.random.default_rng(seed)
    values = rng.normal(0.0, 1.0, n)
    if at is not None:
        values[at:] += size
    return values, rng.uniform(0.3, 1.0, n)


def best_split(values, weights):
    """Return the split with the least weighted squares about two means, by trying each."""
    best = (np.inf, 0)
    for k in range(LEAST_SIDE, len(values) - LEAST_SIDE + 1):
        cost = 0.0
        for part in (slice(0, k), slice(k, len(values))):
            mean = np.sum(weights[part] * values[part]) / np.sum(weights[part])
            cost += float(np.sum(weights[part] * (values[part] - mean) ** 2))
        best = min(best, (cost, k))
    return best[1]


seeds = st.integers(0, 2**32 - 1)


@examples(60)
@given(seeds, st.integers(2 * LEAST_SIDE, 60))
def test_the_place_is_the_one_of_least_squares(seed, n):
    values, weights = series(seed, n)
    found = scan(values, weights)
    assert found.place == best_split(values, weights)
    assert np.argmax(found.likelihood) == found.place


@examples(40)
@given(seeds, st.integers(10, 50), st.floats(-1e3, 1e3), st.floats(0.1, 50.0))
def test_level_and_unit_make_no_difference(seed, n, level, unit):
    values, weights = series(seed, n)
    one, two = scan(values, weights), scan(level + unit * values, 3.0 * weights)
    assert two.place == one.place
    assert two.p_value == pytest.approx(one.p_value, rel=1e-4, abs=1e-12)
    assert two.after - two.before == pytest.approx(unit * (one.after - one.before), abs=1e-6)
    assert two.after_error == pytest.approx(unit * one.after_error, rel=1e-4)


@examples(30)
@given(seeds, st.integers(20, 60))
def test_turned_round_in_time_it_is_the_same_change(seed, n):
    values, weights = series(seed, n)
    one, two = scan(values, weights), scan(values[::-1], weights[::-1])
    assert two.place == n - one.place
    assert two.p_value == pytest.approx(one.p_value, rel=1e-6)


def test_without_a_change_one_is_seen_no_more_often_than_said():
    limit = 0.01
    chances = [scan(*series(seed, 60)).p_value for seed in range(1000)]
    # The correction for correlated neighbours makes it see rather less.
    assert np.mean(np.array(chances) < limit) <= 2.0 * limit


def test_a_change_is_found_and_dated():
    times = 1000 * np.arange(80, dtype=np.int64)
    inside = 0
    for seed in range(60):
        found = scan(*series(seed, 80, 50, 2.0))
        assert found.p_value < 1e-3
        middle, low, high = moment_of([times], [found])
        assert low <= middle <= high
        inside += low <= 49_500 <= high
    assert inside >= 52


def test_two_series_together_date_it_better():
    times = 1000 * np.arange(80, dtype=np.int64)

    def width(*seeds_used):
        scans = [scan(*series(s, 80, 50, 1.5)) for s in seeds_used]
        _, low, high = moment_of([times + 7 * k for k in range(len(scans))], scans)
        return high - low

    alone = np.median([width(s) for s in range(40)])
    together = np.median([width(s, s + 1000) for s in range(40)])
    assert together < 0.7 * alone


@pytest.mark.parametrize('surest', [0, 1])
def test_series_that_never_overlap_are_dated_by_the_surest(surest):
    """Low load in one week, high load in the next: no moment lies within both."""
    times = [1000 * np.arange(80, dtype=np.int64) + 10**6 * k for k in range(2)]
    scans = [scan(*series(k, 80, 50, 3.0 if k == surest else 1.0)) for k in range(2)]
    assert moment_of(times, scans) == moment_of([times[surest]], [scans[surest]])
    assert 10**6 * surest <= moment_of(times, scans)[0] <= 10**6 * surest + 79_000


def test_members_all_at_one_time_tell_no_moment():
    assert moment_of([np.zeros(80, dtype=np.int64)], [scan(*series(1, 80))]) == (0, 0, 0)


@pytest.mark.parametrize('unit', [1e-3, 1.0, 1e3])
@pytest.mark.parametrize('n', [12, 400])
def test_a_change_without_any_noise_is_certain(n, unit):
    found = scan(unit * np.repeat([0.0, 1.0], n // 2), np.full(n, 900.0))
    assert (found.place, found.p_value) == (n // 2, 0.0)
    middle, low, high = moment_of([1000 * np.arange(n, dtype=np.int64)], [found])
    assert 1000 * (n // 2 - 1) <= low <= middle <= high <= 1000 * (n // 2)


def test_short_and_still_series():
    assert scan(*series(1, 2 * LEAST_SIDE - 1)) is None
    assert scan(*series(1, 30), first=27) is None
    assert scan(np.zeros(20), np.ones(20)).p_value == 1.0
    only_late = scan(*series(3, 60, 20, 5.0), first=40)
    assert only_late.place >= 40
