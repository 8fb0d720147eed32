"""Bounds of the larger nodes from those of their children, in a fixed number of steps each.

For a child that ends at ``c`` inside a parent that ends at ``e``, the samples
``[c, e)`` together with the parent's prior are a core in the sense of
`partition_bounds`: a quadratic in the line whose minimum lies at a line ``k``
that is an affine function of the line the parent is asked about. So

    f_parent(m) >= (least of that quadratic)(m) + f_child(k(m)) ,

as long as the child's own window does not reach beyond the parent's. Put in
the child's P and box of slopes, and the parent has a P and a box of slopes.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.jit import inlined, kernel
from valveflow_ros.partition.partition_bounds import SLOTS
from valveflow_ros.partition.partition_moments import (
    BRANCH,
    LEAF,
    Moments,
    Tree,
    joined,
    node_moments,
)
from valveflow_ros.records import FloatArray


@inlined
def _between(lo: float, hi: float, factor: float) -> tuple[float, float]:
    """Multiply the interval from ``lo`` to ``hi``."""
    a = lo * factor
    b = hi * factor
    return min(a, b), max(a, b)


@kernel
def _lift(
    prior: FloatArray,
    child: FloatArray,
    child_prior: FloatArray,
    ends: tuple[float, float, float],
    between: Moments,
    out: FloatArray,
) -> None:
    """Turn the bound of a child into one of its parent and widen ``out`` by it.

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


@inlined
def _lift_flat(child: FloatArray, out: FloatArray) -> None:
    """Widen ``out`` by a child's bound that depends on no line: cost(B) >= cost(part of B)."""
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
