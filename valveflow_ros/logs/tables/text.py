# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The text of a table: encoding, separator and decimal mark, and lines that cannot fill memory."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections import Counter
from pathlib import Path
from typing import BinaryIO

from valveflow_ros.errors import RecordingError

_SEPARATORS = (';', '\t', '|', ',')
_MARKS = ((codecs.BOM_UTF8, 'utf-8-sig'), (codecs.BOM_UTF16_LE, 'utf-16'),
          (codecs.BOM_UTF16_BE, 'utf-16'))  # fmt: skip
_COMMA = re.compile(r'[+-]?\d+,\d+(?:[eE][+-]?\d+)?')
_POINT = re.compile(r'[+-]?\d+\.\d+(?:[eE][+-]?\d+)?')
_GROUPED_BY_COMMA = re.compile(r'[+-]?\d{1,3}(?:,\d{3})+')
_BOTH_US = re.compile(r'[+-]?\d{1,3}(?:,\d{3})+\.\d+')
_BOTH_EU = re.compile(r'[+-]?\d{1,3}(?:\.\d{3})+,\d+')


def encoding_of(head: bytes) -> str | None:
    """Return the encoding of a text by its first bytes, ``None`` if it is no text."""
    for mark, name in _MARKS:
        if head.startswith(mark):
            return name
    even, odd = head[0::2], head[1::2]
    if b'\0' in head:
        for name, zeros, letters in (('utf-16-le', odd, even), ('utf-16-be', even, odd)):
            if zeros.count(0) > 0.7 * len(zeros) and letters.count(0) == 0:
                return name
        return None
    # The head may end within a letter.
    decoder = codecs.getincrementaldecoder('utf-8')()
    try:
        decoder.decode(head)
    except UnicodeDecodeError:
        return 'cp1252'
    return 'utf-8-sig'


def separator_of(lines: list[str]) -> str:
    """Return what parts the cells of these lines.

    The separator is the one by which most lines fall into the same number of
    cells. A comma comes last: it may be part of the numbers.
    """
    best, score = ',', 0.0
    for mark in _SEPARATORS:
        # Line by line: a quote that is not closed would make one of all that follow.
        sizes = Counter(size for line in lines if (size := len(cells_of(line, mark))))
        size, count = max(sizes.items(), key=lambda item: (item[1], item[0]), default=(1, 0))
        share = count / max(1, sum(sizes.values()))
        if size > 1 and share > 1.2 * score:
            best, score = mark, share
    return best


def cells_of(line: str, separator: str) -> list[str]:
    """Return the cells of a line; all of it is one where it cannot be parted."""
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return [line]


def decimal_mark(cells: list[str], separator: str) -> tuple[str, str] | None:
    """Return the decimal and the thousands mark that cells of numbers show.

    Returns
    -------
    tuple of str or None
        ``None`` if a comma may be either: ``230,145`` and nothing that decides.
    """
    text = [cell.strip() for cell in cells]
    if any(_BOTH_US.fullmatch(cell) for cell in text):
        return '.', ','
    if any(_BOTH_EU.fullmatch(cell) for cell in text):
        return ',', '.'
    commas = [cell for cell in text if _COMMA.fullmatch(cell)]
    grouped = sum(bool(_GROUPED_BY_COMMA.fullmatch(cell)) for cell in text)
    points = any(_POINT.fullmatch(cell) for cell in text)
    if any(not _GROUPED_BY_COMMA.fullmatch(cell) for cell in commas):
        # In a table of semicolons some tools write the one mark, some the other.
        return ',', ('' if points else '.')
    if not grouped:
        return '.', ''
    if separator == ';':
        return ',', ''
    return ('.', ',') if points else None


# What a cell of Excel holds at most, in letters and in line breaks; a comment has far fewer.
LONGEST_CELL = 32_767
_MOST_BREAKS = 253


class Quotes:
    """Follows a text that passes by in pieces, of the file ``path``, its cells parted as told.

    A quote opens a cell only where the cell begins, and a doubled one within it stands for itself:
    so do pandas and most programs that write tables.
    """

    def __init__(self, path: Path, separator: str) -> None:
        self._path = path
        ends = f'{re.escape(separator)}\r\n'
        # Group 1: from a quote on that is not closed in what has passed.
        self._cell = re.compile(
            rf'(?:\A|[{ends}]) *"(?:[^"]*(?:""[^"]*)*"(?!")|(.*\Z))', re.DOTALL
        )
        # A cell that is closed in its own line: nearly all are, and this is quick.
        self._closed = re.compile(rf'(?:\A|(?<=[{ends}])) *"[^"\r\n]*(?:""[^"\r\n]*)*"(?!")')
        self._rest = ''
        self._line = 1  # of the first letter of the rest

    def follow(self, text: str) -> None:
        """Look at the next piece.

        Raises
        ------
        RecordingError
            If a cell in quotes is longer than any cell is.
        """
        text = self._rest + text
        end = _last_line(text, [])
        lines, rest = text[:end], text[end:]
        long = len(rest) > LONGEST_CELL and '"' in rest
        if long or ('"' in lines and '"' in self._closed.sub('', lines)):
            end = self._looked_at(text)
        self._line += _breaks(text[:end])
        self._rest = text[end:]

    def _looked_at(self, text: str) -> int:
        """Judge cell by cell; return where the last line begins."""
        begun, cells = len(text), []
        for cell in self._cell.finditer(text):
            opened = cell.start() + cell[0].index('"')
            self._judge(text, opened, cell.end())
            # A quote that ends the piece may be the first of two.
            if cell.start(1) >= 0 or cell.end() == len(text):
                begun = opened
            else:
                cells.append((opened, cell.end()))
        # What is kept begins with a line, so that it is known where its cells begin.
        return _last_line(text[:begun], cells)

    def _judge(self, text: str, opened: int, end: int) -> None:
        breaks = _breaks(text[opened:end]) if end - opened > _MOST_BREAKS else 0
        if end - opened <= LONGEST_CELL and breaks <= _MOST_BREAKS:
            return
        line = self._line + _breaks(text[:opened])
        raise RecordingError(
            self._path,
            f'has in line {line} a quote that is not closed within {LONGEST_CELL} letters or '
            f'{_MOST_BREAKS} lines, as the text of a cell would be; close it there, or take it '
            'away',
        )


def _breaks(text: str) -> int:
    """Return how many lines end in a text; what is left of Windows' two letters counts once."""
    return text.count('\n') or text.count('\r')


def _last_line(text: str, cells: list[tuple[int, int]]) -> int:
    """Return where the last line of a text begins; breaks within cells begin none."""
    # The first of Windows' two letters waits for the second.
    end = len(text) - text.endswith('\r')
    for opened, closed in [*reversed(cells), (0, 0)]:
        found = max(text.rfind('\n', closed, end), text.rfind('\r', closed, end)) + 1
        if found:
            return found
        end = opened
    return 0


LONGEST_LINE = 1 << 20
_PIECE = 1 << 18


class Lines(io.TextIOWrapper):
    """A text that is read in pieces, none of whose lines and cells is without end.

    ``path`` is for sentences; ``stream`` is closed with this; what does not fit the encoding is
    replaced.
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
