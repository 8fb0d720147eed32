# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One layer of the exact search: the best last break for every end.

Ends are processed in groups, from left to right within a run of groups. A group
first tries the breaks that were best for the previous group, which usually are
best again. Then it tests all candidate breaks from right to left, one node of
the tree at a time. A node is skipped if its lower bound (`partition.bounds`) is
not better than the known cost for any end of the group. Otherwise its children
are tested, and in a leaf every single candidate, first by the same kind of bound
and then for each end.

The moments of the core, from the end of the current node to the beginning of the
group, are updated by additions only.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.numerics import copied, helper, inlined, kernel, run_in_threads, runs
from valveflow_ros.partition.bounds import SLOTS, fill_leaf_bounds, fill_node_bounds, fill_priors
from valveflow_ros.partition.group import (
    Group,
    Near,
    bound_about_best_line,
    bound_about_line,
    fill_near,
    make_near,
    new_group,
    open_group,
    refresh,
    search_near,
    tail_part,
    try_break,
)
from valveflow_ros.partition.moments import (
    BRANCH,
    LEAF,
    Moments,
    Tree,
    build_tree,
    fit,
    joined,
    leaf_moments,
    node_moments,
    stretch_moments,
)
from valveflow_ros.records import FloatArray, IntArray

# Initial breaks of the first group of a run, which has no previous group.
_FIRST_SEEDS = 48
# Growth factor of the core after which the tail's reference line is updated.
_RENEW = 4.0


class Layer(NamedTuple):
    """The inputs of the search of one layer, besides the tree.

    A bound is taken as reached within ``slack`` >= 0; reference lines stay within +- ``limit``.
    """

    pieces: int
    shortest: int  # smallest number of samples in a piece
    slack: float
    limit: float
    near: Near
    prior: FloatArray  # (nodes, SLOTS, 5)
    before: FloatArray  # (ends,) costs of the previous layer
    bound: FloatArray  # (nodes, SLOTS, 5)


