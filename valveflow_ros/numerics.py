# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compiler options, threads, and long sums whose result does not depend on the threads."""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from typing import Any, TypeVar, cast

import numba
import numpy as np

from valveflow_ros.records import FloatArray

# No fastmath: it assumes that there is no NaN, and reorders the sums that tests compare.
# No wrapper for calls from C: it is not needed, and takes time to compile.
JIT: dict[str, Any] = {'cache': True, 'nogil': True, 'no_cfunc_wrapper': True}

_Function = TypeVar('_Function', bound=Callable[..., Any])


_USUAL_MW = 300.0


def output_size(output: FloatArray) -> float:
    """Return the size of an output relative to that of a unit of 300 MW.

    Search steps in MW are multiplied by it, so that they suit a unit of any size and a flow in
    any unit. From 212 to 424 MW it is 1: there the steps are those that were tested.
    """
    top = float(np.quantile(np.abs(output), 0.99)) if len(output) else 0.0
    size = top / _USUAL_MW
    return 1.0 if size <= 0.0 or 0.5 <= size * size <= 2.0 else size


def jit(function: _Function) -> _Function:
    """Compile a loop over arrays; the type checker sees the original type."""
    return cast(_Function, _prepared(numba.njit(**JIT)(function)))


def _prepared(compiled: Any) -> Any:
    """Compile a function once for `f(x, 0)` and `f(x, n)`, and use no outdated cache.

    numba treats a constant argument as a separate type, and compiles the function and all
    functions that it calls again for each constant.
    """
    call = getattr(compiled, 'get_call_template', None)
    if call is None:  # NUMBA_DISABLE_JIT
        return compiled

    def get_call_template(args: Any, kws: dict[str, Any]) -> Any:
        whole: Any = numba.types.unliteral
        return call(tuple(map(whole, args)), {name: whole(kind) for name, kind in kws.items()})

    compiled.get_call_template = get_call_template
    return _fresh(compiled)


def _fresh(compiled: Any) -> Any:
    """Use the cache of a function only if no function that it calls has changed.

    numba checks the function's own file only: after an update it would use old loops of other
    files, and it fails if a cached type has another name now.
    """
    cache = getattr(compiled, '_cache', None)
    kept = getattr(getattr(cache, '_cache_file', None), '_index_path', None)
    if cache is None or kept is None:
        return compiled
    load = cache.load_overload

    def load_overload(signature: Any, context: Any) -> Any:
        try:
            kept_s, now_s = os.path.getmtime(kept), time.time()
            # A file with a time in the future, from a wrong clock, would always be newer.
            if any(kept_s < os.path.getmtime(file) <= now_s for file in _sources(compiled)):
                cache.flush()
        except OSError:
            pass  # There is no cache, or there are no sources that could change.
        try:
            return load(signature, context)
        except Exception:  # noqa: BLE001 - numba raises any error of its pickles
            cache.flush()
            return None

    cache.load_overload = load_overload
    return compiled


def _sources(compiled: Any) -> set[str]:
    """Return the files of a compiled function and of all compiled ones that it may call."""
    found, todo = set(), [compiled.py_func.__globals__]
    seen = {id(todo[0])}
    while todo:
        names = todo.pop()
        found.add(names['__file__'])
        for callee in names.values():
            around = getattr(getattr(callee, 'py_func', None), '__globals__', None)
            if around is not None and id(around) not in seen:
                seen.add(id(around))
                todo.append(around)
    return found


# A division by zero gives inf or NaN here. The test for an exception would prevent
# the vectorisation of a loop.
_KERNEL_JIT: dict[str, Any] = {**JIT, 'error_model': 'numpy'}


def kernel(function: _Function) -> _Function:
    """Compile a loop that can be vectorised: like `jit`, with IEEE division."""
    return cast(_Function, _prepared(numba.njit(**_KERNEL_JIT)(function)))


# Not callable from Python: this saves the time to compile wrappers.
_HELPER_JIT: dict[str, Any] = {**_KERNEL_JIT, 'no_cpython_wrapper': True}


def helper(function: _Function) -> _Function:
    """Compile a loop that only compiled ones call, in several places."""
    return cast(_Function, _prepared(numba.njit(**_HELPER_JIT)(function)))


def inlined(function: _Function) -> _Function:
    """Compile a part of a `kernel` into its callers.

    A call with tuples of arrays takes longer than a short loop: every array is passed
    as seven numbers, and its reference count is increased and decreased.
    """
    return cast(_Function, _prepared(numba.njit(forceinline=True, **_HELPER_JIT)(function)))


def copied(function: _Function) -> _Function:
    """Copy a part of a loop into the one place that calls it, before that is compiled.

    A compiled function is optimised and translated alone, and again with each of its callers
    and of theirs. The copy has its caller's rule for a division by zero.
    """
    return cast(_Function, numba.njit(inline='always')(function))


# Python threads for kernels that release the interpreter lock.

T = TypeVar('T')
R = TypeVar('R')
_FEW = 4
_END = object()
# Interval at which a thread that waits for space checks if it must stop.
_LOOK_S = 0.2


