# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts the cells of a table to numbers, and counts the texts that are no numbers."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from valveflow_ros.logs.tables.words import folded, split_unit
from valveflow_ros.records import ByteArray, FloatArray, Quality

if TYPE_CHECKING:
    import pandas as pd


QUALITY_SUFFIX = '_quality'
_WORD_LENGTH = 40
# Maximum number of different words to count, since a column may hold free text.
_MOST_WORDS = 200


@dataclass(frozen=True, slots=True)
class Marks:
    """Decimal and thousands mark of the numbers in a table."""

    decimal: str = '.'
    thousands: str = ''


@dataclass(frozen=True, slots=True)
class Column:
    """Numbers of a column, NaN for other cells, and counts of the other cells.

    ``words`` counts the texts that are no numbers, ``empty`` the cells that are empty or hold a
    word for it such as 'n/a'. ``first_bad_row`` is the row of the first text, -1 if none.
    """

    values: FloatArray
    words: Counter[str] = field(default_factory=Counter)
    empty: int = 0
    first_bad_row: int = -1

    @property
    def bad(self) -> int:
        """Return the number of cells with a text that is no number."""
        return self.words.total()


def to_numbers(column: pd.Series[Any], marks: Marks = Marks()) -> Column:
    """Return the float64 values of cells in file order; NaN for cells without a number."""
    import pandas as pd

    kind = column.dtype.kind
    if kind in 'iufb' and not hasattr(column.dtype, 'na_value'):
        values = column.to_numpy(dtype=np.float64)
        return Column(values, empty=int(np.isnan(values).sum()))
    if kind in 'MO' or marks.thousands == '.':
        text = column.astype(str) if kind == 'M' else column
        return _finish(np.full(len(column), np.nan), text, marks)
    numbers = pd.to_numeric(column, errors='coerce')
    values = numbers.to_numpy(dtype=np.float64, na_value=np.nan, copy=True)
    return _finish(values, column, marks)


def _finish(values: FloatArray, text: pd.Series[Any], marks: Marks) -> Column:
    """Convert the remaining cells; each different text is converted once."""
    import pandas as pd

    left = np.flatnonzero(np.isnan(values))
    if not len(left):
        return Column(values)
    codes, kinds = pd.factorize(text.iloc[left].astype('string').str.strip())
    kinds = kinds.tolist()
    numbers = np.array([_number(kind, marks) for kind in kinds] + [np.nan])
    values[left] = numbers[codes]
    counts = np.bincount(codes[codes >= 0], minlength=len(kinds))
    words: Counter[str] = Counter()
    empty, first = int((codes < 0).sum()), -1
    for k, kind in enumerate(kinds):
        if not np.isnan(numbers[k]):
            continue
        if kind.lower() in _EMPTY:
            empty += int(counts[k])
            continue
        row = int(left[int((codes == k).argmax())]) if len(words) < _MOST_WORDS else first
        first = row if first < 0 else min(first, row)
        words[kind[:_WORD_LENGTH] if len(words) < _MOST_WORDS else '...'] += int(counts[k])
    return Column(values, words, empty, first)


def _number(text: str, marks: Marks) -> float:
    """Return the number in a text; NaN if it is no number."""
    plain = text
    for mark in _PARTING:
        if mark in plain and _is_grouped(plain.replace(marks.decimal, '.'), mark):
            plain = plain.replace(mark, '')
    if marks.thousands and marks.thousands in plain:
        head, _, tail = plain.partition(marks.decimal)
        if _is_grouped(head, marks.thousands) and marks.thousands not in tail:
            plain = plain.replace(marks.thousands, '')
    if marks.decimal == ',':
        plain = plain.replace(',', '.')
    try:
        return np.nan if '_' in plain or not plain.isascii() else float(plain)
    except ValueError:
        return np.nan


def _is_grouped(text: str, mark: str) -> bool:
    """Return True if a mark separates groups of three digits."""
    whole = text.lstrip('+-')
    head, *groups = (whole if mark == '.' else whole.partition('.')[0]).split(mark)
    digits = 1 <= len(head) <= 3 and head.isdecimal()
    return digits and bool(groups) and all(len(g) == 3 and g.isdecimal() for g in groups)


