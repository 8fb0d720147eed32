# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Opens a table file of any kind, finds its heading, and yields its rows block by block."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs.source import Source
from valveflow_ros.logs.tables.binary import (
    look_at_sheet,
    parquet_blocks,
    parquet_names,
    parquet_samples,
    sheet_blocks,
)
from valveflow_ros.logs.tables.cells import Marks
from valveflow_ros.logs.tables.refusal import AS_SEEN, TableOptions
from valveflow_ros.logs.tables.text import Lines, cells_of, decimal_mark, encoding_of, separator_of
from valveflow_ros.logs.tables.words import is_unit, split_unit

if TYPE_CHECKING:
    import pandas as pd

_LOOK = 60  # rows that determine the layout of a table
_NUMBER = re.compile(r"[+-]?(?:\d[\d.,'’ \u00a0\u202f]*|[.,]\d+)(?:[eE][+-]?\d+)?")
_STAMP = re.compile(
    r'\d{1,4}[-./]\d{1,2}[-./]\d{1,4}(?:[T ].*)?|\d{1,2}[-. ][^\W\d]{3,9}[-. ]\d{2,4}.*|'
    r'\d{1,2}:\d{2}(?::\d{2}.*)?'
)
BLOCK_ROWS = 200_000
_HEAD_BYTES = 256 * 1024
_HEAD_ROWS = 400
_PEEKS = 48  # positions in a long file from which rows are sampled
_PEEK_BYTES = 4096
BOOKS = ('.xlsx', '.xlsm')


@dataclass(frozen=True, slots=True)
class Heading:
    """The rows above the data.

    ``row`` is the row of the names, counted from 0. ``others`` are the rows between the names and
    the data, with units or descriptions. ``names``, ``units`` and ``about`` have one entry per
    column, empty if the cell is empty; names are not changed.
    """

    row: int
    others: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    about: tuple[str, ...]

    @property
    def below(self) -> int:
        """Return the first row of data."""
        return max((self.row, *self.others)) + 1


@dataclass
class TableFile:
    """A table whose layout is known and whose data are not read yet.

    ``rows`` are samples from its beginning, middle and end (``None`` if only the column names
    were read). ``marks`` is ``None`` if a comma may be the decimal or the thousands mark.
    ``notes`` are complete when all blocks were read. ``share`` is the fraction of a text file
    read so far, 0 to 1.
    """

    path: Path
    heading: Heading
    rows: list[list[str]] | None
    options: TableOptions
    marks: Marks | None = Marks()  # noqa: RUF009
    encoding: str = ''
    separator: str = ''
    skip: tuple[int, ...] = ()
    sheet: Any = None
    notes: list[str] = field(default_factory=list)
    share: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns in the file, unchanged."""
        return self.heading.names

    def samples(self, *places: int) -> list[tuple[str, ...]]:
        """Return the cells of these columns in some rows, without rows that are too short.

        Raises `RecordingError` if the file cannot be read.
        """
        if self.rows is None:
            with _translated(self.path):
                found = parquet_samples(self.path, places, self.options)
                return [tuple(map(str.strip, row)) for row in found]
        whole = [row for row in self.rows if max(places) < len(row)]
        return [tuple(row[k].strip() for k in places) for row in whole]

    def blocks(self, places: Sequence[int]) -> Iterator[pd.DataFrame]:
        """Yield the columns with these indices block by block, named by their index.

        Raises `RecordingError` if the file cannot be read, or has no rows.
        """
        wanted = sorted(set(places))
        if self.separator:
            frames = self._text_frames(wanted)
        elif self.sheet is not None:
            frames = sheet_blocks(self.sheet, self.heading.below, wanted)
        else:
            frames = parquet_blocks(self.path, wanted, self.options)
        with _translated(self.path):
            any_row = False
            for frame in frames:
                if len(frame):
                    any_row = True
                    frame.columns = wanted
                    yield frame
            if not any_row:
                raise RecordingError(self.path, 'is a table without rows')

    def _text_frames(self, places: list[int]) -> Iterator[pd.DataFrame]:
        import pandas as pd

        marks = self.marks or Marks()
        with Source.open(self.path) as source:
            with warnings.catch_warnings():
                # pandas 4 has only the exact parser and warns about this argument.
                warnings.simplefilter('ignore', DeprecationWarning)
                # The default parser does not always return the nearest double.
                frames = pd.read_csv(
                    Lines(self.path, source.stream, self.encoding, self.separator),
                    sep=self.separator, decimal=marks.decimal, header=0, skiprows=list(self.skip),
                    usecols=places, float_precision='round_trip', keep_default_na=False,
                    na_values=[''], skipinitialspace=True, index_col=False, low_memory=False,
                    chunksize=BLOCK_ROWS,
                )  # fmt: skip
            for frame in frames:
                self.share = min(1.0, source.stream.tell() / source.size)
                yield frame


def look_at(path: Path, options: TableOptions = AS_SEEN) -> TableFile:
    """Determine the kind of a table, its columns and the format of its numbers.

    Raises `RecordingError` if the file cannot be read as a table.
    """
    with Source.open(path) as source:
        head = source.read(0, _HEAD_BYTES)
        with _translated(path):
            if head[:4] == b'PAR1':
                names = parquet_names(path)
                blank = ('',) * len(names)
                units = heading([list(names)]).units
                return TableFile(path, Heading(0, (), names, units, blank), None, options)
            if path.suffix.lower() in BOOKS or head[:4] == b'PK\x03\x04':
                sheet, rows = look_at_sheet(path, options, _HEAD_ROWS)
                top = heading(rows)
                marks = _marks(rows[top.below :], '\t', options)
                return TableFile(path, top, rows[top.below :], options, marks, sheet=sheet)
            return _look_at_text(source, path, head, options)


def _look_at_text(source: Source, path: Path, head: bytes, options: TableOptions) -> TableFile:
    encoding = encoding_of(head)
    if encoding is None:
        raise RecordingError(path, 'is neither a CSV, an Excel nor a Parquet file')
    text = head.decode(encoding, errors='replace')
    lines = text.splitlines()
    if len(head) == _HEAD_BYTES:
        lines = lines[:-1] or lines
    lines = lines[:_HEAD_ROWS]
    told = lines[0].strip('\ufeff"\' ') if lines else ''
    separator = told[4:5] if told.lower().startswith('sep=') and len(told) == 5 else ''
    first = 1 if separator else 0
    separator = separator or separator_of([line for line in lines if line.strip()])
    rows = [[] if k < first else cells_of(line, separator) for k, line in enumerate(lines)]
    top = heading(rows)
    if not any(name for name in top.names):
        raise RecordingError(path, 'is a table without a header')
    data = [row for row in rows[top.below :] if any(cell.strip() for cell in row)]
    data += _peeks(source, encoding, separator, len(head))
    skip = (*range(top.row), *top.others)
    notes = []
    if any(cell.strip() for row in data for cell in row[len(top.names) :]):
        notes.append('Rows have more cells than the header; what stands beyond it was left out.')
    marks = _marks(data, separator, options)
    return TableFile(path, top, data, options, marks, encoding, separator, skip, notes=notes)


def _peeks(source: Source, encoding: str, separator: str, start: int) -> list[list[str]]:
    """Return some rows from the rest of a long file, including the last row."""
    rest = source.size - start
    if rest <= 0:
        return []
    wide = 2 if encoding.startswith('utf-16') else 1
    codec = 'utf-16-le' if encoding == 'utf-16' else encoding.removesuffix('-sig')
    rows = []
    step = max(rest // _PEEKS, _PEEK_BYTES)
    places = {*range(start, source.size, step), max(start, source.size - _PEEK_BYTES)}
    for place in sorted(places):
        text = source.read(place - place % wide, _PEEK_BYTES).decode(codec, errors='replace')
        # The first and the last line are incomplete.
        lines = text.splitlines()[1:]
        at_end = place + _PEEK_BYTES >= source.size
        rows += [cells_of(line, separator) for line in (lines if at_end else lines[:-1])[-3:]]
    return rows


def _marks(rows: list[list[str]], separator: str, options: TableOptions) -> Marks | None:
    if options.decimal:
        return Marks(',', '.') if options.decimal == 'comma' else Marks('.', ',')
    found = decimal_mark([cell for row in rows for cell in row], separator)
    if found is None:
        return None
    if separator == ';' and found == ('.', ''):
        # Only whole numbers so far: tables with semicolons usually have a decimal comma.
        points = any('.' in cell for row in rows for cell in row)
        return Marks('.' if points else ',')
    return Marks(*found)


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Turn the exceptions of pandas, pyarrow and python-calamine into `RecordingError`."""
    try:
        yield
    except (RecordingError, InputError, GeneratorExit):
        raise
    except MemoryError:
        raise RecordingError(path, 'is too large for the memory of this machine') from None
    except Exception as error:  # noqa: BLE001
        # These libraries raise many kinds of exceptions for an invalid file.
        reason = str(error).strip().split('\n')[0][:160] or type(error).__name__
        raise RecordingError(path, f'cannot be read as a table ({reason})') from None


