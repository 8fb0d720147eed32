"""One layer of the exact search: the best last break for every end.

Ends are taken `LEAF` at a time (a group), from left to right within a run of
groups. A group first tries the breaks that were best for the group before it,
which nearly always are best again, and then goes through all candidate breaks
from right to left, a node of the tree at a time. A node whose lower bound
(`partition_bounds`) is no better than what is known for any end of the group
is passed over; otherwise its children are looked at, and of a leaf every
single candidate first by the same kind of bound and only then end by end.

The moments of the core, from the end of the current node to the beginning of
the group, are carried along and only ever added to.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.core.jit import inlined, kernel
from valveflow_ros.core.partition_bounds import SHARE, SLOTS, least_and_most
from valveflow_ros.core.partition_moments import (
    BRANCH,
    LEAF,
    Moments,
    Tree,
    fit,
    joined,
    leaf_moments,
    node_moments,
    stretch_moments,
)
from valveflow_ros.core.partition_near import Near, search_near
from valveflow_ros.records import FloatArray, IntArray

_FIRST_SEEDS = 48
# How many times longer the core must be before the tail's reference line is renewed.
_RENEW = 4.0


class Layer(NamedTuple):
    """What the search of one layer reads, besides the tree.

    Attributes
    ----------
    pieces : int
        Number of pieces of this layer.
    shortest : int
        Smallest number of samples in a piece.
    slack : float
        A bound counts as reached when it comes within ``slack`` (>= 0).
    limit : float
        Reference lines do not leave ``[-limit, limit]``.
    near : Near
    prior : float64 (nodes, SLOTS, 5)
    before : float64 (ends,)
        Costs of the layer before, indexed by end.
    bound : float64 (nodes, SLOTS, 5)
    """

    pieces: int
    shortest: int
    slack: float
    limit: float
    near: Near
    prior: FloatArray
    before: FloatArray
    bound: FloatArray


class _Group(NamedTuple):
    """Scratch of one group of ends.

    tail (6, LEAF): moments of the group's samples up to each end, origin just left of the group;
    best, break_: the best cost and break known for each end;
    excess: lower bound of the tail's cost about the reference line, for each end;
    line: reference line (value, slope), box of slopes (4), smallest excess - best, width;
    slopes (2, LEAF), cost: buffers; keep: flags of a leaf's candidates.
    """

    tail: FloatArray
    best: FloatArray
    break_: IntArray
    excess: FloatArray
    line: FloatArray
    slopes: FloatArray
    cost: FloatArray
    keep: IntArray


def _new_group() -> _Group:
    return _Group(
        np.empty((6, LEAF)),
        np.empty(LEAF),
        np.empty(LEAF, np.int64),
        np.empty(LEAF),
        np.empty(8),
        np.empty((2, LEAF)),
        np.empty(LEAF),
        np.empty(LEAF, np.int64),
    )


_group = inlined(_new_group)


@inlined
def _adopt(group: _Group, break_: int, first: int) -> bool:
    """Note a break for the ends ``first..`` where its cost is less than the best known."""
    cost = group.cost
    best = group.best
    better = 0
    # Counting first keeps the usual case, nothing to note, free of branches and stores.
    for k in range(cost.shape[0]):
        better += cost[k] < best[k]
    if better == 0:
        return False
    better = 0
    for k in range(max(first, 0), LEAF):
        if cost[k] < best[k]:
            best[k] = cost[k]
            group.break_[k] = break_
            better += 1
    return better > 0


@kernel
def _open_group(tree: Tree, layer: Layer, block: int, group: _Group) -> None:
    """Set up the tail's moments and the breaks inside the group's own block."""
    first = LEAF * block
    for k in range(LEAF):
        end = first + 1 + k
        useful = end >= layer.pieces * layer.shortest and end <= tree.n
        # An end that nothing can reach must not keep anything alive.
        group.best[k] = np.inf if useful else -np.inf
        group.break_[k] = -1
    if block == 0:
        return
    origin = tree.x[first - 1]
    m = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(LEAF):
        d = origin - tree.x[first + k]
        w = tree.w[first + k]
        y = tree.y[first + k]
        m = (m[0] + w, m[1] + w * d, m[2] + w * d * d, m[3] + w * y, m[4] + w * d * y,
             m[5] + w * y * y)  # fmt: skip
        for f in range(6):
            group.tail[f, k] = m[f]
    group.line[7] = origin - tree.x[first + LEAF - 1]


@inlined
def _try_break(group: _Group, m: Moments, cost: float, break_: int, first: int) -> bool:
    """Try one break for the ends ``first..`` of the group; ``m`` reaches to the group."""
    t = group.tail
    for k in range(t.shape[1]):
        n = m[0] + t[0, k]
        x1 = m[1] + t[1, k]
        y = m[3] + t[3, k]
        each = 1.0 / n
        sxx = (m[2] + t[2, k]) - x1 * x1 * each
        sxy = (m[4] + t[4, k]) - x1 * y * each
        c = ((m[5] + t[5, k]) - y * y * each) - (sxy * sxy / sxx if sxx > 0.0 else 0.0)
        group.cost[k] = cost + (c if c > 0.0 else 0.0)
    return _adopt(group, break_, first)


@inlined
def _refresh(group: _Group) -> None:
    """Renew the smallest distance between the tail's bound and the best known cost."""
    e = group.excess
    b = group.best
    low0 = low1 = low2 = low3 = np.inf
    for k in range(0, LEAF, 4):
        low0 = min(low0, e[k] - b[k])
        low1 = min(low1, e[k + 1] - b[k + 1])
        low2 = min(low2, e[k + 2] - b[k + 2])
        low3 = min(low3, e[k + 3] - b[k + 3])
    group.line[6] = min(min(low0, low1), min(low2, low3))


