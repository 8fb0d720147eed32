"""Understands a table before it is read, and then reads it block by block."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from valveflow_ros.logs.tables.cells import (
    Column,
    foreign_quality,
    to_numbers,
    to_quality,
    understands,
)
from valveflow_ros.logs.tables.plan import LongForm, TablePlan
from valveflow_ros.logs.tables.refusal import AS_SEEN, TableOptions
from valveflow_ros.logs.tables.times import never
from valveflow_ros.records import SIGNALS, BoolArray, ByteArray, FloatArray, IntArray, Quality

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True)
class RawBlock:
    """Some rows in the order of the file, as in `RawTable`; only those whose time is known."""

    time_ns: IntArray
    columns: dict[str, FloatArray]
    quality: dict[str, ByteArray]
    present: dict[str, BoolArray] = field(default_factory=dict)


class TableReader:
    """A table whose columns are understood.

    Parameters
    ----------
    path : Path
        The file.
    columns, absent, options
        As in `read_table`.

    Attributes
    ----------
    names, units, grounds : dict[str, str]
        By contract column name: theirs, the unit the file names, why it was chosen.
    words : dict[str, Counter]
        By contract column name: what stands in place of numbers, how often; complete
        when all blocks were read.
    bad_times : int
        Rows without a readable time; likewise.

    Raises
    ------
    RecordingError, InputError
        As `read_table`.
    """

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, str],
        absent: Collection[str] = (),
        options: TableOptions = AS_SEEN,
    ) -> None:
        self._plan = plan = TablePlan(path, columns, absent, options)
        self.path = path
        self.long = plan.long
        self.names = {name: c.theirs for name, c in plan.chosen.items()}
        self.units = {n: c.unit.unit for n, c in plan.chosen.items() if c.unit is not None}
        self.grounds = {name: c.ground for name, c in plan.chosen.items() if c.ground}
        self.ignored = plan.ignored
        self.words: dict[str, Counter[str]] = {name: Counter() for name in self.names}
        self.empty: Counter[str] = Counter()
        self._marked_bad: Counter[str] = Counter()
        self._first_bad: dict[str, tuple[int, str]] = {}
        self.bad_times = 0
        self.rows = 0
        self._first_bad_time = 0

    @property
    def bad_cells(self) -> dict[str, int]:
        """Return how many cells hold something else than a number, where some do."""
        return {name: words.total() for name, words in self.words.items() if words}

    @property
    def share(self) -> float:
        """Return how much of the file was read so far, as far as that is known."""
        return self._plan.file.share

    @property
    def time_zone(self) -> str:
        """Return the zone the times were taken to be in, and why; known when all was read."""
        return self._plan.clock.told_zone

    @property
    def time_words(self) -> str:
        """Return which column the times are from and how they are written."""
        names = [
            self._plan.file.names[k] for k in (self._plan.date, self._plan.time) if k is not None
        ]
        told = ' and '.join(f"'{name}'" for name in names)
        return f'{told}, {self._plan.clock.words}'

    @property
    def local_guess(self) -> bool:
        """Tell whether the times name no zone and UTC was taken for want of a better word."""
        return self._plan.clock.told_zone.startswith('UTC (')

    def blocks(self) -> Iterator[RawBlock]:
        """Yield the rows whose time is known, block by block; raises like `read_table`."""
        if self.long is not None:
            yield from self._long_blocks(self.long)
            return
        places = [c.place for c in self._plan.chosen.values()] + list(self._plan.quality.values())
        places += [k for k in (self._plan.time, self._plan.date) if k is not None]
        for frame in self._plan.file.blocks(places):
            time_ns = self._read_times(frame)
            values, quality = {}, {}
            for name, chosen in self._plan.chosen.items():
                values[name] = self._numbers(name, frame[chosen.place])
                if name in self._plan.quality:
                    cells = frame[self._plan.quality[name]]
                    own = self.names[name] == name
                    quality[name] = to_quality(cells) if own else self._foreign(name, cells)
            self.rows += len(frame)
            known = time_ns != never()
            if known.all():
                yield RawBlock(time_ns, values, quality)
            elif known.any():
                yield RawBlock(
                    time_ns[known],
                    {name: column[known] for name, column in values.items()},
                    {name: codes[known] for name, codes in quality.items()},
                )

    def notes(self) -> list[str]:
        """Return sentences about what was read, when all of it was.

        Raises
        ------
        InputError
            If no row has a time.
        """
        notes = [*self._plan.file.notes, *self._plan.clock.finish()]
        for name, theirs in self.names.items():
            words = self.words[name]
            if words:
                row, text = self._first_bad[name]
                n = words.total()
                are = f"{n} cells of '{theirs}' are no numbers and count"
                one = f"1 cell of '{theirs}' is no number and counts"
                notes.append(
                    f"{one if n == 1 else are} as missing; the first is '{text}' in row {row + 1}."
                )
        notes += self._quality_notes()
        if self.bad_times:
            notes.append(
                f'{self.bad_times} rows have no readable time and were left out, the first is '
                f'row {self._first_bad_time + 1}.'
            )
        return notes

    def understood(self) -> list[str]:
        """Return sentences about what had to be found out: which column is which signal."""
        said = []
        for name, ground in self.grounds.items():
            unit = self._plan.chosen[name].unit
            known = f'in {unit.written}' if unit else 'unit not named'
            topic = next(i.topic for i in SIGNALS if i.column == name)
            said.append(f"'{self.names[name]}' is read as {topic} ({ground}, {known}).")
        if self.local_guess:
            said.append(
                'The times name no zone and are taken as UTC; for local time add --time-zone, '
                'such as --time-zone Europe/Berlin.'
            )
        elif self._plan.options.time_zone or self.long is not None:
            said.append(f'Time zone: {self.time_zone}.')
        return said

    def _foreign(self, name: str, cells: pd.Series[Any]) -> ByteArray:
        codes = foreign_quality(cells)
        self._marked_bad[name] += int((codes == Quality.BAD).sum())
        return codes

    def _quality_notes(self) -> Iterator[str]:
        for name, n in self._marked_bad.items():
            place = self._plan.quality[name] if self.long is None else self.long.quality
            column = self._plan.file.names[place]
            yield (
                f"The quality of '{self.names[name]}' is read from '{column}', by which "
                f'{n} of its values {"is" if n == 1 else "are"} bad.'
            )

    def _read_times(self, frame: pd.DataFrame) -> IntArray:
        column = frame[self._plan.time]
        if self._plan.date is not None:
            days = frame[self._plan.date].astype('string').str.strip().str.slice(0, 11)
            column = days.str.strip() + ' ' + column.astype('string').str.strip()
        time_ns = self._plan.clock.read(column)
        bad = time_ns == never()
        if bad.any():
            if not self.bad_times:
                self._first_bad_time = self.rows + int(bad.argmax())
            self.bad_times += int(bad.sum())
        return time_ns

    def _numbers(self, name: str, cells: pd.Series[Any]) -> FloatArray:
        column = to_numbers(cells, self._plan.marks)
        self._count(name, column, self.rows, cells)
        return column.values

    def _count(self, name: str, column: Column, start: int, cells: pd.Series[Any]) -> None:
        self.words[name].update(column.words)
        self.empty[name] += column.empty
        if column.words and name not in self._first_bad:
            text = str(cells.iloc[column.first_bad_row]).strip()[:40]
            self._first_bad[name] = (start + column.first_bad_row, text)

    def _long_blocks(self, form: LongForm) -> Iterator[RawBlock]:
        places = [form.tag, form.value, self._plan.time]
        places += [k for k in (form.quality, self._plan.date) if k is not None and k >= 0]
        coded = form.quality >= 0 and understands(self._plan.cells(form.quality))
        for frame in self._plan.file.blocks(places):
            time_ns = self._read_times(frame)
            tags = frame[form.tag].astype('string').str.strip()
            values, quality, present = {}, {}, {}
            for name, chosen in self._plan.chosen.items():
                mine = (tags == chosen.theirs).fillna(False).to_numpy(dtype=bool)
                place = np.flatnonzero(mine)
                values[name] = np.full(len(frame), np.nan)
                values[name][place] = self._numbers(name, frame[form.value].iloc[place])
                present[name] = mine
                if coded:
                    codes = np.full(len(frame), int(Quality.GOOD), dtype=np.uint8)
                    codes[place] = self._foreign(name, frame[form.quality].iloc[place])
                    quality[name] = codes
            self.rows += len(frame)
            keep = (time_ns != never()) & np.any(list(present.values()), axis=0)
            if keep.any():
                yield RawBlock(
                    time_ns[keep],
                    {name: column[keep] for name, column in values.items()},
                    {name: codes[keep] for name, codes in quality.items()},
                    {name: there[keep] for name, there in present.items()},
                )
