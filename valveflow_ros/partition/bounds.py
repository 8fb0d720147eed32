# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Lower bounds of the cost for a block of candidate breaks, for any samples to its right.

Write ``A(l)`` for the sum of squared residuals of the samples ``A`` about a
line ``l``; it is a quadratic in the two numbers of the line, with Gram matrix
``H_A``, and ``cost(A) = min_l A(l)``. Let ``D(w)`` be the cost of the best
pieces that end at position ``w``. For a break ``w`` in a node that ends at
``e``, and an end ``r`` in a group that begins at ``g >= e``, the last piece
``[w, r)`` is a left part ``B = [w, e)``, a core ``K = [e, g)`` and a tail
``L = [g, r)``. About the core's own best line ``k``

    K(l) = cost(K) + |l - k|^2 in the metric H_K ,

and if ``H1 + H2 <= H_K`` then, giving each part a fraction of the core,

    cost([w, r)) = min_l B(l) + K(l) + L(l) >= cost(K) + f_B(k) + f_L(k) ,
    f_A(k) = min_l A(l) + |l - k|^2 in the metric H1 (for B) or H2 (for L) .

``f_A`` is the cost of ``A`` with a prior on its line. It is a partial minimum
of a jointly convex function, therefore convex in ``k``, therefore above its
tangent at any reference line ``k0``. The smallest ``D(w) + f_B(k0)`` of a node
and the smallest and largest tangent slopes over it are five numbers that can
be prepared for a whole layer; they bound every pair of a break in the node and
an end in the group from below with the work of one line fit:

    D(w) + cost([w, r)) >= P + min over the box of slopes (slope . (k - k0))
                             + cost(K) + the same for the tail .

Here ``H1`` is `SHARE` times the Gram matrix of a window of samples that follows the
node, and ``k0`` the best line of that window; without a window (slot 0)
``f_B = cost(B)``, which needs no line. The farther away the group, the larger
the window that fits, and the smaller the loss by the inequality: for white noise
it decreases like sqrt(node / window), on smooth curves it decreases because the
core's line and the window's line agree.

No statistical assumption is made: a node that is excluded by this bound cannot
contain a better break.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.numerics import copied, inlined, kernel
from valveflow_ros.partition.moments import (
    BRANCH,
    LEAF,
    Moments,
    Tree,
    blocks_moments,
    fit,
    joined,
    node_moments,
)
from valveflow_ros.records import FloatArray

# Windows for which a node has a bound: none, then its own size times 1, 4, 16, 64, 256.
SLOTS = 6
# Two fractions of one core, slightly below 1/2 so that rounding cannot make their sum exceed 1.
SHARE = 0.499999


@copied
def _window_prior(tree: Tree, first: int, last: int, limit: float, out: FloatArray) -> None:
    """Return Gram matrix and line of the blocks ``[first, last)`` about the sample before them."""
    m = blocks_moments(tree, first, last)
    width = tree.x[LEAF * last - 1] - tree.x[LEAF * first - 1]
    _, value, slope, _ = fit(m)
    value += slope * width
    left = tree.x[LEAF * first - 1] - tree.x[max(LEAF * first - LEAF * (last - first), 0)]
    if not max(abs(value), abs(value + slope * left)) <= limit:
        # A steep line through a cluster is no useful reference and loses digits.
        value = m[3] / m[0]
        slope = 0.0
    out[0] = SHARE * m[0]
    out[1] = SHARE * (m[1] - width * m[0])
    out[2] = SHARE * max(m[2] - 2.0 * width * m[1] + width * width * m[0], 0.0)
    out[3] = value
    out[4] = slope


@kernel
def fill_priors(tree: Tree, limit: float, prior: FloatArray) -> None:
    """Fill ``prior[node, slot]``: Gram matrix (3 numbers) and line (2) of each window."""
    blocks = tree.start[1]
    size = 1
    for level in range(tree.levels):
        for number in range(tree.start[level], tree.start[level + 1]):
            end = (number - tree.start[level] + 1) * size
            window = size
            for slot in range(1, SLOTS):
                if end + window <= blocks:
                    _window_prior(tree, end, end + window, limit, prior[number, slot])
                window *= BRANCH
        size *= BRANCH


