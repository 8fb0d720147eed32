"""Read a historian's table once, judge it, and give it out in the order of time."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.interface import Progress
from valveflow_ros.interface.files import reason
from valveflow_ros.interface.mapping import LogMapping, joined
from valveflow_ros.interface.plausibility import (
    air_note,
    check_constants,
    doubt,
    refuse_guesses,
    with_constants,
)
from valveflow_ros.logs.reader import TABLE_SUFFIXES
from valveflow_ros.logs.tables.reader import RawBlock, TableReader
from valveflow_ros.logs.tables.refusal import RefusedError
from valveflow_ros.logs.tables.table import order_note
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
    table_to_readings,
)
from valveflow_ros.report.data import Gap, gaps
from valveflow_ros.signals.units import convert

_SAMPLE = 500_000  # so many values are enough to judge a unit by


@dataclass(frozen=True, slots=True)
class SignalSource:
    """Where one signal comes from; ``low`` and ``high`` in the engine's unit.

    ``words`` counts what stands in cells in place of numbers, the most frequent
    first; ``empty`` counts cells that are empty or say so; ``ground`` says why the
    column was chosen, where that had to be found out; ``air`` what is added to a gauge
    pressure.
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


@dataclass(frozen=True, slots=True)
class Imported:
    """A table that was understood.

    Attributes
    ----------
    sources : list of SignalSource
        In the order of `Signal`.
    rows_read, rows, duplicates : int
        Rows of the file with a readable time, those used, and those left out
        for having one that stood there before.
    period_s : float
        Median step.
    span_ns : tuple of int
        First and last time.
    gaps : list of Gap
        The longest first.
    ignored : tuple of str
        Columns that were not used.
    notes : tuple of str
        Sentences of the reader.
    time_zone : str
        The zone the times were taken to be in.
    time_words : str
        How the times are written.
    """

    path: Path
    sources: list[SignalSource]
    rows_read: int
    rows: int
    duplicates: int
    period_s: float
    span_ns: tuple[int, int]
    gaps: list[Gap]
    ignored: tuple[str, ...]
    notes: tuple[str, ...]
    time_zone: str
    time_words: str = ''

    def summary(self) -> dict[str, Any]:
        """Return everything, for a program."""
        return {
            'source': str(self.path),
            'rows': self.rows,
            'rows_read': self.rows_read,
            'duplicates': self.duplicates,
            'period_s': self.period_s,
            'start_ns': self.span_ns[0],
            'end_ns': self.span_ns[1],
            'time_zone': self.time_zone,
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


class Tally:
    """Range and a sample of a column that passes by in blocks."""

    def __init__(self) -> None:
        self.low = self.high = float('nan')
        self.known = 0
        self.missing = 0
        self._parts: list[FloatArray] = []
        self._stride = 1

    def add(self, values: FloatArray) -> None:
        """Count a block, values as they stand in the file."""
        finite = values[np.isfinite(values)]
        self.known += len(finite)
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
        """Return values that stand for all, the lowest and the highest among them."""
        ends = [np.array([self.low, self.high])] if self.known else []
        return np.concatenate([*self._parts, *ends]) if self._parts else np.empty(0)


@dataclass(frozen=True, slots=True)
class Ordered:
    """In which order the rows of a file are to be taken.

    Attributes
    ----------
    time_ns : int64 (n,)
        In the order of the file.
    order : int64 (m,) or None
        Rows to be taken; ``None``: all, as they stand.
    duplicates : int
        Rows left out for having a time that stood there before.
    sorted_how : str
        A sentence, if the rows had to be sorted.
    """

    time_ns: IntArray
    order: IntArray | None
    duplicates: int = 0
    sorted_how: str = ''

    @classmethod
    def of(cls, time_ns: IntArray, long: bool) -> Ordered:
        """Sort the times; of a table with a row a value no time is one too many."""
        steps = np.diff(time_ns)
        order, how = None, ''
        if (steps < 0).any():
            newest_first = bool((steps <= 0).all())
            how = '' if long else order_note(newest_first)
            order = np.arange(len(time_ns))
            if newest_first:
                order = order[::-1]
            order = order[np.argsort(time_ns[order], kind='stable')]
            steps = np.diff(time_ns[order])
        again = 0 if long else int((steps == 0).sum())
        if again:
            order = np.arange(len(time_ns)) if order is None else order
            order = order[np.r_[True, steps != 0]]
        return cls(time_ns, order, again, how)

    @property
    def rows_read(self) -> int:
        """Return how many rows have a time."""
        return len(self.time_ns)

    @property
    def rows(self) -> int:
        """Return how many rows are taken."""
        return len(self.time_ns) if self.order is None else len(self.order)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Return the first and the last time."""
        return int(self.time_ns.min()), int(self.time_ns.max())

    @property
    def period_s(self) -> float:
        """Return the median step between different times, 0 if there is none."""
        steps = np.diff(self.distinct())
        return float(np.median(steps)) / 1e9 if len(steps) else 0.0

    def distinct(self) -> IntArray:
        """Return the different times in their order."""
        times = self.time_ns if self.order is None else self.time_ns[self.order]
        return times[np.r_[True, np.diff(times) > 0]]

    def blocks(self, size: int) -> Iterator[tuple[IntArray, slice | IntArray]]:
        """Yield times and rows in the order of time."""
        for start in range(0, self.rows, size):
            if self.order is None:
                part = slice(start, min(start + size, self.rows))
                yield self.time_ns[part], part
            else:
                rows = self.order[start : start + size]
                yield self.time_ns[rows], rows


Array = NDArray[Any]


class Spool:
    """Columns in unnamed files, which vanish with the process.

    Parameters
    ----------
    folder : Path
        Where there is room for them: beside the log that is to be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, tuple[IO[bytes], np.dtype[Any]]] = {}

    def append(self, name: str, values: Array) -> None:
        """Add values to the end of a column.

        Raises
        ------
        RecordingError
            If the disk is full.
        """
        if name not in self._files:
            self._files[name] = (self._file(), values.dtype)
        file, dtype = self._files[name]
        with _said(self._folder):
            file.write(np.ascontiguousarray(values, dtype).data.cast('B'))

    def holds(self, name: str) -> bool:
        """Tell whether there is such a column."""
        return name in self._files

    def take(self, name: str, rows: slice | IntArray) -> Array:
        """Return some rows of a column: a stretch, or any rows in any order."""
        file, dtype = self._files[name]
        if isinstance(rows, slice):
            return self._stretch(file, dtype, rows.start, rows.stop)
        low, high = int(rows.min()), int(rows.max()) + 1
        if high - low <= 4 * len(rows):
            return self._stretch(file, dtype, low, high)[rows - low]
        file.flush()
        everything: Array = np.memmap(file, dtype, 'r')
        return np.array(everything[rows])

    def close(self) -> None:
        """Give the space back."""
        for file, _ in self._files.values():
            file.close()

    def _file(self) -> IO[bytes]:
        # It lives as long as this object; `close` ends it.
        with _said(self._folder):
            return tempfile.TemporaryFile(dir=self._folder)

    def _stretch(self, file: IO[bytes], dtype: np.dtype[Any], start: int, stop: int) -> Array:
        with _said(self._folder):
            file.seek(start * dtype.itemsize)
            raw = file.read((stop - start) * dtype.itemsize)
        return np.frombuffer(raw, dtype)


