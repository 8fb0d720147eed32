"""All layers of the exact dynamic programme, and the way back through them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.jit import kernel
from valveflow_ros.partition.partition_bounds import fill_leaf_bounds, make_priors
from valveflow_ros.partition.partition_lift import fill_node_bounds
from valveflow_ros.partition.partition_moments import LEAF, Tree, build_tree, stretch_moments
from valveflow_ros.partition.partition_near import Near, fill_near, make_near
from valveflow_ros.partition.partition_search import Layer, search_groups
from valveflow_ros.records import FloatArray, IntArray
from valveflow_ros.threads import runs, share

# Groups that one thread searches before it asks for more. Fixed, so that the
# result does not depend on the number of threads.
_RUN = 64


class Problem(NamedTuple):
    """A prepared search: the tree and all else that does not depend on the layer."""

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
    """Build the tables for `layers`.

    Parameters
    ----------
    x, y, w : float64 (n,)
        Strictly increasing positions, values, weights > 0.
    shortest : int
        Smallest number of samples in a piece, >= 2.
    slack : float
        Each layer's cost may exceed the optimum by this much, >= 0.
    threads : int
        Threads to use; 1 starts none.
    """
    tree = build_tree(x, y, w)
    near = make_near(len(tree.leaf))

    def fill(first: int, last: int) -> None:
        fill_near(tree, first, last, near)

    share(fill, runs(len(tree.leaf), _RUN), threads)
    limit = 2.0 * float(np.abs(y).max())
    return Problem(tree, near, make_priors(tree, limit), shortest, slack, limit, threads)


@kernel
def _fill_first(tree: Tree, shortest: int, first: int, last: int, after: FloatArray) -> None:
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

    Of the last layer only the end ``n`` is worked out; the array of costs is
    used again two layers later. Costs are inf where an end cannot be reached.
    """
    tree, threads = problem.tree, problem.threads
    blocks = len(tree.leaf)
    before = np.full(LEAF * blocks + 1, np.inf)
    after = np.full(LEAF * blocks + 1, np.inf)
    share(_first(problem, after), runs(blocks, _RUN), threads)
    yield after, np.zeros(len(after), dtype=np.int32)
    bound = np.empty_like(problem.prior)
    groups = runs(blocks, _RUN)
    for j in range(2, pieces + 1):
        before, after = after, before
        after[0] = np.inf
        share(_leaf_bounds(problem, before, bound), runs(blocks, _RUN), threads)
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
        share(_groups(tree, layer, after, breaks), groups, threads)
        yield after, breaks


def _first(problem: Problem, after: FloatArray) -> Callable[[int, int], None]:
    return lambda a, b: _fill_first(problem.tree, problem.shortest, a, b, after)


def _leaf_bounds(
    problem: Problem, before: FloatArray, bound: FloatArray
) -> Callable[[int, int], None]:
    return lambda a, b: fill_leaf_bounds(problem.tree, problem.prior, before, a, b, bound)


def _groups(
    tree: Tree, layer: Layer, after: FloatArray, breaks: NDArray[np.int32]
) -> Callable[[int, int], int]:
    return lambda a, b: search_groups(tree, layer, a, b, after, breaks)


def best_partitions(problem: Problem, pieces: int) -> tuple[FloatArray, list[IntArray]]:
    """Solve eqs. (21)-(23) of the paper for 1..``pieces`` pieces.

    Parameters
    ----------
    pieces : int
        With ``pieces * shortest <= n``.

    Returns
    -------
    cost : float64 (pieces,)
    starts : list of int64 arrays
        ``starts[j - 1]`` holds 0, the first samples of the other pieces, and n.
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
