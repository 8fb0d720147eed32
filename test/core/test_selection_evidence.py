"""The number of pieces by evidence: right on samples of known pieces, and honest about it."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from selection_kinds import KINDS, SEEDS_FOR_TESTS, draw
from streams import examples

from valveflow_ros.fit.knots import KNEE_GAIN, confidence, shifted
from valveflow_ros.partition.partition import partition
from valveflow_ros.partition.selection import select
from valveflow_ros.partition.series import Series, Workshop, describe, thinned

COMPILED = not numba.config.DISABLE_JIT
N = 2000 if COMPILED else 400
needs_speed = pytest.mark.skipif(not COMPILED, reason='too many samples for interpreted loops')


def in_time(u, y):
    fresh = np.zeros(len(u), dtype=bool)
    fresh[0] = True
    return Series(u, y, fresh)


def chosen(kind, seed, n=N):
    data = draw(kind, n, seed)
    found = partition(data.u, data.y, 10, max(2, n // 100), threads=1)
    return select(found, series=in_time(data.u, data.y))


# --- right, and sure ------------------------------------------------------------------------


@needs_speed
@pytest.mark.parametrize('kind', KINDS)
def test_the_number_is_right_on_kinds_where_the_paper_s_rule_fails(kind):
    selection = chosen(kind, SEEDS_FOR_TESTS[kind])
    assert selection.pieces == KINDS[kind]
    assert selection.confidence[KINDS[kind]] == max(selection.confidence.values()) > 0.4
    assert f'J = {KINDS[kind]} has ' in selection.note


@needs_speed
def test_without_the_order_of_time_memory_is_taken_for_knees():
    """The order is what tells a shared error from a bend, so it has to be given."""
    data = draw('J=1 AR .9', N, 9)
    found = partition(data.u, data.y, 10, N // 100, threads=1)
    assert select(found, series=in_time(data.u, data.y)).pieces == 1
    assert select(found).pieces > 1


@needs_speed
def test_less_noise_makes_surer():
    data = draw('J=4 weak knees', N, 3)
    truth = draw('J=4 weak knees', N, 3, noise=0.0)
    sure = []
    for factor in (3.0, 1.0, 0.3):
        y = truth.y + factor * (data.y - truth.y)
        selection = select(partition(data.u, y, 10, N // 100), series=in_time(data.u, y))
        sure.append(sum(p for j, p in selection.confidence.items() if j >= 4))
    assert sure[0] < sure[1] < sure[2] + 1e-3
    assert sure[2] > 0.99


# --- what a probability has to be ------------------------------------------------------------


@examples(8)
@given(
    st.sampled_from(sorted(KINDS)), st.integers(0, 999), st.sampled_from([0.01, 40.0]),
    st.sampled_from([-1e3, 1e5]),
)  # fmt: skip
def test_probabilities_sum_to_one_and_units_change_nothing(kind, seed, factor, shift):
    data = draw(kind, 300, seed)
    here = select(partition(data.u, data.y, 5, 5), series=in_time(data.u, data.y))
    assert sum(here.confidence.values()) == pytest.approx(1.0)
    assert all(0.0 <= p <= 1.0 for p in here.confidence.values())
    assert here.pieces == max(here.confidence, key=here.confidence.get)
    assert set(here.confidence) <= set(here.cost)
    u, y = 2.0 * data.u + shift, factor * data.y - shift
    there = select(partition(u, y, 5, 5), series=in_time(u, y))
    assert there.confidence == pytest.approx(here.confidence, abs=1e-3)


@pytest.mark.parametrize('n', [4, 5, 6, 8, 12, 20, 30])
def test_a_handful_of_samples_has_no_knees(n):
    y = np.random.default_rng(n).normal(size=n)
    selection = select(partition(np.arange(float(n)), y))
    assert selection.pieces == 1
    assert math.isclose(sum(selection.confidence.values()), 1.0)


@pytest.mark.parametrize('offset', [0.0, 1e6])
def test_an_outlier_is_no_knee(offset):
    r = np.random.default_rng(4)
    u, y = r.uniform(size=300), 1e-3 * r.normal(size=300)
    y[100] = 1e3
    assert select(partition(u, y + offset)).pieces == 1


def test_equal_u_bring_no_memory_of_their_own():
    """The partition sorts equal u by y; taken as an order of time that would be memory."""
    r = np.random.default_rng(5)
    u = np.repeat(np.arange(6.0), 60)
    selection = select(partition(u, u + r.normal(size=360)))
    assert 'memory' not in selection.note


# --- the parts -------------------------------------------------------------------------------


def test_the_noise_s_memory_width_and_tails_are_learnt():
    r = np.random.default_rng(6)
    n = 4000
    u = r.uniform(size=n)
    e = r.standard_t(3, n)
    for t in range(1, n):
        e[t] += 0.8 * e[t - 1]
    noise, rows = describe(in_time(u, e), e * (1.0 + 3.0 * u))
    assert noise.ar.sum() == pytest.approx(0.8, abs=0.05)
    assert noise.dof <= 4.0
    low, high = noise.width[u < 0.1].mean(), noise.width[u > 0.9].mean()
    assert 2.0 < high / low < 4.5
    assert len(rows) == n - 4
    plain, _ = describe(in_time(u, u), r.normal(size=n))
    assert not len(plain.ar)
    assert plain.dof >= 10.0


def test_a_series_knows_what_follows_what():
    u, y = np.arange(100.0), np.arange(100.0) ** 2
    spans = np.array([[10, 20, 1], [20, 30, 2], [50, 57, 1]])
    series = Series.of_spans(u, y, spans)
    assert series.u.tolist() == [*range(10, 30), *range(50, 57)]
    assert np.flatnonzero(series.fresh).tolist() == [0, 20]
    assert series.with_history(4).tolist() == [*range(4, 20), *range(24, 27)]
    coarse = series.coarser(9)
    assert coarse.u.tolist() == [11.0, 14.0, 17.0, 20.0, 23.0, 26.0, 51.0, 54.0]
    assert coarse.fresh.tolist() == [True, *[False] * 5, True, False]
    assert series.coarser(27) is series


@examples(10)
@given(st.integers(0, 2**32 - 1), st.integers(0, 4))
def test_a_line_is_its_columns_times_its_coefficients(seed, count):
    r = np.random.default_rng(seed)
    shop = Workshop(in_time(r.uniform(size=80), r.normal(size=80)), np.arange(80))
    knots = thinned(shop, r.uniform(0.1, 0.9, count))
    jumps = r.uniform(size=len(knots)) < 0.5
    coefficients = r.normal(size=len(knots) + 2 + int(jumps.sum()))
    slow = shop.y - shop.design(knots, jumps) @ coefficients
    assert shop.residual(knots, jumps, coefficients) == pytest.approx(slow, abs=1e-9)


# --- the joint fit ---------------------------------------------------------------------------

worths = st.integers(1, 8).flatmap(
    lambda j: st.lists(st.floats(0.0, 300.0), min_size=j, max_size=j)
).map(lambda gains: dict(enumerate(gains, start=2)))  # fmt: skip


@given(worths, st.integers(1, 12))
def test_what_pieces_are_worth_becomes_probabilities(worth, most):
    likely = confidence(worth, most)
    assert list(likely) == list(range(1, most + 1))
    assert sum(likely.values()) == pytest.approx(1.0)
    for j in range(2, min(most, max(worth)) + 1):
        # A piece worth more than the threshold makes J likelier than J - 1, else not.
        if likely[j] > 1e-12 and likely[j - 1] > 1e-12:
            assert (likely[j] >= likely[j - 1]) == (worth[j] >= KNEE_GAIN)


def test_a_line_that_nothing_was_tried_against_is_sure():
    assert confidence({}, 1) == {1: 1.0}
    assert confidence({2: 1e9}, 2)[2] == pytest.approx(1.0)


def test_pieces_merged_later_shift_the_probabilities():
    likely = {1: 0.1, 2: 0.2, 3: 0.7}
    assert shifted(likely, 0) == pytest.approx(likely)
    assert shifted(likely, -1) == pytest.approx({1: 2 / 9, 2: 7 / 9})
    assert shifted(likely, 1) == pytest.approx({2: 0.1, 3: 0.2, 4: 0.7})
    assert shifted({}, 3) == {}
