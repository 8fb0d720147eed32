# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Slow truths: obvious loops in extended precision that the fast code is compared with."""

import itertools
import math

import numpy as np

EXTENDED = np.longdouble


def line_cost(u, y):
    """Return the least sum of squares about a line, in two passes."""
    u = [EXTENDED(value) for value in u]
    y = [EXTENDED(value) for value in y]
    mean_u = sum(u) / len(u)
    mean_y = sum(y) / len(y)
    spread = sum((a - mean_u) ** 2 for a in u)
    slope = sum((a - mean_u) * (b - mean_y) for a, b in zip(u, y, strict=True)) / spread
    return sum((b - mean_y - slope * (a - mean_u)) ** 2 for a, b in zip(u, y, strict=True))


def piece_costs(x, y, weight):
    """Return ``table[a, b]``: cost of the samples ``[a, b)``; inf where a >= b.

    Running sums from the first sample of each stretch, which is the origin.
    """
    x, y, weight = (np.asarray(values).astype(EXTENDED) for values in (x, y, weight))
    n = len(x)
    table = np.full((n, n + 1), np.inf, dtype=EXTENDED)
    for a in range(n):
        d, e, w = x[a:] - x[a], y[a:] - y[a], weight[a:]
        sw, sd, se = np.cumsum(w), np.cumsum(w * d), np.cumsum(w * e)
        sdd, sde, see = np.cumsum(w * d * d), np.cumsum(w * d * e), np.cumsum(w * e * e)
        spread = sdd - sd * sd / sw
        spread[0] = 1  # one sample: nothing to divide
        cost = see - se * se / sw - (sde - sd * se / sw) ** 2 / spread
        cost[:2] = 0
        table[a, a + 1 :] = np.maximum(cost, 0)
    return table


def best_costs(table, pieces, shortest):
    """Return ``cost[j - 1][r]``: the least cost of j pieces of the first r samples.

    The plain dynamic programme of eqs. (21)-(23), every break for every end.
    """
    n = len(table)
    table = table.copy()
    for a in range(n):
        table[a, : min(a + shortest, n + 1)] = np.inf
    costs = [table[0]]
    for _ in range(pieces - 1):
        costs.append((costs[-1][:n, None] + table).min(axis=0))
    return costs


def partition_cost(x, y, weight, starts):
    """Return the cost of given pieces."""
    return sum(
        line_cost(
            np.repeat(x[a:b], np.asarray(weight[a:b], dtype=int)),
            np.repeat(y[a:b], np.asarray(weight[a:b], dtype=int)),
        )
        for a, b in itertools.pairwise(starts)
        if b - a > 2
    )


def by_prefix_sums(x, y, pieces, shortest):
    """Return what everybody writes first: costs from differences of prefix sums in float64.

    x and y are centred and scaled as one should. The result is (claimed cost, starts),
    and it is wrong where samples lie close together.
    """
    x = (x - (x[0] + x[-1]) / 2) / ((x[-1] - x[0]) / 2)
    y = y - np.mean(y)
    n = len(x)
    sums = [
        np.concatenate([[0.0], np.cumsum(values.astype(EXTENDED)).astype(float)])
        for values in (np.ones(n), x, x * x, y, x * y, y * y)
    ]
    cost = np.full((pieces + 1, n + 1), np.inf)
    where = np.zeros((pieces + 1, n + 1), dtype=int)
    cost[0, 0] = 0.0
    for r in range(shortest, n + 1):
        w = np.arange(r - shortest + 1)
        count, sx, sxx, sy, sxy, syy = (s[r] - s[w] for s in sums)
        spread = sxx - sx * sx / count
        with np.errstate(all='ignore'):
            inside = syy - sy * sy / count - (sxy - sx * sy / count) ** 2 / spread
        inside = np.maximum(np.where(spread > 0.0, inside, 0.0), 0.0)
        for j in range(1, pieces + 1):
            total = cost[j - 1, w] + inside
            where[j, r] = int(np.argmin(total))
            cost[j, r] = total[where[j, r]]
    starts = [n]
    for j in range(pieces, 0, -1):
        starts.append(int(where[j, starts[-1]]))
    return float(cost[pieces, n]), starts[::-1]


def turning_angle(cost):
    """Return Lambda(J) as eq. (24) writes it; ``cost[0]`` is Omega(1)."""
    omega = dict(enumerate(cost, start=1))
    angle = {}
    for j in range(2, len(cost)):
        eta_1 = math.log(omega[j - 1] / omega[j])
        eta_2 = math.log(omega[j] / omega[j + 1])
        angle[j] = (eta_1 - eta_2) / (eta_1 + eta_2)
    return angle
