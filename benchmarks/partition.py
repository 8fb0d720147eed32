# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How fast the exact partition is, beside a plain dynamic programme and beside other packages.

Run: python -m benchmarks.partition [--kinds valve noise ...] [--sizes 20000 305633 ...]
                                    [--large 3000000] [--plain 8000] [--no-peers] [--repeats 3]
     python -m benchmarks.partition --certify [--layers 4]    the judge of the exact partition

With --large 0 or --plain 0 that part is left out.

Every kind is partitioned into 1..10 pieces at every size. In the same run the plain
dynamic programme (every break for every end, in compiled loops) solves the size given by
--plain, and ruptures, pwlf and piecewise-regression the sizes they can do, where they are
installed. `cost/optimum` is the cost of what a search found over ours; 1 means that it
found the optimum too. Of several runs the least time counts; processor seconds are those
of all threads together, and do not suffer from other people's work as wall seconds do.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Callable

import numba
import numpy as np

from benchmarks import study
from benchmarks.partition_certify import certify
from benchmarks.partition_peers import against_peers
from valveflow_ros.partition.partition import Partition, make_levels, partition
from valveflow_ros.partition.search import best_partitions, prepare

PIECES = 10


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


@numba.njit(cache=True)
def plain(x: np.ndarray, y: np.ndarray, pieces: int) -> np.ndarray:
    """Return the least cost of 1..pieces pieces, trying every break for every end."""
    n = len(x)
    best = np.full((pieces + 1, n + 1), np.inf)
    best[0, 0] = 0.0
    for r in range(2, n + 1):
        count = sx = sxx = sy = sxy = syy = 0.0
        for w in range(r - 1, -1, -1):
            a = x[r - 1] - x[w]
            b = y[w] - y[r - 1]
            count += 1.0
            sx += a
            sxx += a * a
            sy += b
            sxy += a * b
            syy += b * b
            if w > r - 2:
                continue
            covariance = sxy - sx * sy / count
            cost = syy - sy * sy / count - covariance * covariance / (sxx - sx * sx / count)
            for j in range(1, pieces + 1):
                best[j, r] = min(best[j, r], best[j - 1, w] + max(cost, 0.0))
    return best[1:, n]


def ours(kind: str, n: int, threads: int | None, repeats: int) -> dict[str, object]:
    """Time the whole call, and the search alone: without checking, sorting and merging."""
    u, y = samples(kind, n)
    whole, found = study.timed(lambda: partition(u, y, PIECES, threads=threads), repeats)
    levels = make_levels(u, y)
    used = threads or (len(os.sched_getaffinity(0)) if len(levels) >= 20_000 else 1)

    def search() -> object:
        problem = prepare(levels.x, levels.residual, levels.weight, 2, 2e-14 * len(levels.u), used)
        return best_partitions(problem, PIECES)

    alone, _ = study.timed(search, repeats)
    assert isinstance(found, Partition)
    return {
        'kind': kind, 'samples': n, 'distinct': found.n_distinct, 'search': alone,
        'whole': whole, 'certified': found.certified, 'load': round(os.getloadavg()[0], 1),
        'peak_mb': round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0),
    }  # fmt: skip


def against_plain(kind: str, n: int) -> dict[str, object]:
    u, y = samples(kind, n)
    order = np.argsort(u)
    u, y = u[order], y[order]
    fast, found = study.timed(lambda: partition(u, y, PIECES, threads=1), 3)
    slow, cost = study.timed(lambda: plain(u, y, PIECES))
    assert isinstance(found, Partition)
    assert isinstance(cost, np.ndarray)
    return {
        'kind': kind, 'samples': n, 'search': 'plain', **slow,
        'times_slower': round(slow['cpu_s'] / fast['cpu_s'], 1),
        'cost/optimum': round(float(cost[-1] / found.cost[-1]), 9),
    }  # fmt: skip


def large(kind: str, n: int, threads: int | None) -> dict[str, object]:
    """Time one large partition in a process of its own, and what memory it took at most."""
    command = [sys.executable, '-m', 'benchmarks.partition', '--kinds', kind, '--sizes', str(n)]
    command += ['--plain', '0', '--large', '0', '--no-peers', '--repeats', '1', '--json']
    command += ['--threads', str(threads)] if threads else []
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout)['ours'][0])


def measure(options: argparse.Namespace) -> dict[str, list[dict[str, object]]]:
    partition(*samples('valve', 3000), PIECES)  # compiles
    result: dict[str, list[dict[str, object]]] = {'ours': [], 'beside': []}
    for size in options.sizes:
        for kind in options.kinds:
            result['ours'].append(ours(kind, size, options.threads, options.repeats))
    if options.large:
        for kind in ('valve', 'quantised'):
            result['ours'].append(large(kind, options.large, options.threads))
    if options.plain:
        plain(np.arange(9.0), np.arange(9.0), 2)  # compiles
        for kind in options.kinds:
            if kind not in ('quantised', 'noiseless'):
                result['beside'].append(against_plain(kind, options.plain))
    if options.peers:
        rows = against_peers(lambda n: samples('valve', n))
        result['beside'] += [{'kind': 'valve', **row} for row in rows]
    return result


def arguments_of() -> argparse.Namespace:
    parser = study.options(__doc__, large=3_000_000, plain=8000, repeats=3, layers=4)
    parser.add_argument('--kinds', nargs='+', choices=list(KINDS), default=list(KINDS))
    parser.add_argument('--sizes', nargs='*', type=int, default=[20_000, 305_633])
    parser.add_argument('--no-peers', dest='peers', action='store_false')
    parser.add_argument('--threads', type=int)
    parser.add_argument('--certify', action='store_true', help='every layer, every end; minutes')
    parser.add_argument('--json', action='store_true', help='print only, as JSON')
    return parser.parse_args()


def show(result: dict[str, list[dict[str, object]]]) -> None:
    for row in result['ours']:
        search, whole = row['search'], row['whole']
        assert isinstance(search, dict)
        assert isinstance(whole, dict)
        print(
            f'{row["kind"]:13}{row["samples"]:9,} samples {row["distinct"]:9,} distinct   '
            f'search {search["wall_s"]:8.3f} s (cpu {search["cpu_s"]:.3f} s)   '
            f'whole {whole["wall_s"]:8.3f} s (cpu {whole["cpu_s"]:.3f} s)   '
            f'load {row["load"]}   peak {row["peak_mb"]} MB   certified {row["certified"]}'
        )
    for row in result['beside']:
        print(
            f'{row["kind"]:13}{row["samples"]:9,} samples   {row["search"]:22} '
            f'cpu {row["cpu_s"]:8.3f} s   {row["times_slower"]} times ours   '
            f'cost/optimum {row["cost/optimum"]}'
        )


def main() -> int:
    options = arguments_of()
    if options.certify:
        found = [
            {'kind': k, **certify(*samples(k, n), options.layers)}
            for n in options.sizes for k in options.kinds
        ]  # fmt: skip
        print(json.dumps(found, indent=1))
        study.keep('partition_certified', machine=study.machine(), pieces=PIECES, result=found)
        return 0 if all(row['agree'] for row in found) else 1
    result = measure(options)
    if options.json:
        print(json.dumps(result, indent=2))
        return 0
    print(f'Python {platform.python_version()}, {len(os.sched_getaffinity(0))} cores; J = 1..10')
    show(result)
    study.keep('partition', machine=study.machine(), pieces=PIECES, result=result)
    return 0


if __name__ == '__main__':
    sys.exit(main())
