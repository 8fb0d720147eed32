"""The number of pieces by the paper's rule (24), guarded where that rule cannot be right."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valveflow_ros.core.partition import Partition
from valveflow_ros.errors import InputError
from valveflow_ros.records import FloatArray

# A drop in cost counts as real when it exceeds this many times ln n times the noise variance
# (two further parameters found by a search over n places), widened for correlation in time.
_SIGNIFICANT = 8.0
_EXACT = 1e-20  # costs below this share of the total sum of squares are rounding


@dataclass(frozen=True, slots=True)
class Selection:
    """A chosen number of pieces and why.

    Attributes
    ----------
    rule : str
    pieces : int
    turning_angle : dict
        Lambda(J) of eq. (24), where it is defined: J = 2 .. J_max - 1.
    cost : dict
        Omega(J) of eq. (19).
    guard_reason : str
        Why the rule was overruled; empty when it was not.
    """

    rule: str
    pieces: int
    turning_angle: dict[int, float]
    cost: dict[int, float]
    guard_reason: str


def turning_angle(cost: FloatArray) -> dict[int, float]:
    """Return Lambda(J) of eq. (24) from Omega(1), Omega(2), ...

    It compares the drop of log Omega into J with the drop out of J and lies in
    [-1, 1]. It is not defined for J = 1 and for the largest J, so the rule can
    answer neither. Where no drop is left on either side (an exact fit) it is -1.
    """
    floor = max(float(cost[0]) * _EXACT, 1e-300)
    drop = -np.diff(np.log(np.maximum(cost, floor)))
    angles = {}
    for j in range(2, len(cost)):
        into, out = float(drop[j - 2]), float(drop[j - 1])
        angles[j] = (into - out) / (into + out) if into + out > 0.0 else -1.0
    return angles


def select(
    partition: Partition, *, rule: str = 'paper', correlation_inflation: float = 1.0
) -> Selection:
    """Choose J.

    Parameters
    ----------
    partition : Partition
    rule : str
        Only 'paper' is known here.
    correlation_inflation : float
        How many times the variance of a long mean of the residual exceeds that
        of independent samples, at least 1.

    Raises
    ------
    InputError
        Another rule was asked for.
    """
    if rule != 'paper':
        raise InputError(f"The rule '{rule}' is unknown; 'paper' is eq. (24).")
    cost = partition.cost
    angles = turning_angle(cost)
    costs = {j + 1: float(value) for j, value in enumerate(cost)}
    reason = _straight(partition, max(1.0, correlation_inflation))
    if reason or not angles:
        reason = reason or 'There are too few distinct u for more pieces.'
        return Selection(rule, 1, angles, costs, reason)
    return Selection(rule, max(angles, key=lambda j: angles[j]), angles, costs, '')


def _straight(partition: Partition, inflation: float) -> str:
    """Say why one piece is enough, or return an empty text.

    The rule is scale free: it finds a largest turn in any costs, also in those
    of pure noise about one line.
    """
    cost = partition.cost
    total = float(((partition.y - partition.y.mean()) ** 2).sum())
    if cost[0] <= _EXACT * total:
        return 'One line fits exactly.'
    n = partition.n_samples
    variance = float(cost[-1]) / max(n - 2 * len(cost), 1)
    needed = _SIGNIFICANT * math.log(n) * inflation * variance
    if float(cost[0] - cost.min()) <= needed * (len(cost) - 1) ** 0.5:
        return (
            f'No break lowers the cost by more than chance would: from {cost[0]:.4g} to '
            f'{cost.min():.4g} MW^2 with {len(cost)} pieces.'
        )
    return ''
