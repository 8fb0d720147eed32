"""Plain threads for kernels that release the interpreter lock."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from typing import Any


def cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def runs(count: int, length: int) -> list[tuple[int, int]]:
    """Cut ``range(count)`` into runs of at most ``length``, the last one first."""
    return [(first, min(first + length, count)) for first in range(0, count, length)][::-1]


def share(work: Callable[..., Any], tasks: Iterable[tuple[int, ...]], threads: int) -> None:
    """Call ``work(*task)`` for every task, on ``threads`` threads; 1 starts none.

    Unlike the compiler's own parallel loops this may happen in several places
    of a process at the same time, costs microseconds to start, and leaves no
    pool behind that a fork would break. A task's error is raised here once all
    threads have stopped.
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
            except BaseException as error:  # noqa: BLE001 - raised again below
                errors.append(error)

    helpers = [threading.Thread(target=loop, daemon=True) for _ in range(threads - 1)]
    for helper in helpers:
        helper.start()
    loop()
    for helper in helpers:
        helper.join()
    if errors:
        raise errors[0]
