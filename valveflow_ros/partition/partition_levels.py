"""Samples made ready for the search: checked, sorted, equal u merged, scaled."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.jit import kernel
from valveflow_ros.records import FloatArray, IntArray

# Distinct u closer than this share of the range are one u: no plant resolves them.
_SAME_U = 1e-9
# Beyond this, or over a range below its inverse, sums of squares leave the range of floats.
_LARGEST = 1e100


@dataclass(frozen=True, slots=True)
class Levels:
    """Sorted samples, and the weighted levels of u that they form.

    Attributes
    ----------
    u, y : float64 (n,)
        The samples in ascending order of u, of y within equal u; read-only.
    first : int64 (levels + 1,)
        The first sample of each level, and n.
    x : float64 (levels,)
        The u of each level times a power of two that makes the range about 1, which
        changes no digit; where `rough`, the mean distance from the first sample, so scaled.
    residual : float64 (levels,)
        Mean y of each level about one line through all, over `scale`.
    weight : float64 (levels,)
        Number of samples.
    scale : float
        Root mean square of the levels' residual in the unit of y, or 1 if that is 0.
    within : float
        Sum of squares inside levels, which no partition changes.
    rough : bool
        Some levels hold u that are not quite equal.
    floor : float
        Costs up to here are rounding of u and y, in the square of the unit of y.
    """

    u: FloatArray
    y: FloatArray
    first: IntArray
    x: FloatArray
    residual: FloatArray
    weight: FloatArray
    scale: float
    within: float
    rough: bool
    floor: float

    def __len__(self) -> int:
        """Return the number of levels."""
        return len(self.x)


def make_levels(u: ArrayLike, y: ArrayLike) -> Levels:
    """Check, sort, merge and scale samples.

    Raises
    ------
    DataError
        The arrays do not match, hold something that is not a finite number below
        1e100, or u never changes.
    TooFewSamplesError
        There are fewer than two samples.
    """
    grain = max(_grain(u), _grain(y))
    a, b = _numbers('u', u), _numbers('y', y)
    if a.ndim != 1 or a.shape != b.shape:
        raise DataError(
            f'u and y must be one-dimensional and equally long, not {a.shape} and {b.shape}.'
        )
    for name, values in (('u', a), ('y', b)):
        _check_values(name, values)
    if len(a) < 2:
        raise TooFewSamplesError('Samples', len(a), 2)
    if float(a.max()) - float(a.min()) <= 1.0 / _LARGEST:
        raise DataError(f'u is {a[0]:g} in all {len(a)} samples: a slope needs it to change.')
    order = np.lexsort((b, a))
    a, b = a[order], b[order]
    a.flags.writeable = False
    b.flags.writeable = False
    return _merged(a, b, grain)


def _numbers(name: str, values: ArrayLike) -> FloatArray:
    """Turn anything array-like into float64, or say that it cannot be."""
    array = np.asarray(values)
    if array.dtype.kind not in 'biuf':
        raise DataError(f'{name} must hold real numbers, not {array.dtype}.')
    with np.errstate(over='ignore'):  # becomes infinite, which is refused with its place
        return np.asarray(array, dtype=np.float64)


def _grain(values: ArrayLike) -> float:
    """Return the relative rounding with which values came: that of float32 is much coarser."""
    dtype = np.asarray(values).dtype
    finest = float(np.finfo(np.float64).eps)
    return max(finest, float(np.finfo(dtype).eps)) if dtype.kind == 'f' else finest


def _check_values(name: str, values: FloatArray) -> None:
    """Refuse NaN, infinities and what cannot be squared, naming the first of them."""
    bad = np.flatnonzero(~(np.abs(values) <= _LARGEST))
    if len(bad) == 0:
        return
    value = values[bad[0]]
    what = 'must be finite' if not np.isfinite(value) else f'must lie within {_LARGEST:g}'
    more = f' ({len(bad)} such samples)' if len(bad) > 1 else ''
    raise DataError(f'{name}[{bad[0]}] is {value:g}: every sample {what}{more}.')


@kernel
def _level_starts(u: FloatArray, tolerance: float, first: IntArray) -> int:
    """Begin a level wherever u is more than ``tolerance`` above where the last one began."""
    count = 1
    first[0] = 0
    begin = u[0]
    for k in range(1, len(u)):
        if u[k] - begin > tolerance:
            begin = u[k]
            first[count] = k
            count += 1
    return count


def _merged(u: FloatArray, y: FloatArray, grain: float) -> Levels:
    """Merge sorted samples into levels."""
    n = len(u)
    span = float(u[-1] - u[0])
    first = np.empty(n + 1, dtype=np.int64)
    count = _level_starts(u, _SAME_U * span, first)
    first = first[: count + 1].copy()
    first[count] = n
    size = np.diff(first)
    weight = size.astype(np.float64)
    x = u[first[:-1]]
    rough = bool((u != np.repeat(x, size)).any())
    if rough:
        # Relative to the first sample: a mean of large u would round to their last digit.
        x = np.add.reduceat(u - u[0], first[:-1]) / weight
    # Two lines' worth of digits are kept by never adding an offset back.
    dx = x - float((weight * (x - x[0])).sum() / n + x[0])
    dy = y - float((y - y[0]).mean() + y[0])
    mean = np.add.reduceat(dy, first[:-1]) / weight
    slope = float((weight * dx * mean).sum() / (weight * dx * dx).sum())
    residual = mean - slope * dx
    scale = math.sqrt(float((weight * residual * residual).sum()) / n) or 1.0
    inside = dy - np.repeat(mean, size)
    return Levels(
        u=u,
        y=y,
        first=first,
        x=np.ldexp(x, -math.frexp(span)[1]),
        residual=residual / scale,
        weight=weight,
        scale=scale,
        within=float((inside * inside).sum()),
        rough=rough,
        floor=n * (4.0 * grain * (np.abs(y).max() + abs(slope) * np.abs(u).max())) ** 2,
    )
