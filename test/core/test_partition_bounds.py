"""The lower bounds themselves: never above the truth, and close to it far away."""

from __future__ import annotations

import naive
import numpy as np
import pytest
from partition_kinds import KINDS, samples

from valveflow_ros.partition.bounds import SLOTS, fill_leaf_bounds, fill_node_bounds, make_priors
from valveflow_ros.partition.moments import BRANCH, LEAF, blocks_moments, build_tree
from valveflow_ros.partition.partition import make_levels

N = 17 * LEAF


class Nodes:
    """The bounds of all nodes for one layer, beside the table of true costs."""

    def __init__(self, kind):
        self.levels = make_levels(*samples(kind, N, seed=3))
        x, y, w = self.levels.x, self.levels.residual, self.levels.weight
        self.table = naive.piece_costs(x, y, w).astype(float)
        self.tree = build_tree(x, y, w)
        self.before = np.full(LEAF * len(self.tree.leaf) + 1, np.inf)
        self.before[2 : len(x) + 1] = self.table[0, 2:]
        limit = 2.0 * np.abs(y).max()
        self.prior = make_priors(self.tree, limit)
        self.bound = np.full_like(self.prior, np.nan)
        blocks = int(self.tree.start[1])
        fill_leaf_bounds(self.tree, self.prior, self.before, 0, blocks, self.bound)
        for level in range(1, self.tree.levels):
            count = int(self.tree.start[level + 1] - self.tree.start[level])
            fill_node_bounds(self.tree, self.prior, level, 0, count, self.bound)

    def lower(self, level, i, slot, until):
        """Return the bound for pieces from the node's breaks to the end of block ``until - 1``."""
        size = BRANCH**level
        end = (i + 1) * size
        number = self.tree.start[level] + i
        p, lo_right, hi_right, lo_left, hi_left = self.bound[number, slot]
        if end == until:
            return p
        n, x1, x2, y, xy, yy = blocks_moments(self.tree, end, until)
        spread = x2 - x1 * x1 / n
        slope = (xy - x1 * y / n) / spread
        value = (y - slope * x1) / n
        core = yy - y * y / n - slope * (xy - x1 * y / n)
        if slot == 0:
            return p + core
        at = self.tree.x[LEAF * until - 1] - self.tree.x[LEAF * end - 1]
        width = self.tree.x[LEAF * end - 1] - self.tree.x[LEAF * (end - size)]
        right = value + slope * at - self.prior[number, slot, 3]
        left = right + width * (slope - self.prior[number, slot, 4])
        box = min(lo_right * right, hi_right * right) + min(lo_left * left, hi_left * left)
        return p + box + core

    def truth(self, level, i, until):
        """Return the least cost over the node's breaks."""
        size = LEAF * BRANCH**level
        breaks = np.arange(i * size, (i + 1) * size)
        return (self.before[breaks] + self.table[breaks, LEAF * until]).min()

    def cases(self):
        """Yield every node, window and end that the search could ask about."""
        blocks = int(self.tree.start[1])
        for level in range(self.tree.levels):
            size = BRANCH**level
            for i in range(int(self.tree.start[level + 1] - self.tree.start[level])):
                end = (i + 1) * size
                for slot in range(SLOTS):
                    window = 0 if slot == 0 else size * BRANCH ** (slot - 1)
                    for until in range(end + window, blocks + 1):
                        yield level, i, slot, until


@pytest.mark.parametrize('kind', KINDS)
def test_no_bound_lies_above_the_truth(kind):
    nodes = Nodes(kind)
    close = 1e-11 * len(nodes.levels.u)
    count = 0
    for level, i, slot, until in nodes.cases():
        truth = nodes.truth(level, i, until)
        if np.isfinite(truth):
            assert nodes.lower(level, i, slot, until) <= truth + close, (level, i, slot, until)
            count += 1
    assert count > 100


def test_far_bounds_give_away_less_than_near_ones():
    """In white noise what a leaf's bound gives away falls as the window grows."""
    nodes = Nodes('noise')
    lost = {slot: [] for slot in range(SLOTS)}
    for level, i, slot, until in nodes.cases():
        if level == 0 and until >= i + 1 + 4:
            lost[slot].append(nodes.truth(0, i, until) - nodes.lower(0, i, slot, until))
    variance = 1.0  # the samples are scaled to it
    assert np.median(lost[2]) < np.median(lost[1])
    assert np.median(lost[2]) < 4.0 * variance


def test_moments_of_blocks_are_the_sums_they_claim():
    nodes = Nodes('clumps')
    tree, levels = nodes.tree, nodes.levels
    for first, last in ((0, 1), (0, 5), (3, 4), (2, 11)):
        at = slice(LEAF * first, LEAF * last)
        d = levels.x[LEAF * last - 1] - levels.x[at]
        w, y = levels.weight[at], levels.residual[at]
        sums = [w, w * d, w * d * d, w * y, w * d * y, w * y * y]
        found = blocks_moments(tree, first, last)
        for value, terms in zip(found, sums, strict=True):
            assert value == pytest.approx(terms.sum(), abs=1e-13 * np.abs(terms).sum())
