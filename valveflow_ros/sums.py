"""Long sums that come out alike whatever the number of threads.

The linear algebra library splits long dot products over threads, so its last
bits depend on how many there are. A fit must give the same bits in the
worker of a live run and in a replay, so what runs over samples runs here.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.jit import jit
from valveflow_ros.records import FloatArray


@jit
def gram(table: FloatArray) -> FloatArray:
    """Return ``table.T @ table``; table (m, P), result (P, P)."""
    columns = table.shape[1]
    out = np.zeros((columns, columns))
    for t in range(table.shape[0]):
        for p in range(columns):
            value = table[t, p]
            for q in range(p + 1):
                out[p, q] += value * table[t, q]
    for p in range(columns):
        for q in range(p):
            out[q, p] = out[p, q]
    return out


@jit
def product(table: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return ``table @ matrix``; table (m, P), matrix (P, Q), result (m, Q)."""
    out = np.zeros((table.shape[0], matrix.shape[1]))
    for t in range(table.shape[0]):
        for p in range(table.shape[1]):
            value = table[t, p]
            for q in range(matrix.shape[1]):
                out[t, q] += value * matrix[p, q]
    return out


@jit
def running_average(values: FloatArray, forget: float) -> FloatArray:
    """Return the exponential average of ``values`` (n,) after each, begun at zero, shape (n,).

    Each step keeps ``forget`` (0 to 1) of the average before.
    """
    out = np.empty(values.size)
    average = 0.0
    for t in range(values.size):
        average = forget * average + (1.0 - forget) * values[t]
        out[t] = average
    return out
