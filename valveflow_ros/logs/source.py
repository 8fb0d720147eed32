"""Opens a file for reading without being caught by what is not a file."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from valveflow_ros.errors import RecordingError

BUFFER_BYTES = 1 << 20


def os_problem(error: OSError) -> str:
    """Return what the operating system said, as the end of a sentence."""
    reason = (error.strerror or str(error)).lower()
    return f'cannot be opened ({reason})'


def printable(name: str) -> str:
    """Return a file's name as it may stand in a sentence: a line break would end that."""
    return ''.join(letter if letter.isprintable() else '?' for letter in name)


@dataclass(slots=True)
class Source:
    """A regular file and the size it had when it was opened."""

    path: str
    stream: BinaryIO
    size: int

    @classmethod
    def open(cls, path: str | Path) -> Source:
        """Open a regular file.

        Raises
        ------
        RecordingError
            If it is absent, unreadable, empty, or not a regular file. A FIFO
            or a device is never waited for.
        """
        name = str(path)
        try:
            descriptor = os.open(name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise RecordingError(printable(name), os_problem(error)) from None
        except ValueError:
            raise RecordingError(printable(name), 'is not a name of a file') from None
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_size == 0:
            os.close(descriptor)
            regular = stat.S_ISREG(status.st_mode)
            raise RecordingError(name, 'is empty' if regular else 'is not a regular file')
        stream = os.fdopen(descriptor, 'rb', buffering=BUFFER_BYTES)
        return cls(name, stream, status.st_size)

    def read(self, position: int, size: int) -> bytes:
        """Return up to ``size`` bytes; fewer at the end of the file.

        Raises
        ------
        RecordingError
            If the device fails.
        """
        if position >= self.size:
            return b''
        try:
            self.stream.seek(position)
            return self.stream.read(min(size, self.size - position))
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            problem = f'cannot be read at byte {position} ({reason})'
            raise RecordingError(self.path, problem) from None

    def close(self) -> None:
        """Close the file."""
        self.stream.close()

    def __enter__(self) -> Source:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file."""
        self.close()
