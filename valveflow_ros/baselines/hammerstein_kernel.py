"""Run a Hammerstein model over measured inputs, with derivatives, in one pass.

The model is ``x = F(u)`` with F continuous and piecewise linear, followed by one
linear block ``y[t] = -f_1 y[t-1] - ... + b_0 x[t-d] + b_1 x[t-d-1] + ...``. Its static
gain is 1, as eq. (5) of the paper sets K_g = 1: ``b_0`` follows from the others.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.curve.regional_kernel import piece_of
from valveflow_ros.jit import jit
from valveflow_ros.records import ByteArray, FloatArray


@jit
def value_at(u: float, knots: FloatArray, values: FloatArray) -> float:
    """Evaluate F; the outer pieces go on for ever."""
    k = piece_of(u, knots)
    w = (u - knots[k]) / (knots[k + 1] - knots[k])
    return float(values[k] + (values[k + 1] - values[k]) * w)


@jit
def _slopes_of_curve(
    u: float, knots: FloatArray, values: FloatArray, share: float, gains: FloatArray
) -> None:
    """Add ``share`` times the derivatives of F(u): J + 1 values, then J - 1 inner knots."""
    pieces = knots.size - 1
    k = piece_of(u, knots)
    width = knots[k + 1] - knots[k]
    w = (u - knots[k]) / width
    slope = (values[k + 1] - values[k]) / width
    gains[k] += share * (1.0 - w)
    gains[k + 1] += share * w
    if k > 0:
        gains[pieces + k] -= share * slope * (1.0 - w)
    if k < pieces - 1:
        gains[pieces + k + 1] -= share * slope * w


@jit
def run(
    u: FloatArray,
    usable: ByteArray,
    knots: FloatArray,
    values: FloatArray,
    b: FloatArray,
    f: FloatArray,
    delay: int,
    settle: int,
    answer: FloatArray,
    settled: ByteArray,
) -> None:
    """Write the simulated power (n,), NaN in gaps; ``settled`` is 0 for ``settle`` rows after one.

    After a gap the block starts in equilibrium.
    """
    past = np.zeros(f.size)
    flow = np.empty(u.size)
    age = 0
    for t in range(u.size):
        if not usable[t]:
            age = 0
            answer[t] = np.nan
            settled[t] = 0
            continue
        flow[t] = value_at(u[t], knots, values)
        if age == 0:
            past[:] = flow[t]
        answer[t] = _next(flow, b, f, past, t, delay, age)
        age += 1
        settled[t] = 1 if age > settle else 0


@jit
def _push(
    u: FloatArray,
    flow: FloatArray,
    knots: FloatArray,
    values: FloatArray,
    b: FloatArray,
    past: FloatArray,
    t: int,
    delay: int,
    age: int,
    gains: FloatArray,
) -> None:
    """Write what flow and past power at row ``t`` add to each derivative, before the poles."""
    n_curve = 2 * (knots.size - 1)
    gains[:] = 0.0
    first = flow[t - min(delay, age)]
    for j in range(b.size):
        back = t - min(delay + j, age)
        _slopes_of_curve(u[back], knots, values, b[j], gains)
        if j > 0:
            gains[n_curve + past.size + j - 1] = flow[back] - first
    for i in range(past.size):
        gains[n_curve + i] = first - past[i]


@jit
def _next(flow: FloatArray, b: FloatArray, f: FloatArray, past: FloatArray, t: int, delay: int,
          age: int) -> float:  # fmt: skip
    """Advance the linear block by one row; ``past`` takes the new power in front."""
    state = 0.0
    for j in range(b.size):
        state += b[j] * flow[t - min(delay + j, age)]
    for i in range(f.size):
        state -= f[i] * past[i]
    for i in range(f.size - 1, 0, -1):
        past[i] = past[i - 1]
    past[0] = state
    return state


@jit
def _turn(gains: FloatArray, lag: FloatArray, f: FloatArray, sums: FloatArray) -> None:
    """Advance the derivatives by one row: what the flow adds, through the poles."""
    for p in range(sums.size):
        value = gains[p]
        for i in range(f.size):
            value -= f[i] * lag[i, p]
        for i in range(f.size - 1, 0, -1):
            lag[i, p] = lag[i - 1, p]
        lag[0, p] = value
        sums[p] += value


@jit
def tangents(
    u: FloatArray,
    usable: ByteArray,
    knots: FloatArray,
    values: FloatArray,
    b: FloatArray,
    f: FloatArray,
    delay: int,
    settle: int,
    group: int,
    answer: FloatArray,
    jacobian: FloatArray,
    weight: ByteArray,
) -> None:
    """Write means over ``group`` rows of the simulated power and of its derivatives.

    Parameters
    ----------
    u, usable : (n,)
    knots, values : (J + 1,)
    b : (n_b,), f : (n_f,)
    answer : (m,), jacobian : (m, P), weight : (m,)
        Written. P = (J + 1) + (J - 1) + n_f + (n_b - 1): values, inner knots, f, b_1 and on
        (or fewer columns: the first so many of these). ``weight`` is 1 where all rows of the
        mean are usable and settled.
    """
    columns = jacobian.shape[1]
    n_curve = 2 * (knots.size - 1)
    n_f = f.size
    past = np.zeros(n_f)
    lag = np.zeros((n_f, columns))
    gains = np.zeros(n_curve + n_f + b.size - 1)
    sums = np.zeros(columns)
    flow = np.empty(u.size)
    age = 0
    for m in range(answer.size):
        total = 0.0
        sums[:] = 0.0
        good = True
        for t in range(m * group, (m + 1) * group):
            if not usable[t]:
                age = 0
                good = False
                continue
            flow[t] = value_at(u[t], knots, values)
            if age == 0:
                past[:] = flow[t]
            if columns > 0:
                if age == 0:
                    gains[:] = 0.0
                    _slopes_of_curve(u[t], knots, values, 1.0, gains)
                    for i in range(n_f):
                        lag[i] = gains[:columns]
                _push(u, flow, knots, values, b, past, t, delay, age, gains)
                _turn(gains, lag, f, sums)
            total += _next(flow, b, f, past, t, delay, age)
            age += 1
            good = good and age > settle
        answer[m] = total / group
        for p in range(columns):
            jacobian[m, p] = sums[p] / group
        weight[m] = 1 if good else 0
