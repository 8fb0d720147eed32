# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What other packages make of the same samples: time, and cost over the optimum.

Each is run at sizes it can do in seconds; a package that is not installed is left out and
named. `pwlf` and `piecewise-regression` fit continuous curves, so they cannot reach the
optimum of pieces that need not join.
"""

from __future__ import annotations

import importlib.util
import sys
import time
import warnings
from collections.abc import Callable, Iterable

import numpy as np

from valveflow_ros.partition.partition import partition

PIECES = 4
Row = dict[str, object]


def fitted_cost(u: np.ndarray, y: np.ndarray, ends: Iterable[int]) -> float:
    """Return the cost of separate lines through pieces that end before the given samples."""
    total, begin = 0.0, 0
    for end in ends:
        a, b = u[begin:end], y[begin:end]
        design = np.column_stack([np.ones(len(a)), a - a[0]])
        rest = b - design @ np.linalg.lstsq(design, b, rcond=None)[0]
        total += float(rest @ rest)
        begin = end
    return total


def _ruptures(name: str, **settings: object) -> Callable[[np.ndarray, np.ndarray], float]:
    def run(u: np.ndarray, y: np.ndarray) -> float:
        import ruptures

        signal = np.column_stack([y, (u - u.mean()) / np.ptp(u), np.ones(len(u))])
        search = getattr(ruptures, name)(model='linear', min_size=2, **settings).fit(signal)
        ends = _penalised(search) if name == 'Pelt' else search.predict(n_bkps=PIECES - 1)
        return fitted_cost(u, y, ends)

    return run


def _penalised(search: object) -> list[int]:
    """Search the penalty that gives the wanted number of pieces, which Pelt cannot be told.

    Only the last run would count for its time, so the first penalty is a good one: that
    of a break's three parameters in noise of 3 MW.
    """
    ends: list[int] = []
    penalty = 3.0 * 9.0 * 6.0
    for _ in range(12):
        ends = search.predict(pen=penalty)  # type: ignore[attr-defined]
        if len(ends) == PIECES:
            break
        penalty *= 1.5 if len(ends) > PIECES else 0.7
    return ends


def _pwlf(fast: bool) -> Callable[[np.ndarray, np.ndarray], float]:
    def run(u: np.ndarray, y: np.ndarray) -> float:
        import pwlf

        model = pwlf.PiecewiseLinFit(u, y, seed=1)
        if fast:
            model.fitfast(PIECES)
        else:
            model.fit(PIECES)
        return float(np.sum((y - model.predict(u)) ** 2))

    return run


def _piecewise_regression(u: np.ndarray, y: np.ndarray) -> float:
    import piecewise_regression

    np.random.seed(1)  # noqa: NPY002 - the package draws its starts from here
    model = piecewise_regression.Fit(u.tolist(), y.tolist(), n_breakpoints=PIECES - 1, n_boot=10)
    if not model.get_results()['converged']:
        return float('nan')
    return float(np.sum((y - np.asarray(model.predict(u))) ** 2))


# Package, name, what to run, sizes.
PEERS: tuple[tuple[str, str, Callable[[np.ndarray, np.ndarray], float], tuple[int, ...]], ...] = (
    ('ruptures', 'ruptures Dynp, exact', _ruptures('Dynp', jump=1), (200, 400)),
    ('ruptures', 'ruptures Dynp, jump 5', _ruptures('Dynp', jump=5), (400, 1600)),
    ('ruptures', 'ruptures Pelt, exact', _ruptures('Pelt', jump=1), (300, 600)),
    ('ruptures', 'ruptures Pelt, jump 5', _ruptures('Pelt', jump=5), (600, 2000)),
    ('ruptures', 'ruptures Binseg', _ruptures('Binseg', jump=5), (2000, 20_000)),
    ('ruptures', 'ruptures BottomUp', _ruptures('BottomUp', jump=5), (1000, 4000)),
    ('pwlf', 'pwlf fit', _pwlf(False), (600,)),
    ('pwlf', 'pwlf fitfast', _pwlf(True), (2000,)),
    ('piecewise_regression', 'piecewise-regression', _piecewise_regression, (1000, 4000)),
)  # fmt: skip


def against_peers(samples: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> list[Row]:
    """Run every package that is installed on the samples of its sizes."""
    rows: list[Row] = []
    missing: set[str] = set()
    for package, name, run, sizes in PEERS:
        if importlib.util.find_spec(package) is None:
            missing.add(package)
            continue
        try:
            rows += [_beside(name, run, *samples(n)) for n in sizes]
        except ImportError as error:
            print(f'{name} cannot be run here ({error}).', file=sys.stderr)
    for package in sorted(missing):
        print(f'{package} is not installed, so it is not compared.', file=sys.stderr)
    return rows


def _beside(
    name: str, run: Callable[[np.ndarray, np.ndarray], float], u: np.ndarray, y: np.ndarray
) -> Row:
    order = np.argsort(u)
    u, y = u[order], y[order]
    times, found = [], None
    for _ in range(3):
        begin = time.process_time()
        found = partition(u, y, PIECES, threads=1)
        times.append(time.process_time() - begin)
    assert found is not None
    begin, cpu = time.perf_counter(), time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        cost = run(u, y)
    wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
    return {
        'samples': len(u), 'search': name, 'wall_s': round(wall, 4), 'cpu_s': round(cpu, 4),
        'times_slower': round(cpu / max(min(times), 1e-6), 1),
        'cost/optimum': round(cost / float(found.cost[PIECES - 1]), 6),
    }  # fmt: skip
