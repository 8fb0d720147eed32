# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A group of ends that are searched together, and the best results for them so far.

For a break far to the left, the ends of a group differ only in the tail: the
group's own samples up to each end. The part of the tail in the cost of the last
piece is bounded in the same way as the left part (`partition.bounds`): about a
reference line, with a fraction of the core's Gram matrix as prior, linearly in
the line, for all ends together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from valveflow_ros.numerics import copied, helper, inlined, kernel
from valveflow_ros.partition.bounds import SHARE, about_line, least_and_most
from valveflow_ros.partition.moments import LEAF, Moments, Tree
from valveflow_ros.records import FloatArray, IntArray


class Group(NamedTuple):
    """Working memory of one group of ends."""

    # (6, LEAF) moments of the samples up to each end; the origin is the sample before them.
    tail: FloatArray
    best: FloatArray  # (LEAF,) smallest cost found for each end; -inf for one that is not needed
    breaks: IntArray  # (LEAF,) the break of that cost, or -1
    # (3, LEAF) bound of the tail's cost about the reference line, and its two slopes.
    about: FloatArray
    # (8,) reference line (value at the origin, slope per distance); smallest and largest tangent
    # slope along the value at the origin, and along the value at the last sample; smallest bound
    # minus `best`; width of the tail, < 0.
    line: FloatArray
    cost: FloatArray  # (LEAF,) buffer
    keep: IntArray  # (LEAF,) buffer


@copied
def new_group() -> Group:
    """Return working memory."""
    return Group(
        np.zeros((6, LEAF)), np.empty(LEAF), np.empty(LEAF, np.int64), np.empty((3, LEAF)),
        np.zeros(8), np.empty(LEAF), np.empty(LEAF, np.int64),
    )  # fmt: skip


@copied
def open_group(tree: Tree, block: int, reachable: int, group: Group) -> None:
    """Set up the group that begins at ``block``; ends before ``reachable`` are not needed."""
    first = LEAF * block
    origin = tree.x[max(first - 1, 0)]
    n = x1 = x2 = y1 = xy = yy = 0.0
    tail = group.tail
    for k in range(LEAF):
        d = origin - tree.x[first + k]
        w = tree.w[first + k]
        y = tree.y[first + k]
        n += w
        x1 += w * d
        x2 += w * d * d
        y1 += w * y
        xy += w * d * y
        yy += w * y * y
        tail[0, k] = n
        tail[1, k] = x1
        tail[2, k] = x2
        tail[3, k] = y1
        tail[4, k] = xy
        tail[5, k] = yy
        end = first + 1 + k
        # An end that is not needed must not prevent the exclusion of a candidate.
        group.best[k] = np.inf if reachable <= end <= tree.n else -np.inf
        group.breaks[k] = -1
    group.line[7] = origin - tree.x[first + LEAF - 1]


@inlined
def try_break(group: Group, m: Moments, cost: float, break_: int, first: int) -> bool:
    """Try one break for the ends ``first..`` of the group; ``m`` extends up to the group."""
    t = group.tail
    total = group.cost
    best = group.best
    better = 0
    for k in range(LEAF):
        n = m[0] + t[0, k]
        x1 = m[1] + t[1, k]
        y = m[3] + t[3, k]
        each = 1.0 / n
        sxx = (m[2] + t[2, k]) - x1 * x1 * each
        sxy = (m[4] + t[4, k]) - x1 * y * each
        c = ((m[5] + t[5, k]) - y * y * each) - (sxy * sxy / sxx if sxx > 0.0 else 0.0)
        total[k] = cost + (c if c > 0.0 else 0.0)
    # Counting first avoids branches and stores in the usual case without improvement.
    for k in range(LEAF):
        better += total[k] < best[k]
    if better == 0:
        return False
    better = 0
    for k in range(max(first, 0), LEAF):
        if total[k] < best[k]:
            best[k] = total[k]
            group.breaks[k] = break_
            better += 1
    return better > 0


@inlined
def refresh(group: Group) -> None:
    """Update the smallest difference between the tail's bound and the best known cost."""
    e = group.about[0]
    b = group.best
    low0 = low1 = low2 = low3 = np.inf
    for k in range(0, LEAF, 4):
        low0 = min(low0, e[k] - b[k])
        low1 = min(low1, e[k + 1] - b[k + 1])
        low2 = min(low2, e[k + 2] - b[k + 2])
        low3 = min(low3, e[k + 3] - b[k + 3])
    group.line[6] = min(min(low0, low1), min(low2, low3))


