# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One change of a mean: found where obvious loops find it, and rarely where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import examples

from valveflow_ros.curve.segment_residual import (
    LEAST_SIDE,
    SegmentResiduals,
    common_change,
    scan,
)


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


def piece(values, weights, times=None):
    times = 1000 * np.arange(len(values), dtype=np.int64) if times is None else times
    samples = np.round(900.0 * weights).astype(np.int64)
    return SegmentResiduals(times, np.full(len(values), 1400.0), values, samples)


@examples(60)
@given(seeds, st.integers(2 * LEAST_SIDE, 60))
def test_the_place_is_the_one_of_least_squares(seed, n):
    values, weights = series(seed, n)
    found = scan(values, weights)
    assert found.place == best_split(values, weights)


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
    inside = 0
    for seed in range(60):
        values = series(seed, 80, 50, 2.0)
        assert scan(*values).p_value < 1e-3
        middle, low, high = common_change([piece(*values)], -1)
        assert low <= middle <= high
        inside += low <= 49_500 <= high
    assert inside >= 52


@examples(40)
@given(seeds, st.integers(5, 40), st.integers(5, 40), st.floats(0.1, 0.9))
def test_several_pieces_change_where_their_least_squares_say(seed, n, m, share):
    """The truth is a loop over all times; a piece may have all its members on one side."""
    rng = np.random.default_rng(seed)
    times = [np.sort(rng.choice(10**6, k, replace=False)).astype(np.int64) for k in (n, m)]
    at = int(share * 10**6)
    pieces = [
        piece(rng.normal(0.0, 0.1, len(t)) + jump * (t > at), np.ones(len(t)), t)
        for t, jump in zip(times, (5.0, -7.0), strict=True)
    ]
    edges = np.unique(np.concatenate(times))
    costs = []
    for split in edges[:-1]:
        parts = [p.residual_mw[side] for p in pieces
                 for side in (p.time_ns <= split, p.time_ns > split)]  # fmt: skip
        costs.append(sum(float(np.sum((part - part.mean()) ** 2)) for part in parts if len(part)))
    best = int(np.argmin(costs))
    middle, low, high = common_change(pieces, -1)
    if any(0 < np.sum(p.time_ns > at) < len(p) for p in pieces):
        assert edges[best] <= low <= middle <= high <= edges[best + 1]


def test_two_pieces_together_date_it_better():
    def width(*seeds_used):
        times = 1000 * np.arange(80, dtype=np.int64)
        pieces = [piece(*series(s, 80, 50, 1.5), times + 7 * k) for k, s in enumerate(seeds_used)]
        _, low, high = common_change(pieces, -1)
        return high - low

    alone = np.median([width(s) for s in range(40)])
    together = np.median([width(s, s + 1000) for s in range(40)])
    assert together < 0.7 * alone


@pytest.mark.parametrize('after', [1, 2, 3])
def test_few_members_after_the_change_date_it(after):
    """A young fault: the unit has been at the loads of each piece only once or twice since."""
    times = 1000 * np.arange(30, dtype=np.int64)
    pieces = [piece(*series(k, 30, 30 - after, -11.0), times + 300 * k) for k in range(2)]
    _, low, high = common_change(pieces, -1)
    assert times[29 - after] <= low <= high <= times[30 - after] + 300


@pytest.mark.parametrize('surest', [0, 1])
def test_pieces_in_weeks_of_their_own_are_dated_by_the_surest(surest):
    """Low load in one week, high load in the next, each with a change of its own."""
    pieces = [
        piece(
            *series(k, 80, 50, 3.0 if k == surest else 1.0),
            1000 * np.arange(80, dtype=np.int64) + 10**6 * k,
        )
        for k in range(2)
    ]
    middle = common_change(pieces, -1)[0]
    assert abs(middle - 10**6 * surest - 49_500) < 5_000


def test_changes_before_the_known_time_are_left_out():
    pieces = [piece(*series(1, 80, 30, 5.0))]
    assert common_change(pieces, 60_000) == (0, 0, 0)
    assert common_change(pieces, 10**9) == (0, 0, 0)
    assert common_change(pieces, 20_000)[0] == pytest.approx(29_500, abs=600)
    times = 1000 * np.arange(80, dtype=np.int64)
    times[30:] += 10**6  # no member for a long time, and the known time is in between
    middle, low, high = common_change([piece(*series(1, 80, 30, 5.0), times)], 900_000)
    assert 900_000 <= low <= middle <= high <= times[30]


@pytest.mark.parametrize('n', [4, 6, 40])
def test_no_change_has_no_time(n):
    limit = 0.01
    dated = [common_change([piece(*series(s, n)), piece(*series(s + 1000, n))], -1)[0]
             for s in range(500)]  # fmt: skip
    assert np.mean(np.array(dated) > 0) <= 2.0 * limit
    still = piece(*series(1, 80), np.zeros(80, dtype=np.int64))
    assert common_change([still], -1) == (0, 0, 0)


@pytest.mark.parametrize('unit', [1e-3, 1.0, 1e3])
@pytest.mark.parametrize('n', [12, 400])
def test_a_change_without_any_noise_is_certain(n, unit):
    found = scan(unit * np.repeat([0.0, 1.0], n // 2), np.full(n, 900.0))
    assert (found.place, found.p_value) == (n // 2, 0.0)
    change = unit * np.repeat([0.0, 1.0], n // 2)
    middle, low, high = common_change([piece(change, np.ones(n))], -1)
    assert 1000 * (n // 2 - 1) <= low <= middle <= high <= 1000 * (n // 2)


def test_short_and_still_series():
    assert scan(*series(1, 2 * LEAST_SIDE - 1)) is None
    assert scan(*series(1, 30), first=27) is None
    assert scan(np.zeros(20), np.ones(20)).p_value == 1.0
    only_late = scan(*series(3, 60, 20, 5.0), first=40)
    assert only_late.place >= 40
