"""A historian's table as samples, with everything that had to be understood about it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.cli.console import Console
from valveflow_ros.cli.header import unused_columns
from valveflow_ros.cli.log_input import (
    advice,
    check_constants,
    names_for,
    unit_for,
    unknown_unit,
)
from valveflow_ros.cli.mapping import Mapping
from valveflow_ros.cli.plausible import doubt
from valveflow_ros.config import Settings
from valveflow_ros.core.units import convert
from valveflow_ros.errors import DataError, InputError, RecordingError
from valveflow_ros.logs import RawTable, read_table
from valveflow_ros.records import (
    SIGNALS,
    FloatArray,
    IntArray,
    Quality,
    SampleTable,
    Signal,
    SignalInfo,
)
from valveflow_ros.report.quality import Gap, gaps

_TIMES = ('time', 'date')
_QUALITY = '_quality'  # what stands behind the name of a column of marks
_TABLES = ('.csv', '.tsv', '.txt', '.parquet', '.pq')


@dataclass(frozen=True, slots=True)
class SignalSource:
    """Where one signal comes from; ``low`` and ``high`` in the engine's unit."""

    topic: str
    column: str
    written_unit: str
    unit: str
    low: float
    high: float
    missing: int
    constant: bool


@dataclass(frozen=True, slots=True)
class Imported:
    """A table that was understood.

    Attributes
    ----------
    table : SampleTable
    sources : list of SignalSource
        In the order of `Signal`.
    rows_read, duplicates : int
        Rows of the file with a readable time, and those left out for having one twice.
    period_s : float
        Median step.
    gaps : list of Gap
        The longest first.
    ignored : tuple of str
        Columns that were not used.
    notes : tuple of str
        Sentences of the reader.
    """

    path: Path
    table: SampleTable
    sources: list[SignalSource]
    rows_read: int
    duplicates: int
    period_s: float
    gaps: list[Gap]
    ignored: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def span_ns(self) -> tuple[int, int]:
        """Return the times of the first and the last row."""
        return int(self.table.time_ns[0]), int(self.table.time_ns[-1])

    def summary(self) -> dict[str, Any]:
        """Return everything but the values, for a program."""
        return {
            'source': str(self.path),
            'rows': len(self.table),
            'rows_read': self.rows_read,
            'duplicates': self.duplicates,
            'period_s': self.period_s,
            'start_ns': self.span_ns[0],
            'end_ns': self.span_ns[1],
            'gaps': len(self.gaps),
            'signals': [asdict(source) for source in self.sources],
            'ignored': list(self.ignored),
            'notes': list(self.notes),
        }

    def as_json(self) -> str:
        """Return the summary as the text that goes into the log; the file's name only."""
        content = {**self.summary(), 'source': self.path.name}
        finite = [
            {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in s.items()}
            for s in content['signals']
        ]
        return json.dumps({**content, 'signals': finite}, indent=2, allow_nan=False)


def read_historian(path: Path, mapping: Mapping, console: Console) -> Imported:
    """Read a table, convert it, and warn aloud of what looks wrong.

    Raises
    ------
    RecordingError, InputError, DataError
        It cannot be read, a column is missing, a unit unknown, no row is usable.
    """
    if path.suffix.lower() not in _TABLES:
        raise RecordingError(path, 'is no .csv or .parquet table')
    raw = _read(path, mapping)
    for note in raw.notes:
        console.say(note)
    time_ns, first = np.unique(raw.time_ns, return_index=True)
    columns, quality, sources = _signals(raw, first, mapping, console)
    table = SampleTable.from_columns(time_ns, columns, quality)
    if not any(np.isfinite(table.column(i.signal)).any() for i in SIGNALS):
        raise DataError(f'{path}: there is no number in any of the columns used.')
    period_s = float(np.median(np.diff(time_ns))) / 1e9 if len(time_ns) > 1 else 0.0
    return Imported(
        path, table, sources, len(raw.time_ns), len(raw.time_ns) - len(time_ns), period_s,
        gaps(time_ns, max(1, round(period_s * 1e9))), _ignored(raw, mapping),
        raw.notes,
    )  # fmt: skip


def _read(path: Path, mapping: Mapping) -> RawTable:
    columns, strange = names_for(mapping)
    try:
        return read_table(path, columns, list(mapping.constants))
    except InputError as error:
        if not strange:
            raise
        raise unknown_unit(strange[0]) from error


def _ignored(raw: RawTable, mapping: Mapping) -> tuple[str, ...]:
    """Return the columns that stand for nothing here."""
    used = [name for column, name in raw.names.items() if not _is_constant(column, mapping)]
    unused = unused_columns(Path(raw.path), used)
    times = {mapping.columns[key].theirs for key in _TIMES if key in mapping.columns}
    times |= set(_TIMES) - set(mapping.columns)
    marks = {f'{name}{_QUALITY}' for name in used}
    return tuple(name for name in unused if name not in times | marks)


def _is_constant(column: str, mapping: Mapping) -> bool:
    return any(i.column == column and i.topic in mapping.constants for i in SIGNALS)


def _signals(
    raw: RawTable, rows: IntArray, mapping: Mapping, console: Console
) -> tuple[dict[Signal, FloatArray], dict[Signal, Any], list[SignalSource]]:
    """Convert each column and fill in the constants."""
    constants = {c.name: c.value for c in mapping.constants.values()}
    check_constants({i.signal: constants[i.topic] for i in SIGNALS if i.topic in constants})
    columns: dict[Signal, FloatArray] = {}
    quality: dict[Signal, Any] = {}
    sources = []
    for info in SIGNALS:
        written = raw.columns.get(info.column)
        if info.topic in constants:
            if written is not None:
                console.warn(
                    f"{info.topic} stands in the table as '{raw.names[info.column]}' too; "
                    'the constant is used instead.'
                )
            value = constants[info.topic]
            columns[info.signal] = np.full(len(rows), value)
            sources.append(
                SignalSource(info.topic, '', info.unit, info.unit, value, value, 0, True)
            )
        elif written is not None:
            unit = unit_for(info.signal, mapping)
            columns[info.signal] = convert(info.signal, unit, written[rows])
            if info.column in raw.quality:
                quality[info.signal] = raw.quality[info.column][rows]
            sources.append(_source(info, raw, unit, columns[info.signal]))
            _doubt_aloud(info, written, unit, raw.names[info.column], console)
    _say_uncertain(quality, console)
    return columns, quality, sources


def _source(info: SignalInfo, raw: RawTable, unit: str, values: FloatArray) -> SignalSource:
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)
    return SignalSource(
        info.topic, raw.names[info.column], unit, info.unit, low, high,
        len(values) - len(known), False,
    )  # fmt: skip


def _doubt_aloud(
    info: SignalInfo, written: FloatArray, unit: str, theirs: str, console: Console
) -> None:
    found = doubt(info.signal, written, unit, Settings())
    if found is not None:
        console.warn(advice(found, theirs))


def _say_uncertain(quality: dict[Signal, Any], console: Console) -> None:
    """Say what a plain recording cannot hold."""
    uncertain = sum(int((codes == Quality.UNCERTAIN).sum()) for codes in quality.values())
    if uncertain:
        console.warn(
            f'{uncertain} values are marked uncertain; a plain recording has no place for that '
            'mark, they stand there as good.'
        )
