"""What an object that follows a stream remembers, as plain values.

``snapshot()`` gives numbers, texts, lists, dicts and arrays that no longer change; ``restore()``
puts them into a fresh object made with the same settings, which then goes on bit for bit as the
first one would have. What does not fit is refused, since a state half believed is worse than none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import DataError

State = dict[str, Any]


class Continuing(Protocol):
    """Something that can be taken up where it was left."""

    def snapshot(self) -> State:
        """Return what is remembered."""

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""


class ArrayMemory:
    """Remembers in arrays that it changes in place, and in nothing else."""

    def _memory(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays by names."""
        return {}

    def snapshot(self) -> State:
        """Return what is remembered."""
        return copies(self._memory())

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""
        put_back(self._memory(), saved)


def copies(arrays: Mapping[str, NDArray[Any]]) -> State:
    """Return copies of arrays under their names."""
    return {name: array.copy() for name, array in arrays.items()}


def put_back(arrays: Mapping[str, NDArray[Any]], saved: State) -> None:
    """Overwrite arrays with the saved ones of the same names.

    Raises
    ------
    DataError
        One is missing, or of another type or shape.
    """
    for name, array in arrays.items():
        given = saved.get(name)
        if not isinstance(given, np.ndarray):
            raise DataError(f"The saved state lacks '{name}'.")
        if given.dtype != array.dtype or given.shape != array.shape:
            raise DataError(
                f"The saved state has '{name}' as {given.dtype} {given.shape}, "
                f'{array.dtype} {array.shape} is wanted.'
            )
    for name, array in arrays.items():
        np.copyto(array, saved[name])
