"""A rising broken line through the levels of a step test."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valveflow_ros.records import FloatArray

ENOUGH = 8  # levels from which on pieces are put through several of them
_LEAST_LEVELS = 2  # of a piece
# Of a number, in units of Schwarz' log n. A knee is put where it helps most, so the best of many
# places looks better than it is; at 1.4 noise alone gives one in 4 of 100 tests, at 1 in 10.
_PRICE = 1.4
_Z95 = 1.959963984540054


@dataclass(frozen=True, slots=True)
class Points:
    """Means of levels in order of u; all arrays have shape (n,)."""

    u: FloatArray
    power_mw: FloatArray
    error_mw: FloatArray

    def __len__(self) -> int:
        """Return the number of levels."""
        return len(self.u)


@dataclass(frozen=True, slots=True)
class BrokenLine:
    """The line and its errors.

    Attributes
    ----------
    knots, values : float64 (J + 1,)
    covariance : float64 (J + 1, J + 1)
        Of the values, the knots held.
    knot_error : float64 (J - 1,)
        Standard errors of the inner knots; NaN where a level is the knot.
    cost : dict
        Weighted sum of squares by number of pieces; empty if a level is a knot each.
    """

    knots: FloatArray
    values: FloatArray
    covariance: FloatArray
    knot_error: FloatArray
    cost: dict[int, float]


def pooled(points: Points, near_u: float) -> tuple[Points, list[int]]:
    """Return levels in rising order of u, and how many went into each.

    Levels closer than ``near_u`` are one: the same opening visited twice. Where each level
    becomes a knot, one that gives no more power than the one below it is joined with it, as
    means weighted by their errors (pool adjacent violators): the curve must rise.
    """
    found = _groups(points, near_u, rising=False)
    return found if len(found[0]) >= ENOUGH else _groups(points, near_u, rising=True)


def _groups(points: Points, near_u: float, rising: bool) -> tuple[Points, list[int]]:
    order = np.argsort(points.u, kind='stable')
    groups: list[list[float]] = []  # weight, u, power, members
    for k in order:
        group = [1.0 / points.error_mw[k] ** 2, float(points.u[k]), float(points.power_mw[k]), 1.0]
        while groups and (
            group[1] - groups[-1][1] < near_u or (rising and group[2] <= groups[-1][2])
        ):
            before = groups.pop()
            weight = before[0] + group[0]
            group = [
                weight,
                (before[0] * before[1] + group[0] * group[1]) / weight,
                (before[0] * before[2] + group[0] * group[2]) / weight,
                before[3] + group[3],
            ]
        groups.append(group)
    table = np.array(groups).reshape(-1, 4)
    return Points(table[:, 1], table[:, 2], 1.0 / np.sqrt(table[:, 0])), [
        int(g[3]) for g in groups
    ]


def broken_line(points: Points, most: int) -> BrokenLine:
    """Put the line through: a knot at each level, or the exact partition where levels suffice.

    Parameters
    ----------
    points : Points
        Rising.
    most : int
        Largest number of pieces tried.

    Notes
    -----
    The partition of the levels into pieces of at least two is exact (all are compared by a
    dynamic programme); their number is the one with the least weighted sum of squares plus
    ``1.4 log n`` for each of the 3 J - 1 numbers it takes. Neighbouring lines meet in knots, and
    the values there are fitted again together. A piece that would fall is not taken.
    """
    n = len(points)
    if n < ENOUGH:
        knots = points.u
        return BrokenLine(
            knots,
            points.power_mw,
            np.asarray(np.diag(points.error_mw**2)),
            np.full(n - 2, math.nan),
            {},
        )
    starts, cost = _partition(points, min(most, n // _LEAST_LEVELS))
    score = {j: c + _PRICE * (3 * j - 1) * math.log(n) for j, c in cost.items()}
    for j in sorted(score, key=lambda j: score[j]):
        line = _joined(points, starts[j], cost)
        if np.all(np.diff(line.values) > 0.0):
            return line
    return _joined(points, starts[1], cost)


def _line(points: Points, a: int, b: int) -> tuple[FloatArray, FloatArray, float]:
    """Return value and slope about the middle, their covariance, and the cost of levels [a, b)."""
    w = 1.0 / points.error_mw[a:b]
    middle = float(points.u[a:b].mean())
    design = np.column_stack([w, w * (points.u[a:b] - middle)])
    covariance = np.linalg.pinv(design.T @ design)
    found = covariance @ (design.T @ (w * points.power_mw[a:b]))
    rest = w * points.power_mw[a:b] - design @ found
    slope = float(found[1])
    return (
        np.array([float(found[0]) - slope * middle, slope, middle]),
        np.asarray(covariance),
        float(rest @ rest),
    )


def _partition(points: Points, most: int) -> tuple[dict[int, list[int]], dict[int, float]]:
    """Return where the pieces begin and what they cost, for each number of pieces."""
    n = len(points)
    error = np.full((n + 1, n + 1), math.inf)
    for a in range(n):
        for b in range(a + _LEAST_LEVELS, n + 1):
            error[a, b] = _line(points, a, b)[2]
    best = np.full((most + 1, n + 1), math.inf)
    came = np.zeros((most + 1, n + 1), dtype=np.int64)
    best[0, 0] = 0.0
    for j in range(1, most + 1):
        for b in range(1, n + 1):
            total = best[j - 1, :b] + error[:b, b]
            came[j, b] = int(np.argmin(total))
            best[j, b] = total[came[j, b]]
    starts: dict[int, list[int]] = {}
    for j in range(1, most + 1):
        if math.isfinite(best[j, n]):
            b, found = n, []
            for left in range(j, 0, -1):
                b = int(came[left, b])
                found.append(b)
            starts[j] = found[::-1]
    return starts, {j: float(best[j, n]) for j in starts}


def _joined(points: Points, starts: list[int], cost: dict[int, float]) -> BrokenLine:
    """Let neighbouring lines meet, and fit the values at the knots together."""
    ends = [*starts[1:], len(points)]
    lines = [_line(points, a, b) for a, b in zip(starts, ends, strict=True)]
    knots, errors = [float(points.u[0])], []
    for k, at in enumerate(starts[1:]):
        (one, var_one, _), (two, var_two, _) = lines[k], lines[k + 1]
        low, high = float(points.u[at - 1]), float(points.u[at])
        bend = two[1] - one[1]
        place = (one[0] - two[0]) / bend if bend else 0.5 * (low + high)
        place = min(max(place, low), high)
        variance = sum(
            v[0, 0] + 2.0 * v[0, 1] * (place - c[2]) + v[1, 1] * (place - c[2]) ** 2
            for c, v in ((one, var_one), (two, var_two))
        )
        knots.append(place)
        errors.append(math.sqrt(variance) / abs(bend) if bend else math.nan)
    knots.append(float(points.u[-1]))
    at_knots = np.array(knots)
    hats = np.column_stack([np.interp(points.u, at_knots, row) for row in np.eye(len(knots))])
    w = 1.0 / points.error_mw
    design = hats * w[:, None]
    covariance = np.linalg.pinv(design.T @ design)
    values = covariance @ (design.T @ (w * points.power_mw))
    return BrokenLine(at_knots, values, np.asarray(covariance), np.array(errors), cost)


def interval(knot: float, error: float) -> tuple[float, float]:
    """Return the 95 % interval of a knot."""
    return knot - _Z95 * error, knot + _Z95 * error
