"""The library of candidate functions of Section IV of the paper, and what it makes of time.

``y' = xi . theta(y, u)`` with theta = [1, y, u, y^2, y u, u^2, y^3, y^2 u, y u^2, u^3,
sin y, sin u, cos y, cos u]: the 14 entries of the paper's vector Xi, of which the first
belongs to the constant.
"""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.numerics import jit
from valveflow_ros.records import ByteArray, FloatArray

NAMES = (
    '1', 'y', 'u', 'y^2', 'y u', 'u^2', 'y^3', 'y^2 u', 'y u^2', 'u^3',
    'sin y', 'sin u', 'cos y', 'cos u',
)  # fmt: skip
SIZE = len(NAMES)
_LONGEST_STEP_S = 5.0
_AWAY = 1e6  # MW; what has gone further does not come back


@jit
def theta(y: float, u: float, out: FloatArray) -> None:
    """Write the 14 functions at one point."""
    out[0] = 1.0
    out[1] = y
    out[2] = u
    out[3] = y * y
    out[4] = y * u
    out[5] = u * u
    out[6] = y * y * y
    out[7] = y * y * u
    out[8] = y * u * u
    out[9] = u * u * u
    out[10] = math.sin(y)
    out[11] = math.sin(u)
    out[12] = math.cos(y)
    out[13] = math.cos(u)


@jit
def columns(y: FloatArray, u: FloatArray) -> FloatArray:
    """Return the functions at all rows, shape (n, 14)."""
    out = np.empty((y.size, SIZE))
    for t in range(y.size):
        theta(y[t], u[t], out[t])
    return out


@jit
def rate(y: float, u: float, xi: FloatArray) -> float:
    """Return y' in MW/s; absent functions are not computed."""
    powers = xi[0] + u * (xi[2] + u * (xi[5] + u * xi[9]))
    powers += y * (xi[1] + u * (xi[4] + u * xi[8]) + y * (xi[3] + u * xi[7] + y * xi[6]))
    if xi[10] != 0.0:
        powers += xi[10] * math.sin(y)
    if xi[11] != 0.0:
        powers += xi[11] * math.sin(u)
    if xi[12] != 0.0:
        powers += xi[12] * math.cos(y)
    if xi[13] != 0.0:
        powers += xi[13] * math.cos(u)
    return float(powers)


@jit
def _advance(y: float, before: float, now: float, xi: FloatArray, step_s: float) -> float:
    """Integrate over one row by Runge-Kutta of fourth order, in short enough steps."""
    parts = max(1, math.ceil(step_s / _LONGEST_STEP_S))
    h = step_s / parts
    move = (now - before) / parts
    u = before
    for _ in range(parts):
        k1 = rate(y, u, xi)
        k2 = rate(y + 0.5 * h * k1, u + 0.5 * move, xi)
        k3 = rate(y + 0.5 * h * k2, u + 0.5 * move, xi)
        k4 = rate(y + h * k3, u + move, xi)
        y += h * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0
        u += move
    return y


@jit
def simulate(
    u: FloatArray,
    usable: ByteArray,
    begin: FloatArray,
    xi: FloatArray,
    step_s: float,
    settle: int,
    answer: FloatArray,
    settled: ByteArray,
) -> None:
    """Integrate, u straight between rows.

    ``begin`` (n,) is the power to begin with after a gap. ``answer`` is NaN in
    gaps and infinite once the solution has run away.
    """
    y = 0.0
    age = 0
    for t in range(u.size):
        if not usable[t]:
            age = 0
            answer[t] = np.nan
            settled[t] = 0
            continue
        if age == 0:
            y = begin[t]
        elif abs(y) < _AWAY:
            y = _advance(y, u[t - 1], u[t], xi, step_s)
        answer[t] = y if abs(y) < _AWAY else np.inf
        age += 1
        settled[t] = 1 if age > settle else 0


@jit
def weak_rows(
    y: FloatArray,
    theta_rows: FloatArray,
    usable: ByteArray,
    centres: np.ndarray,
    test: FloatArray,
    slope: FloatArray,
    out: FloatArray,
) -> int:
    """Write rows ``[integral of phi theta, - integral of phi' y]``; return how many.

    ``test`` and ``slope`` are phi and phi' on rows -w..w. A window with a gap in
    it is left out.
    """
    half = test.size // 2
    written = 0
    size = theta_rows.shape[1]
    for c in centres:
        good = True
        for k in range(test.size):
            good = good and usable[c - half + k] > 0
        if not good:
            continue
        for p in range(size + 1):
            out[written, p] = 0.0
        for k in range(test.size):
            t = c - half + k
            for p in range(size):
                out[written, p] += test[k] * theta_rows[t, p]
            out[written, size] -= slope[k] * y[t]
        written += 1
    return written
