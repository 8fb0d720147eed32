# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Yields the rows of Parquet files and Excel workbooks block by block."""

from __future__ import annotations

import datetime
import itertools
import math
import re
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs.tables.refusal import RefusedError, Remedy, TableOptions

if TYPE_CHECKING:
    import pandas as pd

_BLOCK_ROWS = 200_000
_SHEET_BLOCK = 50_000
_SAMPLES = 200
_SHEET_ROWS = 1_048_576  # maximum of Excel
# Maximum unpacked size of a file of any size, unless the user allows more.
_BOOK_BYTES = 1 << 30
_PARQUET_BYTES = 2 << 30  # a year of five signals at 1 s needs 1.5 GB
_CELL_BYTES = 8
_TEXT_BYTES = 64 << 20  # maximum for the texts of one column in a block
# The library stores a sheet as a full rectangle, so two cells far apart would fill the memory. A
# cell has at least 16 bytes of XML, so a sheet with a real table stays below the limit.
_CELLS_FREELY = 8 << 20
_BYTES_PER_CELL = 16
_PLACE = re.compile(rb'\br\s*=\s*["\']\s*([A-Za-z]{0,9})([0-9]{1,10})')
# Cells and rows without a reference are numbered by counting, as the library does.
_CELL = re.compile(rb'<(?:\w+:)?(c|row)[\s/>]')
# The library copies a shared text for each cell that uses it.
_SHARED = re.compile(rb't\s*=\s*["\']s["\']')
_TEXT_END = re.compile(rb'</(?:\w+:)?si>')
_LONGEST_TEXT = 32_767  # maximum characters in an Excel cell; in XML at most ten bytes each
_SHARED_BYTES = 4 << 30
_LONGEST_PLACE = 64
_PIECE = 1 << 20
_STAMPS = (datetime.date, datetime.time)  # and so datetime.datetime


def check_parquet(path: Path) -> None:
    """Check that pyarrow, an optional dependency, can be imported.

    Raises `RecordingError` if it is not installed, or does not work with the installed NumPy.
    """
    try:
        import pyarrow  # noqa: F401
    except ModuleNotFoundError:
        raise RecordingError(
            path,
            "is a Parquet file, and pyarrow that reads and writes those is not installed; 'pip "
            "install pyarrow', or use CSV",
        ) from None
    except ImportError as error:
        raise RecordingError(
            path,
            f'is a Parquet file, and the installed pyarrow cannot be loaded ({error}); beside '
            'NumPy 1 \'pip install "pyarrow<26"\', or use CSV',
        ) from None


def parquet_names(path: Path) -> tuple[str, ...]:
    """Return the names of the columns from the footer of the file."""
    check_parquet(path)
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        return tuple(str(name).strip() for name in file.schema_arrow.names)


def parquet_samples(path: Path, places: Sequence[int], options: TableOptions) -> list[list[str]]:
    """Return cells of these columns from the first and the last row group.

    A group whose unpacked size exceeds the limit is skipped: it may be a single page.
    """
    rows: list[list[str]] = []
    most = options.unpacked_bytes(path.stat().st_size, _PARQUET_BYTES)
    with _parquet(path, places) as (file, names):
        for group in sorted({0, file.num_row_groups - 1} & set(range(file.num_row_groups))):
            if _stated(file.metadata, names, [group]) > most:
                continue
            batch = next(file.iter_batches(_SAMPLES, row_groups=[group], columns=names), None)
            columns = [] if batch is None else [c.to_pylist() for c in _decoded(path, batch)]
            rows += [[_text(cell) for cell in row] for row in zip(*columns, strict=True)]
    return rows


def parquet_blocks(
    path: Path, places: Sequence[int], options: TableOptions
) -> Iterator[pd.DataFrame]:
    """Yield the columns with these indices block by block.

    Raises `RecordingError` if the unpacked size that the footer states is too large for the size
    of the file.
    """
    import pandas as pd

    with _parquet(path, places) as (file, names):
        _check_unpacked(path, file.metadata, names, options)
        for batch in file.iter_batches(_BLOCK_ROWS, columns=names):
            columns = _decoded(path, batch)
            yield pd.DataFrame({k: column.to_pandas() for k, column in enumerate(columns)})


@contextmanager
def _parquet(path: Path, places: Sequence[int]) -> Iterator[tuple[Any, list[str]]]:
    """Open a file; yield it with the names of the columns that have these indices.

    Texts are read in dictionary encoding, because a text that is repeated a million times is
    small in the file.
    """
    import pyarrow as pa
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        every = file.schema_arrow.names
        fields = [file.schema_arrow.field(k) for k in places]
    for field in fields:
        # The library selects columns by name only, and returns all columns with that name.
        if every.count(field.name) > 1:
            raise InputError(f"{path}: there are several columns called '{field.name}'.")
        if pa.types.is_nested(field.type):
            raise RecordingError(
                path, f"the column '{field.name}' holds a {field.type} in each cell, no value"
            )
    names = [field.name for field in fields]
    with parquet.ParquetFile(path, read_dictionary=names) as file:
        yield file, names