@helper
def bound_about_line(
    group: Group, core: Moments, value: float, slope: float, limit: float
) -> None:
    """Bound the tail's cost about a line, with a fraction of the core's Gram matrix as prior.

    The bound is valid for this core and for every core that begins farther left.
    """
    t = group.tail
    line = group.line
    if not max(abs(value), abs(value + slope * line[7])) <= limit:
        # A steep line through a cluster is no useful reference and loses digits.
        value = core[3] / core[0]
        slope = 0.0
    line[0] = value
    line[1] = slope
    out = group.about
    about_line(
        t, SHARE * core[0], SHARE * core[1], SHARE * core[2], value, slope, 1.0 / line[7], out
    )
    line[2], line[3] = least_and_most(out[1])
    line[4], line[5] = least_and_most(out[2])
    refresh(group)


@inlined
def bound_about_best_line(group: Group) -> None:
    """Bound the tail's cost by its own best line, as long as there is no core."""
    t = group.tail
    excess = group.about[0]
    for k in range(t.shape[1]):
        each = 1.0 / t[0, k]
        sxx = t[2, k] - t[1, k] * t[1, k] * each
        sxy = t[4, k] - t[1, k] * t[3, k] * each
        firm = sxx > 1e-10 * t[2, k]
        c = (t[5, k] - t[3, k] * t[3, k] * each) - (sxy * sxy / sxx if firm else 0.0)
        excess[k] = c if firm and c > 0.0 else 0.0
    group.line[:6] = 0.0
    refresh(group)


@inlined
def tail_part(group: Group, value: float, slope: float) -> float:
    """Return a lower bound of tail cost minus best known cost, about the line of the core."""
    line = group.line
    begin = value - line[0]
    end = begin + line[7] * (slope - line[1])
    box = min(line[2] * begin, line[3] * begin) + min(line[4] * end, line[5] * end)
    return float(line[6] + box)


# Breaks in the same block as the end: short pieces, computed by direct running sums.
#
# A block is divided into cells of `CELL` samples. The costs of pieces inside one
# cell are in a small table. For a break in an earlier cell of the block the cost
# up to the cell of the end is in a table, and
#
#     D(w) + cost([w, r)) >= D(w) + cost([w, c)) + cost([c, r)) ,  c the cell's begin,
#
# leaves few candidates, which are then computed sample by sample.


# Samples in a cell: a larger cell excludes more breaks but needs a larger table.
CELL = 8
CELLS = LEAF // CELL


class Near(NamedTuple):
    """Costs of short pieces."""

    # (blocks * CELLS, CELL, CELL): [c, i, k] is the cost of the samples i..k of cell c; inf for
    # k < i.
    square: FloatArray
    # (blocks, CELL * CELLS * (CELLS - 1) / 2), for the cells 1, 2, ... of a block in turn: the
    # cost from each earlier sample of the block up to the cell's begin.
    edge: FloatArray


@helper
def running_costs(tree: Tree, sample: int, last: int, out: FloatArray) -> None:
    """Fill ``out[k]`` with the cost of the samples ``sample..sample + k`` up to ``last``.

    The origin is the first of these samples, in position and value; two samples cost 0.
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


@copied
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
        np.empty((blocks * CELLS, CELL, CELL)), np.empty((blocks, CELL * CELLS * (CELLS - 1) // 2))
    )


@inlined
def _adopt_row(
    cost: FloatArray, offset: float, from_: int, break_: int, best: FloatArray, breaks: IntArray
) -> None:
    """Store a break for the ends at which ``cost + offset`` is less than the best known cost."""
    better = 0
    # Counting first avoids branches and stores in the usual case without improvement.
    for k in range(cost.shape[0]):
        better += cost[k] + offset < best[k]
    if better > 0:
        for k in range(max(from_, 0), len(cost)):
            if cost[k] + offset < best[k]:
                best[k] = cost[k] + offset
                breaks[k] = break_


@copied
def _search_edge(
    tree: Tree, edge: FloatArray, before: FloatArray, first: int, at: int, shortest: int,
    room: float, best: FloatArray, breaks: IntArray,
) -> None:  # fmt: skip
    """Try the breaks ``[first, at)`` for the ends of the cell that begins at ``at``."""
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


@copied
def search_near(
    tree: Tree, near: Near, before: FloatArray, block: int, shortest: int, slack: float,
    best: FloatArray, breaks: IntArray,
) -> None:  # fmt: skip
    """Try all breaks inside a block for all ends inside it.

    ``before`` (ends,) is the cost of the best pieces up to each end, one piece fewer. ``best`` and
    ``breaks`` (LEAF,) of the ends ``LEAF * block + 1 ...`` are improved in place.
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
