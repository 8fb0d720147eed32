"""All layers of the exact dynamic programme, and the way back through them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.core.jit import kernel
from valveflow_ros.core.partition_bounds import fill_leaf_bounds, fill_node_bounds, make_priors
from valveflow_ros.core.partition_moments import (
    BRANCH,
    LEAF,
    Tree,
    build_tree,
    stretch_moments,
)
from valveflow_ros.core.partition_near import Near, fill_near, make_near
from valveflow_ros.core.partition_search import Layer, search_groups
from valveflow_ros.records import FloatArray, IntArray

# Groups one thread takes at a time.
RUN = 64


@kernel
def fill_first(
    tree: Tree, shortest: int, first: int, last: int, after: FloatArray
) -> None:
    """Fill the costs of one piece that begins at the first sample, for a run of groups."""
    for block in range(first, last):
        m = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        origin = tree.x[0]
        if block > 0:
            m = stretch_moments(tree, 0, block)
            origin = tree.x[LEAF * block - 1]
        for k in range(LEAF):
            p = LEAF * block + k
            d = origin - tree.x[p]
            w = tree.w[p]
            y = tree.y[p]
            m = (m[0] + w, m[1] + w * d, m[2] + w * d * d, m[3] + w * y, m[4] + w * d * y,
                 m[5] + w * y * y)  # fmt: skip
            sxy = m[4] - m[1] * m[3] / m[0]
            sxx = m[2] - m[1] * m[1] / m[0]
            cost = 0.0
            if p >= 2:
                cost = max(m[5] - m[3] * m[3] / m[0] - sxy * sxy / sxx, 0.0)
            after[p + 1] = cost if shortest <= p + 1 <= tree.n else np.inf


def _each(work: Callable[..., Any], tasks: Iterable[tuple[int, ...]], threads: int) -> None:
    """Call ``work(*task)`` for every task, on several threads if asked.

    The kernels release the interpreter lock, so plain threads run them side by
    side, also when several callers do this at the same time.
    """
    todo = iter(tasks)
    lock = threading.Lock()
    errors: list[BaseException] = []

    def loop() -> None:
        while not errors:
            with lock:
                task = next(todo, None)
            if task is None:
                return
            try:
                work(*task)
            except BaseException as error:
                errors.append(error)

    helpers = [threading.Thread(target=loop, daemon=True) for _ in range(threads - 1)]
    for helper in helpers:
        helper.start()
    loop()
    for helper in helpers:
        helper.join()
    if errors:
        raise errors[0]


def _runs(count: int, run: int = RUN) -> list[tuple[int, int]]:
    """Cut ``range(count)`` into runs, the last (and most expensive) first."""
    return [(first, min(first + run, count)) for first in range(0, count, run)][::-1]


class Problem(NamedTuple):
    """A prepared search: the tree and all that does not depend on the layer."""

    tree: Tree
    near: Near
    prior: NDArray[np.float64]
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
    _each(lambda a, b: fill_near(tree, a, b, near), _runs(len(tree.leaf)), threads)
    limit = 2.0 * float(np.abs(y).max())
    return Problem(tree, near, make_priors(tree, limit), shortest, slack, limit, threads)


def layers(
    problem: Problem, pieces: int
) -> Iterator[tuple[FloatArray, NDArray[np.int32] | None]]:
    """Yield for 1, 2, ... ``pieces`` pieces the best cost up to each end, and the last break.

    Of the last layer only the end ``n`` is worked out; arrays are reused two
    layers later. Costs are inf where an end cannot be reached.
    """
    tree, near, prior, shortest, slack, limit, threads = problem
    blocks = len(tree.leaf)
    runs = _runs(blocks)
    bound = np.empty_like(prior)
    before = np.full(LEAF * blocks + 1, np.inf)
    after = np.full(LEAF * blocks + 1, np.inf)
    _each(lambda a, b: fill_first(tree, shortest, a, b, after), runs, threads)
    yield after, None
    for j in range(2, pieces + 1):
        before, after = after, before
        after[0] = np.inf
        _each(_leaf_bounds(tree, prior, before, bound), runs, threads)
        for level in range(1, tree.levels):
            fill_node_bounds(tree, prior, level, 0, blocks // BRANCH**level, bound)
        layer = Layer(j, shortest, slack, limit, near, prior, before, bound)
        breaks: NDArray[np.int32] = np.full(LEAF * blocks + 1, -1, dtype=np.int32)
        if j == pieces:
            runs = [((tree.n - 1) // LEAF, (tree.n - 1) // LEAF + 1)]
        _each(_groups(tree, layer, after, breaks), runs, threads)
        yield after, breaks


def _leaf_bounds(
    tree: Tree, prior: FloatArray, before: FloatArray, bound: FloatArray
) -> Callable[[int, int], None]:
    return lambda first, last: fill_leaf_bounds(tree, prior, before, first, last, bound)


def _groups(
    tree: Tree, layer: Layer, after: FloatArray, breaks: NDArray[np.int32]
) -> Callable[[int, int], int]:
    return lambda first, last: search_groups(tree, layer, first, last, after, breaks)


def best_partitions(problem: Problem, pieces: int) -> tuple[FloatArray, list[IntArray]]:
    """Solve eqs. (21)-(23) exactly for 1..``pieces`` pieces.

    Returns
    -------
    cost : float64 (pieces,)
    starts : list of int64 arrays
        ``starts[j - 1]`` holds 0, the first samples of the other pieces, and n.
    """
    n = problem.tree.n
    cost = np.empty(pieces)
    breaks: list[NDArray[np.int32]] = []
    starts: list[IntArray] = []
    for j, (after, last) in enumerate(layers(problem, pieces), start=1):
        cost[j - 1] = after[n]
        if last is not None:
            breaks.append(last)
        starts.append(_way_back(breaks, n))
    return cost, starts


def _way_back(breaks: list[NDArray[np.int32]], n: int) -> IntArray:
    """Follow the recorded breaks from the end to the beginning."""
    starts = np.zeros(len(breaks) + 2, dtype=np.int64)
    starts[-1] = n
    for j in range(len(breaks), 0, -1):
        starts[j] = breaks[j - 1][starts[j + 1]]
    return starts