def _check_unpacked(path: Path, footer: Any, names: list[str], options: TableOptions) -> None:
    """Refuse columns that are too large for the size of the file, before reading any row."""
    packed = path.stat().st_size
    most = options.unpacked_bytes(packed, _PARQUET_BYTES)
    groups = range(footer.num_row_groups)
    rows = max(footer.num_rows, sum(footer.row_group(k).num_rows for k in groups))
    unpacked = max(_CELL_BYTES * rows * len(names), _stated(footer, names, groups))
    if unpacked > most:
        raise RecordingError(
            path,
            f'has {rows} rows that unpack to {unpacked / 1e6:.0f} MB, more than the '
            f'{most / 1e6:.0f} MB that are read of a file of {packed / 1e6:.1f} MB; '
            f'{_allowed(unpacked)}',
        )


def _stated(footer: Any, names: list[str], groups: Iterable[int]) -> int:
    """Return the unpacked bytes of some columns in some groups, as stated in the footer."""
    wanted = [k for k in range(footer.num_columns) if footer.schema.column(k).path in names]
    parts = map(footer.row_group, groups)
    return sum(part.column(k).total_uncompressed_size for part in parts for k in wanted)


def _allowed(unpacked: float) -> str:
    """Return the clause with the option that allows a larger unpacked size."""
    return f'if it is not damaged, add --max-unpacked {math.ceil(unpacked / 1e6)}'


def _decoded(path: Path, batch: Any) -> list[Any]:
    """Return the columns of a batch with dictionary-encoded texts decoded."""
    import pyarrow as pa
    import pyarrow.compute as pc

    def decoded(column: Any) -> Any:
        if not pa.types.is_dictionary(column.type):
            return column
        if not pa.types.is_primitive(column.type.value_type):
            lengths = pc.binary_length(column.dictionary).take(column.indices)
            if (pc.sum(lengths).as_py() or 0) > _TEXT_BYTES:
                raise RecordingError(path, 'has texts too long for the cells of a table')
        return column.dictionary_decode()

    return list(map(decoded, batch.columns))


def look_at_sheet(path: Path, options: TableOptions, most: int) -> tuple[Any, list[list[str]]]:
    """Return the sheet to read, for `sheet_blocks`, and its first rows as texts.

    Raises `InputError` if the sheet does not exist, or several sheets have a table.
    """
    names: list[str] = []
    tables: list[str] = []
    found: tuple[Any, list[list[str]]] | None = None
    with _book(path, options) as book:
        from python_calamine import SheetTypeEnum, SheetVisibleEnum

        for sheet in book.sheets_metadata:
            if (sheet.visible, sheet.typ) != (SheetVisibleEnum.Visible, SheetTypeEnum.WorkSheet):
                continue
            names.append(f"'{sheet.name}'")
            cells = book.get_sheet_by_name(sheet.name)
            head = cells.to_python(skip_empty_area=False, nrows=most)
            rows = [[_text(_plain(cell)) for cell in row] for row in head]
            while rows and not any(rows[-1]):
                rows.pop()
            if sheet.name == options.sheet:
                return cells, rows
            if len(rows) > 1 and len(rows[0]) > 1:
                tables.append(sheet.name)
                # Only the first sheet with a table is kept in memory.
                found = found or (cells, rows)
    if options.sheet:
        raise InputError(f"{path} has no sheet '{options.sheet}'; it has {', '.join(names)}.")
    if found is None:
        raise RecordingError(path, 'is a workbook without a table')
    if len(tables) > 1:
        several = ' and '.join(f"'{name}'" for name in tables)
        choice = Remedy('sheet', tables[0])
        problem = f'there are tables in the sheets {several}; choose with {choice}'
        raise RefusedError(path, problem, [choice])
    return found


def sheet_blocks(sheet: Any, first_row: int, places: list[int]) -> Iterator[pd.DataFrame]:
    """Yield the cells of these columns of a sheet block by block, from ``first_row`` on."""
    top, left = sheet.start or (0, 0)
    below = itertools.islice(sheet.iter_rows(), max(0, first_row - top), None)
    rows = (
        [_plain(row[k - left]) if 0 <= k - left < len(row) else None for k in places]
        for row in below
    )
    filled = (row for row in rows if any(cell is not None for cell in row))
    while block := list(itertools.islice(filled, _SHEET_BLOCK)):
        yield _frame(block)


def _frame(block: list[list[Any]]) -> pd.DataFrame:
    """Return a block as a DataFrame with datetime and number types where possible."""
    import pandas as pd

    frame = pd.DataFrame(block, dtype=object).infer_objects()
    for place in frame.columns:
        column = frame[place]
        if column.dtype.kind == 'M':
            # A workbook stores times as a double of days, which resolves about 1 us.
            frame[place] = column.dt.round('ms')
        elif column.dtype.kind == 'O':
            frame[place] = column.map(
                lambda cell: _text(cell) if isinstance(cell, _STAMPS) else cell, na_action='ignore'
            )
    return frame


def _plain(cell: Any) -> Any:
    """Return an empty cell as None, a whole number as int, and a date as a datetime."""
    if cell == '':
        return None
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < 1e18:
        return int(cell)
    if type(cell) is datetime.date:
        return datetime.datetime(cell.year, cell.month, cell.day)
    return cell