@contextmanager
def _said(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RecordingError(folder, f'has no room for the work ({reason(error)})') from None


_ROWS = 200_000  # in memory at a time
_BY_COLUMN = {info.column: info for info in SIGNALS}


class TableImport:
    """A table that is read once, judged, and then given out in the order of time.

    Parameters
    ----------
    path : Path
        The table.
    mapping : LogMapping
        What the person said of it.
    progress : Progress
        Receives what was understood and what looks wrong.
    strict : bool
        Refuse also a column that the person named without its unit, where its values speak
        against the usual one; otherwise that is a warning.

    Raises
    ------
    RecordingError, InputError, DataError
        It cannot be read, a column is missing, a unit unknown.
    """

    def __init__(
        self, path: Path, mapping: LogMapping, progress: Progress, *, strict: bool = False
    ) -> None:
        if path.suffix.lower() not in TABLE_SUFFIXES:
            raise RecordingError(path, 'is no .csv, .xlsx or .parquet table')
        self._progress = progress
        self._mapping = mapping
        self._strict = strict
        self._reader = mapping.opened(
            lambda names: TableReader(path, names, list(mapping.constants), mapping.table)
        )
        self._constants = mapping.constant_signals
        check_constants(self._constants)
        told = {_BY_COLUMN[n].signal: unit for n, unit in self._reader.units.items()}
        self._units = {
            name: mapping.unit_of(_BY_COLUMN[name].signal, told) for name in self._reader.names
        }
        self._used = [
            name for name in self._reader.names if _BY_COLUMN[name].signal not in self._constants
        ]
        self._warn_of_constants()

    @property
    def signals(self) -> list[Signal]:
        """Return the signals there will be readings of."""
        return sorted({*(_BY_COLUMN[name].signal for name in self._used), *self._constants})

    @property
    def is_long(self) -> bool:
        """Tell whether the table has a row for each value."""
        return self._reader.long is not None

    def read(self, spool: Spool | None) -> tuple[Imported, Ordered]:
        """Read the whole table into the spool (or only look at it) and judge it.

        Raises
        ------
        RecordingError, InputError, DataError
            As the constructor; or no row is usable, or the values of a column
            speak against what it was taken for.
        """
        times: list[IntArray] = []
        tallies = {name: Tally() for name in self._used}
        uncertain = 0
        for block in self._reader.blocks():
            times.append(block.time_ns)
            self._progress(0.1 + 0.5 * self._reader.share, 'reading')
            for name in self._used:
                there = block.present.get(name)
                column = block.columns[name]
                tallies[name].add(column if there is None else column[there])
                uncertain += _uncertain(block, name)
            if spool is not None:
                self._keep(block, spool)
        refused: list[RefusedError] = []
        try:
            notes = self._reader.notes()
        except RefusedError as error:
            refused.append(error)
            notes = []
        ordered = Ordered.of(np.concatenate(times), self.is_long)
        if ordered.sorted_how:
            notes.append(ordered.sorted_how)
        airs = (
            air_note(_BY_COLUMN[name].signal, self._units[name], self._reader.names[name])
            for name in self._used
        )
        notes += [note for note in airs if note]
        for note in notes:
            self._progress.say(note)
        if not any(tally.known for tally in tallies.values()):
            path = self._reader.path
            raise DataError(f'{path}: there is no number in any of the columns used.')
        self._judge(tallies, refused)
        if uncertain:
            self._progress.warn(
                f'{uncertain} values are marked uncertain; a plain recording has no place for '
                'that mark, they stand there as good.'
            )
        return self._told(tallies, ordered, notes), ordered

    def tables(self, spool: Spool, ordered: Ordered) -> Iterator[SampleTable]:
        """Yield the rows in the order of time, in the engine's units."""
        for time_ns, rows in ordered.blocks(_ROWS):
            columns, quality = self._columns(spool, rows)
            for signal, value in self._constants.items():
                columns[signal] = np.full(len(time_ns), value)
            yield SampleTable.from_columns(time_ns, columns, quality)

    def readings(self, spool: Spool, ordered: Ordered) -> Iterator[Readings]:
        """Yield the values one by one in the order of time, in the engine's units."""
        if not self.is_long:
            yield from map(table_to_readings, self.tables(spool, ordered))
            return
        names = self._used
        for time_ns, rows in ordered.blocks(_ROWS):
            columns, quality = self._columns(spool, rows)
            table = SampleTable.from_columns(time_ns, columns, quality)
            there = np.column_stack([spool.take(f'{name}?', rows) for name in names])
            row, column = np.nonzero(there)
            signal = np.array([_BY_COLUMN[name].signal for name in names], np.int8)[column]
            readings = Readings(
                time_ns[row], signal, table.values[row, signal], table.quality[row, signal]
            )
            yield with_constants(readings, self._constants)

    def _columns(
        self, spool: Spool, rows: slice | IntArray
    ) -> tuple[dict[Signal, FloatArray], dict[Signal, ByteArray]]:
        columns: dict[Signal, FloatArray] = {}
        quality: dict[Signal, ByteArray] = {}
        for name in self._used:
            signal = _BY_COLUMN[name].signal
            columns[signal] = convert(signal, self._units[name], spool.take(name, rows))
            if spool.holds(f'{name}!'):
                quality[signal] = spool.take(f'{name}!', rows)
        return columns, quality

    def _keep(self, block: RawBlock, spool: Spool) -> None:
        for name in self._used:
            spool.append(name, block.columns[name])
            if name in block.quality:
                spool.append(f'{name}!', block.quality[name])
            if name in block.present:
                spool.append(f'{name}?', block.present[name])

    def _warn_of_constants(self) -> None:
        for name, theirs in self._reader.names.items():
            if _BY_COLUMN[name].signal in self._constants:
                self._progress.warn(
                    f"{_BY_COLUMN[name].topic} stands in the table as '{theirs}' too; the "
                    'constant is used instead.'
                )

    def _judge(self, tallies: dict[str, Tally], refused: list[RefusedError]) -> None:
        """Refuse what was guessed wrongly, and warn of the rest; raises `RefusedError`."""
        settings, doubts = Settings(), {}
        for name, tally in tallies.items():
            signal = _BY_COLUMN[name].signal
            found = doubt(signal, tally.sample(), self._units[name], settings)
            if found is not None:
                doubts[name] = found
        guessed = {_BY_COLUMN[name].signal for name in self._reader.grounds}
        names = {_BY_COLUMN[name].signal: theirs for name, theirs in self._reader.names.items()}
        said = {c.name for c in self._mapping.columns.values() if c.unit}
        unsaid = {signal for signal in names if SIGNALS[signal].topic not in said}
        for strict, grounds in ((False, guessed), (True, unsaid)):
            # Who has to come back for one thing is told of the others too.
            if strict and not (self._strict or refused):
                break
            try:
                refuse_guesses(self._reader.path, doubts.values(), grounds, names)
            except RefusedError as error:
                refused[:] = [one for one in refused if not one.last] + [error]
        if refused:
            # What was understood until then is of use to who has to correct it.
            for sentence in self._reader.understood():
                self._progress.say(sentence)
            raise joined(self._reader.path, refused)
        for name, found in doubts.items():
            self._progress.warn(found.advice(self._reader.names[name]))

    def _told(self, tallies: dict[str, Tally], ordered: Ordered, notes: list[str]) -> Imported:
        reader = self._reader
        period_s = ordered.period_s
        unused = [reader.names[n] for n in reader.names if n not in self._used]
        return Imported(
            reader.path, self._sources(tallies), ordered.rows_read, ordered.rows,
            ordered.duplicates, period_s, ordered.span_ns,
            gaps(ordered.distinct(), max(1, round(period_s * 1e9))),
            (*reader.ignored, *unused), (*reader.understood(), *notes),
            reader.time_zone, reader.time_words,
        )  # fmt: skip

    def _sources(self, tallies: dict[str, Tally]) -> list[SignalSource]:
        sources = []
        for info in SIGNALS:
            if info.signal in self._constants:
                value = self._constants[info.signal]
                sources.append(
                    SignalSource(info.topic, '', info.unit, info.unit, value, value, 0, True)
                )
            elif info.column in self._used:
                tally, unit = tallies[info.column], self._units[info.column]
                low, high = np.sort(convert(info.signal, unit, np.array([tally.low, tally.high])))
                sources.append(
                    SignalSource(
                        info.topic,
                        self._reader.names[info.column],
                        unit,
                        info.unit,
                        float(low),
                        float(high),
                        tally.missing,
                        False,
                        dict(self._reader.words[info.column].most_common(8)),
                        self._reader.empty[info.column],
                        self._reader.grounds.get(info.column, ''),
                        air_note(info.signal, unit, self._reader.names[info.column]),
                    )
                )
        return sources


def _uncertain(block: RawBlock, name: str) -> int:
    codes: Any = block.quality.get(name)
    if codes is None:
        return 0
    there = block.present.get(name)
    return int(((codes == Quality.UNCERTAIN) if there is None else
                ((codes == Quality.UNCERTAIN) & there)).sum())  # fmt: skip
