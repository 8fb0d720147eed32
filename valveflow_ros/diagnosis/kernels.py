# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The inner loops of the extended model: regional dynamics and valve operators."""

from __future__ import annotations

import numpy as np

from valveflow_ros.curve.regional_model import (
    TAP_0,
    TAP_1,
    TAP_2,
    TAP_A,
    TAP_B,
    TAP_C,
    TAP_WHOLE,
    lag_step,
    region_of,
)
from valveflow_ros.numerics import jit
from valveflow_ros.records import NS_PER_S, BoolArray, ByteArray, FloatArray, IntArray


@jit
def flow(
    u: FloatArray, scale: FloatArray, offset: float, knots: FloatArray, left: FloatArray,
    right: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Write x = ``scale`` F(u) + ``offset``, shape (n,)."""
    k, last = 0, left.size - 1
    for t in range(u.size):
        # The piece is mostly that of the row before.
        while k < last and u[t] >= knots[k + 1]:
            k += 1
        while k > 0 and u[t] < knots[k]:
            k -= 1
        w = (u[t] - knots[k]) / (knots[k + 1] - knots[k])
        out[t] = scale[t] * (left[k] + (right[k] - left[k]) * w) + offset


@jit
def regions(x: FloatArray, levels: FloatArray, out: ByteArray) -> None:
    """Write the region of every flow, shape (n,)."""
    for t in range(x.size):
        out[t] = region_of(x[t], levels)


@jit
def respond_means(
    x: FloatArray,
    usable: ByteArray,
    region: ByteArray,
    taps: FloatArray,
    group: int,
    out: FloatArray,
) -> None:
    """Filter the flow with the taps of the region of each row; write means over ``group`` rows.

    A gap starts in equilibrium; its own rows are 0.
    """
    state, a, w0, w1, w2 = 0.0, 0.0, 0.0, 0.0, 0.0
    age, whole, last = 0, 0, -1
    for b in range(out.size):
        total = 0.0
        for t in range(b * group, (b + 1) * group):
            if not usable[t]:
                age = 0
                continue
            r = region[t]
            if r != last:
                last, whole, a = r, int(taps[r, TAP_WHOLE]), taps[r, TAP_A]
                w0, w1, w2 = taps[r, TAP_0], taps[r, TAP_1], taps[r, TAP_2]
            if age >= whole + 2:
                past = t - whole
                # What does not need the row before is summed first: the processor can begin early.
                state = a * state + (w0 * x[past] + w1 * x[past - 1] + w2 * x[past - 2])
            else:
                state = lag_step(x, t, age, taps[r], x[t] if age == 0 else state)
            total += state
            age += 1
        out[b] = total / group


@jit
def reheated(
    y: FloatArray, usable: ByteArray, alpha: float, tap: FloatArray, out: FloatArray
) -> None:
    """Write ``alpha`` y plus the rest of y after a lag, (n,); a gap starts in equilibrium."""
    a, b, c = tap[TAP_A], tap[TAP_B], tap[TAP_C]
    state, begun = 0.0, False
    for t in range(y.size):
        if not usable[t]:
            begun, out[t] = False, 0.0
            continue
        state = a * state + (c * y[t] + b * y[t - 1]) if begun else y[t]
        begun, out[t] = True, alpha * y[t] + (1.0 - alpha) * state


@jit
def reheated_table(
    table: FloatArray, usable: ByteArray, alpha: float, tap: FloatArray, out: FloatArray
) -> None:
    """Do the same with all columns of a table, (n, k)."""
    a, b, c = tap[TAP_A], tap[TAP_B], tap[TAP_C]
    state, begun = np.zeros(table.shape[1]), False
    for t in range(table.shape[0]):
        if not usable[t]:
            begun, out[t] = False, 0.0
            continue
        now, before, new = table[t], table[t - 1], out[t]
        for j in range(now.size):
            state[j] = a * state[j] + (c * now[j] + b * before[j]) if begun else now[j]
            new[j] = alpha * now[j] + (1.0 - alpha) * state[j]
        begun = True


@jit
def innovations(table: FloatArray, ar: FloatArray, rows: BoolArray, out: FloatArray) -> None:
    """Write the rows of ``table``, (m, k), that count, less their prediction by ``ar``."""
    written = 0
    for t in range(table.shape[0]):
        if not rows[t]:
            continue
        now, here = out[written], table[t]
        for j in range(here.size):
            now[j] = here[j]
        for lag in range(min(ar.size, t)):
            a, past = ar[lag], table[t - 1 - lag]
            for j in range(here.size):
                now[j] -= a * past[j]
        written += 1


@jit
def sums_of_knots(
    at: IntArray, weight: FloatArray, band: FloatArray, across: FloatArray, toward: FloatArray,
    normal: FloatArray, sums_across: FloatArray, sums_toward: FloatArray,
) -> None:  # fmt: skip
    """Add up products of the basis functions of a piecewise-linear function.

    Parameters
    ----------
    at, weight : int64 and float64 (m, q)
        The knots around each mean, and their weights.
    band : float64 (m, k)
        Symmetric band matrix: the diagonal and what is above it.
    across, toward : float64 (m, P), (m,)
        Columns.
    normal : float64 (2, K, K)
        The basis times band matrix times basis: the part of the diagonal, that of what is above.
    sums_across, sums_toward : float64 (K, P), (K,)
        The basis times the columns.
    """
    m, q = at.shape
    for t in range(m):
        for i in range(q):
            a, w = at[t, i], weight[t, i]
            if w == 0.0:
                continue
            sums_toward[a] += w * toward[t]
            for p in range(across.shape[1]):
                sums_across[a, p] += w * across[t, p]
            for k in range(min(band.shape[1], m - t)):
                by = w * band[t, k]
                if by == 0.0:
                    continue
                for j in range(q):
                    normal[min(k, 1), a, at[t + k, j]] += by * weight[t + k, j]


@jit
def means(x: FloatArray, group: int, out: FloatArray) -> None:
    """Write means over ``group`` rows."""
    for b in range(out.size):
        total = 0.0
        for t in range(b * group, (b + 1) * group):
            total += x[t]
        out[b] = total / group


@jit
def whiten_wander(
    hours: FloatArray, load: FloatArray, noise: FloatArray, ratio: float, scale_h: float,
    table: FloatArray, out: FloatArray,
) -> float:  # fmt: skip
    """Whiten columns, (k, c), by the process of `slow`; return half the log of its determinant.

    The Kalman filter of a first-order process makes the same numbers as the Cholesky factor of
    its covariance, in k steps instead of k^3.
    """
    state = np.zeros(table.shape[1])
    variance, level = ratio, 0.0
    for i in range(hours.size):
        if i:
            keep = np.exp((hours[i - 1] - hours[i]) / scale_h)
            state *= keep
            variance = ratio + keep * keep * (variance - ratio)
        total = load[i] * load[i] * variance + noise[i]
        gain, root = variance * load[i] / total, np.sqrt(total)
        level += np.log(root)
        variance *= noise[i] / total
        for j in range(state.size):
            new = table[i, j] - load[i] * state[j]
            out[i, j] = new / root
            state[j] += gain * new
    return level


@jit
def bump(u: FloatArray, centre: float, width: float, out: FloatArray) -> None:
    """Write a raised cosine of height 1 that ends ``width`` from its centre."""
    for t in range(u.size):
        place = (u[t] - centre) / width
        out[t] = 0.5 + 0.5 * np.cos(np.pi * place) if -1.0 < place < 1.0 else 0.0


@jit
def settled(usable: ByteArray, rows: int, out: ByteArray) -> None:
    """Write 1 where the last gap is more than ``rows`` rows before."""
    age = 0
    for t in range(usable.size):
        age = age + 1 if usable[t] else 0
        out[t] = 1 if age > rows else 0


@jit
def play_step(state: float, v: float, half: float) -> float:
    """Return the plug position after the measured one became ``v``; NaN before the first row."""
    return v if np.isnan(state) else min(max(state, v - half), v + half)


@jit
def slip_step(state: float, v: float, off: float, near: float) -> float:
    """Return the position of a sticking plug: beyond a distance ``off`` it slips to ``near``."""
    pull = v - state
    if pull > off:
        state = v - near
    elif pull < -off:
        state = v + near
    return state


@jit
def rate_step(state: float, v: float, largest: float) -> float:
    """Return the position of a slow plug that moves by at most ``largest``."""
    return v if np.isnan(state) else state + min(max(v - state, -largest), largest)


@jit
def play(v: FloatArray, half: float, out: FloatArray) -> None:
    """Follow ``v`` through a backlash of width ``2 half``; NaN stays NaN."""
    state = np.nan
    for t in range(v.size):
        if np.isnan(v[t]):
            out[t] = np.nan
            continue
        state = play_step(state, v[t], half)
        out[t] = state


@jit
def stick_slip(v: FloatArray, band: float, jump: float, out: FloatArray) -> None:
    """Stay until the distance exceeds (S + J)/2, then slip to (S - J)/2 from ``v``."""
    state = np.nan
    off, near = 0.5 * (band + jump), 0.5 * (band - jump)
    for t in range(v.size):
        if np.isnan(v[t]):
            out[t] = np.nan
            continue
        if np.isnan(state):
            state = v[t]
        state = slip_step(state, v[t], off, near)
        out[t] = state


@jit
def rate_limit(v: FloatArray, largest: float, out: FloatArray) -> None:
    """Follow ``v`` by at most ``largest`` per row."""
    state = np.nan
    for t in range(v.size):
        if np.isnan(v[t]):
            out[t] = np.nan
            continue
        state = rate_step(state, v[t], largest)
        out[t] = state


@jit
def viterbi(cost_on: FloatArray, penalty: float, out: ByteArray) -> None:
    """Write the two-state path of least cost; ``cost_on`` (n,) is the cost of on minus off."""
    n = cost_on.size
    back = np.empty((n, 2), dtype=np.uint8)
    off, on = 0.0, penalty
    for t in range(n):
        stay_off, leave = off, on + penalty
        stay_on, enter = on, off + penalty
        back[t, 0] = 0 if stay_off <= leave else 1
        back[t, 1] = 1 if stay_on <= enter else 0
        off = min(stay_off, leave)
        on = min(stay_on, enter) + cost_on[t]
    state = 1 if on < off else 0
    for t in range(n - 1, -1, -1):
        out[t] = state
        state = back[t, state]


# The loops of the extended model for streams, with a state between blocks of rows.
#
# States are arrays that the caller owns and the loops update. ``begin`` gives the state of every
# row: `GOES_ON` after the previous one, `ANEW` after a gap, or `NO_DATA`.

GOES_ON, ANEW, NO_DATA = 0, 1, 2
AGE, PLACE = 0, 1


@jit
def beginnings(
    time_ns: IntArray, u: FloatArray, gap_ns: int, state: IntArray, jumps: ByteArray,
    begin: ByteArray,
) -> None:  # fmt: skip
    """Write where the time jumps, and whether each row continues the previous one.

    ``state`` holds the time and the ``begin`` value of the last row.
    """
    for t in range(time_ns.size):
        step = time_ns[t] - state[0]
        state[0] = time_ns[t]
        jumps[t] = 1 if step > gap_ns or step <= 0 else 0
        if np.isnan(u[t]):
            state[1] = NO_DATA
        else:
            state[1] = ANEW if jumps[t] or state[1] == NO_DATA else GOES_ON
        begin[t] = state[1]


@jit
def respond_block(
    x: FloatArray,
    begin: ByteArray,
    levels: FloatArray,
    taps: FloatArray,
    place: IntArray,
    answer: FloatArray,
    past: FloatArray,
    out: FloatArray,
) -> None:
    """Filter the flow with the taps of the region of each row; a gap starts in equilibrium.

    ``past`` is a ring buffer of flows. ``place`` holds the rows since the gap and the index in the
    ring buffer. ``answer`` (1,) is the filter state.
    """
    room = past.size
    for t in range(x.size):
        if begin[t] == NO_DATA:
            out[t] = np.nan
            continue
        if begin[t] == ANEW:
            place[AGE] = 0
            answer[0] = x[t]
        age, at = place[AGE], place[PLACE]
        past[at] = x[t]
        answer[0] = lag_step(past, at, age, taps[region_of(x[t], levels)], answer[0])
        out[t] = answer[0]
        place[AGE] = age + 1
        place[PLACE] = (at + 1) % room


@jit
def delay(
    y: FloatArray, jumps: ByteArray, whole: int, part: float, place: IntArray, past: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Write the value of a series ``whole + part`` rows ago, NaN if unknown."""
    room = past.size
    for t in range(y.size):
        if jumps[t]:
            place[AGE] = 0
        age, at = place[AGE], place[PLACE]
        past[at] = y[t]
        out[t] = np.nan
        if part == 0.0 and age >= whole:
            out[t] = past[(at - whole) % room]
        elif age >= whole + 1:
            late, later = past[(at - whole) % room], past[(at - whole - 1) % room]
            out[t] = late * (1.0 - part) + later * part
        place[AGE] = age + 1
        place[PLACE] = (at + 1) % room


@jit
def play_block(v: FloatArray, half: float, state: FloatArray, out: FloatArray) -> None:
    """Follow ``v`` through a backlash of width ``2 half``; NaN stays NaN."""
    for t in range(v.size):
        out[t] = np.nan
        if not np.isnan(v[t]):
            out[t] = state[0] = play_step(state[0], v[t], half)


@jit
def rate_limit_block(
    v: FloatArray, time_ns: IntArray, rate_per_s: float, state: FloatArray, last_ns: IntArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Follow ``v`` at a limited rate; the plug continues to move during a gap."""
    for t in range(v.size):
        out[t] = np.nan
        if not np.isnan(v[t]):
            largest = rate_per_s * ((time_ns[t] - last_ns[0]) / NS_PER_S)
            out[t] = state[0] = rate_step(state[0], v[t], largest)
            last_ns[0] = time_ns[t]


@jit
def stick_slip_block(
    v: FloatArray, noise: FloatArray, band: float, jump: float, state: FloatArray, out: FloatArray
) -> None:
    """Write the mean position of several plugs, each with its own noise of the position.

    ``noise`` is (n, draws), ``state`` (draws,).
    """
    off, near = 0.5 * (band + jump), 0.5 * (band - jump)
    draws = state.size
    for t in range(v.size):
        out[t] = np.nan
        if np.isnan(v[t]):
            continue
        total = 0.0
        for d in range(draws):
            here = v[t] + noise[t, d]
            state[d] = here if np.isnan(state[d]) else slip_step(state[d], here, off, near)
            total += state[d]
        out[t] = total / draws


@jit
def filled(x: FloatArray, last: FloatArray, out: FloatArray) -> None:
    """Write a series with missing values replaced by the last value; ``last`` is (1,)."""
    for t in range(x.size):
        if not np.isnan(x[t]):
            last[0] = x[t]
        out[t] = last[0]
