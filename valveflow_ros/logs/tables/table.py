# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads a table of a historian (CSV, Excel or Parquet) and writes samples as a table."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.logs.contents import LogContents
from valveflow_ros.logs.names import signal_of
from valveflow_ros.logs.part_file import make_folder
from valveflow_ros.logs.source import os_errors
from valveflow_ros.logs.tables.binary import check_parquet
from valveflow_ros.logs.tables.cells import QUALITY_SUFFIX
from valveflow_ros.logs.tables.match import TIME
from valveflow_ros.logs.tables.reader import RawBlock, TableReader
from valveflow_ros.logs.tables.refusal import AS_SEEN, TableOptions
from valveflow_ros.records import (
    SIGNALS,
    BoolArray,
    ByteArray,
    FloatArray,
    IntArray,
    Quality,
    Readings,
    SampleTable,
    table_to_readings,
)

_BLOCK_ROWS = 100_000


@dataclass(frozen=True, slots=True)
class RawTable:
    """A table as in its file, except that its rows are in time order."""

    path: str  # the file
    # Since 1970, not decreasing; equal times keep the order of the file, (n,).
    time_ns: IntArray
    # By contract column name, in the units of the file; NaN without a number; each (n,).
    columns: dict[str, FloatArray]
    names: dict[str, str]  # name of each column in the file
    # A `Quality` per value, (n,), for columns that have a quality column in the file.
    quality: dict[str, ByteArray]
    notes: tuple[str, ...]  # sentences about what was inferred or left out
    # Number of cells that are not empty and hold no number, by contract column name.
    bad_cells: dict[str, int]
    bad_times: int = 0  # number of rows left out because their time cannot be read
    # The unit in the file, by contract column name.
    units: dict[str, str] = field(default_factory=dict)
    # Why a column was assigned to a signal, if its name was not exact.
    grounds: dict[str, str] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()  # columns (in a long table: tags) that were not used
    # For a long table: the rows that have a value of this signal, (n,).
    present: dict[str, BoolArray] = field(default_factory=dict)

    def readings(self) -> Readings:
        """Return the values one by one, in time order."""
        by_signal = {signal_of(name): column for name, column in self.columns.items()}
        quality = {signal_of(name): codes for name, codes in self.quality.items()}
        table = SampleTable.from_columns(self.time_ns, by_signal, quality)
        if not self.present:
            return table_to_readings(table)
        order = [signal_of(name) for name in self.present]
        there = np.column_stack([self.present[name] for name in self.present])
        row, column = np.nonzero(there)
        signal = np.array(order, dtype=np.int8)[column]
        return Readings(
            table.time_ns[row], signal, table.values[row, signal], table.quality[row, signal]
        )


def read_table(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    absent: Collection[str] = (),
    options: TableOptions = AS_SEEN,
) -> RawTable:
    """Return the table in a file.

    Raises `RecordingError` if the file cannot be read as a table. Raises `InputError` if a column
    is missing or ambiguous, or a contract name is unknown.

    Parameters
    ----------
    path : str or Path
        ``.csv`` and similar (any common separator, encoding and decimal mark),
        ``.xlsx`` or ``.parquet``; one column per signal, or one row per value.
    columns : mapping of str to str, optional
        The column of a contract name, or of ``time`` or ``date``. Other signals
        are recognised by the names and units of the columns.
    absent : collection of str
        Contract names that may be missing.
    options : TableOptions
        What the user says about the table.
    """
    return whole_table(TableReader(Path(path), columns or {}, absent, options))


def whole_table(reader: TableReader) -> RawTable:
    """Return all blocks of a table in time order; raises like `read_table`."""
    blocks = list(reader.blocks())
    notes = reader.notes()
    block = RawBlock(
        np.concatenate([block.time_ns for block in blocks]),
        {n: np.concatenate([b.columns[n] for b in blocks]) for n in reader.names},
        {n: np.concatenate([b.quality[n] for b in blocks]) for n in blocks[0].quality},
        {n: np.concatenate([b.present[n] for b in blocks]) for n in blocks[0].present},
    )
    steps = np.diff(block.time_ns)
    if (steps < 0).any():
        newest_first = bool((steps <= 0).all())
        order = np.arange(len(block.time_ns))[:: -1 if newest_first else 1]
        block = block.at(order[np.argsort(block.time_ns[order], kind='stable')])
        if not block.present:
            notes.append(order_note(newest_first))
    return RawTable(
        str(reader.path), block.time_ns, block.columns, dict(reader.names), block.quality,
        tuple(notes), reader.bad_cells, reader.bad_times, dict(reader.units),
        dict(reader.grounds), reader.ignored, block.present,
    )  # fmt: skip


