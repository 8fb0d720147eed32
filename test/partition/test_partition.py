# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The partition as its users see it: truth, relations, hostile input, the trap."""

import itertools
import math
import os
import subprocess
import sys
from pathlib import Path

import naive
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from partition_kinds import KINDS, samples

from valveflow_ros.errors import DataError, ParameterError, TooFewSamplesError
from valveflow_ros.partition.partition import partition

COMPILED = not numba.config.DISABLE_JIT
ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = settings(max_examples=20 if COMPILED else 3)
SEEDS = st.integers(0, 10**6)


def random_samples(seed, most=150):
    """Return samples of a random kind and size."""
    r = np.random.default_rng(seed)
    kind = list(KINDS)[r.integers(len(KINDS))]
    return samples(kind, int(r.integers(8, most)), seed)


def noisy_samples(seed):
    """Return samples whose best breaks are unique, sorted."""
    r = np.random.default_rng(seed)
    u = np.sort(r.uniform(0.0, 1.0, int(r.integers(10, 150))))
    return u, np.abs(u - 0.4) + 0.1 * r.normal(size=len(u))


# --- truth ----------------------------------------------------------------------------------


@EXAMPLES
@given(SEEDS, st.integers(2, 5), st.booleans())
def test_costs_are_the_least(seed, shortest, weighted):
    r = np.random.default_rng(seed)
    u = np.sort(r.choice(np.arange(400), int(r.integers(20, 60)), replace=False) / 7.0)
    y = r.normal(size=len(u)) + np.abs(u - 20.0)
    weight = 10.0 ** r.uniform(-2.0, 2.0, len(u)) if weighted else np.ones(len(u))
    found = partition(u, y, 4, shortest, weight=weight if weighted else None)
    truth = naive.best_costs(naive.piece_costs(u, y, weight), 4, shortest)
    assert found.certified
    assert found.cost == pytest.approx([float(row[-1]) for row in truth], rel=1e-9)
    for j in range(1, 5):
        pieces = found.pieces(j)
        assert sum(p.sse for p in pieces) == pytest.approx(found.cost[j - 1], abs=found.floor)


@EXAMPLES
@given(SEEDS)
def test_whole_weights_are_repeated_samples_and_a_common_factor_scales_the_cost(seed):
    r = np.random.default_rng(seed)
    u = np.sort(r.uniform(0.0, 10.0, 40))
    y = np.abs(u - 4.0) + 0.1 * r.normal(size=40)
    times = r.integers(1, 5, 40)
    order = r.permutation(40)
    found = partition(u[order], y[order], 4, weight=times[order])
    repeated = partition(np.repeat(u, times), np.repeat(y, times), 4)
    assert found.cost == pytest.approx(repeated.cost, rel=1e-9)
    for one, other in zip(found.pieces(3), repeated.pieces(3), strict=True):
        assert one.slope == pytest.approx(other.slope)
        assert (one.u_from, one.u_to) == (other.u_from, other.u_to)
    assert partition(u, y, 4, weight=7.5 * times).cost == pytest.approx(7.5 * found.cost)


@pytest.mark.parametrize('kind', KINDS)
def test_a_partition_is_what_it_says(kind):
    u, y = samples(kind, 300 if COMPILED else 70)
    found = partition(u, y, 6)
    assert found.certified
    assert found.limited == ''
    assert found.n_samples == len(u)
    assert np.all(np.diff(found.u) >= 0)
    for j in range(1, 7):
        breaks, pieces = found.breaks(j), found.pieces(j)
        assert len(pieces) == j
        assert breaks.dtype == np.int64
        assert breaks[0] == 0
        assert breaks[-1] == len(u)
        assert pieces[0].u_from == u.min()
        assert pieces[-1].u_to == u.max()
        assert all(a.u_to == b.u_from for a, b in itertools.pairwise(pieces))
        assert [p.samples for p in pieces] == np.diff(breaks).tolist()
        assert sum(p.sse for p in pieces) == pytest.approx(found.cost[j - 1], abs=found.floor)
        assert all(len(np.unique(found.u[a:b])) >= 2 for a, b in itertools.pairwise(breaks))


def test_a_piece_is_the_least_squares_line_with_its_errors():
    u, y = samples('valve', 200)
    found = partition(u, y, 3)
    for (a, b), piece in zip(itertools.pairwise(found.breaks(3)), found.pieces(3), strict=True):
        table = np.column_stack([found.u[a:b], np.ones(b - a)])
        (slope, intercept), rest, *_ = np.linalg.lstsq(table, found.y[a:b], rcond=None)
        errors = np.sqrt(np.diag(rest[0] / (b - a - 2) * np.linalg.inv(table.T @ table)))
        assert (piece.slope, piece.intercept, piece.sse) == pytest.approx(
            (slope, intercept, rest[0])
        )
        assert (piece.slope_stderr, piece.intercept_stderr) == pytest.approx(tuple(errors))