@inlined
def _refer(group: _Group, gram: Moments, value: float, slope: float, limit: float) -> None:
    """Bound the tail's cost about a line, with a share of the core's Gram matrix as prior."""
    t = group.tail
    line = group.line
    if not max(abs(value), abs(value + slope * line[7])) <= limit:
        value = gram[3] / gram[0]
        slope = 0.0
    hn = SHARE * gram[0]
    h1 = SHARE * gram[1]
    h2 = SHARE * gram[2]
    per_width = 1.0 / line[7]
    line[0] = value
    line[1] = slope
    excess = group.excess
    begin = group.slopes[0]
    end = group.slopes[1]
    for k in range(t.shape[1]):
        r0 = t[3, k] - value * t[0, k] - slope * t[1, k]
        r1 = t[4, k] - value * t[1, k] - slope * t[2, k]
        r2 = (t[5, k] - value * t[3, k] - slope * t[4, k]) - value * r0 - slope * r1
        p = hn + t[0, k]
        q = h1 + t[1, k]
        s = h2 + t[2, k]
        det = p * s - q * q
        inverse = 1.0 / det if det > 1e-12 * p * s else 0.0
        za = (s * r0 - q * r1) * inverse
        zb = (p * r1 - q * r0) * inverse
        least = r2 - r0 * za - r1 * zb
        excess[k] = least if least > 0.0 and inverse > 0.0 else 0.0
        along = -2.0 * (h1 * za + h2 * zb) * per_width
        begin[k] = -2.0 * (hn * za + h1 * zb) - along
        end[k] = along
    line[2], line[3] = least_and_most(begin)
    line[4], line[5] = least_and_most(end)
    _refresh(group)


@inlined
def _refer_nowhere(group: _Group) -> None:
    """Bound the tail's cost by its own best line, while there is no core yet."""
    t = group.tail
    excess = group.excess
    for k in range(t.shape[1]):
        each = 1.0 / t[0, k]
        sxx = t[2, k] - t[1, k] * t[1, k] * each
        sxy = t[4, k] - t[1, k] * t[3, k] * each
        c = (t[5, k] - t[3, k] * t[3, k] * each) - sxy * sxy / sxx
        excess[k] = c if sxx > 1e-10 * t[2, k] and c > 0.0 else 0.0
    group.line[:6] = 0.0
    _refresh(group)


