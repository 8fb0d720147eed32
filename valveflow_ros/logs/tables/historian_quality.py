"""Reads a historian's column of quality, in words or in the codes of OPC."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from valveflow_ros.logs.tables.historian_units import split_unit
from valveflow_ros.logs.tables.historian_words import folded
from valveflow_ros.records import ByteArray, Quality

if TYPE_CHECKING:
    import pandas as pd

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
    """Return the place of the column that holds the quality of the column ``name``."""
    own = folded(split_unit(name)[0])
    for place, other in enumerate(names):
        text = folded(other)
        for ending in _ENDINGS:
            if text in (f'{own} {ending}', f'{ending} {own}', f'{own}{ending}'):
                return place
    return None


def quality_columns(names: tuple[str, ...]) -> set[int]:
    """Return the places of all columns that are the quality of another."""
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
    """Tell whether these cells are words or OPC codes of quality.

    Bare 0, 1, 2 are not: one historian's 0 is good, another's is bad.
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
    """Return a `Quality` per cell; what is not understood is bad, as in our own tables."""
    import pandas as pd

    codes, kinds = pd.factorize(column.astype('string').str.strip())
    known = [_quality(kind) for kind in kinds.tolist()]
    qualities: ByteArray = np.array([*known, int(Quality.BAD)], dtype=np.uint8)[codes]
    return qualities


def _word(text: str) -> Quality | None:
    """Return the gravest quality that a text tells: 'Raw, Bad' is bad, and so is 'Not Good'."""
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
            # What is not good is bad; what is not anything else ('no error') says nothing.
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
