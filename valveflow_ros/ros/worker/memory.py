"""Give memory that is free back to the system."""

from __future__ import annotations

import ctypes


def give_back() -> None:
    """Return what the C library keeps of freed memory, where it can (glibc); takes milliseconds.

    A snapshot of a window of days for a fit is 40 MB, and what it leaves in the heap when it is
    freed is otherwise held for good.
    """
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)
