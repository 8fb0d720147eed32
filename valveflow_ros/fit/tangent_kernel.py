"""Derivatives of curve and regional dynamics, a block of rows at a time.

As in `answer_kernel`; what a row adds to each derivative is written down first, and then every row
takes up what is left of the row before. While derivatives are formed the sequence of regions is
taken as it is: letting it flip would turn tangents into spikes.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.curve.regional_kernel import (
    TAP_0,
    TAP_1,
    TAP_2,
    TAP_A,
    TAP_B,
    TAP_C,
    TAP_WHOLE,
    make_taps,
)
from valveflow_ros.fit.answer_kernel import NONE, region_of_each
from valveflow_ros.jit import inlined, kernel
from valveflow_ros.records import ByteArray, FloatArray

_BLOCK = 128


@inlined
def _place_of_each(
    u: FloatArray, knots: FloatArray, left: FloatArray, right: FloatArray,
    flow: FloatArray, share: FloatArray, piece: ByteArray,
) -> None:  # fmt: skip
    """Write F(u), how far u is through its piece (0 to 1), and the piece; all (n,)."""
    piece[:] = 0
    width = knots[1] - knots[0]
    for i in range(u.size):
        share[i] = (u[i] - knots[0]) / width
        flow[i] = left[0] + (right[0] - left[0]) * share[i]
    for k in range(1, left.size):
        begin, low = knots[k], left[k]
        rise, width = right[k] - low, knots[k + 1] - begin
        for i in range(u.size):
            beyond = u[i] >= begin
            through = (u[i] - begin) / width
            share[i] = through if beyond else share[i]
            flow[i] = low + rise * through if beyond else flow[i]
            piece[i] += np.uint8(1) if beyond else np.uint8(0)


@inlined
def _bend(row: FloatArray, k: int, slope: FloatArray, down: float, up: float) -> None:
    """Add the derivatives of F in piece ``k``, weighed by its two ends.

    Columns: the J + 1 values at the knots, the J - 1 inner knots, the J - 1 jumps.
    A jump at inner knot k lifts the left end of piece k + 1.
    """
    pieces = slope.size
    row[k] += down
    row[k + 1] += up
    if k > 0:
        row[pieces + k] -= slope[k] * down
        row[2 * pieces - 1 + k] += down
    if k < pieces - 1:
        row[pieces + k + 1] -= slope[k] * up


@inlined
def _fill(
    flow: FloatArray, share: FloatArray, piece: ByteArray, t: int, region: ByteArray,
    slope: FloatArray, taps: FloatArray, part: FloatArray, slowing: FloatArray, step_s: float,
    settle: int, group: int, state: float, age: int,
    answer: FloatArray, settled: ByteArray, decay: FloatArray, table: FloatArray,
) -> tuple[float, int]:  # fmt: skip
    """Run rows from ``t`` on; write what each adds to the derivatives, and keeps of them.

    ``table[i + 1]`` belongs to row i; ``answer`` gets the sums over groups, ``settled`` 0 where a
    row of the group is not. Returned are the state and the rows since the last gap.
    """
    regions = taps.shape[0]
    n_curve = table.shape[1] - 2 * regions
    answer[:] = 0.0
    settled[:] = 1
    table[1:] = 0.0
    for i in range(region.size):
        r, adds = region[i], table[i + 1]
        if r == NONE:
            age = 0
            decay[i] = 0.0
            settled[i // group] = 0
            continue
        tap = taps[r]
        a, b, c, whole = tap[TAP_A], tap[TAP_B], tap[TAP_C], int(tap[TAP_WHOLE])
        t0 = t + i - min(whole, age)
        t1 = t + i - min(whole + 1, age)
        t2 = t + i - min(whole + 2, age)
        x0, x1, x2 = flow[t0], flow[t1], flow[t2]
        w0, w1, w2 = tap[TAP_0], tap[TAP_1], tap[TAP_2]
        decay[i] = a
        if age == 0:
            # In equilibrium the curve's derivatives have been what they are for ever.
            state, decay[i] = x0, 0.0
            w0, w1, w2 = w0 / (1.0 - a), w1 / (1.0 - a), w2 / (1.0 - a)
        up, down = w0 * share[t0], w0 * (1.0 - share[t0])
        if piece[t0] == piece[t1] == piece[t2]:
            up += w1 * share[t1] + w2 * share[t2]
            down += w1 * (1.0 - share[t1]) + w2 * (1.0 - share[t2])
            _bend(adds, piece[t0], slope, down, up)
        else:
            _bend(adds, piece[t0], slope, down, up)
            _bend(adds, piece[t1], slope, w1 * (1.0 - share[t1]), w1 * share[t1])
            _bend(adds, piece[t2], slope, w2 * (1.0 - share[t2]), w2 * share[t2])
        late = x0 * (1.0 - part[r]) + x1 * part[r]
        before = x1 * (1.0 - part[r]) + x2 * part[r]
        adds[n_curve + r] = slowing[r] * state + (b - slowing[r]) * before - b * late
        adds[n_curve + regions + r] = (c * (x1 - x0) + b * (x2 - x1)) / step_s
        state = a * state + tap[TAP_0] * x0 + tap[TAP_1] * x1 + tap[TAP_2] * x2
        age += 1
        answer[i // group] += state
        if age <= settle:
            settled[i // group] = 0
    return state, age


@kernel
def tangents(
    u: FloatArray,
    usable: ByteArray,
    power: FloatArray,
    knots: FloatArray,
    left: FloatArray,
    right: FloatArray,
    levels: FloatArray,
    time_constants: FloatArray,
    delays: FloatArray,
    step_s: float,
    settle: int,
    group: int,
    begin: int,
    first: int,
    end: int,
    residual: FloatArray,
    jacobian: FloatArray,
    weight: ByteArray,
) -> None:
    """Run the model and its derivatives; write the means ``first`` to ``end``.

    Parameters
    ----------
    u, usable, power, settle, group, begin
        As for `answer_kernel.answer_residual`.
    knots : (J + 1,); left, right : (J,)
    levels : (I - 1,); time_constants, delays : (I,) seconds
    residual, weight : (end - first,)
        Written, as there.
    jacobian : (end - first, P)
        Written, of the answer. P = (J + 1) + (J - 1) + (J - 1) + 2 I: values, knots, jumps, then
        ln T and tau of each region.
    """
    slope = (right - left) / (knots[1:] - knots[:-1])
    regions = time_constants.size
    n_curve = 3 * left.size - 1
    columns = n_curve + 2 * regions
    taps = make_taps(time_constants, delays, step_s)
    part = delays / step_s - taps[:, TAP_WHOLE]
    slowing = taps[:, TAP_A] * step_s / time_constants  # da / d ln T
    row, rows = begin * group, (end - begin) * group
    flow, share = np.empty(rows), np.empty(rows)
    piece = np.empty(rows, dtype=np.uint8)
    means = max(1, _BLOCK // group)
    region = np.empty(means * group, dtype=np.uint8)
    decay = np.empty(means * group)
    table = np.zeros((means * group + 1, columns))
    answer, settled = np.empty(means), np.empty(means, dtype=np.uint8)
    state, age, each = 0.0, 0, 1.0 / group
    for mean in range(begin, end, means):
        n = min(means, end - mean) * group
        t = (mean - begin) * group
        _place_of_each(
            u[row + t : row + t + n], knots, left, right,
            flow[t : t + n], share[t : t + n], piece[t : t + n],
        )  # fmt: skip
        region_of_each(flow[t : t + n], usable[row + t : row + t + n], levels, region[:n])
        state, age = _fill(
            flow, share, piece, t, region[:n], slope, taps, part, slowing, step_s, settle, group,
            state, age, answer, settled, decay, table,
        )  # fmt: skip
        for i in range(n):
            kept, last, now = decay[i], table[i], table[i + 1]
            for p in range(columns):
                now[p] += kept * last[p]
        table[0] = table[n]
        for k in range(max(0, first - mean), n // group):
            good, place = settled[k] == 1, mean + k - first
            weight[place] = 1 if good else 0
            residual[place] = power[mean + k] - answer[k] * each if good else 0.0
            out, now = jacobian[place], table[k * group + 1]
            for p in range(columns):
                out[p] = each * now[p]
            for i in range(k * group + 2, (k + 1) * group + 1):
                now = table[i]
                for p in range(columns):
                    out[p] += each * now[p]
