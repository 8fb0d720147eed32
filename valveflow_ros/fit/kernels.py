# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Residuals of curve and regional dynamics, and their derivatives, in blocks of rows.

`tangents` works like `answer_residual`: first the input of each row to each derivative is
written, then the recursion over the rows is applied. The sequence of regions is kept fixed in
the derivatives: a change of region would give spikes in them.
"""

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
    make_taps,
)
from valveflow_ros.numerics import copied, helper, inlined, kernel
from valveflow_ros.records import ByteArray, FloatArray

# Residuals of curve and regional dynamics over all rows, a block at a time.
#
# Within a block, everything that does not depend on the previous row (curve, regions, delayed
# flows) is computed first, so that the compiler can vectorise it. The recursion that remains is
# one product and one sum per row.

_BLOCK = 256
# The region of a row without data.
NONE = np.uint8(255)


@copied
def flow_of(u: FloatArray, knots: FloatArray, left: FloatArray, right: FloatArray,
            flow: FloatArray) -> None:  # fmt: skip
    """Write F(u) to ``flow``, both (n,); the outer pieces extend to infinity."""
    slope = (right[0] - left[0]) / (knots[1] - knots[0])
    for i in range(u.size):
        flow[i] = left[0] + slope * (u[i] - knots[0])
    for k in range(1, left.size):
        begin, low = knots[k], left[k]
        slope = (right[k] - low) / (knots[k + 1] - begin)
        for i in range(u.size):
            # A choice between two values, in contrast to a branch, can be vectorised.
            flow[i] = low + slope * (u[i] - begin) if u[i] >= begin else flow[i]


@inlined
def scale_flow(flow: FloatArray, scale: FloatArray, offset: float) -> None:
    """Convert F(u) in place into the flow in MW, shape (n,)."""
    for i in range(flow.size):
        flow[i] = scale[i] * flow[i] + offset


@inlined
def region_of_each(
    flow: FloatArray, usable: ByteArray, levels: FloatArray, region: ByteArray
) -> None:
    """Write the region of each flow, or `NONE` without data; all (n,)."""
    region[:] = 0
    for r in range(levels.size):
        for i in range(flow.size):
            region[i] += np.uint8(1) if flow[i] >= levels[r] else np.uint8(0)
    for i in range(flow.size):
        region[i] = region[i] if usable[i] else NONE


@copied
def _delayed(flow: FloatArray, first: int, count: int, tap: FloatArray, fed: FloatArray) -> None:
    """Write the input to ``count`` rows from ``first`` on from the delayed flows."""
    at = first - int(tap[TAP_WHOLE])
    a, b, c = tap[TAP_0], tap[TAP_1], tap[TAP_2]
    x, y, z = flow[at : at + count], flow[at - 1 : at - 1 + count], flow[at - 2 : at - 2 + count]
    for i in range(count):
        fed[i] = a * x[i] + b * y[i] + c * z[i]


@copied
def _feed(
    flow: FloatArray, t: int, region: ByteArray, taps: FloatArray, settle: int, age: int,
    fed: FloatArray, decay: FloatArray, settled: ByteArray,
) -> int:  # fmt: skip
    """Write each row's input from the flows and its decay factor, from row ``t`` on; all (n,).

    ``age`` is the number of rows since the last gap; the value for the next block is returned.
    """
    i, n = 0, region.size
    while i < n:
        r, end = region[i], i + 1
        while end < n and region[end] == r:
            end += 1
        if r == NONE:
            age = 0
            fed[i:end], decay[i:end], settled[i:end] = 0.0, 0.0, 0
            i = end
            continue
        tap = taps[r]
        whole = int(tap[TAP_WHOLE])
        decay[i:end] = tap[TAP_A]
        for k in range(i, end):
            settled[k] = 1 if age + 1 + k - i > settle else 0
        while i < end and age < whole + 2:
            now = t + i
            fed[i] = (
                tap[TAP_0] * flow[now - min(whole, age)]
                + tap[TAP_1] * flow[now - min(whole + 1, age)]
                + tap[TAP_2] * flow[now - age]
            )
            if age == 0:
                # Start in steady state, as if the previous answer had been equal to this flow.
                fed[i] += decay[i] * flow[now]
                decay[i] = 0.0
            age += 1
            i += 1
        _delayed(flow, t + i, end - i, tap, fed[i:end])
        age += end - i
        i = end
    return age


@kernel
def answer_residual(
    u: FloatArray,
    scale: FloatArray,
    offset: float,
    usable: ByteArray,
    power: FloatArray,
    knots: FloatArray,
    left: FloatArray,
    right: FloatArray,
    levels: FloatArray,
    taps: FloatArray,
    settle: int,
    group: int,
    begin: int,
    first: int,
    end: int,
    residual: FloatArray,
    weight: ByteArray,
) -> None:
    """Run the model; write the residuals of the means ``first`` to ``end`` of the power.

    Parameters
    ----------
    u, scale, usable : (n,)
        The flow is ``scale`` F(u) + ``offset``.
    power, residual, weight : (m,)
        Means over ``group`` rows. ``residual`` and ``weight`` are outputs: ``weight`` is 1 if all
        rows of the mean are usable and settled; otherwise weight and residual are 0.
    knots : (J + 1,); left, right : (J,)
    levels : (I - 1,); taps : (I, 7)
    settle : int
        Number of rows after a gap that are ignored.
    begin : int
        The mean at which the filters start in steady state, so far before ``first`` that the
        start has no effect; 0 at the beginning of the data.
    """
    row = begin * group
    flow = np.empty((end - begin) * group)
    means = max(1, _BLOCK // group)
    fed, decay = np.empty(means * group), np.empty(means * group)
    settled = np.empty(means * group, dtype=np.uint8)
    region = np.empty(means * group, dtype=np.uint8)
    state, age = 0.0, 0
    for mean in range(begin, end, means):
        n = min(means, end - mean) * group
        t = (mean - begin) * group
        now = flow[t : t + n]
        flow_of(u[row + t : row + t + n], knots, left, right, now)
        scale_flow(now, scale[row + t : row + t + n], offset)
        region_of_each(now, usable[row + t : row + t + n], levels, region[:n])
        age = _feed(flow, t, region[:n], taps, settle, age, fed, decay, settled)
        for i in range(n):
            state = decay[i] * state + fed[i]
            fed[i] = state
        for k in range(max(0, first - mean), n // group):
            total, good = 0.0, 0
            for i in range(k * group, (k + 1) * group):
                total += fed[i]
                good += settled[i]
            weight[mean + k] = 1 if good == group else 0
            residual[mean + k] = power[mean + k] - total / group if good == group else 0.0


_TANGENT_BLOCK = 128


@inlined
def _place_of_each(
    u: FloatArray, knots: FloatArray, left: FloatArray, right: FloatArray,
    flow: FloatArray, share: FloatArray, piece: ByteArray,
) -> None:  # fmt: skip
    """Write F(u), the relative position of u in its piece (0 to 1), and the piece; all (n,)."""
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
    """Add the derivatives of F in piece ``k``, weighted by the parts of its two ends.

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
    flow: FloatArray, scale: FloatArray, share: FloatArray, piece: ByteArray, t: int,
    region: ByteArray,
    slope: FloatArray, taps: FloatArray, part: FloatArray, slowing: FloatArray, step_s: float,
    settle: int, group: int, state: float, age: int,
    answer: FloatArray, settled: ByteArray, decay: FloatArray, table: FloatArray,
) -> tuple[float, int]:  # fmt: skip
    """Run the rows from ``t`` on; write each row's input to the derivatives and their decay.

    ``table[i + 1]`` belongs to row i. ``answer`` receives the sums over groups; ``settled`` is 0
    if a row of the group is not settled. Return the state and the rows since the last gap.
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
            # In steady state the derivatives of the curve have always been constant.
            state, decay[i] = x0, 0.0
            w0, w1, w2 = w0 / (1.0 - a), w1 / (1.0 - a), w2 / (1.0 - a)
        w0, w1, w2 = w0 * scale[t0], w1 * scale[t1], w2 * scale[t2]
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
    scale: FloatArray,
    added: FloatArray,
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
    u, scale, usable, power, settle, group, begin
        As for `answer_residual`.
    added : (n,)
        The flow is ``scale`` F(u) + ``added``.
    knots : (J + 1,); left, right : (J,)
    levels : (I - 1,); time_constants, delays : (I,) seconds
    residual, weight : (end - first,)
        Outputs, as in `answer_residual`.
    jacobian : (end - first, P)
        Output, derivatives of the answer. P = (J + 1) + (J - 1) + (J - 1) + 2 I: values, knots,
        jumps, then ln T and tau of each region; an additional column is that of the offset.
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
    means = max(1, _TANGENT_BLOCK // group)
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
        for i in range(t, t + n):
            flow[i] = scale[row + i] * flow[i] + added[row + i]
        region_of_each(flow[t : t + n], usable[row + t : row + t + n], levels, region[:n])
        state, age = _fill(
            flow, scale[row : row + rows], share, piece, t, region[:n],
            slope, taps, part, slowing, step_s, settle, group,
            state, age, answer, settled, decay, table,
        )  # fmt: skip
        for i in range(n):
            kept, last, now = decay[i], table[i], table[i + 1]
            for p in range(columns):
                now[p] += kept * last[p]
        for p in range(columns):  # a whole row at once takes numba seconds more to compile
            table[0, p] = table[n, p]
        for k in range(max(0, first - mean), n // group):
            good, place = settled[k] == 1, mean + k - first
            weight[place] = 1 if good else 0
            residual[place] = power[mean + k] - answer[k] * each if good else 0.0
            out, now = jacobian[place], table[k * group + 1]
            if out.size > columns:
                out[columns] = 1.0
            for p in range(columns):
                out[p] = each * now[p]
            for i in range(k * group + 2, (k + 1) * group + 1):
                now = table[i]
                for p in range(columns):
                    out[p] += each * now[p]


# Normal equations of whitened residuals and tangents, a block of rows at a time.
#
# Rows are contiguous in memory, so whitening a block is, for each coefficient, one long
# multiply-add of two slices that are a whole number of rows apart.

_NORMAL_BLOCK = 128


@helper
def _innovations(
    rows: FloatArray, first: int, count: int, width: int, ar: FloatArray, out: FloatArray
) -> None:
    """Write ``count`` rows from ``first`` on, minus their prediction by ``ar``, to ``out``.

    ``rows`` and ``out`` contain rows of ``width`` numbers in sequence.
    """
    size, at = count * width, first * width
    now, new = rows[at : at + size], out[:size]
    for i in range(size):
        new[i] = now[i]
    k = 0
    while k + 4 <= ar.size:
        # Four coefficients at once need a quarter of the loads and stores of the sum.
        a, b, c, d = ar[k], ar[k + 1], ar[k + 2], ar[k + 3]
        at -= 4 * width
        w = rows[at + 3 * width : at + 3 * width + size]
        x = rows[at + 2 * width : at + 2 * width + size]
        y = rows[at + width : at + width + size]
        z = rows[at : at + size]
        for i in range(size):
            new[i] = (((new[i] - a * w[i]) - b * x[i]) - c * y[i]) - d * z[i]
        k += 4
    while k < ar.size:
        at -= width
        a, w = ar[k], rows[at : at + size]
        for i in range(size):
            new[i] -= a * w[i]
        k += 1


@inlined
def _whole_before(weight: ByteArray, first: int, order: int) -> int:
    """Return the number of usable rows directly before ``first``, at most ``order``."""
    run = 0
    while run < order and run < first and weight[first - 1 - run]:
        run += 1
    return run


@kernel
def square_sum(residual: FloatArray, weight: ByteArray, ar: FloatArray) -> tuple[float, int]:
    """Return the sum of squared innovations of ``residual`` (m,), and their number; ar is (k,)."""
    order, end = ar.size, residual.size
    run = _whole_before(weight, min(order, end), order)
    out = np.empty(_NORMAL_BLOCK)
    # Four independent sums, so that no addition waits for the previous one.
    sums, rows = np.zeros(4), 0
    for t in range(order, end, _NORMAL_BLOCK):
        n = min(_NORMAL_BLOCK, end - t)
        _innovations(residual, t, n, 1, ar, out)
        for i in range(n):
            run = run + 1 if weight[t + i] else 0
            if run > order:
                sums[i % 4] += out[i] * out[i]
                rows += 1
    return (sums[0] + sums[1]) + (sums[2] + sums[3]), rows


@copied
def _add_products(table: FloatArray, rows: int, sums: FloatArray) -> None:
    """Add the products of all columns of ``table``; ``rows`` must be a multiple of four."""
    columns = table.shape[1]
    for i in range(0, rows, 4):
        a, b, c, d = table[i], table[i + 1], table[i + 2], table[i + 3]
        for p in range(columns):
            w, x, y, z = a[p], b[p], c[p], d[p]
            out = sums[p]
            for q in range(columns):
                out[q] = (((out[q] + w * a[q]) + x * b[q]) + y * c[q]) + z * d[q]


@kernel
def normal_sums(
    jacobian: FloatArray,
    residual: FloatArray,
    weight: ByteArray,
    ar: FloatArray,
    first: int,
    end: int,
    sums: FloatArray,
    scores: FloatArray,
) -> int:
    """Add up the products of whitened tangents and residual; return the number of rows used.

    Parameters
    ----------
    jacobian : (m, P), rows in sequence; residual, weight : (m,)
    ar : (k,)
    first, end : int
        The rows whose products are added; the rows before them are read as history.
    sums : (P + 1, P + 1)
        Output: products of all columns; the residual is the last one.
    scores : (blocks, P)
        Increased by whitened tangents times innovation in each of equal blocks of the m rows;
        may be empty.

    Notes
    -----
    Rows without a complete history of k rows are left out, as in `whiten`.
    """
    m, columns = jacobian.shape
    order, blocks = ar.size, scores.shape[0]
    first = max(first, order)
    run = _whole_before(weight, min(first, m), order)
    rows = 0
    flat = jacobian.reshape(m * columns)
    white, innovation = np.empty(_NORMAL_BLOCK * columns), np.empty(_NORMAL_BLOCK)
    table = np.empty((_NORMAL_BLOCK, columns + 1))
    sums[:] = 0.0
    for t in range(first, end, _NORMAL_BLOCK):
        n = min(_NORMAL_BLOCK, end - t)
        _innovations(flat, t, n, columns, ar, white)
        _innovations(residual, t, n, 1, ar, innovation)
        used = 0
        for i in range(n):
            run = run + 1 if weight[t + i] else 0
            if run <= order:
                continue
            row, now = table[used], white[i * columns : (i + 1) * columns]
            e = innovation[i]
            row[:columns] = now
            row[columns] = e
            used += 1
            if blocks:
                score = scores[(t + i) * blocks // m]
                for p in range(columns):
                    score[p] += now[p] * e
        rows += used
        while used % 4:
            table[used] = 0.0
            used += 1
        _add_products(table, used, sums)
    return rows
