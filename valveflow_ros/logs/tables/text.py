# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Text tables: encoding, separator, decimal mark, and limits on the length of lines and cells."""

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
    """Return the encoding of a text from its first bytes; ``None`` if it is not a text."""
    for mark, name in _MARKS:
        if head.startswith(mark):
            return name
    even, odd = head[0::2], head[1::2]
    if b'\0' in head:
        for name, zeros, letters in (('utf-16-le', odd, even), ('utf-16-be', even, odd)):
            if zeros.count(0) > 0.7 * len(zeros) and letters.count(0) == 0:
                return name
        return None
    # The last character may be incomplete.
    decoder = codecs.getincrementaldecoder('utf-8')()
    try:
        decoder.decode(head)
    except UnicodeDecodeError:
        return 'cp1252'
    return 'utf-8-sig'


def separator_of(lines: list[str]) -> str:
    """Return the separator of the cells in these lines.

    It is the separator for which most lines have the same number of cells. The
    comma is tried last, because it may be part of the numbers.
    """
    best, score = ',', 0.0
    for mark in _SEPARATORS:
        # Each line is parsed alone, so that an open quote does not join the following lines.
        sizes = Counter(size for line in lines if (size := len(cells_of(line, mark))))
        size, count = max(sizes.items(), key=lambda item: (item[1], item[0]), default=(1, 0))
        share = count / max(1, sum(sizes.values()))
        if size > 1 and share > 1.2 * score:
            best, score = mark, share
    return best


def cells_of(line: str, separator: str) -> list[str]:
    """Return the cells of a line; the whole line is one cell if it cannot be parsed."""
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return [line]


def decimal_mark(cells: list[str], separator: str) -> tuple[str, str] | None:
    """Return the decimal and the thousands mark of the numbers in these cells.

    ``None`` if a comma may be either, as in ``230,145``, and no other cell decides.
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
        # With points in other cells, a point may be a decimal mark, too.
        return ',', ('' if points else '.')
    if not grouped:
        return '.', ''
    if separator == ';':
        return ',', ''
    return ('.', ',') if points else None


# Maximum number of characters and of line breaks in an Excel cell.
LONGEST_CELL = 32_767
_MOST_BREAKS = 253


class Quotes:
    """Checks the quotes in the text of the file ``path``, which is given in pieces.

    A quote opens a quoted cell only at the start of the cell, and a doubled quote within it is a
    literal quote, as in pandas and most programs that write tables.
    """

    def __init__(self, path: Path, separator: str) -> None:
        self._path = path
        ends = f'{re.escape(separator)}\r\n'
        # Group 1: the text after a quote that is not closed yet.
        self._cell = re.compile(
            rf'(?:\A|[{ends}]) *"(?:[^"]*(?:""[^"]*)*"(?!")|(.*\Z))', re.DOTALL
        )
        # A quoted cell within one line; this fast pattern matches nearly all of them.
        self._closed = re.compile(rf'(?:\A|(?<=[{ends}])) *"[^"\r\n]*(?:""[^"\r\n]*)*"(?!")')
        self._rest = ''
        self._line = 1  # line number at the start of the rest

    def follow(self, text: str) -> None:
        """Check the next piece; raises `RecordingError` if a quoted cell exceeds the limits."""
        text = self._rest + text
        end = _last_line(text, [])
        lines, rest = text[:end], text[end:]
        long = len(rest) > LONGEST_CELL and '"' in rest
        if long or ('"' in lines and '"' in self._closed.sub('', lines)):
            end = self._looked_at(text)
        self._line += _breaks(text[:end])
        self._rest = text[end:]

    def _looked_at(self, text: str) -> int:
        """Check each quoted cell; return where the last line begins."""
        begun, cells = len(text), []
        for cell in self._cell.finditer(text):
            opened = cell.start() + cell[0].index('"')
            self._judge(text, opened, cell.end())
            # A quote at the end of the piece may be the first of a doubled quote.
            if cell.start(1) >= 0 or cell.end() == len(text):
                begun = opened
            else:
                cells.append((opened, cell.end()))
        # The rest begins with a line, so that the start of its cells is known.
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
    """Return the number of line breaks in a text; CR LF counts once."""
    return text.count('\n') or text.count('\r')


def _last_line(text: str, cells: list[tuple[int, int]]) -> int:
    """Return where the last line of a text begins; line breaks within ``cells`` do not count."""
    # A CR at the end may be followed by an LF in the next piece.
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
    """A text stream that is read in pieces and limits the length of lines and quoted cells.

    ``path`` is for error messages. ``stream`` is closed together with this object. Bytes that are
    invalid in ``encoding`` are replaced.
    """

    def __init__(self, path: Path, stream: BinaryIO, encoding: str, separator: str) -> None:
        super().__init__(stream, encoding=encoding, errors='replace', newline='')
        self._path = path
        self._length = 0
        self._quotes = Quotes(path, separator)

    def read(self, size: int | None = -1, /) -> str:
        """Return at most ``size`` characters, and never more than one piece.

        Raises `RecordingError` if a line is longer than `LONGEST_LINE` characters, or a quote is
        not closed.
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
