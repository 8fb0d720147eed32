# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check whether the engine must be compiled first, which is done once."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

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
