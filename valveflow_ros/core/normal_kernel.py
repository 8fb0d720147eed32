"""Normal equations of whitened residuals and tangents, in one pass and without copies."""

from __future__ import annotations

import numpy as np

from valveflow_ros.core.jit import jit
from valveflow_ros.records import ByteArray, FloatArray


@jit
def square_sum(residual: FloatArray, weight: ByteArray, ar: FloatArray) -> float:
    """Return the sum of squared innovations of ``residual`` (m,) under ``ar`` (k,)."""
    order = ar.size
    run = 0
    total = 0.0
    for t in range(residual.size):
        run = run + 1 if weight[t] else 0
        if run <= order:
            continue
        value = residual[t]
        for k in range(order):
            value -= ar[k] * residual[t - 1 - k]
        total += value * value
    return total


@jit
def normal_sums(
    jacobian: FloatArray,
    residual: FloatArray,
    weight: ByteArray,
    ar: FloatArray,
    sums: FloatArray,
    scores: FloatArray,
) -> int:
    """Add up the products of whitened tangents and residual; return the rows that count.

    Parameters
    ----------
    jacobian : (m, P); residual, weight : (m,); ar : (k,)
    sums : (P + 1, P + 1)
        Written: products of all columns, the residual being the last.
    scores : (blocks, P)
        Written: whitened tangents times innovation, added up over even blocks of time.

    Notes
    -----
    Rows whose history of k rows is not complete are left out, as in `whiten`.
    """
    m, columns = jacobian.shape
    order = ar.size
    row = np.empty(columns + 1)
    run = 0
    rows = 0
    sums[:] = 0.0
    scores[:] = 0.0
    for t in range(m):
        run = run + 1 if weight[t] else 0
        if run <= order:
            continue
        rows += 1
        row[:columns] = jacobian[t]
        e = residual[t]
        for k in range(order):
            a = ar[k]
            e -= a * residual[t - 1 - k]
            for p in range(columns):
                row[p] -= a * jacobian[t - 1 - k, p]
        row[columns] = e
        block = t * scores.shape[0] // m
        for p in range(columns):
            scores[block, p] += row[p] * e
        for p in range(columns + 1):
            value = row[p]
            for q in range(p + 1):
                sums[p, q] += value * row[q]
    for p in range(columns + 1):
        for q in range(p):
            sums[q, p] = sums[p, q]
    return rows
