"""Small files that a parameter names: read whole, or refused for what they are."""

from __future__ import annotations

import os
import stat
from pathlib import Path

_MOST_BYTES = 10_000_000


def given_path(name: str) -> str:
    """Return the path a parameter names; raises `ValueError` if its `~` means nobody."""
    try:
        return str(Path(name).expanduser())
    except RuntimeError:
        raise ValueError(f"'{name.partition('/')[0]}' is nobody's home") from None


def read_given(path: str, what: str) -> str:
    """Return the text of a file.

    Neither a device, which may have no end, nor a pipe, which may never begin, is read.

    Parameters
    ----------
    path : str
    what : str
        What it should be, for the sentence.

    Raises
    ------
    OSError
        It cannot be read.
    ValueError
        It is no file, no text, or too large.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, 'rb') as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError('it is no file')
        # It may still grow, so its size is not asked for.
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise ValueError(f'it is too large to be {what}')
    return content.decode()
