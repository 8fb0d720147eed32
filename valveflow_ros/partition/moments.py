# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Moments of stretches of samples, without cancellation, and the line through them.

A stretch of weighted samples is described by six sums about an origin ``o``, with
``d = o - x`` the distance to the left of it::

    (n, x1, x2, y, xy, yy) = sum of w * (1, d, d*d, y, d*y, y*y)

The origin is always the last sample of the stretch or a later one, so every
``d`` is >= 0; moving the origin to the right and joining stretches only adds
numbers of one sign. Differences of prefix sums are not used: for a short
stretch such a difference has no correct digit, and a search with it finds
wrong optima.

The stretches are blocks of `LEAF` samples, each suffix of a block, and a tree
of nodes in which each node contains `BRANCH` nodes of the level below.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.numerics import helper, inlined, kernel
from valveflow_ros.records import FloatArray, IntArray

# Samples in a block, which is the smallest node of the tree and one group of ends.
LEAF = 64
# Nodes of one level in a node of the next.
BRANCH = 4
Moments = tuple[float, float, float, float, float, float]


class Tree(NamedTuple):
    """Sorted samples, padded with weight 0 to whole blocks, and their moments."""

    n: int  # samples (distinct openings) before padding
    levels: int  # of nodes; a node of level k contains BRANCH**k full blocks
    x: FloatArray  # (blocks * LEAF,) position, value and weight
    y: FloatArray
    w: FloatArray
    # (blocks, 6, LEAF): [b, :, i] are the moments from sample i of block b to its end, origin at
    # the block's last sample.
    leaf: FloatArray
    start: IntArray  # (levels + 1,) number of the first node of each level, and of all nodes
    node: FloatArray  # (nodes, 7) moments of a whole node, origin at its last sample; that origin


@inlined
def joined(left: Moments, shift: float, right: Moments) -> Moments:
    """Join two stretches; ``shift`` >= 0 is the distance of the left one's origin to the left."""
    n, x1, x2, y, xy, yy = left
    return (
        right[0] + n,
        right[1] + (x1 + shift * n),
        right[2] + (x2 + shift * (2.0 * x1 + shift * n)),
        right[3] + y,
        right[4] + (xy + shift * y),
        right[5] + yy,
    )


@inlined
def leaf_moments(tree: Tree, block: int, i: int) -> Moments:
    """Return the moments from sample ``i`` of a block to the block's end."""
    t = tree.leaf[block]
    return (t[0, i], t[1, i], t[2, i], t[3, i], t[4, i], t[5, i])


@inlined
def node_moments(tree: Tree, number: int) -> Moments:
    """Return the moments of a whole node."""
    t = tree.node[number]
    return (t[0], t[1], t[2], t[3], t[4], t[5])


@inlined
def fit(m: Moments) -> tuple[float, float, float, bool]:
    """Return cost, value at the origin, slope per distance, and whether the slope is usable.

    If the positions are too close together for a slope, the returned cost is 0,
    a valid lower bound, and the line is flat.
    """
    n, x1, x2, y, xy, yy = m
    mean = y / n
    sxx = x2 - x1 * x1 / n
    if not sxx > 1e-10 * x2:
        return 0.0, mean, 0.0, False
    slope = (xy - x1 * mean) / sxx
    cost = (yy - y * mean) - slope * (xy - x1 * mean)
    return max(cost, 0.0), mean - slope * x1 / n, slope, True


@helper
def blocks_moments(tree: Tree, first: int, last: int) -> Moments:
    """Return the moments of the blocks ``[first, last)``, origin at the last sample."""
    origin = tree.x[LEAF * last - 1]
    total = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    while first < last:
        level = 0
        size = 1
        above = BRANCH
        while level < tree.levels - 1 and first % above == 0 and first + above <= last:
            level += 1
            size = above
            above *= BRANCH
        number = tree.start[level] + first // size
        total = joined(node_moments(tree, number), origin - tree.node[number, 6], total)
        first += size
    return total


@helper
def stretch_moments(tree: Tree, sample: int, last: int) -> Moments:
    """Return the moments from ``sample`` to the end of block ``last - 1``."""
    block = sample // LEAF
    shift = tree.x[LEAF * last - 1] - tree.x[LEAF * block + LEAF - 1]
    head = leaf_moments(tree, block, sample - LEAF * block)
    return joined(head, shift, blocks_moments(tree, block + 1, last))


@kernel
def _fill_leaves(x: FloatArray, y: FloatArray, w: FloatArray, leaf: FloatArray) -> None:
    for b in range(leaf.shape[0]):
        origin = x[LEAF * b + LEAF - 1]
        m = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        for i in range(LEAF - 1, -1, -1):
            p = LEAF * b + i
            sample = (w[p], 0.0, 0.0, w[p] * y[p], 0.0, w[p] * y[p] * y[p])
            m = joined(sample, origin - x[p], m)
            for f in range(6):
                leaf[b, f, i] = m[f]


@kernel
def _fill_nodes(x: FloatArray, leaf: FloatArray, start: IntArray, node: FloatArray) -> None:
    for b in range(start[1]):
        for f in range(6):
            node[b, f] = leaf[b, f, 0]
        node[b, 6] = x[LEAF * b + LEAF - 1]
    for level in range(1, len(start) - 1):
        for i in range(start[level + 1] - start[level]):
            child = start[level - 1] + BRANCH * i
            origin = node[child + BRANCH - 1, 6]
            m = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            for c in range(child, child + BRANCH):
                t = node[c]
                part = (t[0], t[1], t[2], t[3], t[4], t[5])
                m = joined(part, origin - node[c, 6], m)
            for f in range(6):
                node[start[level] + i, f] = m[f]
            node[start[level] + i, 6] = origin


def build_tree(x: FloatArray, y: FloatArray, w: FloatArray) -> Tree:
    """Build the tree over samples (n,) sorted by strictly increasing x, with weights > 0.

    O(n) time; about 75 bytes per sample.
    """
    n = len(x)
    blocks = -(-n // LEAF)
    pad = LEAF * blocks - n
    x = np.concatenate([x, np.full(pad, x[-1])])
    y = np.concatenate([y, np.zeros(pad)])
    w = np.concatenate([w, np.zeros(pad)])
    leaf: NDArray[np.float64] = np.empty((blocks, 6, LEAF))
    _fill_leaves(x, y, w, leaf)
    counts = [n // LEAF]
    while counts[-1] // BRANCH >= 2:
        counts.append(counts[-1] // BRANCH)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    node = np.empty((int(start[-1]), 7))
    _fill_nodes(x, leaf, start, node)
    return Tree(n, len(counts), x, y, w, leaf, start, node)
