# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The exact partition: the best J straight pieces through samples, for all J in one pass.

It solves eqs. (19)-(23) of the paper. The samples are sorted by u, and equal u
are merged into one weighted level (a break inside equal u is meaningless). The
dynamic programme of `partition.search` finds the breaks of minimal cost for every
J up to the largest. Candidates are excluded only if a proven lower bound
(`partition.bounds`) shows that they cannot be better, so the result is the
optimum and not an estimate.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from valveflow_ros.errors import DataError, ParameterError, TooFewSamplesError
from valveflow_ros.numerics import cores, kernel
from valveflow_ros.partition.search import best_partitions, prepare
from valveflow_ros.records import FloatArray, IntArray

# Values of u closer than this fraction of the range are merged: no plant resolves them.
_SAME_U = 1e-9
# For larger values, or a range below the inverse, sums of squares overflow or underflow.
_LARGEST = 1e100
_HEAVIEST = 1e6


@dataclass(frozen=True, slots=True)
class Levels:
    """Sorted samples, and the weighted levels of u that they form."""

    # (n,) the samples in ascending order of u, of y within equal u, and their weights; read-only.
    u: FloatArray
    y: FloatArray
    each: FloatArray
    first: IntArray  # (levels + 1,) the first sample of each level, and n
    # (levels,) the u of each level times a power of two that makes the range about 1, which
    # changes no digit; where `rough`, the mean distance from the first sample, so scaled.
    x: FloatArray
    residual: FloatArray  # (levels,) mean y about one line through all, over `scale`
    weight: FloatArray  # (levels,) sum of the samples' weights
    scale: float  # root mean square of the levels' residual in the unit of y, or 1 if this is 0
    within: float  # sum of squares inside levels, which is the same for all partitions
    rough: bool  # some levels contain u that are not exactly equal
    floor: float  # costs up to this are rounding of u and y, in the square of the unit of y

    def __len__(self) -> int:
        """Return the number of levels."""
        return len(self.x)


def make_levels(u: ArrayLike, y: ArrayLike, weight: ArrayLike | None = None) -> Levels:
    """Check, sort, merge and scale samples; without ``weight`` each has weight 1.

    Raises `DataError` and `TooFewSamplesError` as `partition` does.
    """
    a, b = _numbers('u', u), _numbers('y', y)
    if a.ndim != 1 or a.shape != b.shape:
        raise DataError(
            f'u and y must be one-dimensional and equally long, not {a.shape} and {b.shape}.'
        )
    for name, values in (('u', a), ('y', b)):
        _check(name, values)
    each = np.ones(len(a)) if weight is None else _weights(weight, a.shape)
    if len(a) < 2:
        raise TooFewSamplesError('Samples', len(a), 2)
    if float(a.max()) - float(a.min()) <= 1.0 / _LARGEST:
        raise DataError(f'u is {a[0]:g} in all {len(a)} samples: a slope needs it to change.')
    order = np.lexsort((each, b, a))
    a, b, each = a[order], b[order], each[order]
    for values in (a, b, each):
        values.flags.writeable = False
    return _merged(a, b, each, max(_grain(u), _grain(y)))


