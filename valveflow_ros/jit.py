"""The one place where numba's flags are chosen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

# No fastmath: it lets NaN disappear and reorders the sums that tests compare.
JIT: dict[str, Any] = {'cache': True, 'nogil': True}

_Function = TypeVar('_Function', bound=Callable[..., Any])


def jit(function: _Function) -> _Function:
    """Compile a loop over arrays, keeping its type for the checker."""
    return cast(_Function, numba.njit(**JIT)(function))


# A division by zero gives inf or NaN here instead of an exception, whose test
# would keep a loop from being turned into SIMD instructions.
_KERNEL_JIT: dict[str, Any] = {**JIT, 'error_model': 'numpy'}


def kernel(function: _Function) -> _Function:
    """Compile a loop made for SIMD: like `jit`, with IEEE division."""
    return cast(_Function, numba.njit(**_KERNEL_JIT)(function))


# Not callable from Python, which saves compiling a wrapper for each.
_INLINED_JIT: dict[str, Any] = {
    **_KERNEL_JIT,
    'forceinline': True,
    'no_cpython_wrapper': True,
    'no_cfunc_wrapper': True,
}


def inlined(function: _Function) -> _Function:
    """Compile a part of a `kernel` into its caller.

    A call that hands over records of arrays costs more than a short loop does:
    every array is passed as seven numbers and its reference count goes up and down.
    """
    return cast(_Function, numba.njit(**_INLINED_JIT)(function))
