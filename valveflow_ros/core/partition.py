"""The exact partition: the best J straight pieces through samples, for all J in one pass.

Solves eqs. (19)-(23) of the paper. The samples are sorted by u, equal u are
merged into one weighted sample (a break inside equal u is meaningless), and
the dynamic programme of `partition_layers` finds, for every J up to the
largest, the breaks of least cost. Every candidate it does not look at is
discarded by a proven bound, so the result is the optimum and not an estimate.
"""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from valveflow_ros.core.partition_layers import best_partitions, prepare
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.records import FloatArray, IntArray

# Distinct u closer than this share of the range are one u: no plant resolves them.
_SAME_U = 1e-9
# A layer may stop at costs this much above the optimum, as a share of the total sum of squares.
_SLACK = 1e-12
# Below this many samples starting threads costs more than it gains.
_SERIAL_BELOW = 50_000


@dataclass(frozen=True, slots=True)
class FittedPiece:
    """One piece of a partition, fitted by least squares, eq. (20).

    Standard errors take the samples for independent.
    """

    u_from: float
    u_to: float
    slope: float
    intercept: float
    samples: int
    sse: float
    slope_stderr: float
    intercept_stderr: float


@dataclass(frozen=True, slots=True)
class Partition:
    """The best partitions into 1, 2, ... pieces.

    Attributes
    ----------
    cost : float64 (J_max,)
        Omega(J) of eq. (19) in MW^2, recomputed from the samples.
    u, y : float64 (n,)
        The samples in ascending order of u.
    starts : tuple of int64 arrays
        For each J the first sample of each piece, and n.
    n_distinct : int
        Number of different u.
    certified : bool
        Always true: every candidate discarded was discarded by a proven bound.
    """

    cost: FloatArray
    u: FloatArray
    y: FloatArray
    starts: tuple[IntArray, ...]
    n_distinct: int
    certified: bool = True

    @property
    def n_samples(self) -> int:
        """Return the number of samples."""
        return len(self.u)

    def breaks(self, pieces: int) -> IntArray:
        """Return where the pieces begin among the sorted samples, and n: int64 (pieces + 1,)."""
        if not 1 <= pieces <= len(self.starts):
            raise DataError(
                f'There is no partition into {pieces} pieces, only into 1 to {len(self.starts)}.'
            )
        return self.starts[pieces - 1]

    def pieces(self, pieces: int) -> tuple[FittedPiece, ...]:
        """Return the fitted pieces; each ends where the next begins."""
        starts = self.breaks(pieces)
        ends = [*self.u[starts[1:-1]].tolist(), float(self.u[-1])]
        return tuple(
            _fit_piece(self.u[a:b], self.y[a:b], float(self.u[a]), end)
            for a, b, end in zip(starts[:-1], starts[1:], ends, strict=True)
        )


