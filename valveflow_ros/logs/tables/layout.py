"""Finds header, units, separator, decimal mark and encoding of a table that is text."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from dataclasses import dataclass

from valveflow_ros.logs.tables.words import is_unit, split_unit

_SEPARATORS = (';', '\t', '|', ',')
_LOOK = 60  # rows from which the shape of a table is seen
_MARKS = ((codecs.BOM_UTF8, 'utf-8-sig'), (codecs.BOM_UTF16_LE, 'utf-16'),
          (codecs.BOM_UTF16_BE, 'utf-16'))  # fmt: skip
_NUMBER = re.compile(r"[+-]?(?:\d[\d.,'’ \u00a0\u202f]*|[.,]\d+)(?:[eE][+-]?\d+)?")
_STAMP = re.compile(
    r'\d{1,4}[-./]\d{1,2}[-./]\d{1,4}(?:[T ].*)?|\d{1,2}[-. ][^\W\d]{3,9}[-. ]\d{2,4}.*|'
    r'\d{1,2}:\d{2}(?::\d{2}.*)?'
)
_COMMA = re.compile(r'[+-]?\d+,\d+(?:[eE][+-]?\d+)?')
_POINT = re.compile(r'[+-]?\d+\.\d+(?:[eE][+-]?\d+)?')
_GROUPED_BY_COMMA = re.compile(r'[+-]?\d{1,3}(?:,\d{3})+')
_GROUPED_BY_POINT = re.compile(r'[+-]?\d{1,3}(?:\.\d{3})+')
_BOTH_US = re.compile(r'[+-]?\d{1,3}(?:,\d{3})+\.\d+')
_BOTH_EU = re.compile(r'[+-]?\d{1,3}(?:\.\d{3})+,\d+')


@dataclass(frozen=True, slots=True)
class Heading:
    """The rows above the data.

    Attributes
    ----------
    row : int
        Row of the names, counted from 0.
    others : tuple of int
        Rows between the names and the first row of data: units, descriptions.
    names, units, about : tuple of str
        One a column, empty where nothing stands; the names as they stand in the file.
    """

    row: int
    others: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    about: tuple[str, ...]


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


def heading(rows: list[list[str]]) -> Heading:
    """Find the names of the columns among the first rows of a table.

    A preamble above them is left out; rows of units and descriptions below
    them are told apart.
    """
    usual = Counter(_full_cells(row) for row in rows if _full_cells(row) > 1)
    least = 0.5 * max(usual, key=lambda size: (usual[size], size), default=0)
    first = next((k for k, row in enumerate(rows) if _is_data(row, least)), None)
    filled = [k for k, row in enumerate(rows) if any(cell.strip() for cell in row)]
    if first is None:
        at = _first_full(rows, filled) if filled else 0
        return _heading(rows, at, ())
    width = len(rows[first])
    above = [k for k in filled if k < first]
    # Only rows right above the data and as wide as they belong to the heading.
    block: list[int] = []
    for k in reversed(above):
        if _full_cells(rows[k]) < 2 or len(rows[k]) < 0.6 * width:
            break
        block.insert(0, k)
    if not block:
        return _heading(rows, above[-1] if above else filled[0], ())
    named = [k for k in block if not _are_units(rows[k])] or block
    most = max(_full_cells(rows[k]) for k in named)
    at = next(k for k in named if _full_cells(rows[k]) >= 0.8 * most)
    return _heading(rows, at, tuple(k for k in block if k > at))


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


def _is_data(row: list[str], least: float) -> bool:
    cells = [cell.strip() for cell in row if cell.strip()]
    if len(cells) < least:
        return False
    values = [cell for cell in cells if _NUMBER.fullmatch(cell) or _STAMP.fullmatch(cell)]
    stamped = any(_STAMP.fullmatch(cell) for cell in cells[:3])
    # A row of a long table has more words than values: tag, time, value, unit, description.
    return len(row) > 1 and bool(values) and (2 * len(values) >= len(cells) or stamped)


def _are_units(row: list[str]) -> bool:
    cells = [cell for cell in row if cell.strip()]
    units = sum(is_unit(cell) for cell in cells)
    return units >= 1 and units >= len(cells) - 1


def _full_cells(row: list[str]) -> int:
    return sum(bool(cell.strip()) for cell in row)


def _first_full(rows: list[list[str]], filled: list[int]) -> int:
    wide = max(_full_cells(rows[k]) for k in filled[:_LOOK])
    return next(k for k in filled if _full_cells(rows[k]) >= min(2, wide))


def _heading(rows: list[list[str]], at: int, others: tuple[int, ...]) -> Heading:
    names = [cell.strip() for cell in rows[at]] if rows else []
    units = [split_unit(name)[1] for name in names]
    about = [''] * len(names)
    for k in others:
        of_units = _are_units(rows[k])
        for column, cell in enumerate(rows[k][: len(names)]):
            if of_units and is_unit(cell):
                units[column] = units[column] or cell.strip()
            elif not of_units and cell.strip():
                about[column] = f'{about[column]} {cell.strip()}'.strip()
    return Heading(at, others, tuple(names), tuple(units), tuple(about))