def _text(cell: Any) -> str:
    """Return a cell as text."""
    if cell is None:
        return ''
    if isinstance(cell, datetime.datetime):
        if cell.microsecond and not hasattr(cell, 'nanosecond'):
            cell = cell + datetime.timedelta(microseconds=500)
            cell = cell.replace(microsecond=cell.microsecond // 1000 * 1000)
        return str(cell.isoformat(sep=' '))
    if isinstance(cell, _STAMPS):
        return str(cell.isoformat())
    return str(cell)


@contextmanager
def _book(path: Path, options: TableOptions) -> Iterator[Any]:
    try:
        from python_calamine import CalamineWorkbook
    except ImportError:
        raise RecordingError(
            path,
            "is an Excel workbook, and python-calamine that reads those is not installed; 'pip "
            "install python-calamine', or save the sheet as CSV",
        ) from None
    # The library does not check the archive, so it reads a copy whose size was verified.
    with tempfile.NamedTemporaryFile(suffix='.xlsx') as copy:
        _copy_within_bounds(path, copy, options)
        copy.flush()
        try:
            with CalamineWorkbook.from_path(copy.name) as book:
                yield book
        except BaseException as error:
            # A panic of the library is not a subclass of `Exception`.
            if type(error).__name__ != 'PanicException':
                raise
            raise RecordingError(path, 'cannot be read as a table (it is no workbook)') from None


def _copy_within_bounds(path: Path, copy: IO[bytes], options: TableOptions) -> None:
    """Copy a workbook and check its unpacked size and sheets; raises `RecordingError`."""
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(copy, 'w') as out:
        parts = {part.filename: part for part in archive.infolist()}
        unpacked = sum(part.file_size for part in parts.values())
        packed = path.stat().st_size
        most = options.unpacked_bytes(packed, _BOOK_BYTES)
        if unpacked > most:
            raise RecordingError(
                path,
                f'is a workbook of {packed / 1e6:.1f} MB that unpacks to {unpacked / 1e6:.0f} MB, '
                f'more than the {most / 1e6:.0f} MB that are read of one its size; save the sheet '
                f'as CSV or Parquet, or, {_allowed(unpacked)}',
            )
        longest, shared = 0, 0
        for name, part in parts.items():
            measured = _Measure()
            with archive.open(part) as source, out.open(name, 'w') as target:
                while piece := source.read(_PIECE):
                    target.write(piece)
                    measured.add(piece)
            _check_size(path, measured.rows, measured.columns, part.file_size)
            longest, shared = max(longest, measured.longest_text), shared + measured.shared
        if longest > 10 * _LONGEST_TEXT or longest * shared > _SHARED_BYTES:
            raise RecordingError(
                path, 'has texts too long for the cells of a sheet; save the table in it as CSV'
            )


class _Measure:
    """Measures the extent of the cells in a part of a workbook, and its shared texts."""

    def __init__(self) -> None:
        self.rows = self.columns = self.shared = self.longest_text = 0
        self._unplaced_rows = self._in_row = self._since_text = 0
        self._rest = b''

    def add(self, piece: bytes) -> None:
        """Process the next bytes; a tag that spans two pieces is counted once."""
        data = self._rest + piece
        # An incomplete tag at the end is processed with the next piece.
        end = max(data.rfind(b'<'), 0) if len(piece) == _PIECE else len(data)
        end = end if len(data) - end <= _LONGEST_PLACE else len(data)
        data, self._rest = data[:end], data[end:]
        for letters, row in _PLACE.findall(data):
            self.rows = max(self.rows, int(row))
            self.columns = max(self.columns, _column(letters.upper()))
        for kind in _CELL.findall(data):
            if kind == b'row':
                self._unplaced_rows += 1
                self._in_row = 0
            else:
                self._in_row += 1
                self.columns = max(self.columns, self._in_row)
        self.rows = max(self.rows, self._unplaced_rows)
        self.shared += len(_SHARED.findall(data))
        ends = [match.end() for match in _TEXT_END.finditer(data)]
        if ends:
            lengths = [ends[0] + self._since_text, *(b - a for a, b in itertools.pairwise(ends))]
            self.longest_text = max(self.longest_text, *lengths)
            self._since_text = len(data) - ends[-1]
        else:
            self._since_text += len(data)


def _column(letters: bytes) -> int:
    """Return the number of a column: 1 for A, 0 without letters."""
    return reduce(lambda number, letter: 26 * number + letter - 64, letters, 0)


def _check_size(path: Path, rows: int, columns: int, size: int) -> None:
    """Refuse a sheet whose cells span too large a rectangle for the size of the sheet."""
    if rows > _SHEET_ROWS:
        raise RecordingError(path, f'has more than the {_SHEET_ROWS} rows of a sheet')
    if rows * columns > max(_CELLS_FREELY, size // _BYTES_PER_CELL):
        raise RecordingError(
            path,
            f'has a sheet of {rows} rows and {columns} columns, most of them empty; save the '
            'table in it as CSV or Parquet',
        )