@inlined
def about_line(
    t: FloatArray, hn: float, h1: float, h2: float, a: float, b: float, per_width: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fill ``out`` (3, LEAF) with f_A(k0) of columns of moments and its two tangent slopes.

    The Gram matrix of the prior is (hn, h1, h2), and k0 has the value ``a`` at the origin and the
    slope ``b``. The slopes are along the line's value at the origin, and at the other end.
    """
    for i in range(t.shape[1]):
        n = t[0, i]
        x1 = t[1, i]
        x2 = t[2, i]
        r0 = t[3, i] - a * n - b * x1
        r1 = t[4, i] - a * x1 - b * x2
        r2 = (t[5, i] - a * t[3, i] - b * t[4, i]) - a * r0 - b * r1
        p = hn + n
        q = h1 + x1
        s = h2 + x2
        det = p * s - q * q
        inverse = 1.0 / det if det > 1e-12 * p * s else 0.0
        za = (s * r0 - q * r1) * inverse
        zb = (p * r1 - q * r0) * inverse
        value = r2 - r0 * za - r1 * zb
        along = -2.0 * (h1 * za + h2 * zb) * per_width
        out[0, i] = value if value > 0.0 and inverse > 0.0 else 0.0
        out[1, i] = -2.0 * (hn * za + h1 * zb) - along
        out[2, i] = along


@inlined
def least_and_most(row: FloatArray) -> tuple[float, float]:
    """Return the extremes of `LEAF` numbers, in four independent chains to reduce latency."""
    a0 = b0 = row[0]
    a1 = b1 = row[1]
    a2 = b2 = row[2]
    a3 = b3 = row[3]
    for i in range(4, LEAF, 4):
        a0 = min(a0, row[i])
        a1 = min(a1, row[i + 1])
        a2 = min(a2, row[i + 2])
        a3 = min(a3, row[i + 3])
        b0 = max(b0, row[i])
        b1 = max(b1, row[i + 1])
        b2 = max(b2, row[i + 2])
        b3 = max(b3, row[i + 3])
    return min(min(a0, a1), min(a2, a3)), max(max(b0, b1), max(b2, b3))


@kernel
def fill_leaf_bounds(
    tree: Tree, prior: FloatArray, before: FloatArray, bound: FloatArray, first: int, last: int
) -> None:
    """Fill ``bound[block, slot]`` of the full blocks in ``[first, last)`` from their candidates.

    The five numbers are P, then the box of slopes: minimum and maximum along the line's
    value at the node's last sample, minimum and maximum along that at its first.
    """
    blocks = tree.start[1]
    out = np.empty((3, LEAF))
    for block in range(first, min(last, blocks)):
        per_width = 1.0 / (tree.x[LEAF * block + LEAF - 1] - tree.x[LEAF * block])
        mine = before[LEAF * block : LEAF * block + LEAF]
        window = 0
        for slot in range(SLOTS):
            b = bound[block, slot]
            b[0] = -np.inf
            if block + 1 + window <= blocks:
                p = prior[block, slot]
                about_line(tree.leaf[block], p[0], p[1], p[2], p[3], p[4], per_width, out)
                for i in range(LEAF):
                    out[0, i] = mine[i] + out[0, i]
                b[0], _ = least_and_most(out[0])
                b[1], b[2] = least_and_most(out[1])
                b[3], b[4] = least_and_most(out[2])
            window = window * BRANCH if slot else 1


# Bounds of the larger nodes from those of their children, in a fixed number of steps each.
#
# For a child that ends at ``c`` inside a parent that ends at ``e``, the samples
# ``[c, e)`` together with the parent's prior are a core in the sense of
# `partition.bounds`: a quadratic in the line whose minimum lies at a line ``k``
# that is an affine function of the line at which the parent is evaluated. So
#
#     f_parent(m) >= (least of that quadratic)(m) + f_child(k(m)) ,
#
# if the child's own window does not extend beyond the parent's. The child's P
# and box of slopes then give the P and box of slopes of the parent.


@inlined
def _between(lo: float, hi: float, factor: float) -> tuple[float, float]:
    """Multiply the interval from ``lo`` to ``hi`` by a factor."""
    a = lo * factor
    b = hi * factor
    return min(a, b), max(a, b)


@copied
def _lift(
    prior: FloatArray,
    child: FloatArray,
    child_prior: FloatArray,
    ends: tuple[float, float, float],
    between: Moments,
    out: FloatArray,
) -> None:
    """Convert the bound of a child into one of its parent and widen ``out`` by it.

    ``between`` are the samples from the child's end to the parent's. They and the
    parent's prior are the child's core. ``ends`` are the distances, to the left of the
    parent's last sample, of the parent's first sample and the child's last and first.
    """
    width, near, far = ends
    hn = prior[0]
    h1 = prior[1]
    h2 = prior[2]
    a = prior[3]
    b = prior[4]
    r0 = between[3] - a * between[0] - b * between[1]
    r1 = between[4] - a * between[1] - b * between[2]
    r2 = (between[5] - a * between[3] - b * between[4]) - a * r0 - b * r1
    p = hn + between[0]
    q = h1 + between[1]
    s = h2 + between[2]
    det = p * s - q * q
    inverse = 1.0 / det
    za = (s * r0 - q * r1) * inverse
    zb = (p * r1 - q * r0) * inverse
    right = a + za + near * (b + zb) - child_prior[3]
    left = a + za + far * (b + zb) - child_prior[3] - (far - near) * child_prior[4]
    box = min(child[1] * right, child[2] * right) + min(child[3] * left, child[4] * left)
    out[0] = min(out[0], max(r2 - r0 * za - r1 * zb, 0.0) + child[0] + box)
    per_width = 1.0 / width
    # The columns of H A^-1 for the child's two values, as slopes along the parent's two.
    ua = (s - q * near) * inverse
    ub = (p * near - q) * inverse
    va = (s - q * far) * inverse
    vb = (p * far - q) * inverse
    zl = -2.0 * (h1 * za + h2 * zb) * per_width
    ul = (h1 * ua + h2 * ub) * per_width
    vl = (h1 * va + h2 * vb) * per_width
    zr = -2.0 * (hn * za + h1 * zb) - zl
    ur = (hn * ua + h1 * ub) - ul
    vr = (hn * va + h1 * vb) - vl
    lo1, hi1 = _between(child[1], child[2], ur)
    lo2, hi2 = _between(child[3], child[4], vr)
    out[1] = min(out[1], zr + lo1 + lo2)
    out[2] = max(out[2], zr + hi1 + hi2)
    lo1, hi1 = _between(child[1], child[2], ul)
    lo2, hi2 = _between(child[3], child[4], vl)
    out[3] = min(out[3], zl + lo1 + lo2)
    out[4] = max(out[4], zl + hi1 + hi2)


@copied
def _lift_flat(child: FloatArray, out: FloatArray) -> None:
    """Widen ``out`` by a child's bound without a line: cost(B) >= cost(part of B)."""
    out[0] = min(out[0], child[0])
    out[1] = min(out[1], 0.0)
    out[2] = max(out[2], 0.0)
    out[3] = min(out[3], 0.0)
    out[4] = max(out[4], 0.0)


@kernel
def fill_node_bounds(
    tree: Tree, prior: FloatArray, level: int, first: int, last: int, bound: FloatArray
) -> None:
    """Fill ``bound`` of the nodes ``[first, last)`` of a level from the level below."""
    blocks = tree.start[1]
    size = BRANCH**level
    part = size // BRANCH
    for i in range(first, last):
        end = (i + 1) * size
        number = tree.start[level] + i
        origin = tree.x[LEAF * end - 1]
        width = origin - tree.x[LEAF * (end - size)]
        window = 0
        for slot in range(SLOTS):
            out = bound[number, slot]
            out[0] = -np.inf
            if end + window > blocks:
                continue
            out[0] = np.inf
            out[1] = out[3] = np.inf
            out[2] = out[4] = -np.inf
            between = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            for c in range(BRANCH - 1, -1, -1):
                child = tree.start[level - 1] + BRANCH * i + c
                stop = end - (BRANCH - 1 - c) * part
                near = origin - tree.x[LEAF * stop - 1]
                far = origin - tree.x[LEAF * (stop - part)]
                wide = min(slot + 1, SLOTS - 1) if slot or c < BRANCH - 1 else 0
                p = prior[number, slot, 0] + between[0]
                q = prior[number, slot, 1] + between[1]
                s = prior[number, slot, 2] + between[2]
                if bound[child, 0, 0] < np.inf:
                    if wide and p * s - q * q > 1e-12 * p * s:
                        _lift(prior[number, slot], bound[child, wide], prior[child, wide],
                              (width, near, far), between, out)  # fmt: skip
                    else:
                        _lift_flat(bound[child, 0], out)
                between = joined(node_moments(tree, child), near, between)
            window = window * BRANCH if slot else size