@inlined
def _mark_candidates(
    tree: Tree, layer: Layer, block: int, core: Moments, shift: float, group: _Group
) -> int:
    """Flag a leaf's candidates whose bound leaves room for improvement; return how many."""
    t = tree.leaf[block]
    a, b, lo1, hi1, lo2, hi2, least, width = (
        group.line[0], group.line[1], group.line[2], group.line[3],
        group.line[4], group.line[5], group.line[6], group.line[7],
    )  # fmt: skip
    room = -layer.slack - least
    before = layer.before[LEAF * block : LEAF * block + LEAF]
    keep = group.keep
    kept = 0
    for i in range(t.shape[1]):
        n = core[0] + t[0, i]
        x1 = core[1] + (t[1, i] + shift * t[0, i])
        x2 = core[2] + (t[2, i] + shift * (2.0 * t[1, i] + shift * t[0, i]))
        y = core[3] + t[3, i]
        xy = core[4] + (t[4, i] + shift * t[3, i])
        yy = core[5] + t[5, i]
        each = 1.0 / n
        sxx = x2 - x1 * x1 * each
        sxy = xy - x1 * y * each
        firm = sxx > 1e-10 * x2
        slope = sxy / sxx if firm else 0.0
        cost = (yy - y * y * each) - slope * sxy
        cost = cost if firm and cost > 0.0 else 0.0
        da = (y - slope * x1) * each - a
        db = da + width * (slope - b)
        box = min(lo1 * da, hi1 * da) + min(lo2 * db, hi2 * db)
        possible = (before[i] + cost + box < room) | (not firm)
        keep[i] = possible
        kept += possible
    return kept


