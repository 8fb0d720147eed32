# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How fast the exact partition is, and whether it is exact.

Run: python -m benchmarks.partition [--kinds valve noise ...] [--sizes 20000 305633 ...]
                                    [--large 3000000] [--repeats 3]
     python -m benchmarks.partition --certify [--layers 4]    the judge of the exact partition

Every kind is partitioned into 1..10 pieces at every size, 'valve' and 'quantised' also at the size
given by --large (0 leaves it out). Of several runs the least time counts; processor seconds are
those of all threads together, and do not suffer from other people's work as wall seconds do.

--certify compares all layers at all ends with the plain dynamic programme: nothing is left out and
no bound is used, n^2 / 2 costs of pieces are each tried in every layer (minutes).
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from benchmarks import study
from valveflow_ros.partition.partition import make_levels, partition
from valveflow_ros.partition.search import best_partitions, layers, prepare

PIECES = 10
# In shares of the sum of squares about one line: what rounding of sums over 300,000 samples
# leaves, far below the 1e-10 within which a partition calls itself certified.
_CLOSE = 1e-11


def valve(u: np.ndarray) -> np.ndarray:
    """Return the curve of the paper's simulation study."""
    return np.select(
        [u < 1250.0, u < 1600.0, u < 1900.0],
        [0.24 * u - 100.0, 0.18 * u - 25.0, 0.09 * u + 119.0],
        0.01 * u + 271.0,
    )


def random_walk(u: np.ndarray, r: np.random.Generator) -> np.ndarray:
    walk = np.empty(len(u))
    walk[np.argsort(u)] = np.cumsum(r.normal(size=len(u)))
    return walk


def share(u: np.ndarray) -> np.ndarray:
    return (u - 1000.0) / 1336.0


KINDS: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    'valve': lambda u, r: valve(u) + r.normal(0, 3, len(u)),
    'quantised': lambda u, r: valve(u) + r.normal(0, 3, len(u)),  # u in steps of 0.1
    'noise': lambda u, r: r.normal(size=len(u)),
    'heavy_tails': lambda u, r: valve(u) + 3.0 * r.standard_t(3, len(u)),
    'root': lambda u, r: 100.0 * np.sqrt(share(u)) + r.normal(size=len(u)),
    'square': lambda u, r: 100.0 * share(u) ** 2 + r.normal(size=len(u)),
    'square_quiet': lambda u, r: 100.0 * share(u) ** 2 + r.normal(0, 0.05, len(u)),
    'sine': lambda u, r: 50.0 * np.sin(5 * np.pi * share(u)) + r.normal(size=len(u)),
    'walk': random_walk,
    'noiseless': lambda u, _: valve(u),
}


def samples(kind: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    r = np.random.default_rng(2024)
    u = r.uniform(1000.0, 2336.0, n)
    if kind == 'quantised':
        u = np.round(u, 1)
    return u, KINDS[kind](u, r)


def ours(kind: str, n: int, threads: int | None, repeats: int) -> dict[str, Any]:
    """Time the whole call, and the search alone: without checking, sorting and merging."""
    u, y = samples(kind, n)
    whole, found = study.timed(lambda: partition(u, y, PIECES, threads=threads), repeats)
    levels = make_levels(u, y)
    used = threads or (len(os.sched_getaffinity(0)) if len(levels) >= 20_000 else 1)

    def search() -> object:
        problem = prepare(levels.x, levels.residual, levels.weight, 2, 2e-14 * len(levels.u), used)
        return best_partitions(problem, PIECES)

    return {
        'kind': kind, 'samples': n, 'distinct': found.n_distinct,
        'search': study.timed(search, repeats)[0], 'whole': whole, 'certified': found.certified,
        'peak_mb': round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0),
    }  # fmt: skip


@numba.njit(cache=True, error_model='numpy')
def plain_layers(x: np.ndarray, y: np.ndarray, w: np.ndarray, pieces: int) -> np.ndarray:
    """Return the least cost of 1..pieces pieces of two samples or more, for every end.

    Shape (n + 1, pieces). Sums run backwards from each end, in an origin beside it, so
    that short pieces lose no digits.
    """
    best = np.full((len(x) + 1, pieces), np.inf)
    for end in range(2, len(x) + 1):
        least = best[end]
        n = sx = sxx = sy = sxy = syy = 0.0
        for begin in range(end - 1, -1, -1):
            a, b, v = x[begin] - x[end - 1], y[begin] - y[end - 1], w[begin]
            n += v
            sx += v * a
            sxx += v * a * a
            sy += v * b
            sxy += v * a * b
            syy += v * b * b
            if begin == end - 1:
                continue
            cost = 0.0  # a line goes through two samples
            if begin < end - 2:
                inverse = 1.0 / n
                across = sxy - sx * sy * inverse
                spread = sxx - sx * sx * inverse
                cost = max(syy - sy * sy * inverse - across * across / spread, 0.0)
            if begin == 0:
                least[0] = cost
            for j in range(1, pieces):
                least[j] = min(least[j], best[begin, j - 1] + cost)
    return best


def certify(kind: str, n: int, pieces: int) -> dict[str, Any]:
    """Compare the search with the plain programme in every layer and at every end."""
    levels = make_levels(*samples(kind, n))
    arrays = levels.x, levels.residual, levels.weight
    took, truth = study.timed(lambda: plain_layers(*arrays, pieces))
    problem = prepare(*arrays, 2, 2e-14 * len(levels.u), 1)
    worst = []
    # One layer more is asked for, because the last one is worked out at its end only.
    for j, (cost, _) in zip(range(pieces), layers(problem, pieces + 1), strict=False):
        found, true = cost[: len(levels) + 1], truth[:, j]
        reached = np.isfinite(true)
        same = np.array_equal(np.isfinite(found), reached)
        off = float(np.abs(found[reached] - true[reached]).max() / len(levels.u))
        worst.append(off if same else np.inf)
    return {
        'kind': kind, 'samples': n, 'distinct': len(levels), 'layers': pieces,
        'ends_compared': len(levels) * pieces,
        'largest_difference_of_total': worst, 'agree': bool(max(worst) <= _CLOSE),
        'plain_wall_s': took['wall_s'], 'plain_cpu_s': took['cpu_s'],
    }  # fmt: skip


def options() -> argparse.Namespace:
    parser = study.options(__doc__, large=3_000_000, repeats=3, layers=4)
    parser.add_argument('--kinds', nargs='+', choices=list(KINDS), default=list(KINDS))
    parser.add_argument('--sizes', nargs='*', type=int, default=[20_000, 305_633])
    parser.add_argument('--threads', type=int)
    parser.add_argument('--certify', action='store_true', help='every layer, every end; minutes')
    return parser.parse_args()


def main() -> int:
    given = options()
    wanted = [(kind, size) for size in given.sizes for kind in given.kinds]
    if given.certify:
        found = [certify(kind, size, given.layers) for kind, size in wanted]
        study.keep('partition_certified', machine=study.machine(), result=found)
        return 0 if all(row['agree'] for row in found) else 1
    partition(*samples('valve', 3000), PIECES)  # compiles
    if given.large:
        wanted += [(kind, given.large) for kind in ('valve', 'quantised')]
    found = [ours(kind, size, given.threads, given.repeats) for kind, size in wanted]
    study.keep('partition', machine=study.machine(), pieces=PIECES, result={'ours': found})
    return 0


if __name__ == '__main__':
    sys.exit(main())
