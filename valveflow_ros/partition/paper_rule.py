# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The number of pieces by the paper's rule, eq. (24), with a significance test."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.errors import DataError, ParameterError
from valveflow_ros.partition.partition import Partition
from valveflow_ros.records import FloatArray

# A break is significant if it reduces the cost by more than this many times ln n times the
# variance of the noise. In simulated data about one line (independent normal, binary and t3
# noise, 200 to 20000 samples, pieces of at least 1 %) the value was always below 8; without
# a minimum piece, noise with heavy tails exceeds this.
_SIGNIFICANT = 8.0
# A fit is exact if its cost is below this fraction of Omega(1), or if Omega(1) is below this
# fraction of the sum of squares about the mean.
_EXACT = 1e-12


@dataclass(frozen=True, slots=True)
class Selection:
    """A chosen number of pieces and why."""

    pieces: int  # the chosen J
    turning_angle: dict[int, float]  # Lambda(J) of eq. (24), defined for J = 2 .. J_max - 1
    cost: dict[int, float]  # Omega(J) of eq. (19) in MW^2, J = 1 .. J_max
    note: str  # why the rule was not followed, as a sentence; empty if it was


def paper_rule(
    cost: Sequence[float] | FloatArray, exact: float = 0.0
) -> tuple[dict[int, float], int]:
    """Return Lambda(J) of eq. (24) for J = 2 .. J_max - 1, and the smallest J of its maximum.

    The costs are Omega(1), Omega(2), ...; those up to ``exact`` are taken as zero. J is never 1
    and never J_max: the rule compares the decrease of log Omega from J - 1 to J with that from J
    to J + 1, and one of them does not exist at these ends. Raises `DataError` if there are fewer
    than three costs, or one is negative or not finite.

    Notes
    -----
    Extensions of eq. (24): a decrease to zero is infinite, so the first exact J
    has Lambda = 1 and the previous one -1. Between two zeros, and if the cost
    decreases on neither side, Lambda = -1. An increase of the cost (possible due
    to the minimum size of pieces) is taken as no change.
    """
    values = [float(c) for c in cost]
    if len(values) < 3:
        raise DataError(
            f'The rule (24) compares three numbers of pieces; there are costs for {len(values)}.'
        )
    if not all(0.0 <= c < math.inf for c in values):
        raise DataError('The rule (24) needs costs that are finite and not negative.')
    drops = [_drop(a, b, exact) for a, b in itertools.pairwise(values)]
    angles = {j: _turn(drops[j - 2], drops[j - 1]) for j in range(2, len(values))}
    return angles, max(angles, key=lambda j: (angles[j], -j))


def _drop(before: float, after: float, exact: float) -> float:
    """Return log(before / after), at least 0; 0 if ``before`` is zero, else infinite to zero."""
    if before <= exact or after >= before:
        return 0.0
    return math.inf if after <= exact else math.log(before) - math.log(after)


def _turn(into: float, out: float) -> float:
    if into == math.inf:
        return 1.0
    if out == math.inf or into + out == 0.0:
        return -1.0
    return (into - out) / (into + out)


def select(partition: Partition, correlation_inflation: float = 1.0) -> Selection:
    """Choose J by eq. (24).

    ``correlation_inflation`` is the ratio of the variance of a long mean of the residual to that
    of independent samples, at least 1. Raises `ParameterError` if ``correlation_inflation`` is
    below 1 or not a number.

    Notes
    -----
    The rule is independent of scale: it finds a maximum for any costs, also for noise about
    one line, and cannot return 1. So it is only used if some partition reduces the cost
    per break by more than noise would.
    """
    if not 1.0 <= correlation_inflation < math.inf:
        raise ParameterError('correlation_inflation', f'is {correlation_inflation:g}, not >= 1')
    cost = partition.cost
    angles: dict[int, float] = {}
    pieces = most = len(cost)
    if most >= 3:
        angles, pieces = paper_rule(cost, max(partition.floor, _EXACT * float(cost[0])))
    note = _straight(partition, correlation_inflation)
    if note:
        pieces = 1
    elif not angles:
        note = (
            f'The rule (24) compares three numbers of pieces and only {most} are '
            f'possible; {most} pieces lower the cost by more than chance would.'
        )
    costs = {j: float(value) for j, value in enumerate(cost, start=1)}
    return Selection(pieces, angles, costs, note)


def _straight(partition: Partition, inflation: float) -> str:
    """Return a sentence why one piece is enough, or an empty text."""
    if len(partition.cost) == 1:
        return f'One piece is all that {partition.n_distinct} distinct u allow.'
    about_mean = partition.y - partition.y.mean()
    total = float((about_mean * about_mean).sum())
    if partition.cost[0] <= max(partition.floor, _EXACT * total):
        return 'One line fits exactly.'
    cost = partition.cost
    n = partition.n_samples
    variance = float(cost[-1]) / max(n - 2 * len(cost), 1)
    gain = float(np.max((cost[0] - cost[1:]) / np.arange(1, len(cost))))
    needed = _SIGNIFICANT * math.log(n) * inflation * variance
    if gain > needed:
        return ''
    return (
        f'No break lowers the cost by more than chance would: by {gain:.4g} MW^2 at best, '
        f'where {needed:.4g} MW^2 would be significant.'
    )
