"""The names of a table's columns, to say which of them were not used."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

_PARQUET = b'PAR1'
_SEPARATORS = ',;\t'


def unused_columns(path: Path, used: Iterable[str]) -> tuple[str, ...]:
    """Return the columns of a readable table that are not among ``used``, in the file's order.

    Parameters
    ----------
    used : iterable of str
        Names as they stand in the file. If one of them is not found the header
        was not understood, and nothing is said of it.
    """
    with path.open('rb') as file:
        parquet = file.read(4) == _PARQUET
    names = _parquet(path) if parquet else _csv(path)
    wanted = set(used)
    return tuple(n for n in names if n not in wanted) if wanted <= set(names) else ()


def _parquet(path: Path) -> list[str]:
    import pyarrow.parquet as pq

    return [str(name).strip() for name in pq.read_schema(path).names]


def _csv(path: Path) -> list[str]:
    with path.open(encoding='utf-8-sig', errors='replace', newline='') as file:
        line = file.readline()
    separator = max(_SEPARATORS, key=line.count)
    return [name.strip() for name in next(csv.reader([line], delimiter=separator), [])]
