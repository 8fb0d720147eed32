# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read a historian's table once, check it, and return its rows in chronological order.

The values are stored on disk: a table of years needs memory for its times only.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.interface import Progress, plausibility
from valveflow_ros.interface.files import reason
from valveflow_ros.interface.logs import Series, read_series
from valveflow_ros.interface.mapping import LogMapping, merge_refusals
from valveflow_ros.logs.reader import TABLE_SUFFIXES
from valveflow_ros.logs.tables.reader import RawBlock, TableReader
from valveflow_ros.logs.tables.refusal import RefusedError
from valveflow_ros.logs.tables.table import order_note
from valveflow_ros.logs.tables.words import split_unit
from valveflow_ros.parameters import Settings
from valveflow_ros.records import (
    SIGNALS,
    ByteArray,
    FloatArray,
    IntArray,
    Quality,
    Readings,
    SampleTable,
    Signal,
    finite,
    table_to_readings,
)
from valveflow_ros.report.data import Gap, gaps
from valveflow_ros.signals.units import convert, engine_unit

_SAMPLE = 500_000  # values that are enough to check a unit
_ROWS = 200_000  # in memory at a time
_SIGNALS = {info.column: info.signal for info in SIGNALS}


@dataclass(frozen=True, slots=True)
class SignalSource:
    """The column of one signal; ``low`` and ``high`` in the engine's unit.

    ``words`` counts the texts in place of numbers, the most frequent first, and ``empty`` the
    cells without a value; ``ground`` says why the column was chosen, if it was not named; ``air``
    describes the air pressure that is added to a gauge pressure.
    """

    topic: str
    column: str
    written_unit: str
    unit: str
    low: float
    high: float
    missing: int
    constant: bool
    words: dict[str, int] = field(default_factory=dict)
    empty: int = 0
    ground: str = ''
    air: str = ''


class _Statistics:
    """Range and a sample of a column that is read in blocks."""

    def __init__(self) -> None:
        self.low = self.high = float('nan')
        self.missing = 0
        self._parts: list[FloatArray] = []
        self._stride = 1

    def add(self, values: FloatArray) -> None:
        """Add a block of values in the unit of the file."""
        finite = values[np.isfinite(values)]
        self.missing += len(values) - len(finite)
        if not len(finite):
            return
        self.low = float(np.fmin(self.low, finite.min()))
        self.high = float(np.fmax(self.high, finite.max()))
        self._parts.append(finite[:: self._stride].copy())
        if sum(map(len, self._parts)) > _SAMPLE:
            self._stride *= 2
            self._parts = [np.concatenate(self._parts)[::2].copy()]

    def sample(self) -> FloatArray:
        """Return representative values, including the lowest and the highest."""
        return np.concatenate([*self._parts, np.array([self.low, self.high])])


# Times, row numbers in the file, columns, qualities.
_Block = tuple[IntArray, slice | IntArray, dict[Signal, FloatArray], dict[Signal, ByteArray]]


