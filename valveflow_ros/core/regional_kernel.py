"""Run curve and regional dynamics over measured inputs, with derivatives, in one pass.

The model is eqs. (2)-(5) of the paper with K_g = 1: x = F(u), and G_i of eq. (3)
in the region i that x(t) lies in, discretised exactly for a flow that is
straight between two rows: ``y[t] = a y[t-1] + b x(t-h-tau) + c x(t-tau)`` with
``a = exp(-h/T)``, ``b = (1-a) T/h - a`` and ``c = 1 - (1-a) T/h``. Delays need not be
whole steps; with the two rows around each delayed instant that makes three
taps. While the derivatives are formed the sequence of regions is taken as it
is: letting it flip would turn tangents into spikes.
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


# Columns of a table of taps, one row a region: decay, weights of the flows at `TAP_WHOLE`
# steps back and one and two before, b and c as above.
TAP_A, TAP_0, TAP_1, TAP_2, TAP_WHOLE, TAP_B, TAP_C = range(7)
TAPS = 7


@jit
def make_taps(time_constants: FloatArray, delays: FloatArray, step_s: float) -> FloatArray:
    """Return the taps of each region, shape (I, 7)."""
    taps = np.empty((time_constants.size, TAPS))
    for r in range(time_constants.size):
        a = np.exp(-step_s / time_constants[r])
        mean = (1.0 - a) * time_constants[r] / step_s
        b, c = mean - a, 1.0 - mean
        whole = np.floor(delays[r] / step_s)
        part = delays[r] / step_s - whole
        taps[r, TAP_A] = a
        taps[r, TAP_0] = c * (1.0 - part)
        taps[r, TAP_1] = c * part + b * (1.0 - part)
        taps[r, TAP_2] = b * part
        taps[r, TAP_WHOLE] = whole
        taps[r, TAP_B], taps[r, TAP_C] = b, c
    return taps


@jit
def respond(
    x: FloatArray,
    usable: ByteArray,
    levels: FloatArray,
    taps: FloatArray,
    settle: int,
    answer: FloatArray,
    settled: ByteArray,
) -> None:
    """Filter the flow ``x`` (n,) into the power ``answer`` (n,).

    After a gap the filter starts in equilibrium, and
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
        tap = taps[region_of(x[t], levels)]
        whole = int(tap[TAP_WHOLE])
        state = (
            tap[TAP_A] * state
            + tap[TAP_0] * x[t - min(whole, age)]
            + tap[TAP_1] * x[t - min(whole + 1, age)]
            + tap[TAP_2] * x[t - min(whole + 2, age)]
        )
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
    taps: FloatArray,
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
            if age == 0:
                state = x
            tap = taps[region_of(x, levels)]
            whole = int(tap[TAP_WHOLE])
            state = (
                tap[TAP_A] * state
                + tap[TAP_0] * flow[t - min(whole, age)]
                + tap[TAP_1] * flow[t - min(whole + 1, age)]
                + tap[TAP_2] * flow[t - min(whole + 2, age)]
            )
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
def _turn(
    tangent: FloatArray,
    gains: FloatArray,
    past: FloatArray,
    tap: FloatArray,
    state: float,
    region: int,
    part: float,
    slowing: float,
    step_s: float,
) -> None:
    """Advance the derivatives by one row; ``slowing`` is da / d ln T, ``state`` the answer before.

    After the curve's columns come ln T of each region, then tau of each region.
    """
    n_curve = gains.size
    regions = (tangent.size - n_curve) // 2
    a, b, c = tap[TAP_A], tap[TAP_B], tap[TAP_C]
    for p in range(n_curve):
        tangent[p] = a * tangent[p] + gains[p]
    for p in range(n_curve, tangent.size):
        tangent[p] *= a
    late = past[0] * (1.0 - part) + past[1] * part
    before = past[1] * (1.0 - part) + past[2] * part
    tangent[n_curve + region] += slowing * state + (b - slowing) * before - b * late
    later = (c * (past[1] - past[0]) + b * (past[2] - past[1])) / step_s
    tangent[n_curve + regions + region] += later


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
    past = np.empty(3)
    taps = make_taps(time_constants, delays, step_s)
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
            r = region_of(curve(u[t], knots, left, right), levels)
            tap = taps[r]
            a, whole = tap[TAP_A], int(tap[TAP_WHOLE])
            past[0] = curve(u[t - min(whole, age)], knots, left, right)
            past[1] = curve(u[t - min(whole + 1, age)], knots, left, right)
            past[2] = curve(u[t - min(whole + 2, age)], knots, left, right)
            gains[:] = 0.0
            for k in range(3):
                share = tap[TAP_0 + k]
                _slopes_of_curve(u[t - min(whole + k, age)], knots, left, right, share, gains)
            if age == 0:
                state = past[0]
                tangent[:] = 0.0
                tangent[:n_curve] = gains / (1.0 - a)
            part = delays[r] / step_s - whole
            slowing = a * step_s / time_constants[r]
            _turn(tangent, gains, past, tap, state, r, part, slowing, step_s)
            state = a * state
            for k in range(3):
                state += tap[TAP_0 + k] * past[k]
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
