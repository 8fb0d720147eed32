"""Run curve and regional dynamics over measured inputs, with derivatives, in one pass.

The model is eqs. (2)-(5) of the paper with K_g = 1: x = F(u), and
``y[t] = a_i y[t-1] + (1 - a_i) x(t - tau_i)`` with ``a_i = exp(-h / T_i)``,
the exact discretisation of eq. (3); region i is the one x(t) lies in. Delays
need not be whole steps. While the derivatives are formed the sequence of
regions is taken as it is: letting it flip would turn tangents into spikes.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.core.jit import jit
from valveflow_ros.records import ByteArray, FloatArray, IntArray


@jit
def piece_of(u: float, knots: FloatArray) -> int:
    """Return the piece ``u`` lies in; the outer pieces go on for ever."""
    k = 0
    while k < knots.size - 2 and u >= knots[k + 1]:
        k += 1
    return k


@jit
def curve(u: float, knots: FloatArray, left: FloatArray, right: FloatArray) -> float:
    """Evaluate F: piece k runs from ``left[k]`` to ``right[k]`` in MW."""
    k = piece_of(u, knots)
    w = (u - knots[k]) / (knots[k + 1] - knots[k])
    return float(left[k] + (right[k] - left[k]) * w)


@jit
def region_of(x: float, levels: FloatArray) -> int:
    """Return the region of flow x; ``levels`` are the inner boundaries in MW."""
    r = 0
    while r < levels.size and x >= levels[r]:
        r += 1
    return r


@jit
def respond(
    x: FloatArray,
    usable: ByteArray,
    levels: FloatArray,
    decay: FloatArray,
    delay: FloatArray,
    settle: int,
    answer: FloatArray,
    settled: ByteArray,
) -> None:
    """Filter the flow ``x`` (n,) into the power ``answer`` (n,).

    ``delay`` is in steps. After a gap the filter starts in equilibrium, and
    ``settled`` is 0 for ``settle`` rows.
    """
    state = 0.0
    age = 0
    for t in range(x.size):
        if not usable[t]:
            age = 0
            answer[t] = np.nan
            settled[t] = 0
            continue
        if age == 0:
            state = x[t]
        r = region_of(x[t], levels)
        whole = int(delay[r])
        part = delay[r] - whole
        back = min(whole, age)
        further = min(whole + 1, age)
        late = x[t - back] * (1.0 - part) + x[t - further] * part
        state = decay[r] * state + (1.0 - decay[r]) * late
        answer[t] = state
        age += 1
        settled[t] = 1 if age > settle else 0


@jit
def answer_means(
    u: FloatArray,
    usable: ByteArray,
    knots: FloatArray,
    left: FloatArray,
    right: FloatArray,
    levels: FloatArray,
    decay: FloatArray,
    delay: FloatArray,
    settle: int,
    group: int,
    flow: FloatArray,
    answer: FloatArray,
    weight: ByteArray,
) -> None:
    """Run the model; write means over ``group`` rows as `tangents` does, without derivatives.

    ``flow`` (n,) is scratch.
    """
    state = 0.0
    age = 0
    for b in range(answer.size):
        total = 0.0
        good = True
        for t in range(b * group, (b + 1) * group):
            if not usable[t]:
                age = 0
                good = False
                continue
            x = curve(u[t], knots, left, right)
            flow[t] = x
            r = region_of(x, levels)
            whole = int(delay[r])
            part = delay[r] - whole
            late = flow[t - min(whole, age)] * (1.0 - part) + flow[t - min(whole + 1, age)] * part
            if age == 0:
                state = x
            state = decay[r] * state + (1.0 - decay[r]) * late
            age += 1
            good = good and age > settle
            total += state
        answer[b] = total / group
        weight[b] = 1 if good else 0


@jit
def _slopes_of_curve(
    u: float, knots: FloatArray, left: FloatArray, right: FloatArray, share: float,
    gains: FloatArray,
) -> None:  # fmt: skip
    """Add ``share`` times the derivatives of F(u) to ``gains``.

    Columns: the J + 1 values at the knots, the J - 1 inner knots, the J - 1 jumps.
    A jump at inner knot k lifts the left end of piece k + 1.
    """
    pieces = knots.size - 1
    k = piece_of(u, knots)
    width = knots[k + 1] - knots[k]
    w = (u - knots[k]) / width
    slope = (right[k] - left[k]) / width
    gains[k] += share * (1.0 - w)
    gains[k + 1] += share * w
    if k > 0:
        gains[pieces + k] -= share * slope * (1.0 - w)
        gains[2 * pieces - 1 + k] += share * (1.0 - w)
    if k < pieces - 1:
        gains[pieces + k + 1] -= share * slope * w


@jit
def tangents(
    u: FloatArray,
    usable: ByteArray,
    knots: FloatArray,
    left: FloatArray,
    right: FloatArray,
    levels: FloatArray,
    time_constants: FloatArray,
    delays: FloatArray,
    step_s: float,
    settle: int,
    group: int,
    answer: FloatArray,
    jacobian: FloatArray,
    weight: ByteArray,
) -> None:
    """Run the model and its derivatives; write means over ``group`` rows.

    Parameters
    ----------
    u, usable : (n,)
    knots : (J + 1,); left, right : (J,)
    levels : (I - 1,); time_constants, delays : (I,) seconds
    answer : (m,), jacobian : (m, P), weight : (m,)
        Written. P = (J + 1) + (J - 1) + (J - 1) + 2 I: values, knots, jumps, then ln T and
        tau of each region. ``weight`` is 1 where all rows of the mean are usable and settled.
    """
    n_curve = 3 * knots.size - 4
    regions = time_constants.size
    columns = n_curve + 2 * regions
    state = 0.0
    gains = np.zeros(n_curve)
    tangent = np.zeros(columns)
    sums = np.zeros(columns)
    decay = np.exp(-step_s / time_constants)
    age = 0
    for b in range(answer.size):
        total = 0.0
        sums[:] = 0.0
        good = True
        for t in range(b * group, (b + 1) * group):
            if not usable[t]:
                age = 0
                good = False
                continue
            x = curve(u[t], knots, left, right)
            r = region_of(x, levels)
            a = decay[r]
            whole = int(delays[r] / step_s)
            part = delays[r] / step_s - whole
            back, further = min(whole, age), min(whole + 1, age)
            near = curve(u[t - back], knots, left, right)
            far = curve(u[t - further], knots, left, right)
            late = near * (1.0 - part) + far * part
            for p in range(n_curve):
                gains[p] = 0.0
            _slopes_of_curve(u[t - back], knots, left, right, 1.0 - part, gains)
            _slopes_of_curve(u[t - further], knots, left, right, part, gains)
            if age == 0:
                state = late
                tangent[:] = 0.0
                tangent[:n_curve] = gains
            for p in range(n_curve):
                tangent[p] = a * tangent[p] + (1.0 - a) * gains[p]
            for p in range(n_curve, columns):
                tangent[p] *= a
            tangent[n_curve + r] += a * step_s / time_constants[r] * (state - late)
            tangent[n_curve + regions + r] += (1.0 - a) * (far - near) / step_s
            state = a * state + (1.0 - a) * late
            age += 1
            good = good and age > settle
            total += state
            for p in range(columns):
                sums[p] += tangent[p]
        answer[b] = total / group
        for p in range(columns):
            jacobian[b, p] = sums[p] / group
        weight[b] = 1 if good else 0


@jit
def whiten(series: FloatArray, weight: ByteArray, ar: FloatArray, out: FloatArray) -> int:
    """Write the innovations of ``series`` (m,) under AR coefficients ``ar``.

    Rows whose history is not complete are left out; returns the rows written.
    """
    order = ar.size
    written = 0
    run = 0
    for t in range(series.size):
        run = run + 1 if weight[t] else 0
        if run > order:
            value = series[t]
            for k in range(order):
                value -= ar[k] * series[t - 1 - k]
            out[written] = value
            written += 1
    return written


@jit
def lagged_products(series: FloatArray, weight: ByteArray, order: int) -> FloatArray:
    """Return mean products at lags 0..order over pairs of weighted rows."""
    out = np.zeros(order + 1)
    count: IntArray = np.zeros(order + 1, dtype=np.int64)
    for t in range(series.size):
        if not weight[t]:
            continue
        for k in range(min(order, t) + 1):
            if weight[t - k]:
                out[k] += series[t] * series[t - k]
                count[k] += 1
    for k in range(order + 1):
        out[k] /= max(count[k], 1)
    return out