@inlined
def _search_leaf(
    tree: Tree, layer: Layer, block: int, leaf: int, core: Moments, group: _Group
) -> None:
    """Try the breaks of one leaf on the ends of the group that begins at ``block``."""
    shift = tree.x[LEAF * block - 1] - tree.x[LEAF * leaf + LEAF - 1]
    kept = _mark_candidates(tree, layer, leaf, core, shift, group)
    if kept > 2 and leaf < block - 1:
        middle = joined(leaf_moments(tree, leaf, LEAF // 2), shift, core)
        _, value, slope, firm = fit(middle)
        if firm:
            _refer(group, core, value, slope, layer.limit)
            kept = _mark_candidates(tree, layer, leaf, core, shift, group)
    if kept == 0:
        return
    better = False
    for i in range(LEAF):
        break_ = LEAF * leaf + i
        first = break_ + layer.shortest - 1 - LEAF * block
        if group.keep[i] and first < LEAF:
            m = joined(leaf_moments(tree, leaf, i), shift, core)
            better |= _try_break(group, m, layer.before[break_], break_, first)
    if better:
        _refresh(group)


@inlined
def _tail_part(group: _Group, value: float, slope: float) -> float:
    """Lower bound of tail cost minus best known cost, about the line of the core."""
    line = group.line
    begin = value - line[0]
    end = begin + line[7] * (slope - line[1])
    box = min(line[2] * begin, line[3] * begin) + min(line[4] * end, line[5] * end)
    return line[6] + box


@inlined
def _node_part(
    tree: Tree, layer: Layer, level: int, size: int, end: int, wide: int, right: float,
    slope: float,
) -> float:  # fmt: skip
    """Lower bound of a node's part about the core's line, whose value at its end is ``right``."""
    number = tree.start[level] + end // size - 1
    slot = min(wide - level, SLOTS - 1) if wide > level else 0
    b = layer.bound[number, slot]
    if slot == 0 or b[0] == np.inf:
        return b[0]
    width = tree.x[LEAF * end - 1] - tree.x[LEAF * (end - size)]
    dr = right - layer.prior[number, slot, 3]
    dl = dr + width * (slope - layer.prior[number, slot, 4])
    return b[0] + (min(b[1] * dr, b[2] * dr) + min(b[3] * dl, b[4] * dl))


@kernel
def _descend(tree: Tree, layer: Layer, block: int, group: _Group) -> int:
    """Go through all breaks left of a group, near ones first; return the leaves opened."""
    origin = tree.x[LEAF * block - 1]
    core = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    end = block
    wide = 0
    next_wide = 1
    renewed = 0.0
    leaves = 0
    _refer_nowhere(group)
    while end > 0:
        distance = block - end
        cost = 0.0
        value = 0.0
        slope = 0.0
        firm = False
        if distance > 0:
            cost, value, slope, firm = fit(core)
            if distance >= _RENEW * renewed and firm:
                _refer(group, core, value, slope, layer.limit)
                renewed = distance
            while distance >= next_wide:
                wide += 1
                next_wide *= BRANCH
        level = 0
        size = 1
        while level < tree.levels - 1 and end % (BRANCH * size) == 0:
            level += 1
            size *= BRANCH
        shift = origin - tree.x[LEAF * end - 1]
        rest = cost + layer.slack + _tail_part(group, value, slope)
        usable = wide if firm else 0
        while True:
            part = _node_part(
                tree, layer, level, size, end, usable, value + slope * shift, slope
            )
            drop = part + rest >= 0.0
            if drop or level == 0:
                break
            level -= 1
            size //= BRANCH
        if not drop:
            leaves += 1
            _search_leaf(tree, layer, block, end - 1, core, group)
        number = tree.start[level] + end // size - 1
        core = joined(node_moments(tree, number), origin - tree.node[number, 6], core)
        end -= size
    return leaves


@kernel
def _sow(tree: Tree, layer: Layer, block: int, seeds: IntArray, count: int, group: _Group) -> None:
    """Try the breaks that were best for the group before this one."""
    for q in range(count):
        break_ = seeds[q]
        m = stretch_moments(tree, break_, block)
        first = break_ + layer.shortest - 1 - LEAF * block
        _try_break(group, m, layer.before[break_], break_, first)


@inlined
def _harvest(group: _Group, seeds: IntArray) -> int:
    """Collect the different breaks of a group; return how many."""
    count = 0
    last = -1
    for k in range(LEAF):
        if group.break_[k] != last and group.break_[k] >= 0:
            last = group.break_[k]
            seeds[count] = last
            count += 1
    return count


@kernel
def search_groups(
    tree: Tree,
    layer: Layer,
    first: int,
    last: int,
    after: FloatArray,
    breaks: NDArray[np.int32],
) -> int:
    """Fill ``after`` and ``breaks`` for the ends of the groups ``[first, last)``.

    Parameters
    ----------
    after : float64 (ends,)
        Cost of the best ``layer.pieces`` pieces up to each end; inf where impossible.
    breaks : int32 (ends,)
        Where the last of them begins; -1 where impossible.

    Returns
    -------
    int
        How many leaves were opened.
    """
    group = _group()
    seeds = np.empty(_FIRST_SEEDS + LEAF, np.int64)
    count = 0
    step = max(LEAF * first // _FIRST_SEEDS, 1)
    for break_ in range(step // 2, LEAF * first, step):
        if layer.before[break_] < np.inf and count < len(seeds):
            seeds[count] = break_
            count += 1
    leaves = 0
    for block in range(first, last):
        _open_group(tree, layer, block, group)
        if block > 0:
            _sow(tree, layer, block, seeds, count, group)
        search_near(
            tree, layer.near, layer.before, block, layer.shortest, layer.slack,
            group.best, group.break_,
        )  # fmt: skip
        if block > 0:
            leaves += _descend(tree, layer, block, group)
        count = _harvest(group, seeds)
        for k in range(LEAF):
            end = LEAF * block + 1 + k
            reached = group.break_[k] >= 0
            after[end] = group.best[k] if reached else np.inf
            breaks[end] = group.break_[k]
    return leaves
