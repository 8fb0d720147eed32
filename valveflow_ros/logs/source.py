# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Opens regular files for reading, and refuses FIFOs, devices and folders."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from valveflow_ros.errors import RecordingError

BUFFER_BYTES = 1 << 20


@contextmanager
def os_errors(path: object, problem: str) -> Iterator[None]:
    """Turn an `OSError` into a `RecordingError` with the problem and the system's reason."""
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(path, f'{problem} ({reason})') from None


def printable(name: str) -> str:
    """Return a file's name with ``?`` for what cannot be printed, such as a line break."""
    return ''.join(letter if letter.isprintable() else '?' for letter in name)


@dataclass
class Source(AbstractContextManager['Source']):
    """A regular file and the size it had when it was opened."""

    path: str
    stream: BinaryIO
    size: int

    @classmethod
    def open(cls, path: str | Path) -> Source:
        """Open a regular file, without blocking on a FIFO or a device.

        Raises `RecordingError` if it is absent, unreadable, empty, or not a regular file.
        """
        name = str(path)
        try:
            with os_errors(printable(name), 'cannot be opened'):
                descriptor = os.open(name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except ValueError:
            raise RecordingError(printable(name), 'is not a name of a file') from None
        status = os.fstat(descriptor)
        regular = stat.S_ISREG(status.st_mode)
        if not regular or status.st_size == 0:
            os.close(descriptor)
            raise RecordingError(name, 'is empty' if regular else 'is not a regular file')
        stream = os.fdopen(descriptor, 'rb', buffering=BUFFER_BYTES)
        return cls(name, stream, status.st_size)

    def read(self, position: int, size: int) -> bytes:
        """Return up to ``size`` bytes; raises `RecordingError` if the device fails."""
        if position >= self.size:
            return b''
        with os_errors(self.path, f'cannot be read at byte {position}'):
            self.stream.seek(position)
            return self.stream.read(min(size, self.size - position))

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.stream.close()


# Limits that a reader keeps, whatever sizes a file claims.
MIB = 1 << 20
RECORD_BYTES = ATTACHMENT_BYTES = 64 * MIB
CHUNK_CONTENT_BYTES = 32 * MIB
DEFINITION_BYTES = 4 * MIB
MOST_TOPICS = 1024
# The limits on work are so much, and more for each byte of the file, because data of a plant are
# compressed about ten times at most: what is decompressed in total, and without a usable result.
_WORK_BYTES = (32 * MIB, 64)
_FAILED_BYTES = (128 * MIB, 2)


class OverBudgetError(Exception):
    """A file needs more work than its size justifies; caught within the package."""


class Budget:
    """Counts the bytes that the reader processes for a file."""

    __slots__ = ('failed_left', 'left')

    def __init__(self, file_bytes: int) -> None:
        self.left = _WORK_BYTES[0] + _WORK_BYTES[1] * file_bytes
        self.failed_left = _FAILED_BYTES[0] + _FAILED_BYTES[1] * file_bytes

    def spend(self, size: int, in_vain: bool = False) -> None:
        """Count work before it is done, or work without a usable result.

        Raises `OverBudgetError` beyond the limit.
        """
        if in_vain:
            self.failed_left -= size
        else:
            self.left -= size
        if min(self.left, self.failed_left) < 0:
            raise OverBudgetError