def _weights(weight: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Check weights: with extreme weights the other samples would be lost by rounding."""
    each = _numbers('weight', weight)
    if each.shape != shape:
        raise DataError(f'weight must be as long as u, {shape}, not {each.shape}.')
    bad = np.flatnonzero(~((each >= 1.0 / _HEAVIEST) & (each <= _HEAVIEST)))
    if len(bad):
        raise DataError(
            f'weight[{bad[0]}] is {each[bad[0]]:g}: every weight must lie between '
            f'{1.0 / _HEAVIEST:g} and {_HEAVIEST:g}.'
        )
    return each


def _numbers(name: str, values: ArrayLike) -> FloatArray:
    array = np.asarray(values)
    if array.dtype.kind not in 'biuf':
        raise DataError(f'{name} must hold real numbers, not {array.dtype}.')
    with np.errstate(over='ignore'):  # becomes infinite, which is refused later with its index
        return np.asarray(array, dtype=np.float64)


def _grain(values: ArrayLike) -> float:
    """Return the relative rounding of the input's type: that of float32 is much larger."""
    dtype = np.asarray(values).dtype
    finest = float(np.finfo(np.float64).eps)
    return max(finest, float(np.finfo(dtype).eps)) if dtype.kind == 'f' else finest


def _check(name: str, values: FloatArray) -> None:
    """Raise `DataError` for NaN, infinity and too large values, naming the first of them."""
    bad = np.flatnonzero(~(np.abs(values) <= _LARGEST))
    if len(bad) == 0:
        return
    value = values[bad[0]]
    what = 'must be finite' if not np.isfinite(value) else f'must lie within {_LARGEST:g}'
    more = f' ({len(bad)} such samples)' if len(bad) > 1 else ''
    raise DataError(f'{name}[{bad[0]}] is {value:g}: every sample {what}{more}.')


@kernel
def _level_starts(u: FloatArray, tolerance: float, first: IntArray) -> int:
    """Begin a level if u is more than ``tolerance`` above the beginning of the last one."""
    count = 1
    first[0] = 0
    begin = u[0]
    for k in range(1, len(u)):
        if u[k] - begin > tolerance:
            begin = u[k]
            first[count] = k
            count += 1
    return count


def _merged(u: FloatArray, y: FloatArray, each: FloatArray, grain: float) -> Levels:
    n = len(u)
    span = float(u[-1] - u[0])
    first = np.empty(n + 1, dtype=np.int64)
    count = _level_starts(u, _SAME_U * span, first)
    first = first[: count + 1].copy()
    first[count] = n
    size = np.diff(first)
    weight = np.add.reduceat(each, first[:-1])
    total = float(weight.sum())
    x = u[first[:-1]]
    rough = bool((u != np.repeat(x, size)).any())
    if rough:
        # Relative to the first sample: the mean of large u would lose digits by rounding.
        x = np.add.reduceat(each * (u - u[0]), first[:-1]) / weight
    # The offsets are not added back, because that would lose digits.
    dx = x - float((weight * (x - x[0])).sum() / total + x[0])
    dy = y - float((each * (y - y[0])).sum() / total + y[0])
    mean = np.add.reduceat(each * dy, first[:-1]) / weight
    slope = float((weight * dx * mean).sum() / (weight * dx * dx).sum())
    residual = mean - slope * dx
    scale = math.sqrt(float((weight * residual * residual).sum()) / total) or 1.0
    inside = dy - np.repeat(mean, size)
    return Levels(
        u=u, y=y, each=each, first=first, x=np.ldexp(x, -math.frexp(span)[1]),
        residual=residual / scale, weight=weight, scale=scale,
        within=float((each * inside * inside).sum()), rough=rough,
        floor=total * (4.0 * grain * (np.abs(y).max() + abs(slope) * np.abs(u).max())) ** 2,
    )  # fmt: skip


# A bound is taken as reached within this fraction of the sum of squares about one line. It is
# ten times the rounding of the search: without it all exact ties (data without noise) would
# have to be evaluated.
_SLACK = 2e-14
# The result is certified if the search's own cost and the cost of its breaks, recomputed from
# the samples, agree within this fraction of Omega(1).
_AGREE = 1e-10
# With fewer levels the start of threads takes longer than they save.
_SERIAL_BELOW = 20_000


@dataclass(frozen=True, slots=True)
class FittedPiece:
    """One piece of a partition, fitted by least squares, eq. (20).

    A piece begins at its first sample, as in the paper, and ends where the next one begins, so
    there are no gaps.
    """

    u_from: float  # % MPa^m
    u_to: float
    slope: float  # K_f in MW per unit of u
    intercept: float  # C in MW
    samples: int
    sse: float  # sum of squared residuals in MW^2
    slope_stderr: float  # for independent samples; NaN for two, which have no residual
    intercept_stderr: float


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """The best partitions into 1, 2, ... J_max pieces.

    If it is ``certified``, the search's own costs agree with `cost`. As the lower bounds are
    exact, no partition then costs less than ``cost[J - 1] - tolerance``.
    """

    # (J_max,) Omega(J) of eq. (19) in MW^2, recomputed in two passes from the samples. Due to the
    # minimum size of pieces it can rise with J.
    cost: FloatArray
    u: FloatArray  # (n,) the samples in ascending order of u, and their weights; read-only
    y: FloatArray
    weight: FloatArray
    starts: tuple[IntArray, ...]  # for each J the first sample of each piece, and n
    n_distinct: int  # number of different u
    certified: bool
    floor: float  # costs up to this value, in MW^2, are rounding of the samples
    limited: str  # why there are fewer partitions than requested, as a sentence; else empty

    @property
    def n_samples(self) -> int:
        """Return the number of samples."""
        return len(self.u)

    @property
    def tolerance(self) -> float:
        """Return the maximum difference of a certified cost from the optimum, MW^2."""
        return _AGREE * float(self.cost[0])

    def breaks(self, pieces: int) -> IntArray:
        """Return the indices of the first samples of the pieces, and n: int64 (pieces + 1,)."""
        if not 1 <= pieces <= len(self.starts):
            raise DataError(
                f'There is no partition into {pieces} pieces, only into 1 to {len(self.starts)}.'
            )
        return self.starts[pieces - 1]

    def pieces(self, pieces: int) -> tuple[FittedPiece, ...]:
        """Return the fitted pieces in ascending order of u."""
        starts = self.breaks(pieces)
        ends = [*self.u[starts[1:-1]].tolist(), float(self.u[-1])]
        return tuple(
            _fit_piece(self.u[a:b], self.y[a:b], self.weight[a:b], float(self.u[a]), end)
            for a, b, end in zip(starts[:-1], starts[1:], ends, strict=True)
        )


def partition(
    u: ArrayLike, y: ArrayLike, max_pieces: int = 10, min_distinct: int = 2, *,
    weight: ArrayLike | None = None, threads: int | None = None,
) -> Partition:  # fmt: skip
    """Partition samples exactly into 1, 2, ... ``max_pieces`` straight pieces.

    Raises `DataError` if the lengths differ, a value is not a finite number below 1e100, u is
    constant, or a weight is not between 1e-6 and 1e6. Raises `TooFewSamplesError` if there are too
    few distinct u for one piece. Raises `ParameterError` if ``max_pieces``, ``min_distinct`` or
    ``threads`` is too small.

    Parameters
    ----------
    u, y : array_like (n,)
        Integrated input in % MPa^m and power in MW, in any order; not changed.
    max_pieces : int
        Largest J, R_max of the paper, at least 1. The result has fewer partitions, with a
        reason in `Partition.limited`, for fewer than ``max_pieces * min_distinct`` distinct u.
    min_distinct : int
        Minimum number of distinct u in a piece, at least 2: with one, a piece has no slope.
    weight : array_like (n,), optional
        Weight of each sample's square in the cost, between 1e-6 and 1e6; default 1.
    threads : int, optional
        1 starts no threads. By default all available cores are used for large inputs.
        The result does not depend on the number of threads.

    Notes
    -----
    Differences from the paper: equal u are merged before the search; a piece has at
    least ``min_distinct`` distinct u; a sample belongs to one piece only (in eqs.
    (21)-(23) the sample at a break ends one piece and begins the next); u closer than
    1e-9 of the range are taken as equal, also for the breaks.

    Any one of several partitions of equal cost may be returned: the cost is unique,
    the breaks are not.

    Time grows slightly faster than n for each J in practice, O(J n^2) at worst; memory
    is about 300 bytes per sample for 10 pieces.
    """
    given = (
        ('max_pieces', max_pieces, 1),
        ('min_distinct', min_distinct, 2),
        ('threads', threads, 1),
    )
    for name, value, least in given:
        if value is not None and not value >= least:
            raise ParameterError(name, f'is {value}, but must be at least {least}')
    levels = make_levels(u, y, weight)
    if len(levels) < min_distinct:
        raise TooFewSamplesError('Distinct values of u for one piece', len(levels), min_distinct)
    most = min(max_pieces, len(levels) // min_distinct)
    if threads is None:
        threads = cores() if len(levels) >= _SERIAL_BELOW else 1
    slack = _SLACK * float(levels.weight.sum())  # the scaled sum of squares about one line
    problem = prepare(levels.x, levels.residual, levels.weight, min_distinct, slack, threads)
    found, starts = best_partitions(problem, most)
    original = tuple(levels.first[s] for s in starts)
    cost = np.array([_cost(levels.u, levels.y, levels.each, s) for s in original])
    limited = '' if most == max_pieces else (
        f'{max_pieces} pieces of {min_distinct} distinct u each were asked for, but there are '
        f'only {len(levels)} distinct u: {most} is the largest number of pieces.'
    )  # fmt: skip
    return Partition(
        cost=cost, u=levels.u, y=levels.y, weight=levels.each, starts=original,
        n_distinct=len(levels), certified=_agree(levels, found, cost, starts),
        floor=levels.floor, limited=limited,
    )  # fmt: skip


def _agree(levels: Levels, found: FloatArray, cost: FloatArray, starts: list[IntArray]) -> bool:
    """Return True if the search's costs agree with those of its breaks, as a check of rounding."""
    if levels.rough:
        # The search takes nearly equal u as equal: compare costs of the problem that it solved.
        flat = np.repeat(levels.x, np.diff(levels.first))
        cost = np.array([_cost(flat, levels.y, levels.each, levels.first[s]) for s in starts])
    claimed = found * levels.scale**2 + levels.within
    return bool(np.all(np.abs(claimed - cost) <= _AGREE * cost[0] + levels.floor))


def _centred(
    u: FloatArray, y: FloatArray, weight: FloatArray
) -> tuple[float, float, float, float, float]:
    """Return mean u, mean y, slope, spread of u and sum of squares about the line, in two passes.

    No dot products: their last bits would depend on the number of threads.
    """
    total = weight.sum()
    mean_u = float((weight * (u - u[0])).sum() / total + u[0])
    mean_y = float((weight * (y - y[0])).sum() / total + y[0])
    du, dy = u - mean_u, y - mean_y
    spread = float((weight * du * du).sum())
    slope = float((weight * du * dy).sum()) / spread if spread > 0.0 else 0.0
    rest = dy - slope * du
    return mean_u, mean_y, slope, spread, float((weight * rest * rest).sum())


def _cost(u: FloatArray, y: FloatArray, weight: FloatArray, starts: IntArray) -> float:
    return sum(_centred(u[a:b], y[a:b], weight[a:b])[4] for a, b in itertools.pairwise(starts))


def _fit_piece(
    u: FloatArray, y: FloatArray, weight: FloatArray, begin: float, end: float
) -> FittedPiece:
    mean_u, mean_y, slope, spread, sse = _centred(u, y, weight)
    n = len(u)
    variance = sse / (n - 2) if n > 2 else math.nan
    leverage = 1.0 / float(weight.sum()) + mean_u * mean_u / spread
    return FittedPiece(
        u_from=begin, u_to=end, slope=slope, intercept=mean_y - slope * mean_u, samples=n, sse=sse,
        slope_stderr=math.sqrt(variance / spread),
        intercept_stderr=math.sqrt(variance * leverage),
    )  # fmt: skip
