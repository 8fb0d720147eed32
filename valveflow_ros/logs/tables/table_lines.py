"""Gives the text of a table and refuses a line or a cell that would fill the memory."""

from __future__ import annotations

import io
from pathlib import Path
from typing import BinaryIO

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.tables.table_quotes import Quotes

LONGEST_LINE = 1 << 20
_PIECE = 1 << 18


class Lines(io.TextIOWrapper):
    """A text that is read in pieces, none of whose lines and cells is without end.

    Parameters
    ----------
    path : Path
        The file, for the sentence.
    stream : BinaryIO
        Its bytes; closed with this.
    encoding : str
        What does not fit it is replaced.
    separator : str
        What parts the cells.
    """

    def __init__(self, path: Path, stream: BinaryIO, encoding: str, separator: str) -> None:
        super().__init__(stream, encoding=encoding, errors='replace', newline='')
        self._path = path
        self._length = 0
        self._quotes = Quotes(path, separator)

    def read(self, size: int | None = -1, /) -> str:
        """Return up to so many letters; all in one piece is more than anybody asks for.

        Raises
        ------
        RecordingError
            If a line is longer than `LONGEST_LINE` letters, or a quote is not closed.
        """
        text = super().read(_PIECE if size is None or size < 0 else min(size, _PIECE))
        ends = [place for mark in '\n\r' if (place := text.find(mark)) >= 0]
        self._length += min(ends, default=len(text))
        if self._length > LONGEST_LINE:
            raise RecordingError(
                self._path, f'has a line of more than {LONGEST_LINE} letters; no table has'
            )
        if ends:
            self._length = len(text) - 1 - max(text.rfind('\n'), text.rfind('\r'))
        self._quotes.follow(text)
        return text