# --- relations ------------------------------------------------------------------------------


# What is done to u and y: the factor of the cost, and what becomes of the n breaks b.
RELATIONS = {
    'repeated': (lambda u, y: (np.repeat(u, 3), np.repeat(y, 3)), 3.0, lambda b, n: 3 * b),
    'y scaled': (lambda u, y: (u, -1e5 * y), 1e10, lambda b, n: b),
    'y scaled down': (lambda u, y: (u, 1e-6 * y), 1e-12, lambda b, n: b),
    'u reversed': (lambda u, y: (-u, y), 1.0, lambda b, n: n - b[::-1]),
    'a line added': (lambda u, y: (u, y + 30.0 * u - 7.0), 1.0, lambda b, n: b),
    'u in other units': (lambda u, y: (1e-30 * u, y), 1.0, lambda b, n: b),
    'u in large units': (lambda u, y: (1e90 * u, y), 1.0, lambda b, n: b),
    'all far from zero': (lambda u, y: (u + 1e4, y - 1e4), 1.0, lambda b, n: b),
}


@pytest.mark.parametrize('name', RELATIONS)
@EXAMPLES
@given(SEEDS)
def test_cost_and_breaks_follow_what_is_done_to_the_samples(name, seed):
    u, y = noisy_samples(seed)
    change, factor, mapped = RELATIONS[name]
    here, there = partition(u, y, 4), partition(*change(u, y), 4)
    assert there.cost == pytest.approx(factor * here.cost, rel=1e-6)
    assert there.n_distinct == here.n_distinct
    for j in range(1, 5):
        assert np.array_equal(there.breaks(j), mapped(here.breaks(j), len(u)))


@EXAMPLES
@given(SEEDS)
def test_the_order_of_the_samples_changes_nothing(seed):
    u, y = random_samples(seed)
    order = np.random.default_rng(seed).permutation(len(u))
    one, other = partition(u, y, 4), partition(u[order], y[order], 4)
    assert np.array_equal(one.cost, other.cost)
    assert all(np.array_equal(a, b) for a, b in zip(one.starts, other.starts, strict=True))


# --- the trap -------------------------------------------------------------------------------


def test_differences_of_prefix_sums_find_an_optimum_that_does_not_exist():
    """What everybody writes first is wrong on close samples; the exact search is not."""
    r = np.random.default_rng(5)
    places = np.sort(r.uniform(0.0, 1.0, 6))
    u = (places[:, None] + 3e-9 * np.arange(50)).ravel()
    y = 3.0 * u + r.normal(size=300)
    ones = np.ones(300)
    optimum = float(naive.best_costs(naive.piece_costs(u, y, ones), 6, 2)[-1][-1])

    claimed, starts = naive.by_prefix_sums(u, y, 6, 2)
    really = float(naive.partition_cost(u, y, ones, starts))
    assert claimed < optimum - 1.0  # an optimum that does not exist
    assert really > optimum + 1.0  # and breaks that are not the best

    found = partition(u, y, 6)
    assert found.certified
    assert found.cost[5] == pytest.approx(optimum, rel=1e-9)
    assert float(naive.partition_cost(u, y, ones, found.breaks(6))) == pytest.approx(optimum)


def test_a_cost_that_its_breaks_do_not_have_is_not_certified(monkeypatch):
    from valveflow_ros.partition import partition as module

    right = module.best_partitions

    def wrong(problem, pieces):
        cost, starts = right(problem, pieces)
        return 0.999 * cost, starts

    u, y = samples('valve', 100)
    monkeypatch.setattr(module, 'best_partitions', wrong)
    assert not partition(u, y, 3).certified


# --- hostile input --------------------------------------------------------------------------


LINE = np.arange(9.0)


def with_value(value, *at):
    bad = LINE.copy()
    bad[list(at)] = value
    return bad


