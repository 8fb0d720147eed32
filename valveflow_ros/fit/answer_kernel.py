"""Residuals of curve and regional dynamics over all rows, a block at a time.

Within a block all that does not wait for the row before (curve, regions, delayed flows) is done
first, for the processor to do side by side; what is left row after row is one product and one sum.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.curve.regional_kernel import TAP_0, TAP_1, TAP_2, TAP_A, TAP_WHOLE
from valveflow_ros.jit import inlined, kernel
from valveflow_ros.records import ByteArray, FloatArray

_BLOCK = 256
# The region of a row without data.
NONE = np.uint8(255)


@inlined
def flow_of(u: FloatArray, knots: FloatArray, left: FloatArray, right: FloatArray,
            flow: FloatArray) -> None:  # fmt: skip
    """Write F(u) to ``flow``, both (n,); the outer pieces go on for ever."""
    slope = (right[0] - left[0]) / (knots[1] - knots[0])
    for i in range(u.size):
        flow[i] = left[0] + slope * (u[i] - knots[0])
    for k in range(1, left.size):
        begin, low = knots[k], left[k]
        slope = (right[k] - low) / (knots[k + 1] - begin)
        for i in range(u.size):
            # A choice between two values, unlike one between two ways, is made for many at once.
            flow[i] = low + slope * (u[i] - begin) if u[i] >= begin else flow[i]


@inlined
def region_of_each(
    flow: FloatArray, usable: ByteArray, levels: FloatArray, region: ByteArray
) -> None:
    """Write the region of each flow, or `NONE` where there is no data; all (n,)."""
    region[:] = 0
    for r in range(levels.size):
        for i in range(flow.size):
            region[i] += np.uint8(1) if flow[i] >= levels[r] else np.uint8(0)
    for i in range(flow.size):
        region[i] = region[i] if usable[i] else NONE


@inlined
def _delayed(flow: FloatArray, first: int, count: int, tap: FloatArray, fed: FloatArray) -> None:
    """Write what ``count`` rows from ``first`` on take from flows before them."""
    at = first - int(tap[TAP_WHOLE])
    a, b, c = tap[TAP_0], tap[TAP_1], tap[TAP_2]
    x, y, z = flow[at : at + count], flow[at - 1 : at - 1 + count], flow[at - 2 : at - 2 + count]
    for i in range(count):
        fed[i] = a * x[i] + b * y[i] + c * z[i]


@inlined
def _feed(
    flow: FloatArray, t: int, region: ByteArray, taps: FloatArray, settle: int, age: int,
    fed: FloatArray, decay: FloatArray, settled: ByteArray,
) -> int:  # fmt: skip
    """Write what each row from ``t`` on takes from the flows and keeps of the state, all (n,).

    ``age`` is the number of rows since the last gap; returned is that of the next block.
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
                # In equilibrium, as if the row before had answered with this flow.
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
    """Run the model; write what it leaves of the means ``first`` to ``end`` of the power.

    Parameters
    ----------
    u, usable : (n,)
    power, residual, weight : (m,)
        Means over ``group`` rows. The latter two are written: ``weight`` is 1 where all rows of
        the mean are usable and settled; elsewhere the residual is 0.
    knots : (J + 1,); left, right : (J,)
    levels : (I - 1,); taps : (I, 7)
    settle : int
        Rows after a gap that do not count.
    begin : int
        The mean at which the filters begin, in equilibrium, so far before ``first`` that this is
        forgotten; 0 at the head of the data.
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
