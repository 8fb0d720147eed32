# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The plain dynamic programme, every break for every end, as the judge of the exact partition.

``python -m benchmarks.partition --certify`` compares all layers at all ends. Nothing is left
out and no bound is used: n^2 / 2 costs of pieces, each tried in every layer.
"""

from __future__ import annotations

import time

import numba
import numpy as np

from valveflow_ros.partition.partition import make_levels
from valveflow_ros.partition.search import layers, prepare

LANES = 16
# In shares of the sum of squares about one line: what rounding of sums over 300,000 samples
# leaves, far below the 1e-10 within which a partition calls itself certified.
_CLOSE = 1e-11


@numba.njit(cache=True, error_model='numpy')
def _sum(sums: np.ndarray, a: float, b: float, v: float) -> None:
    """Add one sample of weight ``v``, at (a, b) from the origin, to six moments."""
    sums[0] += v
    sums[1] += v * a
    sums[2] += v * a * a
    sums[3] += v * b
    sums[4] += v * a * b
    sums[5] += v * b * b


@numba.njit(cache=True, error_model='numpy')
def _costs(sums: np.ndarray, tail: np.ndarray, cost: np.ndarray) -> None:
    """Fill the cost of one line through what was summed and each of the tails."""
    n, x1, x2, y1, xy, yy = sums
    for lane in range(cost.size):
        sx, sy = x1 + tail[1, lane], y1 + tail[3, lane]
        inverse = 1.0 / (n + tail[0, lane])
        sxx = x2 + tail[2, lane] - sx * sx * inverse
        sxy = xy + tail[4, lane] - sx * sy * inverse
        cost[lane] = max(yy + tail[5, lane] - sy * sy * inverse - sxy * sxy / sxx, 0.0)


@numba.njit(cache=True, error_model='numpy')
def _try(begin: int, cost: np.ndarray, best: np.ndarray, least: np.ndarray) -> None:
    """Let a last piece from ``begin`` compete in every layer and at every end."""
    if begin == 0:
        least[0] = np.minimum(least[0], cost)
    for j in range(1, least.shape[0]):
        before = best[begin, j - 1]
        for lane in range(cost.size):
            least[j, lane] = min(least[j, lane], before + cost[lane])


@numba.njit(cache=True, error_model='numpy')
def _far(
    x: np.ndarray, y: np.ndarray, w: np.ndarray, r0: int, best: np.ndarray, least: np.ndarray
) -> None:
    """Try all last pieces that begin before ``r0 - 1``, for the ends from ``r0`` on."""
    x0, y0 = x[r0 - 1], y[r0 - 1]
    tail = np.zeros((6, LANES))
    for lane in range(1, min(LANES, len(x) + 1 - r0)):
        p = r0 + lane - 1
        tail[:, lane] = tail[:, lane - 1]
        _sum(tail[:, lane], x[p] - x0, y[p] - y0, w[p])
    sums, cost = np.zeros(6), np.empty(LANES)
    for begin in range(r0 - 1, -1, -1):
        _sum(sums, x[begin] - x0, y[begin] - y0, w[begin])
        if begin < r0 - 1:
            _costs(sums, tail, cost)
            _try(begin, cost, best, least)


@numba.njit(cache=True, error_model='numpy')
def _near(
    x: np.ndarray, y: np.ndarray, w: np.ndarray, r0: int, end: int, best: np.ndarray,
    least: np.ndarray,
) -> None:  # fmt: skip
    """Try the last pieces up to ``end`` that begin at ``r0 - 1`` or later."""
    sums, nothing, cost = np.zeros(6), np.zeros((6, 1)), np.empty(1)
    for begin in range(end - 1, r0 - 2, -1):
        _sum(sums, x[begin] - x[end - 1], y[begin] - y[end - 1], w[begin])
        if begin <= end - 2:
            _costs(sums, nothing, cost)
            if begin == end - 2:
                cost[0] = 0.0  # a line goes through two samples
            _try(begin, cost, best, least[:, end - r0 : end - r0 + 1])


@numba.njit(cache=True, error_model='numpy')
def plain_layers(x: np.ndarray, y: np.ndarray, w: np.ndarray, pieces: int) -> np.ndarray:
    """Return the least cost of 1..pieces pieces of two samples or more, for every end.

    Shape (n + 1, pieces). Sums run backwards from each end, in an origin beside it, so
    that short pieces lose no digits; sixteen ends share a run.
    """
    best = np.full((len(x) + 1, pieces), np.inf)
    for r0 in range(1, len(x) + 1, LANES):
        least = np.full((pieces, LANES), np.inf)
        _far(x, y, w, r0, best, least)
        for end in range(r0, min(r0 + LANES, len(x) + 1)):
            _near(x, y, w, r0, end, best, least)
            best[end] = least[:, end - r0]
    return best


def certify(u: np.ndarray, y: np.ndarray, pieces: int) -> dict[str, object]:
    """Compare the search with the plain programme in every layer and at every end."""
    levels = make_levels(u, y)
    begin = time.perf_counter()
    cpu = time.process_time()
    truth = plain_layers(levels.x, levels.residual, levels.weight, pieces)
    wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
    problem = prepare(levels.x, levels.residual, levels.weight, 2, 2e-14 * len(levels.u), 1)
    worst = []
    # One layer more is asked for, because the last one is worked out at its end only.
    for j, (cost, _) in zip(range(pieces), layers(problem, pieces + 1), strict=False):
        found, true = cost[: len(levels) + 1], truth[:, j]
        if not np.array_equal(np.isfinite(found), np.isfinite(true)):
            raise AssertionError(f'Layer {j + 1} reaches other ends than the plain programme.')
        reached = np.isfinite(true)
        off = np.abs(found[reached] - true[reached])
        worst.append(float(off.max() / len(levels.u)))
    return {
        'samples': len(u), 'distinct': len(levels), 'layers': pieces,
        'ends_compared': len(levels) * pieces,
        'largest_difference_of_total': worst, 'agree': bool(max(worst) <= _CLOSE),
        'plain_wall_s': round(wall, 1), 'plain_cpu_s': round(cpu, 1),
    }  # fmt: skip