@pytest.mark.parametrize(
    ('u', 'y', 'more', 'error', 'words'),
    [
        (with_value(np.nan, 4), LINE, {}, DataError, r'^u\[4\] is nan: every sample must be fin'),
        (LINE, with_value(-np.inf, 4), {}, DataError, r'^y\[4\] is -inf: every'),
        (with_value(np.nan, 2, 5, 6), LINE, {}, DataError, r'^u\[2\] is.*\(3 such samples\)\.$'),
        (LINE, with_value(-1e200, 3), {}, DataError, r'^y\[3\] is -1e\+200: .* within 1e\+100\.$'),
        (np.zeros((3, 3)), np.zeros((3, 3)), {}, DataError, 'one-dimensional and equally long'),
        (np.arange(4.0), np.arange(5.0), {}, DataError, 'one-dimensional and equally long'),
        ([0.0, 1.0], ['a', 'b'], {}, DataError, 'must hold real numbers'),
        ([0.0, 1.0], [None, 1.0], {}, DataError, 'must hold real numbers'),
        ([], [], {}, TooFewSamplesError, 'Samples: 0 found, at least 2 needed'),
        *((np.full(9, u), LINE, {}, DataError, r'^u is \S+ in all 9 samples: a slope needs')
          for u in (0.0, -1e6, 1e-200)),
        (LINE // 3, LINE, {'min_distinct': 5}, TooFewSamplesError,
         r'Distinct values of u.*: 3 found, at least 5'),
        (LINE, LINE, {'max_pieces': 0}, ParameterError, 'max_pieces'),
        (LINE, LINE, {'min_distinct': 1}, ParameterError, 'min_distinct'),
        (LINE, LINE, {'threads': 0}, ParameterError, 'threads'),
        *((LINE, LINE, {'weight': weight}, DataError, words) for weight, words in (
            ([1.0, 2.0], 'as long as u'), (np.where(LINE == 1, 0.0, 1.0), r'weight\[1\] is 0'),
            (with_value(math.nan, 0), r'weight\[0\] is nan'), (['a'] * 9, 'real numbers'),
        )),
    ],
)  # fmt: skip
def test_what_cannot_be_divided_is_refused_with_a_sentence(u, y, more, error, words):
    with pytest.raises(error, match=words):
        partition(u, y, **more)


def test_fewer_pieces_than_asked_for_is_said():
    u = np.repeat(np.arange(7.0), 3)
    found = partition(u, u**2, max_pieces=10, min_distinct=2)
    assert len(found.cost) == 3
    assert '7 distinct u: 3 is the largest number of pieces' in found.limited
    with pytest.raises(DataError, match='no partition into 4 pieces, only into 1 to 3'):
        found.breaks(4)


@pytest.mark.parametrize('kind', [list, np.float32, '>f8', np.longdouble, 'strided'])
def test_any_array_of_numbers_will_do_and_is_neither_changed_nor_needed_afterwards(kind):
    u, y = samples('valve', 120)
    truth = partition(u, y, 3)
    if kind == 'strided':
        u, y = np.column_stack([u, y]).T
    elif kind is list:
        u, y = u.tolist(), y.tolist()
    else:
        u, y = u.astype(kind), y.astype(kind)
        u.flags.writeable = y.flags.writeable = False
    kept = list(u), list(y)
    found = partition(u, y, 3)
    assert found.cost == pytest.approx(truth.cost, rel=1e-4)
    assert found.certified
    assert (list(u), list(y)) == kept
    assert not np.shares_memory(found.u, u)
    assert not found.u.flags.writeable


def test_nearly_equal_u_are_one():
    r = np.random.default_rng(2)
    u = np.repeat(np.arange(30.0), 10)
    y = np.abs(u - 12.0) + r.normal(size=300)
    rough = partition(u + 1e-10 * r.uniform(size=300), y, 4)
    assert rough.n_distinct == 30
    assert rough.cost == pytest.approx(partition(u, y, 4).cost, rel=1e-6)
    assert rough.certified


def test_it_runs_without_the_compiler():
    """Coverage is measured that way, and the loops must mean the same in plain Python."""
    code = (
        'import numpy as np; from valveflow_ros.partition.partition import partition;'
        'r = np.random.default_rng(1); u = r.uniform(size=150);'
        'p = partition(u, np.abs(u - .4) + .1 * r.normal(size=150), 4);'
        'print(p.certified, *(float(c).hex() for c in p.cost))'
    )
    outputs = []
    for disabled in ('0', '1'):
        done = subprocess.run(
            [sys.executable, '-W', 'error', '-c', code],
            env={**os.environ, 'NUMBA_DISABLE_JIT': disabled, 'PYTHONPATH': str(ROOT)},
            capture_output=True,
            text=True,
            timeout=300,
            check=True,
        )
        outputs.append(done.stdout)
    assert outputs[0] == outputs[1]
    assert outputs[0].startswith('True')