def heading(rows: list[list[str]]) -> Heading:
    """Find the names of the columns among the first rows of a table.

    A preamble above them is ignored. Rows below them are recognised as units or
    descriptions.
    """
    usual = Counter(_full_cells(row) for row in rows if _full_cells(row) > 1)
    least = 0.5 * max(usual, key=lambda size: (usual[size], size), default=0)
    first = next((k for k, row in enumerate(rows) if _is_data(row, least)), None)
    filled = [k for k, row in enumerate(rows) if any(cell.strip() for cell in row)]
    if first is None:
        wide = max((_full_cells(rows[k]) for k in filled[:_LOOK]), default=0)
        return _heading(rows, next((k for k in filled if _full_cells(rows[k]) >= min(2, wide)), 0))
    width = len(rows[first])
    above = [k for k in filled if k < first]
    # Only rows directly above the data and about as wide belong to the heading.
    block: list[int] = []
    for k in reversed(above):
        if _full_cells(rows[k]) < 2 or len(rows[k]) < 0.6 * width:
            break
        block.insert(0, k)
    if not block:
        return _heading(rows, above[-1] if above else filled[0])
    named = [k for k in block if not _are_units(rows[k])] or block
    most = max(_full_cells(rows[k]) for k in named)
    at = next(k for k in named if _full_cells(rows[k]) >= 0.8 * most)
    return _heading(rows, at, tuple(k for k in block if k > at))


def _is_data(row: list[str], least: float) -> bool:
    cells = [cell.strip() for cell in row if cell.strip()]
    if len(cells) < least:
        return False
    values = [cell for cell in cells if _NUMBER.fullmatch(cell) or _STAMP.fullmatch(cell)]
    stamped = any(_STAMP.fullmatch(cell) for cell in cells[:3])
    # A row of a long table has more texts than values: tag, time, value, unit, description.
    return len(row) > 1 and bool(values) and (2 * len(values) >= len(cells) or stamped)


def _are_units(row: list[str]) -> bool:
    cells = [cell for cell in row if cell.strip()]
    units = sum(is_unit(cell) for cell in cells)
    return units >= 1 and units >= len(cells) - 1


def _full_cells(row: list[str]) -> int:
    return sum(bool(cell.strip()) for cell in row)


def _heading(rows: list[list[str]], at: int, others: tuple[int, ...] = ()) -> Heading:
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
