"""Normal equations of whitened residuals and tangents, a block of rows at a time.

Rows lie one behind the other in memory, so whitening a block of them is, for each coefficient,
one long product and sum of two stretches that lie whole rows apart.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.jit import inlined, kernel
from valveflow_ros.records import ByteArray, FloatArray

_BLOCK = 128


@inlined
def _innovations(
    rows: FloatArray, first: int, count: int, width: int, ar: FloatArray, out: FloatArray
) -> None:
    """Write ``count`` rows from ``first`` on, each less what ``ar`` foretells, to ``out``.

    ``rows`` and ``out`` hold rows of ``width`` numbers one behind the other.
    """
    size, at = count * width, first * width
    now, new = rows[at : at + size], out[:size]
    for i in range(size):
        new[i] = now[i]
    k = 0
    while k + 4 <= ar.size:
        # Four at once: the sum is fetched and put back a quarter as often.
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
    """Return how many rows before ``first`` follow each other, ``order`` at most."""
    run = 0
    while run < order and run < first and weight[first - 1 - run]:
        run += 1
    return run


@kernel
def square_sum(residual: FloatArray, weight: ByteArray, ar: FloatArray) -> float:
    """Return the sum of squared innovations of ``residual`` (m,) under ``ar`` (k,)."""
    order, end = ar.size, residual.size
    run = _whole_before(weight, min(order, end), order)
    out = np.empty(_BLOCK)
    # Four sums, so that none of them waits for the one before.
    sums = np.zeros(4)
    for t in range(order, end, _BLOCK):
        n = min(_BLOCK, end - t)
        _innovations(residual, t, n, 1, ar, out)
        for i in range(n):
            run = run + 1 if weight[t + i] else 0
            if run > order:
                sums[i % 4] += out[i] * out[i]
    return float((sums[0] + sums[1]) + (sums[2] + sums[3]))


@inlined
def _add_products(table: FloatArray, rows: int, sums: FloatArray) -> None:
    """Add the products of all columns of ``table``, ``rows`` being a multiple of four."""
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
    """Add up the products of whitened tangents and residual; return the rows that count.

    Parameters
    ----------
    jacobian : (m, P), rows one behind the other; residual, weight : (m,)
    ar : (k,)
    first, end : int
        The rows whose products are added; what is before them is looked at.
    sums : (P + 1, P + 1)
        Written: products of all columns, the residual being the last.
    scores : (blocks, P)
        Added to: whitened tangents times innovation, over even blocks of time of all m rows;
        there may be none.

    Notes
    -----
    Rows whose history of k rows is not complete are left out, as in `whiten`.
    """
    m, columns = jacobian.shape
    order, blocks = ar.size, scores.shape[0]
    first = max(first, order)
    run = _whole_before(weight, min(first, m), order)
    rows = 0
    flat = jacobian.reshape(m * columns)
    white, innovation = np.empty(_BLOCK * columns), np.empty(_BLOCK)
    table = np.empty((_BLOCK, columns + 1))
    sums[:] = 0.0
    for t in range(first, end, _BLOCK):
        n = min(_BLOCK, end - t)
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
