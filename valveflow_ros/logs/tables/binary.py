"""Gives the rows of Parquet files and Excel workbooks block by block."""

from __future__ import annotations

import datetime
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs.tables.refusal import RefusedError, Remedy

if TYPE_CHECKING:
    import pandas as pd

_BLOCK_ROWS = 200_000
_SHEET_BLOCK = 50_000
_SAMPLES = 200
_SHEET_ROWS = 1_048_576  # a sheet has no more
# What a workbook may unpack to: XML of tables shrinks to a tenth, hardly ever to a hundredth.
_UNPACKED_BYTES = 1 << 30
_UNPACKED_FREELY = 64 << 20
_UNPACKED_TIMES = 200


def look_at_parquet(path: Path) -> tuple[tuple[str, ...], list[list[str]]]:
    """Return the names of the columns and rows from the first and the last group."""
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        names = tuple(str(name).strip() for name in file.schema_arrow.names)
        rows: list[list[str]] = []
        groups = sorted({0, file.num_row_groups - 1} & set(range(file.num_row_groups)))
        for group in groups:
            batch = next(file.iter_batches(_SAMPLES, row_groups=[group]), None)
            columns = [] if batch is None else [c.to_pylist() for c in batch.columns]
            rows += [[_text(cell) for cell in row] for row in zip(*columns, strict=True)]
    return names, rows


def parquet_blocks(path: Path, places: list[int]) -> Iterator[pd.DataFrame]:
    """Yield the columns at these places."""
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        names = file.schema_arrow.names
        for batch in file.iter_batches(_BLOCK_ROWS, columns=[names[k] for k in places]):
            yield batch.to_pandas(ignore_metadata=True)


def look_at_sheet(path: Path, wanted: str, most: int) -> tuple[str, list[list[str]]]:
    """Return the sheet to be read and its first rows as texts.

    Raises
    ------
    InputError
        If the sheet is not there, or several could be meant.
    """
    with _book(path) as book:
        sheets = [sheet for sheet in book.worksheets if sheet.sheet_state == 'visible']
        found = {sheet.title: _first_rows(sheet, most) for sheet in sheets}
    names = ', '.join(f"'{name}'" for name in found)
    if wanted:
        if wanted not in found:
            raise InputError(f"{path} has no sheet '{wanted}'; it has {names}.")
        return wanted, found[wanted]
    tables = [name for name, rows in found.items() if len(rows) > 1 and max(map(len, rows)) > 1]
    if not tables:
        raise RecordingError(path, 'is a workbook without a table')
    if len(tables) > 1:
        several = ' and '.join(f"'{name}'" for name in tables)
        sheet = Remedy('sheet', tables[0])
        problem = f'there are tables in the sheets {several}; choose with {sheet}'
        raise RefusedError(path, problem, [sheet])
    return tables[0], found[tables[0]]


def sheet_blocks(
    path: Path, sheet: str, first_row: int, places: list[int]
) -> Iterator[pd.DataFrame]:
    """Yield the cells at these places, from a row on.

    Raises
    ------
    RecordingError
        If a row has a number that no row of a sheet can have.
    """
    import pandas as pd

    with _book(path) as book:
        block: list[list[Any]] = []
        table = book[sheet]
        table.reset_dimensions()
        rows = table.iter_rows(min_row=first_row + 1, max_col=max(places) + 1, values_only=True)
        # Rows that the file leaves out are given as empty ones, up to whatever number comes next.
        for number, row in enumerate(rows, first_row + 1):
            if number > _SHEET_ROWS:
                raise RecordingError(path, f'has more than the {_SHEET_ROWS} rows of a sheet')
            picked = [row[k] if k < len(row) else None for k in places]
            if any(cell is not None for cell in picked):
                block.append(picked)
            if len(block) == _SHEET_BLOCK:
                yield _frame(pd.DataFrame(block, dtype=object))
                block = []
        if block:
            yield _frame(pd.DataFrame(block, dtype=object))


def _frame(frame: pd.DataFrame) -> pd.DataFrame:
    """Give columns of stamps or of numbers the type that is quick to work with."""
    frame = frame.infer_objects()
    for place in frame.columns:
        column = frame[place]
        if column.dtype.kind == 'M':
            # A workbook holds days as a double, which knows a second to about a microsecond.
            frame[place] = column.dt.round('ms')
        elif column.dtype.kind == 'O':
            frame[place] = column.map(_cell, na_action='ignore')
    return frame


def _cell(cell: Any) -> Any:
    return (
        _text(cell)
        if isinstance(cell, datetime.datetime | datetime.date | datetime.time)
        else cell
    )


def _text(cell: Any) -> str:
    """Return a cell as it would stand in a text."""
    if cell is None:
        return ''
    if isinstance(cell, datetime.datetime):
        if cell.microsecond and not hasattr(cell, 'nanosecond'):
            cell = cell + datetime.timedelta(microseconds=500)
            cell = cell.replace(microsecond=cell.microsecond // 1000 * 1000)
        return str(cell.isoformat(sep=' '))
    if isinstance(cell, datetime.date | datetime.time):
        return str(cell.isoformat())
    return str(cell)


def _first_rows(sheet: Any, most: int) -> list[list[str]]:
    # Some tools write a size that leaves out most of the sheet.
    sheet.reset_dimensions()
    rows = [
        [_text(cell) for cell in row] for row in sheet.iter_rows(max_row=most, values_only=True)
    ]
    while rows and not any(rows[-1]):
        rows.pop()
    width = max(map(len, rows), default=0)
    return [row + [''] * (width - len(row)) for row in rows]


def _check_unpacked(path: Path) -> None:
    """Refuse a workbook whose parts would fill the memory; raises `RecordingError`."""
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(part.file_size for part in archive.infolist())
    packed = path.stat().st_size
    most = min(_UNPACKED_BYTES, max(_UNPACKED_FREELY, _UNPACKED_TIMES * packed))
    if unpacked > most:
        raise RecordingError(
            path,
            f'is a workbook of {packed / 1e6:.1f} MB that unpacks to {unpacked / 1e6:.0f} MB, '
            f'more than the {most / 1e6:.0f} MB that are read of one its size; save the sheet as '
            'CSV or Parquet',
        )


@contextmanager
def _book(path: Path) -> Iterator[Any]:
    try:
        import openpyxl  # type: ignore[import-untyped]
    except ImportError:
        raise RecordingError(
            path,
            "is an Excel workbook, and openpyxl that reads those is not installed; 'pip install "
            "openpyxl', or save the sheet as CSV",
        ) from None
    _check_unpacked(path)
    book = openpyxl.load_workbook(path, read_only=True, data_only=True)
    try:
        yield book
    finally:
        book.close()