def partition(
    u: ArrayLike,
    y: ArrayLike,
    max_pieces: int = 10,
    min_distinct: int = 2,
    *,
    threads: int | None = None,
) -> Partition:
    """Partition samples into 1 .. ``max_pieces`` straight pieces, each exactly.

    Parameters
    ----------
    u, y : array_like (n,)
        Integrated input in % MPa^m and power in MW, in any order.
    max_pieces : int
        Largest J, R_max of the paper. Fewer come out when there are not enough distinct u.
    min_distinct : int
        Fewest distinct u in a piece, at least 2.
    threads : int, optional
        1 starts none. By default as many as there are cores, for large inputs.

    Raises
    ------
    DataError
        The arrays do not match, hold NaN or infinity, or u never changes.
    TooFewSamplesError
        There are fewer distinct u than one piece needs.

    Notes
    -----
    Complexity: in practice somewhat above linear in n for each J; O(J n^2) at worst.
    """
    u_sorted, y_sorted = _checked(u, y)
    least = max(2, int(min_distinct))
    x, mean, weight, first = _merge(u_sorted, y_sorted)
    if len(x) < least:
        raise TooFewSamplesError('Distinct values of u for one piece', len(x), least)
    most = max(1, min(int(max_pieces), len(x) // least))
    if threads is None:
        threads = (os.cpu_count() or 1) if len(x) >= _SERIAL_BELOW else 1
    centre_x, centre_y = np.average(x, weights=weight), np.average(mean, weights=weight)
    dx, dy = x - centre_x, mean - centre_y
    rest = dy - float((weight * dx * dy).sum() / (weight * dx * dx).sum()) * dx
    scale = float(np.sqrt(np.average(rest**2, weights=weight)))
    # Without residual there is nothing to scale, and any partition is exact.
    scaled = (
        rest / scale if scale > 1e-13 * max(1.0, float(np.abs(y_sorted).max())) else 0.0 * rest
    )
    slack = _SLACK * float(weight.sum())
    _, starts = best_partitions(prepare(x, scaled, weight, least, slack, threads), most)
    bounds = np.append(first, len(u_sorted))
    original = tuple(bounds[s] for s in starts)
    cost = np.array([_cost(u_sorted, y_sorted, s) for s in original])
    # Costs cannot rise with J; where rounding says so, the poorer partition is as good.
    cost = np.minimum.accumulate(cost)
    return Partition(cost, u_sorted, y_sorted, original, len(x))


def _checked(u: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return float64 copies in ascending order of u, or say what is wrong."""
    a, b = np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise DataError(
            f'u and y must be one-dimensional and equally long, not {a.shape} and {b.shape}.'
        )
    for name, values in (('u', a), ('y', b)):
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            raise DataError(f'{name}[{bad[0]}] is {values[bad[0]]}: every sample must be finite.')
    if len(a) < 2:
        raise TooFewSamplesError('Samples', len(a), 2)
    if a.min() == a.max():
        raise DataError(f'u is {a[0]:g} in all {len(a)} samples: a slope needs it to change.')
    order = np.lexsort((b, a))
    return a[order], b[order]


def _merge(u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Merge equal u; return u scaled to [-1, 1], mean y, weight and the first sample of each."""
    tolerance = _SAME_U * (u[-1] - u[0])
    first = np.flatnonzero(np.append(True, np.diff(u) > tolerance))
    weight = np.diff(np.append(first, len(u))).astype(np.float64)
    centre = y.mean()
    mean = np.add.reduceat(y - centre, first) / weight + centre
    middle, half = 0.5 * (u[0] + u[-1]), 0.5 * (u[-1] - u[0])
    return (u[first] - middle) / half, mean, weight, first.astype(np.int64)


def _centred(u: FloatArray, y: FloatArray) -> tuple[float, float, float, float]:
    """Return mean u, mean y, slope and sum of squares about the line, in two passes."""
    mean_u, mean_y = float(u.mean()), float(y.mean())
    du, dy = u - mean_u, y - mean_y
    # Not a dot product: its last bits would depend on the number of threads.
    sxx = float((du * du).sum())
    slope = float((du * dy).sum()) / sxx if sxx > 0.0 else 0.0
    rest = dy - slope * du
    return mean_u, mean_y, slope, float((rest * rest).sum())


def _cost(u: FloatArray, y: FloatArray, starts: IntArray) -> float:
    """Return the cost of a partition from the samples themselves."""
    return sum(_centred(u[a:b], y[a:b])[3] for a, b in itertools.pairwise(starts))


def _fit_piece(u: FloatArray, y: FloatArray, begin: float, end: float) -> FittedPiece:
    """Fit one piece."""
    mean_u, mean_y, slope, sse = _centred(u, y)
    spread = float(((u - mean_u) ** 2).sum())
    n = len(u)
    variance = sse / (n - 2) if n > 2 else float('nan')
    slope_error = float(np.sqrt(variance / spread)) if spread > 0.0 else float('nan')
    return FittedPiece(
        u_from=begin,
        u_to=end,
        slope=slope,
        intercept=mean_y - slope * mean_u,
        samples=n,
        sse=sse,
        slope_stderr=slope_error,
        intercept_stderr=float(np.sqrt(variance / n + (slope_error * mean_u) ** 2)),
    )
