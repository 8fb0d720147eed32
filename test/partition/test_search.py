# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The search against the plain dynamic programme: every number of pieces, every end."""

import threading

import naive
import numba
import numpy as np
import pytest
from partition_kinds import KINDS, samples

from valveflow_ros.partition import search
from valveflow_ros.partition.partition import make_levels
from valveflow_ros.partition.search import best_partitions, layers, prepare

COMPILED = not numba.config.DISABLE_JIT
PIECES = 10


def problem(levels, shortest, threads=1, slack=2e-14):
    total = slack * len(levels.u)
    return prepare(levels.x, levels.residual, levels.weight, shortest, total, threads)


def compare(kind, n, shortest, seed=0):
    """Compare all layers with the slow truth; costs within 1e-12 of the sum of squares."""
    levels = make_levels(*samples(kind, n, seed))
    table = naive.piece_costs(levels.x, levels.residual, levels.weight)
    pieces = min(PIECES, len(levels) // shortest)
    truth = naive.best_costs(table, pieces, shortest)
    close = 1e-12 * len(levels.u)
    ends = np.arange(len(levels) + 1)
    # One layer more is asked for, because the last one is worked out at its end only.
    for j, (cost, breaks) in enumerate(layers(problem(levels, shortest), pieces + 1)):
        if j == pieces:
            return
        cost, breaks = cost[ends], breaks[ends]
        possible = np.isfinite(truth[j])
        assert np.array_equal(np.isfinite(cost), possible)
        assert np.abs(cost[possible] - truth[j][possible]).max() <= close
        if j > 0:  # and the breaks give those costs
            at = ends[possible]
            given = truth[j - 1][breaks[at]] + table[breaks[at], at]
            assert np.abs(given - truth[j][at]).max() <= close
            assert (at - breaks[at]).min() >= shortest
    pytest.fail('the search ended early')


# Every kind; blocks that begin and end anywhere; several levels of nodes, and a shortest piece
# that is longer than a block.
CASES = [
    *((kind, 500 if COMPILED else 140, shortest) for kind in KINDS for shortest in (2, 33)),
    *(('noise', n, 2) for n in (2, 3, 63, 64, 65, 128, 129)),
    *((kind, 1500, n) for kind, n in (('clumps', 2), ('square', 2), ('valve', 140)) if COMPILED),
]


@pytest.mark.parametrize(('kind', 'n', 'shortest'), CASES)
def test_every_layer_and_end_is_optimal(kind, n, shortest):
    compare(kind, n, shortest, seed=n)


def test_the_result_does_not_depend_on_the_threads():
    levels = make_levels(*samples('valve', 20_000 if COMPILED else 150))
    cost, starts = best_partitions(problem(levels, 2, threads=1), 6)
    for threads in (2, 5):
        other, other_starts = best_partitions(problem(levels, 2, threads=threads), 6)
        assert np.array_equal(cost, other)
        assert all(np.array_equal(a, b) for a, b in zip(starts, other_starts, strict=True))


def test_searches_may_run_side_by_side():
    levels = [make_levels(*samples('root', 6000 if COMPILED else 140, seed)) for seed in (1, 2)]
    alone = [best_partitions(problem(x, 2), 5)[0] for x in levels]
    found = [None, None]

    def work(k):
        found[k] = best_partitions(problem(levels[k], 2, threads=2), 5)[0]

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert np.array_equal(found[0], alone[0])
    assert np.array_equal(found[1], alone[1])


@pytest.mark.skipif(not COMPILED, reason='counts are those of the compiled search')
@pytest.mark.parametrize('kind', ['valve', 'straight'])
def test_far_breaks_are_passed_over(kind, monkeypatch):
    """The work must stay far below every break for every end, also for exact ties."""
    levels = make_levels(*samples(kind, 20_000))
    opened = []
    original = search.search_groups
    monkeypatch.setattr(search, 'search_groups', lambda *args: opened.append(original(*args)))
    best_partitions(problem(levels, 2), 4)
    groups = 20_000 / 64
    assert sum(opened) < 0.1 * 3 * groups * groups / 2
