# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Samples of many kinds to try the partition on: kind, and hard kinds that numerics dislike."""

import numpy as np


def valve(u):
    """Return the curve of the paper's simulation study, MW."""
    return np.select(
        [u < 1250.0, u < 1600.0, u < 1900.0],
        [0.24 * u - 100.0, 0.18 * u - 25.0, 0.09 * u + 119.0],
        0.01 * u + 271.0,
    )


def _over_openings(answer):
    """Return the maker of samples whose y is an answer to uniform openings."""

    def make(n, r):
        u = r.uniform(1000.0, 2336.0, n)
        return u, answer(u, r)

    return make


def _share(u):
    return (u - 1000.0) / 1336.0


def _correlated(n, r):
    u = np.sort(r.uniform(1000.0, 2336.0, n))
    drift = np.empty(n)
    last = 0.0
    for k in range(n):
        last = 0.9 * last + r.normal(0, 3)
        drift[k] = last
    return u, valve(u) + drift


def _outliers(n, r):
    y = 1e-3 * r.normal(size=n)
    y[n // 3], y[n // 2] = 1e3, -1e2
    return r.uniform(size=n), y


def _clumps(n, r):
    """Steady states: eight openings, each with a jitter of 1e-7, and steps between them."""
    places = np.sort(r.uniform(0, 1, 8))
    at = r.integers(0, 8, n)
    return places[at] + 1e-7 * r.normal(size=n), 10.0 * (at % 3) + 0.1 * r.normal(size=n)


def _steady_and_ramps(n, r):
    steady = [c + 1e-4 * r.normal(size=n // 8) for c in np.linspace(0, 1, 6)]
    u = np.concatenate([*steady, r.uniform(0, 1, n - 6 * (n // 8))])
    return u, 100.0 * np.abs(u - 0.5) + r.normal(size=n)


def _geometric(n, r):
    u = 10.0 ** r.uniform(-8, 0, n)
    return u, np.log(u) + 0.1 * r.normal(size=n)


def _tight_far_from_zero(n, r):
    u = 1e6 + 10.0 * r.integers(0, 40, n) + 1e-3 * r.normal(size=n)
    return u, valve(u - 1e6 + 1100.0) + r.normal(0, 3, n)


def _heavy_ties(n, r):
    often = np.repeat(r.uniform(0, 1, 3), 20 * n)
    u = np.concatenate([often, r.uniform(0, 1, n)])
    return u, 5.0 * u * u + r.normal(size=len(u))


KINDS = {
    'valve': _over_openings(lambda u, r: valve(u) + r.normal(0, 3, len(u))),
    'noise': _over_openings(lambda u, r: r.normal(0, 1, len(u))),
    'root': _over_openings(lambda u, r: 100.0 * np.sqrt(_share(u)) + r.normal(0, 1, len(u))),
    'square': _over_openings(lambda u, r: 100.0 * _share(u) ** 2 + r.normal(0, 0.05, len(u))),
    'noiseless': _over_openings(lambda u, r: valve(u)),
    'straight': _over_openings(lambda u, r: 0.24 * u - 100.0),
    'binary': _over_openings(lambda u, r: (r.uniform(size=len(u)) < 0.5) * 1.0),
    'cauchy_u': lambda n, r: (r.standard_cauchy(n), r.normal(0, 1, n)),
    'correlated': _correlated, 'outliers': _outliers, 'clumps': _clumps,
    'steady_and_ramps': _steady_and_ramps, 'geometric': _geometric,
    'tight_far_from_zero': _tight_far_from_zero, 'heavy_ties': _heavy_ties,
}  # fmt: skip


def samples(kind, n, seed=0):
    """Return u and y of a kind, unsorted."""
    return KINDS[kind](n, np.random.default_rng(seed))
