"""Keeps the numbers of a long table on disk while its times decide their order."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import RecordingError
from valveflow_ros.records import IntArray

Array = NDArray[Any]


class Spool:
    """Columns in unnamed files, which vanish with the process.

    Parameters
    ----------
    folder : Path
        Where there is room for them: beside the log that is to be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, tuple[IO[bytes], np.dtype[Any]]] = {}

    def append(self, name: str, values: Array) -> None:
        """Add values to the end of a column.

        Raises
        ------
        RecordingError
            If the disk is full.
        """
        if name not in self._files:
            self._files[name] = (self._file(), values.dtype)
        file, dtype = self._files[name]
        with _said(self._folder):
            file.write(np.ascontiguousarray(values, dtype).data.cast('B'))

    def holds(self, name: str) -> bool:
        """Tell whether there is such a column."""
        return name in self._files

    def take(self, name: str, rows: slice | IntArray) -> Array:
        """Return some rows of a column: a stretch, or any rows in any order."""
        file, dtype = self._files[name]
        if isinstance(rows, slice):
            return self._stretch(file, dtype, rows.start, rows.stop)
        low, high = int(rows.min()), int(rows.max()) + 1
        if high - low <= 4 * len(rows):
            return self._stretch(file, dtype, low, high)[rows - low]
        file.flush()
        everything: Array = np.memmap(file, dtype, 'r')
        return np.array(everything[rows])

    def close(self) -> None:
        """Give the space back."""
        for file, _ in self._files.values():
            file.close()

    def _file(self) -> IO[bytes]:
        # It lives as long as this object; `close` ends it.
        with _said(self._folder):
            return tempfile.TemporaryFile(dir=self._folder)

    def _stretch(self, file: IO[bytes], dtype: np.dtype[Any], start: int, stop: int) -> Array:
        with _said(self._folder):
            file.seek(start * dtype.itemsize)
            raw = file.read((stop - start) * dtype.itemsize)
        return np.frombuffer(raw, dtype)


@contextmanager
def _said(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(folder, f'has no room for the work ({reason})') from None
