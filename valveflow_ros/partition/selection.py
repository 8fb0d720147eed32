"""The number of pieces: by evidence, or by the paper's rule (24) with a guard."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from valveflow_ros.errors import DataError, InputError, ParameterError
from valveflow_ros.partition.partition import Partition
from valveflow_ros.partition.series import Evidence, Series, weigh
from valveflow_ros.records import FloatArray

# A break counts as real when it lowers the cost by more than this many times ln n times the
# variance of the noise. In simulated data about one line (independent normal, binary and t3
# noise, 200 to 20000 samples, pieces of at least 1 %) chance stays below 8; without a
# smallest piece heavy tails do not.
_SIGNIFICANT = 8.0
# Costs below this share of Omega(1), or Omega(1) below this share of the sum of squares about
# the mean, mean an exact fit.
_EXACT = 1e-12


@dataclass(frozen=True, slots=True)
class Selection:
    """A chosen number of pieces and why.

    Attributes
    ----------
    rule : str
    pieces : int
        The chosen J.
    turning_angle : dict
        Lambda(J) of eq. (24), where it is defined: J = 2 .. J_max - 1.
    cost : dict
        Omega(J) of eq. (19) in MW^2, J = 1 .. J_max.
    guard_reason : str
        Why the rule was overruled, as a sentence; empty when it was not.
    confidence : dict
        Probability of each J; empty under the paper's rule, which has none.
    note : str
        On what J was chosen, as a sentence.
    """

    rule: str
    pieces: int
    turning_angle: dict[int, float]
    cost: dict[int, float]
    guard_reason: str
    confidence: dict[int, float] = field(default_factory=dict)
    note: str = ''


def paper_rule(
    cost: Sequence[float] | FloatArray, exact: float = 0.0
) -> tuple[dict[int, float], int]:
    """Return Lambda(J) of eq. (24) for J = 2 .. J_max - 1, and the J where it is largest.

    Parameters
    ----------
    cost : sequence of float (J_max,)
        Omega(1), Omega(2), ...; finite and >= 0, at least three.
    exact : float
        Costs up to here count as zero.

    Returns
    -------
    turning_angle : dict
        Lambda(J) in [-1, 1].
    pieces : int
        The smallest J of the largest Lambda. Never 1 and never J_max: the rule
        compares the drop of log Omega into J with the drop out of it, and those
        two have one drop only.

    Raises
    ------
    DataError
        There are fewer than three costs, or one is negative or not finite.

    Notes
    -----
    Where eq. (24) is not defined: dropping to zero is an infinite drop, so the
    first exact J has Lambda = 1 and the one before it -1; between two zeros, and
    where the cost does not drop on either side, there is no turn and Lambda = -1.
    A rising cost (possible where the smallest piece binds) is no drop.
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
    """Return log(before / after), at least 0; 0 from zero and infinite to zero."""
    if before <= exact or after >= before:
        return 0.0
    return math.inf if after <= exact else math.log(before) - math.log(after)


def _turn(into: float, out: float) -> float:
    if into == math.inf:
        return 1.0
    if out == math.inf or into + out == 0.0:
        return -1.0
    return (into - out) / (into + out)


def select(
    partition: Partition,
    *,
    rule: str = 'evidence',
    correlation_inflation: float = 1.0,
    series: Series | None = None,
) -> Selection:
    """Choose J.

    Parameters
    ----------
    partition : Partition
    rule : str
        'evidence' weighs every J by how probable it makes the samples; 'paper' is eq. (24).
        Lambda(J) and Omega(J) are reported under both.
    correlation_inflation : float
        Paper's rule: how many times the variance of a long mean of the residual
        exceeds that of independent samples, at least 1.
    series : Series, optional
        Evidence: the partition's samples in order of time, from which the noise's memory is
        learnt. Without it the samples are taken in ascending order of u.

    Raises
    ------
    InputError
        Another rule was asked for.
    ParameterError
        ``correlation_inflation`` is below 1 or not a number.

    Notes
    -----
    The paper's rule is free of scale: it finds a largest turn in any costs, also in
    those of pure noise about one line, and cannot answer 1. So it is asked only if some
    partition lowers the cost by more, per break, than chance would.
    """
    if rule not in ('evidence', 'paper'):
        raise InputError(
            f"The rule '{rule}' is unknown; there are 'evidence', and 'paper', eq. (24)."
        )
    if not 1.0 <= correlation_inflation < math.inf:
        raise ParameterError('correlation_inflation', f'is {correlation_inflation:g}, not >= 1')
    if rule == 'evidence':
        return _by_evidence(partition, series)
    angles, pieces = _turning(partition)
    reason = _straight(partition, correlation_inflation)
    if reason:
        pieces = 1
    elif not angles:
        most = len(partition.cost)
        reason = (
            f'The rule (24) compares three numbers of pieces and only {most} are '
            f'possible; {most} pieces lower the cost by more than chance would.'
        )
    return Selection(rule, pieces, angles, _costs(partition), reason, note=reason)


