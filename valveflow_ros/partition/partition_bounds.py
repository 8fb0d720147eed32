"""What a block of candidate breaks can give at best, whatever lies to its right.

Write ``A(l)`` for the sum of squared residuals of the samples ``A`` about a
line ``l``; it is a quadratic in the two numbers of the line, with Gram matrix
``H_A``, and ``cost(A) = min_l A(l)``. Let ``D(w)`` be the cost of the best
pieces that end at position ``w``. For a break ``w`` in a node that ends at
``e``, and an end ``r`` in a group that begins at ``g >= e``, the last piece
``[w, r)`` is a left part ``B = [w, e)``, a core ``K = [e, g)`` and a tail
``L = [g, r)``. About the core's own best line ``k``

    K(l) = cost(K) + |l - k|^2 in the metric H_K ,

and if ``H1 + H2 <= H_K`` then, giving each part a core's share of its own,

    cost([w, r)) = min_l B(l) + K(l) + L(l) >= cost(K) + f_B(k) + f_L(k) ,
    f_A(k) = min_l A(l) + |l - k|^2 in the metric H1 (for B) or H2 (for L) .

``f_A`` is the cost of ``A`` with a prior on its line. It is a partial minimum
of a jointly convex function, therefore convex in ``k``, therefore above its
tangent at any reference line ``k0``. The smallest ``D(w) + f_B(k0)`` of a node
and the smallest and largest tangent slopes over it are five numbers that can
be prepared for a whole layer; they bound every pair of a break in the node and
an end in the group from below at the cost of one line fit:

    D(w) + cost([w, r)) >= P + min over the box of slopes (slope . (k - k0))
                             + cost(K) + the same for the tail .

Here ``H1`` is `SHARE` times the Gram matrix of a window of samples that follows the
node, and ``k0`` the best line of that window; without a window (slot 0)
``f_B = cost(B)``, which needs no line. The farther away the group, the larger
the window that fits, and the smaller what the inequality gives away: for white
noise it falls like sqrt(node / window), on smooth curves it falls because the
core's line and the window's line agree.

No statistics is assumed: a node that is dropped by this bound cannot hold a
better break.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.jit import inlined, kernel
from valveflow_ros.partition.partition_moments import BRANCH, LEAF, Tree, blocks_moments, fit
from valveflow_ros.records import FloatArray

# Windows that a node knows a bound for: none, then its own size times 1, 4, 16, 64, 256.
SLOTS = 6
# Two shares of one core, a little less than halves so that rounding cannot make them more.
SHARE = 0.499999


@kernel
def _window_prior(tree: Tree, first: int, last: int, limit: float, out: FloatArray) -> None:
    """Gram matrix and line of the blocks ``[first, last)`` about the sample before them."""
    m = blocks_moments(tree, first, last)
    width = tree.x[LEAF * last - 1] - tree.x[LEAF * first - 1]
    _, value, slope, _ = fit(m)
    value += slope * width
    left = tree.x[LEAF * first - 1] - tree.x[max(LEAF * first - LEAF * (last - first), 0)]
    if not max(abs(value), abs(value + slope * left)) <= limit:
        # A steep line through a cluster is no use as a reference and costs digits.
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


@kernel
def _candidate_costs(
    leaf: FloatArray,
    prior: FloatArray,
    per_width: float,
    before: FloatArray,
    out: FloatArray,
) -> None:
    """Fill ``out`` with D + f_B(k0) of a block's candidates and its two slopes."""
    hn = prior[0]
    h1 = prior[1]
    h2 = prior[2]
    a = prior[3]
    b = prior[4]
    for i in range(leaf.shape[1]):
        n = leaf[0, i]
        x1 = leaf[1, i]
        x2 = leaf[2, i]
        r0 = leaf[3, i] - a * n - b * x1
        r1 = leaf[4, i] - a * x1 - b * x2
        r2 = (leaf[5, i] - a * leaf[3, i] - b * leaf[4, i]) - a * r0 - b * r1
        p = hn + n
        q = h1 + x1
        s = h2 + x2
        det = p * s - q * q
        inverse = 1.0 / det if det > 1e-12 * p * s else 0.0
        za = (s * r0 - q * r1) * inverse
        zb = (p * r1 - q * r0) * inverse
        value = r2 - r0 * za - r1 * zb
        left = -2.0 * (h1 * za + h2 * zb) * per_width
        out[0, i] = before[i] + (value if value > 0.0 and inverse > 0.0 else 0.0)
        out[1, i] = -2.0 * (hn * za + h1 * zb) - left
        out[2, i] = left


@inlined
def least_and_most(row: FloatArray) -> tuple[float, float]:
    """Return the extremes of `LEAF` numbers, in four chains for the sake of latency."""
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
    tree: Tree, prior: FloatArray, before: FloatArray, first: int, last: int, bound: FloatArray
) -> None:
    """Fill ``bound[block, slot]`` of the full blocks in ``[first, last)`` from their candidates.

    The five numbers are P, then the box of slopes: least and most along the
    line's value at the node's last sample, least and most along that at its first.
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
                _candidate_costs(tree.leaf[block], prior[block, slot], per_width, mine, out)
                b[0], _ = least_and_most(out[0])
                b[1], b[2] = least_and_most(out[1])
                b[3], b[4] = least_and_most(out[2])
            window = window * BRANCH if slot else 1


def make_priors(tree: Tree, limit: float) -> NDArray[np.float64]:
    """Return the layer-independent part of the bounds, shape (nodes, SLOTS, 5)."""
    prior = np.zeros((len(tree.node), SLOTS, 5))
    fill_priors(tree, limit, prior)
    return prior