def to_quality(column: pd.Series[Any]) -> ByteArray:
    """Return a `Quality` per cell; an empty or unknown code is bad."""
    import pandas as pd

    codes = pd.to_numeric(column, errors='coerce').to_numpy(dtype=np.float64, na_value=np.nan)
    known = np.isin(codes, [int(quality) for quality in Quality])
    return np.where(known, codes, float(Quality.BAD)).astype(np.uint8)


_PARTING = ("'", '’', ' ', '\u00a0', '\u202f')
_EMPTY = frozenset({'', 'nan', 'na', 'n/a', '#n/a', 'null', 'none', '-', '--'})


_ENDINGS = ('quality', 'qualitaet', 'status', 'qual', 'q', 'quality code', 'guete', 'st')
_WORDS = {
    Quality.GOOD: 'good gut ok valid gueltig annotated normal raw interpolated',
    Quality.UNCERTAIN: 'uncertain questionable substituted doubtful suspect unsicher ersatzwert '
    'manual hand estimated',
    Quality.BAD: 'bad schlecht invalid ungueltig fault failed error stoerung timeout',
}
_BY_WORD = {word: quality for quality, words in _WORDS.items() for word in words.split()}
_PRAISE = frozenset(['good', 'gut', 'ok', 'valid', 'gueltig', 'normal'])
_NOT = frozenset(['not', 'no', 'nicht', 'kein', 'keine', 'keinen'])
_CLAUSES = re.compile(r'[,;:|/()\[\]]+')
# OPC: the two upper bits of the low byte, 11 good, 01 uncertain, 00 bad.
_OPC_GOOD, _OPC_UNCERTAIN = 192, 64


def quality_column(name: str, names: tuple[str, ...]) -> int | None:
    """Return the index of the quality column of the column ``name``; None if there is none."""
    own = folded(split_unit(name)[0])
    wanted = {text for e in _ENDINGS for text in (f'{own} {e}', f'{e} {own}', f'{own}{e}')}
    return next((place for place, other in enumerate(names) if folded(other) in wanted), None)


def quality_columns(names: tuple[str, ...]) -> set[int]:
    """Return the indices of all columns that hold the quality of another column."""
    bare = {folded(split_unit(name)[0]) for name in names} - {''}
    found = set()
    for place, name in enumerate(names):
        text = folded(name)
        for ending in _ENDINGS:
            own = text.removesuffix(ending) if text != ending else text
            own = own.strip() if own != text else text.removeprefix(f'{ending} ')
            if own != text and own in bare:
                found.add(place)
    return found


def understands(cells: list[str]) -> bool:
    """Return True if these cells are quality words or OPC quality codes.

    Codes 0, 1, 2 alone are not accepted: 0 is good in one historian and bad in another.
    """
    text = [cell.strip() for cell in cells if cell.strip()]
    if not text:
        return False
    known = sum(_word(cell) is not None for cell in text)
    if 2 * known >= len(text):
        return True
    codes = [int(cell) for cell in text if cell.isdecimal()]
    return len(codes) == len(text) and max(codes) >= _OPC_GOOD and max(codes) < 256


def foreign_quality(column: pd.Series[Any]) -> ByteArray:
    """Return a `Quality` per cell; an unknown text or code is bad, as in `to_quality`."""
    import pandas as pd

    codes, kinds = pd.factorize(column.astype('string').str.strip())
    known = [_quality(kind) for kind in kinds.tolist()]
    qualities: ByteArray = np.array([*known, int(Quality.BAD)], dtype=np.uint8)[codes]
    return qualities


def _word(text: str) -> Quality | None:
    """Return the worst quality in a text ('Raw, Bad' and 'Not Good' are bad), None if unknown."""
    found = [quality for clause in _CLAUSES.split(text) for quality in _told(folded(clause))]
    return max(found, default=None)


def _told(clause: str) -> Iterator[Quality]:
    denied = False
    for word in clause.split():
        if word in _NOT:
            denied = True
        elif not denied and word in _BY_WORD:
            yield _BY_WORD[word]
        elif word in _PRAISE:
            # 'Not good' is bad; the negation of another word ('no error') is ignored.
            yield Quality.BAD


def _quality(text: str) -> int:
    word = _word(text)
    if word is not None:
        return int(word)
    try:
        code = int(float(text))
    except (ValueError, OverflowError):
        return int(Quality.BAD)
    if code >= _OPC_GOOD:
        return int(Quality.GOOD)
    return int(Quality.UNCERTAIN if code >= _OPC_UNCERTAIN else Quality.BAD)