class Spool:
    """Columns in unnamed temporary files in a folder with enough space: that of the log."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, tuple[IO[bytes], np.dtype[Any]]] = {}

    def append(self, name: str, values: NDArray[Any]) -> None:
        """Add values to the end of a column; `RecordingError` if the disk is full."""
        try:
            if name not in self._files:
                file: IO[bytes] = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115
                self._files[name] = file, values.dtype
            file, dtype = self._files[name]
            file.write(np.ascontiguousarray(values, dtype).data.cast('B'))
            file.flush()
        except OSError as error:
            problem = f'has no room for the work ({reason(error)})'
            raise RecordingError(self._folder, problem) from None

    def __contains__(self, name: str) -> bool:
        """Return True if there is such a column."""
        return name in self._files

    def take(self, name: str, rows: slice | IntArray) -> NDArray[Any]:
        """Return rows of a column: a slice, or any indices in any order."""
        file, dtype = self._files[name]
        column: NDArray[Any] = np.memmap(file, dtype, 'r')
        return np.array(column[rows])

    def close(self) -> None:
        """Release the disk space."""
        for file, _ in self._files.values():
            file.close()


class TableImport:
    """A table that is read once, checked, and then returned in chronological order.

    Parameters
    ----------
    covariates : mapping of str to str
        Further columns to keep, by the topic: ``COLUMN`` or ``COLUMN:unit``.
    strict : bool
        Also refuse a column that the user named without a unit if its values contradict the
        usual unit; otherwise only warn.

    Attributes
    ----------
    rows_read, rows, duplicates : int
        Number of rows with a readable time, of rows used, and of rows left out because
        their time occurred before.
    period_s : float
        Median step of time.
    gaps : list of Gap
        The longest first.
    ignored, numeric_ignored : tuple of str
        Columns that were not used; those of them that hold different numbers.
    further : dict of str to Series
        The covariates by topic; complete when the table was read.
    time_zone, time_words : str
        The assumed time zone, and a description of the format of the times.
    is_long : bool
        True if the table has one row per value.

    Raises
    ------
    RecordingError, InputError, DataError
        The table cannot be read, a column is missing, or a unit is unknown.
    """

    def __init__(
        self,
        path: Path,
        mapping: LogMapping,
        progress: Progress,
        *,
        covariates: Mapping[str, str] | None = None,
        strict: bool = False,
    ) -> None:
        if path.suffix.lower() not in TABLE_SUFFIXES:
            raise RecordingError(path, 'is no .csv, .xlsx or .parquet table')
        self._progress, self._mapping, self._strict = progress, mapping, strict
        self._reader = mapping.open_with(
            lambda names: TableReader(path, names, list(mapping.constants), mapping.table)
        )
        self._covariates = covariates or {}
        self.further: dict[str, Series] = {}
        self._constants = mapping.constant_signals
        names = self._reader.names
        told = {_SIGNALS[n]: unit for n, unit in self._reader.units.items()}
        self._units = {name: mapping.unit_of(_SIGNALS[name], told) for name in names}
        measured = {_SIGNALS[name]: unit for name, unit in self._units.items()}
        self._stated = {**measured, **mapping.constant_units}
        self._limits = Settings(plausibility.limits_beside_steam(self._stated, self._constants))
        plausibility.check_constants(self._constants, self._limits)
        self._output = engine_unit(
            Signal.GENERATED_POWER, self._stated.get(Signal.GENERATED_POWER, '')
        )
        progress.measured_in(self._output)
        self._used = [n for n in names if _SIGNALS[n] not in self._constants]
        self._spool: Spool | None = None
        self._statistics = {name: _Statistics() for name in self._used}
        self._time_ns: IntArray = np.empty(0, np.int64)
        # Rows to use, in chronological order; None: all rows in the order of the file.
        self._order: IntArray | None = None
        unused = [n for n in names if n not in self._used]
        self.ignored = (*self._reader.ignored, *(names[n] for n in unused))
        self.rows_read = self.rows = self.duplicates = 0
        self.period_s, self.span_ns = 0.0, (0, 0)
        self.gaps: list[Gap] = []
        self.notes: tuple[str, ...] = ()
        self.time_zone, self.time_words = '', ''
        self.is_long = self._reader.long is not None
        self.numeric_ignored: tuple[str, ...] = ()
        for name in unused:
            progress.warn(
                f"{SIGNALS[_SIGNALS[name]].topic} stands in the table as '{names[name]}' too; the "
                'constant is used instead.'
            )

    @property
    def signals(self) -> list[Signal]:
        """Return the signals that will have readings."""
        return sorted({*(_SIGNALS[name] for name in self._used), *self._constants})

    def read(self, spool: Spool | None) -> None:
        """Read the whole table and check it; store the values in the spool unless it is a trial.

        Raises as the constructor; also if no row is usable, or the values of a column contradict
        the signal or unit assumed for it.
        """
        reader = self._reader
        times: list[IntArray] = []
        uncertain = 0
        for block in reader.blocks():
            times.append(block.time_ns)
            self._progress(0.1 + 0.5 * reader.share, 'reading')
            for name in self._used:
                there = block.present.get(name, slice(None))
                self._statistics[name].add(block.columns[name][there])
                if name in block.quality:
                    uncertain += int((block.quality[name][there] == Quality.UNCERTAIN).sum())
            if spool is not None:
                self._keep(block, spool)
        self._spool = spool
        refused: list[RefusedError] = []
        notes: list[str] = []
        try:
            notes = reader.notes()
        except RefusedError as error:
            if not times:
                raise
            refused.append(error)
        self._time_ns = np.concatenate(times)
        notes += self._sort()
        notes = [note for note in notes if note]
        for note in notes:
            self._progress.say(note)
        airs = (
            plausibility.air_note(_SIGNALS[n], self._units[n], reader.names[n]) for n in self._used
        )
        notes += filter(None, airs)  # the result says them
        if all(np.isnan(found.low) for found in self._statistics.values()):
            raise DataError(f'{reader.path}: there is no number in any of the columns used.')
        self._judge(refused)
        if uncertain:
            self._progress.warn(
                f'{uncertain} values are marked uncertain; a plain recording has no place for '
                'that mark, they stand there as good.'
            )
        self._read_further()
        self.notes = (*reader.understood(), *notes)
        self.time_zone, self.time_words = reader.time_zone, reader.time_words

    def tables(self) -> Iterator[SampleTable]:
        """Yield the rows in chronological order, in the engine's units."""
        for time_ns, _, columns, quality in self._blocks():
            for signal, value in self._constants.items():
                columns[signal] = np.full(len(time_ns), value)
            yield SampleTable.from_columns(time_ns, columns, quality)

    def readings(self) -> Iterator[Readings]:
        """Yield the values one by one in chronological order, in the engine's units.

        Those of the covariates have the numbers that follow those of the signals.
        """
        yield from _merged(self._readings(), list(self.further.values()))

    def _readings(self) -> Iterator[Readings]:
        if not self.is_long:
            yield from map(table_to_readings, self.tables())
            return
        assert self._spool is not None
        signals = np.array([_SIGNALS[name] for name in self._used], np.int8)
        for time_ns, rows, columns, quality in self._blocks():
            table = SampleTable.from_columns(time_ns, columns, quality)
            there = [self._spool.take(f'{name}?', rows) for name in self._used]
            row, column = np.nonzero(np.column_stack(there))
            signal = signals[column]
            readings = Readings(
                time_ns[row], signal, table.values[row, signal], table.quality[row, signal]
            )
            yield plausibility.with_constants(readings, self._constants)

    def sources(self) -> list[SignalSource]:
        """Return the source of each signal, in the order of `Signal`."""
        sources = []
        reader = self._reader
        for info in SIGNALS:
            name = info.column
            unit = engine_unit(info.signal, self._stated.get(info.signal, ''))
            if info.signal in self._constants:
                value = self._constants[info.signal]
                sources.append(SignalSource(info.topic, '', unit, unit, value, value, 0, True))
            elif name in self._used:
                found, written = self._statistics[name], self._units[name]
                theirs = reader.names[name]
                ends = np.array([found.low, found.high])
                low, high = np.sort(convert(info.signal, written, ends))
                sources.append(
                    SignalSource(
                        info.topic, theirs, written, unit, float(low), float(high),
                        found.missing, False, dict(reader.words[name].most_common(8)),
                        reader.empty[name], reader.grounds.get(name, ''),
                        plausibility.air_note(info.signal, written, theirs),
                    )
                )  # fmt: skip
        return sources

    def summary(self) -> dict[str, Any]:
        """Return the interpretation of the table as plain values."""
        start_ns, end_ns = self.span_ns
        return {
            'source': str(self._reader.path),
            'rows': self.rows,
            'rows_read': self.rows_read,
            'duplicates': self.duplicates,
            'period_s': self.period_s,
            'start_ns': start_ns,
            'end_ns': end_ns,
            'time_zone': self.time_zone,
            'gaps': len(self.gaps),
            'signals': [asdict(source) for source in self.sources()],
            'covariates': [
                {
                    'name': name,
                    'column': series.column,
                    'unit': series.unit,
                    'low': float(series.values.min()),
                    'high': float(series.values.max()),
                    'values': len(series.values),
                }
                for name, series in self.further.items()
            ],
            'ignored': list(self.ignored),
            'notes': list(self.notes),
        }

    def as_json(self) -> str:
        """Return the summary as JSON text for the log, with the file's name without its path."""
        content = {**self.summary(), 'source': self._reader.path.name}
        return json.dumps(finite(content), indent=2, allow_nan=False)

    def _read_further(self) -> None:
        path = self._reader.path
        for name, said in self._covariates.items():
            self._progress(0.6, f'reading {name}')
            self.further[name] = read_series(path, self._mapping, str(path), name, said)
        kept = {series.column for series in self.further.values()}
        kept |= {n for n in self.ignored if split_unit(n)[0] in kept}
        self.ignored = tuple(name for name in self.ignored if name not in kept)
        self.numeric_ignored = tuple(n for n in self._reader.numeric_ignored if n not in kept)

    def _sort(self) -> list[str]:
        """Sort the rows by time; a long table may repeat a time, another table may not."""
        time_ns, order = self._time_ns, None
        steps = np.diff(time_ns)
        notes = []
        if (steps < 0).any():
            newest_first = bool((steps <= 0).all())
            notes = [] if self.is_long else [order_note(newest_first)]
            order = np.arange(len(time_ns))[:: -1 if newest_first else 1]
            order = order[np.argsort(time_ns[order], kind='stable')]
            steps = np.diff(time_ns[order])
        if not self.is_long and (steps == 0).any():
            self.duplicates = int((steps == 0).sum())
            order = np.arange(len(time_ns)) if order is None else order
            order = order[np.r_[True, steps != 0]]
        self._order = order
        ordered = time_ns if order is None else time_ns[order]
        distinct = ordered[np.r_[True, np.diff(ordered) > 0]]
        steps = np.diff(distinct)
        self.rows_read, self.rows = len(time_ns), len(ordered)
        self.period_s = float(np.median(steps)) / 1e9 if len(steps) else 0.0
        self.span_ns = int(distinct[0]), int(distinct[-1])
        self.gaps = gaps(distinct, max(1, round(self.period_s * 1e9)))
        return notes

    def _keep(self, block: RawBlock, spool: Spool) -> None:
        for name in self._used:
            spool.append(name, block.columns[name])
            if name in block.quality:
                spool.append(f'{name}!', block.quality[name])
            if name in block.present:
                spool.append(f'{name}?', block.present[name])

    def _blocks(self) -> Iterator[_Block]:
        """Yield times, row numbers in the file, columns and qualities, block by block."""
        spool = self._spool
        assert spool is not None
        for start in range(0, self.rows, _ROWS):
            part = slice(start, min(start + _ROWS, self.rows))
            rows = part if self._order is None else self._order[part]
            columns: dict[Signal, FloatArray] = {}
            quality: dict[Signal, ByteArray] = {}
            for name in self._used:
                signal = _SIGNALS[name]
                columns[signal] = convert(signal, self._units[name], spool.take(name, rows))
                if f'{name}!' in spool:
                    quality[signal] = spool.take(f'{name}!', rows)
            yield self._time_ns[rows], rows, columns, quality

    def _judge(self, refused: list[RefusedError]) -> None:
        """Raise `RefusedError` for wrong guesses, and warn of other implausible columns."""
        settings, reader, steam = self._limits, self._reader, self._output == 'MW'
        judged = (
            plausibility.doubt(_SIGNALS[name], found.sample(), self._units[name], settings, steam)
            for name, found in self._statistics.items()
        )
        doubts = [found for found in judged if found is not None]
        guessed = {_SIGNALS[name] for name in reader.grounds}
        names = {_SIGNALS[name]: theirs for name, theirs in reader.names.items()}
        try:
            # If anything is refused, report all other problems in the same message.
            plausibility.refuse_guesses(
                reader.path, doubts, guessed, self._mapping.unsaid(names), names,
                strict=self._strict or bool(refused),
            )  # fmt: skip
        except RefusedError as error:
            refused.append(error)
        if refused:
            # The interpretation so far helps the user to correct the command.
            for sentence in reader.understood():
                self._progress.say(sentence)
            raise merge_refusals(reader.path, refused)
        plausibility.refuse_impossible(reader.path, doubts, names)
        for found in doubts:
            self._progress.warn(found.advice(names[found.signal]))


def _merged(blocks: Iterable[Readings], further: list[Series]) -> Iterator[Readings]:
    """Yield the blocks with the further columns merged, in chronological order."""
    done = [0] * len(further)

    def upto(end_ns: int | None) -> Iterator[Readings]:
        for k, series in enumerate(further):
            end = len(series.time_ns)
            if end_ns is not None:
                end = int(np.searchsorted(series.time_ns, end_ns, side='right'))
            part, done[k] = slice(done[k], end), end
            n = len(series.time_ns[part])
            yield Readings(
                series.time_ns[part], np.full(n, len(SIGNALS) + k, np.int8), series.values[part],
                np.full(n, Quality.GOOD, np.uint8),
            )  # fmt: skip

    for block in blocks:
        parts = [block, *(upto(int(block.time_ns[-1])) if len(block) else ())]
        yield _in_order(parts) if further else block
    if further:
        yield _in_order(list(upto(None)))


def _in_order(parts: list[Readings]) -> Readings:
    whole = plausibility.joined(parts)
    return plausibility.selected(whole, np.argsort(whole.time_ns, kind='stable'))
