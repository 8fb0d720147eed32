"""Writes samples as a table that reads back to the same samples."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs.part_file import make_folder
from valveflow_ros.logs.tables.cells import QUALITY_SUFFIX
from valveflow_ros.logs.tables.match import TIME
from valveflow_ros.records import SIGNALS, IntArray, Quality, SampleTable

if TYPE_CHECKING:
    import pyarrow as pa


def write_table(table: SampleTable, path: str | Path) -> None:
    """Write a table with the contract's columns.

    Times are ISO 8601 in UTC with as many digits as they need, numbers have
    all digits that tell them apart, a missing value is an empty cell. A signal
    that is optional and wholly missing gets no column; a column of quality
    codes stands beside a signal that has doubtful values.

    Parameters
    ----------
    table : SampleTable
        The samples.
    path : str or Path
        ``.csv`` or ``.parquet``; replaced if it exists.

    Raises
    ------
    InputError
        If the suffix is neither.
    RecordingError
        If the file cannot be written.
    """
    place = Path(path)
    kind = place.suffix.lower()
    if kind not in ('.csv', '.parquet'):
        raise InputError(f"A table is written as .csv or .parquet, not as '{place.name}'.")
    draft = place.with_name(f'.{place.name}.part')
    try:
        make_folder(place.parent)
        if kind == '.csv':
            _write_csv(_columns(table, _iso(table.time_ns)), draft)
        else:
            _write_parquet(_columns(table, table.time_ns), draft)
        draft.replace(place)
    except OSError as error:
        with suppress(OSError):
            draft.unlink()
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(path, f'cannot be written ({reason})') from None


def _columns(table: SampleTable, time: IntArray | list[str]) -> pa.Table:
    import pyarrow as pa

    stamps = pa.array(time, pa.string() if isinstance(time, list) else pa.timestamp('ns', 'UTC'))
    columns = {TIME: stamps}
    for info in SIGNALS:
        values = table.column(info.signal)
        if not info.required and not np.isfinite(values).any():
            continue
        columns[info.column] = pa.array(values, mask=np.isnan(values))
        quality = table.quality[:, info.signal]
        if (quality == int(Quality.UNCERTAIN)).any():
            columns[info.column + QUALITY_SUFFIX] = pa.array(quality)
    return pa.table(columns)


def _write_csv(columns: pa.Table, path: Path) -> None:
    from pyarrow import csv

    for number, name in enumerate(columns.column_names):
        if _has_negative_zero(columns[name]):
            columns = columns.set_column(number, name, _as_text(columns[name]))
    with path.open('wb') as stream:
        stream.write((','.join(columns.column_names) + '\n').encode())
        options = csv.WriteOptions(include_header=False, quoting_style='none')
        csv.write_csv(columns, stream, options)


def _has_negative_zero(column: pa.ChunkedArray) -> bool:
    import pyarrow as pa

    if column.type != pa.float64():
        return False
    values = column.to_numpy()
    return bool((np.signbit(values) & (values == 0.0)).any())


def _as_text(column: pa.ChunkedArray) -> pa.Array:
    """Return numbers with their point: among whole numbers a reader takes ``-0`` for 0."""
    import pyarrow as pa

    cells = [None if cell is None else repr(cell) for cell in column.to_pylist()]
    return pa.array(cells, pa.string())


def _write_parquet(columns: pa.Table, path: Path) -> None:
    from pyarrow import parquet

    with path.open('wb') as stream:
        parquet.write_table(columns, stream)


def _iso(time_ns: IntArray) -> list[str]:
    """Return times as text, all with as many digits of a second as the finest needs."""
    stamps = time_ns.astype('datetime64[ns]')
    digits = 9
    while digits and not (time_ns % 10 ** (12 - digits)).any():
        digits -= 3
    # A text of nanoseconds is cut, never rounded: what is cut are zeros.
    size = len('2000-01-01T00:00:00') + (digits + 1 if digits else 0)
    return [f'{text[:size]}Z' for text in np.datetime_as_string(stamps).tolist()]