def cores() -> int:
    """Return the number of cores that this process may use.

    ``NUMBA_NUM_THREADS`` sets a limit, as for numba's own threads: a monitor's worker uses
    one core only.
    """
    have = len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count()
    told = os.environ.get('NUMBA_NUM_THREADS', '')
    return max(1, min(have or 1, int(told) if told.isdecimal() else have or 1))


def runs(count: int, length: int) -> list[tuple[int, int]]:
    """Divide ``range(count)`` into runs of at most ``length``, the last one first."""
    return [(first, min(first + length, count)) for first in range(0, count, length)][::-1]


class _Helpers:
    """The number of threads that help now, in all calls of `run_in_threads` together."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Count from none: the threads of a process are not in its fork."""
        self.lock, self.count = threading.Lock(), 0

    def add(self, wanted: int, most: int) -> int:
        """Count up to ``wanted`` more, ``most`` in all; return how many."""
        with self.lock:
            more = max(0, min(wanted, most - self.count))
            self.count += more
        return more


_helpers = _Helpers()
os.register_at_fork(after_in_child=_helpers.begin)


def run_in_threads(
    work: Callable[..., Any], tasks: Iterable[tuple[int, ...]], threads: int
) -> None:
    """Call ``work(*task)`` for every task, on ``threads`` threads; 1 starts none.

    Tasks may call it too: all calls together start ``threads`` - 1 threads at most.
    In contrast to numba's parallel loops this can be used in several threads of a
    process at the same time, starts in microseconds, and creates no thread pool
    that a fork would break. An error of a task is raised here after all threads
    have stopped.
    """
    waiting = list(tasks)
    todo = iter(waiting)
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
            except BaseException as error:  # noqa: BLE001 - raised again below
                errors.append(error)

    def help_out() -> None:
        loop()
        with _helpers.lock:
            _helpers.count -= 1

    count = _helpers.add(len(waiting) - 1, threads - 1)
    helpers = [threading.Thread(target=help_out, daemon=True) for _ in range(count)]
    for helper in helpers:
        helper.start()
    loop()
    for helper in helpers:
        helper.join()
    if errors:
        raise errors[0]


def each_in_threads(work: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Return ``work(item)`` of every item, computed in a few threads: each needs much memory."""
    found: list[Any] = [None] * len(items)

    def one(k: int) -> None:
        found[k] = work(items[k])

    run_in_threads(one, [(k,) for k in range(len(items))], min(_FEW, cores()))
    return found


def read_ahead(items: Iterator[T], depth: int = 2) -> Iterator[T]:
    """Yield the same items, produced in a thread while the caller processes earlier ones.

    At most ``depth`` items wait. With one core, items are produced on request. An error is
    raised at the same item as without a thread. Closing the iterator stops the thread.
    """
    return items if cores() < 2 else _made_ahead(items, depth)


def _made_ahead(items: Iterator[T], depth: int) -> Generator[T, None, None]:
    made: queue.Queue[Any] = queue.Queue(depth)
    unwanted = threading.Event()

    def hand_over(item: object, error: BaseException | None = None) -> bool:
        while not unwanted.is_set():
            try:
                made.put((item, error), timeout=_LOOK_S)
            except queue.Full:
                continue
            return True
        return False

    def make() -> None:
        try:
            for item in items:
                if not hand_over(item):
                    return
        except BaseException as error:  # noqa: BLE001 - raised again in the consumer
            hand_over(_END, error)
        else:
            hand_over(_END)

    threading.Thread(target=make, daemon=True).start()
    try:
        while True:
            item, error = made.get()
            if error is not None:
                raise error
            if item is _END:
                return
            yield item
    finally:
        unwanted.set()


# Long sums whose result does not depend on the number of threads.
#
# The linear algebra library divides long dot products among threads, so the last
# bits depend on the number of threads. A fit must give the same bits in the
# worker of a live run and in a replay, so sums over samples are computed here.


@jit
def gram(table: FloatArray) -> FloatArray:
    """Return ``table.T @ table``; table (m, P), result (P, P)."""
    columns = table.shape[1]
    out = np.zeros((columns, columns))
    for t in range(table.shape[0]):
        for p in range(columns):
            value = table[t, p]
            for q in range(p + 1):
                out[p, q] += value * table[t, q]
    for p in range(columns):
        for q in range(p):
            out[q, p] = out[p, q]
    return out


@jit
def product(table: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return ``table @ matrix``; table (m, P), matrix (P, Q), result (m, Q)."""
    out = np.zeros((table.shape[0], matrix.shape[1]))
    for t in range(table.shape[0]):
        for p in range(table.shape[1]):
            value = table[t, p]
            for q in range(matrix.shape[1]):
                out[t, q] += value * matrix[p, q]
    return out


@jit
def running_average(values: FloatArray, forget: float) -> FloatArray:
    """Return the exponential average after each of ``values`` (n,), starting at 0, shape (n,).

    Each step multiplies the previous average by ``forget`` (0 to 1).
    """
    out = np.empty(values.size)
    average = 0.0
    for t in range(values.size):
        average = forget * average + (1.0 - forget) * values[t]
        out[t] = average
    return out
