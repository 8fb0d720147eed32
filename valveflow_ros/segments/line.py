"""A straight line through points that arrive one by one, in constant time."""

from __future__ import annotations

import math

from valveflow_ros.jit import jit
from valveflow_ros.records import FloatArray

# A line is five running sums over (k, v), k = 0, 1, 2, ... and v taken
# relative to the first point, so that a large offset costs no digits.
N, ORIGIN, SV, SKV, SVV = range(5)
LINE_SIZE = 5


@jit
def line_reset(line: FloatArray) -> None:
    """Forget all points."""
    line[:] = 0.0


@jit
def line_add(line: FloatArray, value: float) -> None:
    """Append the next point."""
    if line[N] == 0.0:
        line[ORIGIN] = value
    v = value - line[ORIGIN]
    k = line[N]
    line[N] += 1.0
    line[SV] += v
    line[SKV] += k * v
    line[SVV] += v * v


@jit
def line_fit(line: FloatArray) -> tuple[float, float, float]:
    """Return mean, slope per point, and rms residual (n - 2 degrees of freedom).

    Two points or fewer have no residual (0); one point has no slope (0).
    """
    n = line[N]
    if n < 1.0:
        return math.nan, 0.0, 0.0
    mean = line[SV] / n
    if n < 2.0:
        return mean + line[ORIGIN], 0.0, 0.0
    middle = (n - 1.0) / 2.0
    sxx = n * (n * n - 1.0) / 12.0
    sxy = line[SKV] - middle * line[SV]
    slope = sxy / sxx
    if n < 3.0:
        return mean + line[ORIGIN], slope, 0.0
    rest = line[SVV] - line[SV] * mean - slope * sxy
    return mean + line[ORIGIN], slope, math.sqrt(max(rest, 0.0) / (n - 2.0))


@jit
def line_ahead(line: FloatArray, steps: float) -> tuple[float, float]:
    """Extrapolate to ``steps`` points after the last one.

    Returns the value and the factor on the noise sd that the error of a new
    point there has, ``sqrt(1 + leverage)``.
    """
    mean, slope, _ = line_fit(line)
    n = line[N]
    x = n - 1.0 + steps - (n - 1.0) / 2.0
    spread = n * (n * n - 1.0) / 12.0
    leverage = 1.0 / n + (x * x / spread if spread > 0.0 else 0.0)
    return mean + slope * x, math.sqrt(1.0 + leverage)
