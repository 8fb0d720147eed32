"""Reads a historian's table, CSV or Parquet, into columns of numbers over time."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.logs.contents import LogContents
from valveflow_ros.logs.names import signal_of, signals_of
from valveflow_ros.logs.table_cells import QUALITY_SUFFIX, to_numbers, to_quality
from valveflow_ros.logs.table_file import load_frame
from valveflow_ros.logs.table_time import never, to_nanoseconds
from valveflow_ros.records import (
    SIGNALS,
    ByteArray,
    FloatArray,
    IntArray,
    SampleTable,
    Signal,
    table_to_readings,
)

if TYPE_CHECKING:
    import pandas as pd

TIME = 'time'
DATE = 'date'


@dataclass(frozen=True, slots=True)
class RawTable:
    """A table as it stands in its file, but for the order of time.

    Attributes
    ----------
    path : str
        Where it was read.
    time_ns : int64 (n,)
        Not decreasing; equal times keep the order of the file.
    columns : dict[str, float64 (n,)]
        By contract column name, in the units of the file; NaN where no number stands.
    names : dict[str, str]
        What each column is called in the file.
    quality : dict[str, uint8 (n,)]
        A `Quality` per value, for columns beside which the file has one.
    notes : tuple of str
        Sentences about what had to be understood or left out.
    bad_cells : dict[str, int]
        Cells that are not empty and hold no number, by contract column name.
    bad_times : int
        Rows left out because their time cannot be read.
    """

    path: str
    time_ns: IntArray
    columns: dict[str, FloatArray]
    names: dict[str, str]
    quality: dict[str, ByteArray]
    notes: tuple[str, ...]
    bad_cells: dict[str, int]
    bad_times: int = 0


def read_table(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    absent: Collection[str] = (),
) -> RawTable:
    """Return the table in a file.

    Parameters
    ----------
    path : str or Path
        ``.csv`` (separated by comma, semicolon or tab; decimal comma with the
        semicolon) or ``.parquet``.
    columns : mapping of str to str, optional
        Contract name, also ``time`` and ``date``, to their column.
    absent : collection of str
        Contract names that need not be there.

    Raises
    ------
    RecordingError
        If the file is not a table that can be read.
    InputError
        If a column is missing or a contract name unknown.
    """
    place = Path(path)
    wanted = dict(columns or {})
    times = {name: wanted.pop(name) for name in (TIME, DATE) if name in wanted}
    by_signal = {signal_of(name): theirs for name, theirs in wanted.items()}
    spared = signals_of(absent)
    frame, separator, notes = load_frame(place)
    chosen = _choose(str(path), frame, by_signal, spared)
    time_ns, time_notes = _time(str(path), frame, times)
    notes += time_notes
    values: dict[str, FloatArray] = {}
    quality: dict[str, ByteArray] = {}
    bad_cells: dict[str, int] = {}
    for name, theirs in chosen.items():
        column = to_numbers(frame[theirs], separator == ';')
        values[name] = column.values
        if column.bad:
            bad_cells[name] = column.bad
            notes.append(
                f"{column.bad} cells of '{theirs}' are no numbers and count as missing; "
                f"the first is '{column.first_bad_text}' in row {column.first_bad_row + 1}."
            )
        if theirs == name and name + QUALITY_SUFFIX in frame.columns:
            quality[name] = to_quality(frame[name + QUALITY_SUFFIX])
    raw = RawTable(str(path), time_ns, values, chosen, quality, tuple(notes), bad_cells)
    return _ordered(raw)


def open_table(
    path: Path, columns: Mapping[str, str], absent: Collection[str] = ()
) -> LogContents:
    """Return a table as a log; raises like `read_table`."""
    raw = read_table(path, columns, absent)
    by_signal = {signal_of(name): column for name, column in raw.columns.items()}
    quality = {signal_of(name): codes for name, codes in raw.quality.items()}
    readings = table_to_readings(SampleTable.from_columns(raw.time_ns, by_signal, quality))
    names = {signal_of(name): theirs for name, theirs in raw.names.items()}
    start, end = int(raw.time_ns[0]), int(raw.time_ns[-1])
    return LogContents(
        raw.path,
        readings,
        readings.time_ns,
        signals=names,
        warnings=raw.notes,
        start_ns=start,
        end_ns=end,
    )


def _choose(
    path: str,
    frame: pd.DataFrame,
    wanted: Mapping[Signal, str],
    spared: set[Signal],
) -> dict[str, str]:
    """Return the column of the file for each contract column that can be had."""
    chosen: dict[str, str] = {}
    for info in SIGNALS:
        theirs = wanted.get(info.signal, info.column)
        if theirs in frame.columns:
            _check_single(path, frame, theirs)
            chosen[info.column] = theirs
        elif info.signal in wanted or (info.required and info.signal not in spared):
            raise _missing(path, frame, theirs, info.column)
    return chosen


def _missing(path: str, frame: pd.DataFrame, theirs: str, name: str) -> InputError:
    have = ', '.join(frame.columns[:40])
    return InputError(
        f"{path}: there is no column '{theirs}'; the columns are: {have}. "
        f'Name theirs with --column {name}=THEIRS[:unit].'
    )


def _check_single(path: str, frame: pd.DataFrame, name: str) -> None:
    if list(frame.columns).count(name) > 1:
        raise InputError(f"{path}: there are several columns called '{name}'.")


def _time(path: str, frame: pd.DataFrame, names: Mapping[str, str]) -> tuple[IntArray, list[str]]:
    time, date = names.get(TIME, TIME), names.get(DATE, DATE)
    for key, theirs in names.items():
        if theirs not in frame.columns:
            raise _missing(path, frame, theirs, key)
    if time not in frame.columns:
        if DATE not in names and date not in frame.columns:
            raise _missing(path, frame, time, TIME)
        time = date
    _check_single(path, frame, time)
    column = frame[time]
    if date in frame.columns and date != time and _is_clock(column):
        _check_single(path, frame, date)
        column = frame[date].astype('string').str.strip() + 'T' + column.str.strip()
    return to_nanoseconds(column, path, time)


def _is_clock(column: pd.Series[Any]) -> bool:
    """Tell whether a column holds the time of day only, so that a date is wanted beside it."""
    if column.dtype.kind in 'iufbM':
        return False
    text = column.astype('string').str.strip()
    clock = text.str.fullmatch(r'[0-9]{1,2}:[0-9]{2}(?::[0-9]{2}(?:[.,][0-9]+)?)?')
    return bool(clock.fillna(False).mean() > 0.5)


def _ordered(raw: RawTable) -> RawTable:
    """Return the rows whose time is known, in the order of time."""
    known = raw.time_ns != never()
    bad_times = int((~known).sum())
    notes = list(raw.notes)
    order = np.flatnonzero(known)
    if bad_times:
        first = int((~known).argmax()) + 1
        notes.append(
            f'{bad_times} rows have no readable time and were left out, the first is row {first}.'
        )
    steps = np.diff(raw.time_ns[order])
    if (steps < 0).any():
        newest_first = bool((steps <= 0).all())
        if newest_first:
            order = order[::-1]
        order = order[np.argsort(raw.time_ns[order], kind='stable')]
        kind = 'newest first' if newest_first else 'not in the order of time'
        notes.append(f'The rows stood {kind} and were sorted.')
    return replace(
        raw,
        time_ns=raw.time_ns[order],
        columns={name: column[order] for name, column in raw.columns.items()},
        quality={name: codes[order] for name, codes in raw.quality.items()},
        notes=tuple(notes),
        bad_times=bad_times,
    )
