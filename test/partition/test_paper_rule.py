# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The paper's rule (24), its guard, and its answer where there is no choice."""

import math

import naive
import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from partition_kinds import samples

from valveflow_ros.errors import DataError, ParameterError
from valveflow_ros.partition.paper_rule import paper_rule, select
from valveflow_ros.partition.partition import partition

COMPILED = not numba.config.DISABLE_JIT
N = 2000 if COMPILED else 150

# Any costs at all, zeros, ties and rises among them.
COSTS = st.lists(
    st.one_of(st.just(0.0), st.floats(0.0, 1e6), st.sampled_from([1.0, 2.0])),
    min_size=3,
    max_size=12,
)
# Costs that fall strictly, where eq. (24) is defined as it stands.
FALLING = st.lists(st.floats(1.001, 100.0), min_size=3, max_size=11).map(
    lambda factors: (1e9 / np.cumprod(factors)).tolist()
)


@given(FALLING, st.floats(1e-9, 1e9))
def test_the_rule_is_equation_24_and_knows_no_scale(cost, factor):
    angles, pieces = paper_rule(cost)
    assert paper_rule([factor * c for c in cost])[0] == pytest.approx(angles, abs=1e-9)
    truth = naive.turning_angle(cost)
    assert angles == pytest.approx(truth, abs=1e-9)
    assert truth[pieces] == pytest.approx(max(truth.values()), abs=1e-9)


@given(COSTS)
def test_the_rule_always_answers_within_its_range(cost):
    angles, pieces = paper_rule(cost)
    assert list(angles) == list(range(2, len(cost)))
    assert all(-1.0 <= angle <= 1.0 for angle in angles.values())  # so none is NaN
    assert 2 <= pieces <= len(cost) - 1
    assert angles[pieces] == max(angles.values())


@pytest.mark.parametrize(
    ('cost', 'exact', 'pieces', 'known'),
    [
        ([100.0, 20.0, 10.0, 0.0, 0.0, 0.0], 0.0, 4, {3: -1.0, 4: 1.0, 5: -1.0}),
        ([100.0, 20.0, 10.0, 1e-9, 1e-10, 1e-12], 1e-6, 4, {}),
        ([100.0, 20.0, 10.0, 0.0], 0.0, 2, {3: -1.0}),  # an exact fit at the end is no turn
        ([27.0, 9.0, 9.0, 3.0, 3.0], 0.0, 2, {}),  # of equal turns the fewest pieces win
    ],
)
def test_the_first_exact_fit_is_the_turn(cost, exact, pieces, known):
    angles, found = paper_rule(cost, exact=exact)
    assert found == pieces
    assert angles.items() >= known.items()


@pytest.mark.parametrize(
    ('cost', 'words'),
    [
        *((cost, f'there are costs for {len(cost)}') for cost in ([], [1.0], [2.0, 1.0])),
        *(([3.0, bad, 1.0], 'finite and not negative') for bad in (math.nan, math.inf, -1.0)),
    ],
)
def test_costs_without_a_turn_are_refused(cost, words):
    with pytest.raises(DataError, match=words):
        paper_rule(cost)


def test_the_paper_s_curve_has_four_pieces():
    u, y = samples('noiseless', N)
    found = partition(u, y + np.random.default_rng(6).normal(0, 0.5, N))
    assert select(partition(u, y)).pieces == 4
    selection = select(found)
    assert selection.pieces == 4
    assert selection.note == ''
    assert list(selection.cost) == list(range(1, 11))
    assert selection.cost[4] == found.cost[3]
    assert list(selection.turning_angle) == list(range(2, 10))


@pytest.mark.parametrize('kind', ['noise', 'binary', 'cauchy_u'])
@pytest.mark.parametrize('seed', range(2))
def test_noise_about_a_line_is_one_piece(kind, seed):
    u, y = samples(kind, N, seed)
    selection = select(partition(u, y))
    assert selection.pieces == 1
    assert selection.note.startswith('No break lowers the cost by more than chance')
    assert len(selection.turning_angle) == 8  # still reported


@pytest.mark.parametrize(
    'y',
    [lambda u: 0.0 * u, lambda u: (0.24 * u - 100.0).astype(np.float32), lambda u: 1e8 + u * 1e-3],
)
def test_an_exact_line_is_one_piece(y):
    u, _ = samples('straight', N)
    selection = select(partition(u, y(u)))
    assert selection.pieces == 1
    assert selection.note == 'One line fits exactly.'


def test_few_distinct_u_leave_few_choices():
    r = np.random.default_rng(4)
    u = np.repeat(np.arange(4.0), 60)
    kinked = np.abs(u - 1.5) + 0.01 * r.normal(size=240)
    selection = select(partition(u, kinked))
    assert selection.pieces == 2
    assert selection.turning_angle == {}
    assert 'only 2 are possible' in selection.note
    assert select(partition(u, u + 0.01 * r.normal(size=240))).pieces == 1
    single = select(partition(u[u < 3.0], kinked[u < 3.0]))
    assert single.pieces == 1
    assert '3 distinct u' in single.note


def test_impossible_inflations_are_refused():
    found = partition(np.arange(30.0), np.arange(30.0) ** 2)
    for bad in (0.5, math.nan, math.inf):
        with pytest.raises(ParameterError, match='correlation_inflation'):
            select(found, correlation_inflation=bad)