def open_table(
    path: Path,
    columns: Mapping[str, str],
    absent: Collection[str] = (),
    options: TableOptions = AS_SEEN,
) -> LogContents:
    """Return a table as a log; raises like `read_table`."""
    reader = TableReader(path, columns, absent, options)
    raw = whole_table(reader)
    readings = raw.readings()
    return LogContents(
        raw.path,
        readings,
        readings.time_ns,
        signals={signal_of(name): theirs for name, theirs in raw.names.items()},
        warnings=raw.notes,
        start_ns=int(raw.time_ns[0]),
        end_ns=int(raw.time_ns[-1]),
        units={signal_of(name): unit for name, unit in raw.units.items()},
        grounds={signal_of(name): ground for name, ground in raw.grounds.items()},
        understood=reader.understood(),
    )


def order_note(newest_first: bool) -> str:
    """Return the sentence for rows that were sorted."""
    kind = 'newest first' if newest_first else 'not in the order of time'
    return f'The rows were {kind}; they were sorted.'


def write_table(
    table: SampleTable, path: str | Path, extra: Mapping[str, FloatArray] | None = None
) -> None:
    """Write a table with the columns of the contract.

    Times are ISO 8601 in UTC with as many digits as they need. Numbers have enough digits to be
    read back exactly; a missing value is an empty cell. An optional signal without values gets no
    column. A signal with values of uncertain quality gets an additional column of quality codes.
    Raises `InputError` if the suffix is another one. Raises `RecordingError` if the file cannot be
    written, or is Parquet and pyarrow is not installed.

    Parameters
    ----------
    path : str or Path
        ``.csv`` or ``.parquet``; replaced if it exists.
    extra : mapping of str to float64 (n,), optional
        Further columns by name, after the signals.
    """
    place = Path(path)
    kind = place.suffix.lower()
    if kind not in ('.csv', '.parquet'):
        raise InputError(f"A table is written as .csv or .parquet, not as '{place.name}'.")
    if kind == '.parquet':
        check_parquet(place)
    draft = place.with_name(f'.{place.name}.part')
    with os_errors(path, 'cannot be written'):
        make_folder(place.parent)
        try:
            write = _write_csv if kind == '.csv' else _write_parquet
            write(table.time_ns, list(_columns(table, extra or {})), draft)
            draft.replace(place)
        except OSError:
            draft.unlink(missing_ok=True)
            raise


_Column = tuple[str, FloatArray, ByteArray | None]


def _columns(table: SampleTable, extra: Mapping[str, FloatArray]) -> Iterator[_Column]:
    """Yield name, values and qualities of the columns; None if no quality is uncertain."""
    for info in SIGNALS:
        values = table.column(info.signal)
        if info.required or np.isfinite(values).any():
            quality = table.quality[:, info.signal]
            doubtful = bool((quality == int(Quality.UNCERTAIN)).any())
            yield info.column, values, quality if doubtful else None
    for name, values in extra.items():
        yield name, values, None


def _write_csv(time_ns: IntArray, columns: Sequence[_Column], path: Path) -> None:
    times, names = _iso(time_ns), [TIME]
    for name, _, quality in columns:
        names += [name] if quality is None else [name, name + QUALITY_SUFFIX]
    # In a column of whole numbers a reader takes ``-0`` for 0.
    signed = [bool((np.signbit(values) & (values == 0.0)).any()) for _, values, _ in columns]
    with path.open('w', encoding='utf-8', newline='') as stream:
        stream.write(','.join(names) + '\n')
        for start in range(0, len(times), _BLOCK_ROWS):
            part = slice(start, start + _BLOCK_ROWS)
            cells = [times[part]]
            for (_, values, quality), sign in zip(columns, signed, strict=True):
                cells.append(_numbers(values[part], sign))
                if quality is not None:
                    cells.append([str(code) for code in quality[part].tolist()])
            stream.writelines(f'{",".join(row)}\n' for row in zip(*cells, strict=True))


def _numbers(values: FloatArray, signed: bool) -> list[str]:
    """Return numbers with enough digits to be read back exactly; empty for NaN."""
    cells = [repr(value) for value in values.tolist()]
    if not signed:
        cells = [cell.removesuffix('.0') for cell in cells]
    return ['' if cell == 'nan' else cell for cell in cells] if np.isnan(values).any() else cells


def _write_parquet(time_ns: IntArray, columns: Sequence[_Column], path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    arrays = {TIME: pa.array(time_ns, pa.timestamp('ns', 'UTC'))}
    for name, values, quality in columns:
        arrays[name] = pa.array(values, mask=np.isnan(values))
        if quality is not None:
            arrays[name + QUALITY_SUFFIX] = pa.array(quality)
    with path.open('wb') as stream:
        parquet.write_table(pa.table(arrays), stream)


def _iso(time_ns: IntArray) -> list[str]:
    """Return times as text, all with the number of decimals that the finest one needs."""
    stamps = time_ns.astype('datetime64[ns]')
    digits = 9
    while digits and not (time_ns % 10 ** (12 - digits)).any():
        digits -= 3
    # The removed digits are zeros in all rows.
    size = len('2000-01-01T00:00:00') + (digits + 1 if digits else 0)
    return [f'{text[:size]}Z' for text in np.datetime_as_string(stamps).tolist()]