def _costs(partition: Partition) -> dict[int, float]:
    return {j: float(value) for j, value in enumerate(partition.cost, start=1)}


def _turning(partition: Partition) -> tuple[dict[int, float], int]:
    """Return Lambda(J) and where it is largest; none, and the most pieces, for fewer than 3."""
    cost = partition.cost
    if len(cost) < 3:
        return {}, len(cost)
    return paper_rule(cost, max(partition.floor, _EXACT * float(cost[0])))


def _by_evidence(partition: Partition, series: Series | None) -> Selection:
    """Weigh every J, unless one line or some exact fit leaves nothing to weigh."""
    angles, turn = _turning(partition)
    note = _exactly_straight(partition)
    confidence = {1: 1.0}
    if not note:
        exact = max(partition.floor, _EXACT * float(partition.cost[0]))
        fits = np.flatnonzero(partition.cost <= exact)
        # Where pieces have two or three samples each, lines fit anything.
        if len(fits) and partition.n_distinct > 4 * (int(fits[0]) + 1):
            confidence = {int(fits[0]) + 1: 1.0}
            note = f'{int(fits[0]) + 1} lines fit exactly.'
        else:
            found = _weighed(partition, series)
            confidence, note = found.probability, _sentence(found, partition, turn)
    pieces = max(confidence, key=lambda j: (confidence[j], -j))
    return Selection('evidence', pieces, angles, _costs(partition), '', confidence, note)


def _weighed(partition: Partition, series: Series | None) -> Evidence:
    most = len(partition.cost)
    starts = {j: partition.u[partition.breaks(j)[1:-1]] for j in range(2, most + 1)}
    if series is None:
        # Equal u come in ascending order of y, which would look like memory.
        mixed = np.random.default_rng(0).permutation(partition.n_samples)
        order = mixed[np.argsort(partition.u[mixed], kind='stable')]
        fresh = np.zeros(partition.n_samples, dtype=bool)
        fresh[0] = True
        series = Series(partition.u[order], partition.y[order], fresh)
    return weigh(series, most, starts)


def _sentence(found: Evidence, partition: Partition, turn: int) -> str:
    """Say on what evidence J was chosen."""
    share = found.probability
    others = sorted((j for j in share if j != found.pieces), key=lambda j: -share[j])
    words = (
        f'J = {found.pieces} has {_percent(share[found.pieces])} of the evidence of '
        f'{partition.n_samples} samples'
    )
    if others:
        words += f', J = {others[0]} has {_percent(share[others[0]])}'
    noise = [] if found.memory < 1.5 else [
        f'a memory (one independent sample in {found.memory:.3g})'
    ]  # fmt: skip
    if found.dof < 10.0:
        noise.append(f"heavy tails (Student's t, {found.dof:g} degrees of freedom)")
    if noise:
        words += f'; the noise has {" and ".join(noise)}'
    if len(partition.cost) >= 3 and turn != found.pieces:
        words += f"; the paper's rule (24) takes J = {turn}"
    return f'{words}.'


def _percent(share: float) -> str:
    if share > 0.9995:
        return 'more than 99.9 %'
    return 'less than 0.1 %' if share < 0.001 else f'{100.0 * share:.3g} %'


def _exactly_straight(partition: Partition) -> str:
    """Say why there is nothing to choose, or return an empty text."""
    if len(partition.cost) == 1:
        return f'One piece is all that {partition.n_distinct} distinct u allow.'
    about_mean = partition.y - partition.y.mean()
    total = float((about_mean * about_mean).sum())
    if partition.cost[0] <= max(partition.floor, _EXACT * total):
        return 'One line fits exactly.'
    return ''


def _straight(partition: Partition, inflation: float) -> str:
    """Say why one piece is enough, or return an empty text."""
    exactly = _exactly_straight(partition)
    if exactly:
        return exactly
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
