"""A historian's table as readings, with everything that had to be understood about it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.cli.console import Console
from valveflow_ros.cli.constant_signals import check_constants, with_constants
from valveflow_ros.cli.historian_facts import Imported, SignalSource, Tally
from valveflow_ros.cli.historian_open import joined
from valveflow_ros.cli.historian_order import Ordered
from valveflow_ros.cli.historian_spool import Spool
from valveflow_ros.cli.log_input import (
    advice,
    air_note,
    names_for,
    refuse_guesses,
    unit_for,
    unknown_unit,
)
from valveflow_ros.cli.mapping import Mapping
from valveflow_ros.cli.plausible import doubt
from valveflow_ros.config import Settings
from valveflow_ros.errors import DataError, InputError, RecordingError
from valveflow_ros.logs.reader import TABLE_SUFFIXES
from valveflow_ros.logs.tables.historian_refusal import RefusedError
from valveflow_ros.logs.tables.table_reader import RawBlock, TableReader
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
from valveflow_ros.report.quality import gaps
from valveflow_ros.signals.unit_table import convert

_ROWS = 200_000  # in memory at a time
_BY_COLUMN = {info.column: info for info in SIGNALS}


class Historian:
    """A table that is read once, judged, and then given out in the order of time.

    Parameters
    ----------
    path : Path
        The table.
    mapping : Mapping
        What the person said of it.
    console : Console
        Hears what was understood and what looks wrong.
    strict : bool
        Refuse also a column that the person named without its unit, where its values speak
        against the usual one; otherwise that is a warning.

    Raises
    ------
    RecordingError, InputError, DataError
        It cannot be read, a column is missing, a unit unknown.
    """

    def __init__(
        self, path: Path, mapping: Mapping, console: Console, *, strict: bool = False
    ) -> None:
        if path.suffix.lower() not in TABLE_SUFFIXES:
            raise RecordingError(path, 'is no .csv, .xlsx or .parquet table')
        self._console = console
        self._mapping = mapping
        self._strict = strict
        self._reader = _reader(path, mapping)
        self._constants = {
            info.signal: mapping.constants[info.topic].value
            for info in SIGNALS
            if info.topic in mapping.constants
        }
        check_constants(self._constants)
        told = {_BY_COLUMN[n].signal: unit for n, unit in self._reader.units.items()}
        self._units = {
            name: unit_for(_BY_COLUMN[name].signal, mapping, told) for name in self._reader.names
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
            self._console.progress(0.1 + 0.5 * self._reader.share, 'reading')
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
            self._console.say(note)
        if not any(tally.known for tally in tallies.values()):
            path = self._reader.path
            raise DataError(f'{path}: there is no number in any of the columns used.')
        self._judge(tallies, refused)
        if uncertain:
            self._console.warn(
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
                self._console.warn(
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
                self._console.say(sentence)
            raise joined(self._reader.path, refused)
        for name, found in doubts.items():
            self._console.warn(advice(found, self._reader.names[name]))

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


def _reader(path: Path, mapping: Mapping) -> TableReader:
    columns, strange = names_for(mapping)
    try:
        return TableReader(path, columns, list(mapping.constants), mapping.table)
    except InputError as error:
        if not strange:
            raise
        raise unknown_unit(strange[0]) from error


def _uncertain(block: RawBlock, name: str) -> int:
    codes: Any = block.quality.get(name)
    if codes is None:
        return 0
    there = block.present.get(name)
    return int(((codes == Quality.UNCERTAIN) if there is None else
                ((codes == Quality.UNCERTAIN) & there)).sum())  # fmt: skip
