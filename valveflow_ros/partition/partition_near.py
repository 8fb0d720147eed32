"""Breaks that lie in the same block as the end: short pieces, by direct running sums.

A block is cut into cells of `CELL` samples. Pieces inside one cell have their
costs in a small table. For a break in an earlier cell of the block the cost up
to the cell of the end is in a table, and

    D(w) + cost([w, r)) >= D(w) + cost([w, c)) + cost([c, r)) ,  c the cell's begin,

leaves few candidates, which are then worked out sample by sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from valveflow_ros.jit import inlined, kernel
from valveflow_ros.partition.partition_moments import LEAF, Tree
from valveflow_ros.records import FloatArray, IntArray

# Samples in a cell; a smaller table against fewer breaks that need no look.
CELL = 8
CELLS = LEAF // CELL


class Near(NamedTuple):
    """Costs of short pieces.

    Attributes
    ----------
    square : float64 (blocks * CELLS, CELL, CELL)
        ``square[c, i, k]``: cost of the samples ``i..k`` of cell ``c``; inf for ``k < i``.
    edge : float64 (blocks, CELL * CELLS * (CELLS - 1) / 2)
        For the cells 1, 2, ... of a block in turn: the cost from each earlier
        sample of the block up to the cell's begin.
    """

    square: FloatArray
    edge: FloatArray


@kernel
def running_costs(tree: Tree, sample: int, last: int, out: FloatArray) -> None:
    """Fill ``out[k]`` with the cost of the samples ``sample..sample + k`` up to ``last``.

    The origin is the first of them, in position and value; two samples cost 0.
    """
    n = x1 = x2 = y1 = xy = yy = 0.0
    for k in range(last - sample):
        w = tree.w[sample + k]
        x = tree.x[sample + k] - tree.x[sample]
        y = tree.y[sample + k] - tree.y[sample]
        n += w
        x1 += w * x
        x2 += w * x * x
        y1 += w * y
        xy += w * x * y
        yy += w * y * y
        cost = 0.0
        if k >= 2 and w > 0.0:
            sxy = xy - x1 * y1 / n
            cost = max(yy - y1 * y1 / n - sxy * sxy / (x2 - x1 * x1 / n), 0.0)
        out[k] = cost


@inlined
def _backward_costs(tree: Tree, first: int, last: int, out: FloatArray) -> None:
    """Fill ``out[i]`` with the cost of the samples ``[first + i, last)``."""
    n = x1 = x2 = y1 = xy = yy = 0.0
    for p in range(last - 1, first - 1, -1):
        w = tree.w[p]
        x = tree.x[last - 1] - tree.x[p]
        y = tree.y[p] - tree.y[last - 1]
        n += w
        x1 += w * x
        x2 += w * x * x
        y1 += w * y
        xy += w * x * y
        yy += w * y * y
        cost = 0.0
        if p <= last - 3 and n > 0.0:
            sxx = x2 - x1 * x1 / n
            sxy = xy - x1 * y1 / n
            cost = max(yy - y1 * y1 / n - (sxy * sxy / sxx if sxx > 0.0 else 0.0), 0.0)
        out[p - first] = cost


@kernel
def fill_near(tree: Tree, first: int, last: int, near: Near) -> None:
    """Fill the tables of the blocks ``[first, last)``."""
    for block in range(first, last):
        begin = LEAF * block
        filled = 0
        for c in range(CELLS):
            at = begin + CELL * c
            for i in range(CELL):
                near.square[block * CELLS + c, i, :i] = np.inf
                running_costs(tree, at + i, at + CELL, near.square[block * CELLS + c, i, i:])
            if c > 0:
                _backward_costs(tree, begin, at, near.edge[block, filled : filled + CELL * c])
            filled += CELL * c


def make_near(blocks: int) -> Near:
    """Return empty tables; `fill_near` fills them."""
    return Near(
        np.empty((blocks * CELLS, CELL, CELL)),
        np.empty((blocks, CELL * CELLS * (CELLS - 1) // 2)),
    )


@inlined
def _adopt_row(
    cost: FloatArray, offset: float, from_: int, break_: int, best: FloatArray, breaks: IntArray
) -> None:
    """Note a break for the ends where ``cost + offset`` is less than the best known."""
    better = 0
    # Counting first keeps the usual case, nothing to note, free of branches and stores.
    for k in range(cost.shape[0]):
        better += cost[k] + offset < best[k]
    if better > 0:
        for k in range(max(from_, 0), len(cost)):
            if cost[k] + offset < best[k]:
                best[k] = cost[k] + offset
                breaks[k] = break_


@kernel
def _search_edge(
    tree: Tree,
    edge: FloatArray,
    before: FloatArray,
    first: int,
    at: int,
    shortest: int,
    room: float,
    best: FloatArray,
    breaks: IntArray,
) -> None:
    """Try the breaks ``[first, at)`` on the ends of the cell that begins at ``at``."""
    possible = 0
    for i in range(edge.shape[0]):
        possible += before[i] + edge[i] < room
    if possible == 0:
        return
    row = np.empty(LEAF)
    for i in range(len(edge)):
        from_ = first + i + shortest - at - 1
        if before[i] + edge[i] < room and from_ < CELL:
            running_costs(tree, first + i, at + CELL, row)
            cost = row[at - first - i : at - first - i + CELL]
            _adopt_row(cost, before[i], from_, first + i, best, breaks)


@kernel
def search_near(
    tree: Tree,
    near: Near,
    before: FloatArray,
    block: int,
    shortest: int,
    slack: float,
    best: FloatArray,
    breaks: IntArray,
) -> None:
    """Try all breaks inside a block on all ends inside it.

    Parameters
    ----------
    before : float64 (ends,)
        Cost of the best pieces up to each end, one piece fewer.
    best, breaks : (LEAF,)
        Best cost and break known for the ends ``LEAF * block + 1 ...``; improved in place.
    """
    first = LEAF * block
    filled = 0
    for c in range(CELLS):
        at = first + CELL * c
        square = near.square[block * CELLS + c]
        mine = best[CELL * c : CELL * c + CELL]
        mine_breaks = breaks[CELL * c : CELL * c + CELL]
        for i in range(CELL - shortest + 1):
            if before[at + i] < np.inf:
                _adopt_row(square[i], before[at + i], i + shortest - 1, at + i, mine, mine_breaks)
        if c > 0:
            low = np.inf
            for k in range(CELL):
                low = min(low, square[0, k] - mine[k])
            _search_edge(
                tree, near.edge[block, filled : filled + CELL * c], before[first:at], first, at,
                shortest, -slack - low, mine, mine_breaks,
            )  # fmt: skip
        filled += CELL * c
