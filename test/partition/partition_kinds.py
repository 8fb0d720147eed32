# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Samples of many kinds to try the partition on: kind, and hard kinds that numerics dislike."""

from __future__ import annotations

import numpy as np


def valve(u):
    """Return the curve of the paper's simulation study, MW."""
    return np.select(
        [u < 1250.0, u < 1600.0, u < 1900.0],
        [0.24 * u - 100.0, 0.18 * u - 25.0, 0.09 * u + 119.0],
        0.01 * u + 271.0,
    )


def _opening(n, r):
    return r.uniform(1000.0, 2336.0, n)


def _share(u):
    return (u - 1000.0) / 1336.0


def _valve(n, r):
    u = _opening(n, r)
    return u, valve(u) + r.normal(0, 3, n)


def _quantised(n, r):
    u = np.round(_opening(n, r), 1)
    return u, valve(u) + r.normal(0, 3, n)


def _noise(n, r):
    return _opening(n, r), r.normal(0, 1, n)


def _cauchy_u(n, r):
    return r.standard_cauchy(n), r.normal(0, 1, n)


def _root(n, r):
    u = _opening(n, r)
    return u, 100.0 * np.sqrt(_share(u)) + r.normal(0, 1, n)


def _square(n, r):
    u = _opening(n, r)
    return u, 100.0 * _share(u) ** 2 + r.normal(0, 0.05, n)


def _heavy_tails(n, r):
    u = _opening(n, r)
    return u, valve(u) + 3.0 * r.standard_t(3, n)


def _correlated(n, r):
    u = np.sort(_opening(n, r))
    drift = np.empty(n)
    last = 0.0
    for k in range(n):
        last = 0.9 * last + r.normal(0, 3)
        drift[k] = last
    return u, valve(u) + drift


def _walk(n, r):
    return np.sort(_opening(n, r)), np.cumsum(r.normal(0, 1, n))


def _sine(n, r):
    u = _opening(n, r)
    return u, 50.0 * np.sin(5 * np.pi * _share(u)) + r.normal(0, 1, n)


def _noiseless(n, r):
    u = _opening(n, r)
    return u, valve(u)


def _straight(n, r):
    u = _opening(n, r)
    return u, 0.24 * u - 100.0


def _binary(n, r):
    return _opening(n, r), (r.uniform(size=n) < 0.5) * 1.0


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
    name[1:]: make
    for name, make in list(globals().items())
    if callable(make) and name.startswith('_') and name not in ('_opening', '_share')
}


def samples(kind, n, seed=0):
    """Return u and y of a kind, unsorted."""
    return KINDS[kind](n, np.random.default_rng(seed))