@helper
def _mark_candidates(
    tree: Tree, layer: Layer, block: int, core: Moments, shift: float, group: Group
) -> int:
    """Mark a leaf's candidates whose bound permits an improvement; return their number."""
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
    tree: Tree, layer: Layer, block: int, leaf: int, core: Moments, group: Group
) -> None:
    """Try the breaks of one leaf for the ends of the group that begins at ``block``."""
    shift = tree.x[LEAF * block - 1] - tree.x[LEAF * leaf + LEAF - 1]
    kept = _mark_candidates(tree, layer, leaf, core, shift, group)
    if kept > 2 and leaf < block - 1:
        # A reference line from these candidates makes the box of slopes smaller.
        _, value, slope, firm = fit(joined(leaf_moments(tree, leaf, LEAF // 2), shift, core))
        if firm:
            bound_about_line(group, core, value, slope, layer.limit)
            kept = _mark_candidates(tree, layer, leaf, core, shift, group)
    if kept == 0:
        return
    better = False
    for i in range(LEAF):
        break_ = LEAF * leaf + i
        first = break_ + layer.shortest - 1 - LEAF * block
        if group.keep[i] and first < LEAF:
            m = joined(leaf_moments(tree, leaf, i), shift, core)
            better |= try_break(group, m, layer.before[break_], break_, first)
    if better:
        refresh(group)


@inlined
def _node_part(
    tree: Tree, layer: Layer, level: int, end: int, size: int, wide: int, right: float,
    slope: float,
) -> float:  # fmt: skip
    """Return a lower bound of a node's part about the core's line, which ends at ``right``."""
    number = tree.start[level] + end // size - 1
    slot = min(wide - level, SLOTS - 1) if wide > level else 0
    b = layer.bound[number, slot]
    if slot == 0 or b[0] == np.inf:
        return float(b[0])
    width = tree.x[LEAF * end - 1] - tree.x[LEAF * (end - size)]
    dr = right - layer.prior[number, slot, 3]
    dl = dr + width * (slope - layer.prior[number, slot, 4])
    return float(b[0] + (min(b[1] * dr, b[2] * dr) + min(b[3] * dl, b[4] * dl)))


@copied
def _descend(tree: Tree, layer: Layer, block: int, group: Group) -> int:
    """Test all breaks left of a group, near ones first; return the number of leaves opened."""
    origin = tree.x[LEAF * block - 1]
    core = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    end = block
    wide = 0  # windows of BRANCH ** (wide - 1) blocks fit between the node and the group
    next_wide = 1
    renewed = 0.0
    leaves = 0
    bound_about_best_line(group)
    while end > 0:
        cost = value = slope = 0.0
        firm = True
        if end < block:
            cost, value, slope, firm = fit(core)
            if block - end >= _RENEW * renewed and firm:
                bound_about_line(group, core, value, slope, layer.limit)
                renewed = float(block - end)
            while block - end >= next_wide:
                wide += 1
                next_wide *= BRANCH
        level = 0
        size = 1
        while level < tree.levels - 1 and end % (BRANCH * size) == 0:
            level += 1
            size *= BRANCH
        right = value + slope * (origin - tree.x[LEAF * end - 1])
        rest = cost + layer.slack + tail_part(group, value, slope)
        while True:
            part = _node_part(tree, layer, level, end, size, wide, right, slope)
            # Without a line of the core there is no bound.
            drop = firm and part + rest >= 0.0
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


@copied
def _try_breaks(
    tree: Tree, layer: Layer, block: int, seeds: IntArray, count: int, group: Group
) -> None:
    """Try the breaks that were best for the previous group."""
    for q in range(count):
        break_ = seeds[q]
        m = stretch_moments(tree, break_, block)
        first = break_ + layer.shortest - 1 - LEAF * block
        try_break(group, m, layer.before[break_], break_, first)


@copied
def _collect_breaks(group: Group, seeds: IntArray) -> int:
    """Collect the different breaks of a group; return their number."""
    count = 0
    last = -1
    for k in range(LEAF):
        if group.breaks[k] != last and group.breaks[k] >= 0:
            last = group.breaks[k]
            seeds[count] = last
            count += 1
    return count


@kernel
def search_groups(
    tree: Tree, layer: Layer, after: FloatArray, breaks: NDArray[np.int32], first: int, last: int
) -> int:
    """Fill ``after`` and ``breaks`` (ends,) for the ends of the groups ``[first, last)``.

    They are the cost of the best ``layer.pieces`` pieces up to each end, inf if impossible, and
    the first sample of the last piece, then -1. Return the number of leaves that the bounds could
    not exclude.
    """
    group = new_group()
    seeds = np.empty(_FIRST_SEEDS + LEAF, np.int64)
    count = 0
    step = max(LEAF * first // _FIRST_SEEDS, 1)
    for break_ in range(step // 2, LEAF * first, step):
        if layer.before[break_] < np.inf and count < len(seeds):
            seeds[count] = break_
            count += 1
    leaves = 0
    for block in range(first, last):
        open_group(tree, block, layer.pieces * layer.shortest, group)
        if block > 0:
            _try_breaks(tree, layer, block, seeds, count, group)
        search_near(
            tree, layer.near, layer.before, block, layer.shortest, layer.slack,
            group.best, group.breaks,
        )  # fmt: skip
        if block > 0:
            leaves += _descend(tree, layer, block, group)
        count = _collect_breaks(group, seeds)
        for k in range(LEAF):
            end = LEAF * block + 1 + k
            after[end] = group.best[k] if group.breaks[k] >= 0 else np.inf
            breaks[end] = group.breaks[k]
    return leaves


def compile_search() -> None:
    """Compile the search of a layer, which takes longest of all, by a search of no group."""
    none = np.empty(0)
    tree = Tree(0, 0, none, none, none, np.empty((0, 6, LEAF)), np.empty(0, np.int64),
                np.empty((0, 7)))  # fmt: skip
    table = np.empty((0, SLOTS, 5))
    layer = Layer(2, 2, 0.0, 0.0, make_near(0), table, none, table)
    search_groups(tree, layer, none, np.empty(0, np.int32), 0, 0)


# Groups in one task of a thread. The number is fixed, so that the result does
# not depend on the number of threads.
_RUN = 64


class Problem(NamedTuple):
    """A prepared search: the tree and all other data that do not depend on the layer."""

    tree: Tree
    near: Near
    prior: FloatArray
    shortest: int
    slack: float
    limit: float
    threads: int


def prepare(
    x: FloatArray, y: FloatArray, w: FloatArray, shortest: int, slack: float, threads: int
) -> Problem:
    """Build the tables for `layers`, of x strictly increasing and w > 0, all (n,).

    A piece has at least ``shortest`` >= 2 samples, each layer's cost may exceed the optimum by
    ``slack`` >= 0, and with ``threads`` of 1 none is started.
    """
    tree = build_tree(x, y, w)
    near = make_near(len(tree.leaf))
    run_in_threads(lambda a, b: fill_near(tree, a, b, near), runs(len(tree.leaf), _RUN), threads)
    limit = 2.0 * float(np.abs(y).max())
    prior = np.zeros((len(tree.node), SLOTS, 5))
    fill_priors(tree, limit, prior)
    return Problem(tree, near, prior, shortest, slack, limit, threads)


@kernel
def _fill_first(tree: Tree, shortest: int, after: FloatArray, first: int, last: int) -> None:
    """Fill the costs of one piece that begins at the first sample, for a run of groups."""
    for block in range(first, last):
        n = x1 = x2 = y1 = xy = yy = 0.0
        origin = tree.x[0]
        if block > 0:
            n, x1, x2, y1, xy, yy = stretch_moments(tree, 0, block)
            origin = tree.x[LEAF * block - 1]
        for k in range(LEAF):
            p = LEAF * block + k
            d = origin - tree.x[p]
            w = tree.w[p]
            y = tree.y[p]
            n += w
            x1 += w * d
            x2 += w * d * d
            y1 += w * y
            xy += w * d * y
            yy += w * y * y
            cost = 0.0
            if p >= 2:
                sxy = xy - x1 * y1 / n
                sxx = x2 - x1 * x1 / n
                cost = max(yy - y1 * y1 / n - sxy * sxy / sxx, 0.0)
            after[p + 1] = cost if shortest <= p + 1 <= tree.n else np.inf


def layers(problem: Problem, pieces: int) -> Iterator[tuple[FloatArray, NDArray[np.int32]]]:
    """Yield for 1, 2, ... ``pieces`` pieces the best cost up to each end, and the last break.

    In the last layer only the end ``n`` is computed. The array of costs is
    reused two layers later. Costs are inf if an end cannot be reached.
    """
    tree, threads = problem.tree, problem.threads
    blocks = len(tree.leaf)
    before = np.full(LEAF * blocks + 1, np.inf)
    after = np.full(LEAF * blocks + 1, np.inf)
    groups = runs(blocks, _RUN)
    run_in_threads(partial(_fill_first, tree, problem.shortest, after), groups, threads)
    yield after, np.zeros(len(after), dtype=np.int32)
    bound = np.empty_like(problem.prior)
    for j in range(2, pieces + 1):
        before, after = after, before
        after[0] = np.inf
        fill = partial(fill_leaf_bounds, tree, problem.prior, before, bound)
        run_in_threads(fill, runs(blocks, _RUN), threads)
        for level in range(1, tree.levels):
            count = int(tree.start[level + 1] - tree.start[level])
            fill_node_bounds(tree, problem.prior, level, 0, count, bound)
        layer = Layer(
            j, problem.shortest, problem.slack, problem.limit, problem.near, problem.prior,
            before, bound,
        )  # fmt: skip
        breaks: NDArray[np.int32] = np.full(len(after), -1, dtype=np.int32)
        if j == pieces:
            groups = [((tree.n - 1) // LEAF, (tree.n - 1) // LEAF + 1)]
        run_in_threads(partial(search_groups, tree, layer, after, breaks), groups, threads)
        yield after, breaks


def best_partitions(problem: Problem, pieces: int) -> tuple[FloatArray, list[IntArray]]:
    """Solve eqs. (21)-(23) of the paper for 1..``pieces`` pieces, ``pieces * shortest <= n``.

    Return the costs (pieces,) and ``starts``: ``starts[j - 1]`` contains 0, the first samples of
    the other pieces, and n.
    """
    n = problem.tree.n
    cost = np.empty(pieces)
    all_breaks: list[NDArray[np.int32]] = []
    starts: list[IntArray] = []
    for j, (after, breaks) in enumerate(layers(problem, pieces), start=1):
        cost[j - 1] = after[n]
        all_breaks.append(breaks)
        starts.append(_way_back(all_breaks, n))
    return cost, starts


def _way_back(breaks: list[NDArray[np.int32]], n: int) -> IntArray:
    """Follow the recorded breaks from the end to the beginning."""
    starts = np.empty(len(breaks) + 1, dtype=np.int64)
    starts[-1] = n
    for j in range(len(breaks) - 1, -1, -1):
        starts[j] = breaks[j][starts[j + 1]]
    return starts
