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

        Raises
        ------
        RecordingError
            If it is absent, unreadable, empty, or not a regular file.
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


MIB = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that a reader keeps, whatever sizes a file claims.

    The limits on work grow with the file size, because data of a plant are
    compressed about ten times at most. ``work_floor_bytes + work_per_byte * size``
    bytes may be decompressed in total, and ``failed_floor_bytes + failed_per_byte *
    size`` bytes without a usable result.
    """

    record_bytes: int = 64 * MIB
    chunk_bytes: int = 32 * MIB
    channels: int = 1024
    definition_bytes: int = 4 * MIB
    attachment_bytes: int = 64 * MIB
    work_floor_bytes: int = 32 * MIB
    work_per_byte: int = 64
    failed_floor_bytes: int = 128 * MIB
    failed_per_byte: int = 2


DEFAULT_LIMITS = Limits()


class OverBudgetError(Exception):
    """A file needs more work than its size justifies; caught within the package."""


class Budget:
    """Counts the bytes that the reader processes for a file."""

    __slots__ = ('failed_left', 'left')

    def __init__(self, file_bytes: int, limits: Limits = DEFAULT_LIMITS) -> None:
        self.left = limits.work_floor_bytes + limits.work_per_byte * file_bytes
        self.failed_left = limits.failed_floor_bytes + limits.failed_per_byte * file_bytes

    def spend(self, size: int) -> None:
        """Count work before it is done; raises `OverBudgetError` beyond the limit."""
        self.left -= size
        if self.left < 0:
            raise OverBudgetError

    def spend_in_vain(self, size: int) -> None:
        """Count work without a usable result; raises `OverBudgetError` beyond the limit."""
        self.failed_left -= size
        if self.failed_left < 0:
            raise OverBudgetError
