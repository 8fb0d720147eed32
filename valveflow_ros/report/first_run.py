# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check whether the engine must be compiled first, which is done once; use two cores for it."""

from __future__ import annotations

import atexit
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from valveflow_ros.numerics import cores

SENTENCE = 'The program is now compiled for this machine, once. This takes about half a minute.'
_FOLDERS = ('numerics', 'signals', 'segments', 'partition', 'curve', 'fit', 'monitoring')
_ENGINE = tuple(f'valveflow_ros.{name}' for name in _FOLDERS)
# Some functions are compiled only as part of others, or for tests.
_FEW = 0.05


def is_first_run() -> bool:
    """Return True if most of the engine is not in numba's cache for this machine and version.

    Return False if there are no compiled functions or if their state is unknown.
    """
    from valveflow_ros.monitoring import monitor  # noqa: F401 - what is asked about must be loaded

    return _cold_share() > 0.5


def compile_beside() -> None:
    """Start a process that compiles what is needed last while this one compiles the rest.

    Numba compiles on one core only. The process ends with this one at the latest.
    """
    if cores() < 2 or not sys.executable:
        return
    command = sys.executable, '-c', f'from {__name__} import compile_late; compile_late()'
    nowhere = subprocess.DEVNULL
    with suppress(OSError):
        beside = subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere)
        atexit.register(beside.kill)


def compile_late() -> None:
    """Compile the search of the partition and the loops of the joint fit into numba's cache."""
    from valveflow_ros.curve.regional_model import RegionalModel
    from valveflow_ros.fit.problem import Problem, Samples
    from valveflow_ros.partition.search import compile_search

    compile_search()
    u, usable = np.linspace(1000.0, 2000.0, 64), np.ones(64, dtype=np.uint8)
    problem = Problem(Samples(u, 0.1 * u, usable, step_s=1.0, settle_s=0.0, group=2))
    model = RegionalModel(
        knots=np.array([1000.0, 2000.0]), left=np.array([100.0]), right=np.array([200.0]),
        levels=np.array([150.0]), time_constants=np.full(2, 10.0), delays=np.zeros(2),
    )  # fmt: skip
    ar = np.zeros(4)
    problem.normal(model, ar)
    problem.cost(model, ar)


def must_compile_to_fit() -> bool:
    """Return True if more than a few functions have to be compiled for a fit."""
    from valveflow_ros.fit import fit  # noqa: F401 - what is asked about must be loaded
    from valveflow_ros.monitoring import monitor  # noqa: F401

    return _cold_share() > _FEW


def _cold_share() -> float:
    known = [cold for dispatcher in _compiled() if (cold := _is_cold(dispatcher)) is not None]
    return sum(known) / len(known) if known else 0.0


def _compiled() -> Iterator[Any]:
    for name, module in list(sys.modules.items()):
        if name.startswith(_ENGINE):
            yield from (
                found
                for found in vars(module).values()
                if hasattr(found, 'py_func') and getattr(found, '__module__', '') == name
            )


def _is_cold(dispatcher: Any) -> bool | None:
    """Return True if a function is not in the cache; None if unknown."""
    if dispatcher.signatures:
        return False
    # numba's public interface gives only the folder, which may contain other code.
    file = getattr(getattr(dispatcher, '_cache', None), '_cache_file', None)
    index = getattr(file, '_load_index', None)
    if index is None:
        return None
    try:
        return not index()
    except Exception:  # noqa: BLE001 - numba raises what its pickles raise
        return None
