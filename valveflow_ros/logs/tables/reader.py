# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Determines the columns of a table, and then reads it block by block."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.logs.names import signal_of
from valveflow_ros.logs.tables import cells as cell_values
from valveflow_ros.logs.tables.cells import Marks, to_numbers, understands
from valveflow_ros.logs.tables.file import Heading, TableFile, look_at
from valveflow_ros.logs.tables.match import (
    DATE,
    NAMES_OF_AN_INDEX,
    PERIOD,
    TIME,
    Chosen,
    Matcher,
    local_zone_in,
    stamps_in,
    time_columns,
    zone_in,
)
from valveflow_ros.logs.tables.refusal import (
    AS_SEEN,
    THEIRS,
    RefusedError,
    Remedy,
    TableOptions,
)
from valveflow_ros.logs.tables.text import decimal_mark
from valveflow_ros.logs.tables.times import NEVER, RowClock, TimeReader, as_numbers, is_excel
from valveflow_ros.logs.tables.words import folded, split_unit
from valveflow_ros.records import (
    SIGNALS,
    BoolArray,
    ByteArray,
    FloatArray,
    IntArray,
    Quality,
    Signal,
)

if TYPE_CHECKING:
    import pandas as pd

# Numbers below it (2 January 1990 in s) may count the rows.
_LEAST_UNIX_S = 631_238_400.0
# Column names in a long table (one row per value), as exported by PI and other historians.
_TAG = re.compile(
    r'^(?:pi )?(?:tag|point|sensor|item|variable|signal|name|kks|channel)(?: ?(?:name|id))?$|'
    r'^(?:messstelle|kennzeichen|messstellenname|messgroesse|tag path)$'
)
_VALUE = re.compile(r'^(?:value|wert|messwert|val|reading|y|pv|avg|average|mean)$')
_UNIT = re.compile(r'^(?:unit|units|uom|eng units|engineering units|einheit|eu)$')
_QUALITY = re.compile(r'^(?:quality|status|qualitaet|quality code|guete|opc quality)$')
_ABOUT = re.compile(r'^(?:description|descriptor|beschreibung|bezeichnung|comment)$')


@dataclass(frozen=True, slots=True)
class RawBlock:
    """Some rows in file order, as in `RawTable`, without rows whose time is unknown."""

    time_ns: IntArray
    columns: dict[str, FloatArray] = field(default_factory=dict)
    quality: dict[str, ByteArray] = field(default_factory=dict)
    present: dict[str, BoolArray] = field(default_factory=dict)

    def at(self, rows: Any) -> RawBlock:
        """Return the rows with these indices, or where a mask is True."""
        parts = (self.columns, self.quality, self.present)
        picked = [{name: values[rows] for name, values in part.items()} for part in parts]
        return RawBlock(self.time_ns[rows], *picked)


@dataclass(frozen=True, slots=True)
class LongForm:
    """Column indices of a long table (one row per value); -1 for a column that is absent."""

    tag: int
    value: int
    unit: int
    quality: int
    about: int

    @classmethod
    def of(cls, heading: Heading) -> LongForm | None:
        """Return the column indices of a long table; ``None`` if the table is not long."""
        names = [folded(split_unit(name)[0]) for name in heading.names]
        places = [
            next((k for k, name in enumerate(names) if pattern.search(name)), -1)
            for pattern in (_TAG, _VALUE, _UNIT, _QUALITY, _ABOUT)
        ]
        return None if min(places[:2]) < 0 else cls(*places)

    def tags(self, file: TableFile) -> Heading:
        """Return the tags as if they were columns; reads the whole column of tags."""
        places = sorted({k for k in (self.tag, self.unit, self.about) if k >= 0})
        found: dict[str, tuple[str, str]] = {}
        for frame in file.blocks(places):
            text = frame.astype('string').fillna('')
            for row in text.drop_duplicates(self.tag).itertuples(index=False):
                cells = {k: cell.strip() for k, cell in zip(places, row, strict=True)}
                if cells[self.tag]:
                    rest = cells.get(self.unit, ''), cells.get(self.about, '')
                    found.setdefault(cells[self.tag], rest)
        units = tuple(unit or split_unit(tag)[1] for tag, (unit, _) in found.items())
        return Heading(0, (), tuple(found), units, tuple(about for _, about in found.values()))


def cells_of(file: TableFile, place: int) -> list[str]:
    """Return the cells of a column in the sampled rows that are not empty."""
    return [cell for (cell,) in file.samples(place) if cell]


def time_samples(file: TableFile, time: int, date: int | None) -> list[str]:
    """Return the times in the sampled rows, with their date if that stands in another column."""
    if date is None:
        return cells_of(file, time)
    return [f'{day[:11].strip()} {clock}' for day, clock in file.samples(date, time)]


def time_cells(frame: pd.DataFrame, time: int, date: int | None) -> pd.Series[Any]:
    """Return the times of a block in the same form."""
    if date is None:
        return frame[time]
    days = frame[date].astype('string').str.strip().str.slice(0, 11)
    return days.str.strip() + ' ' + frame[time].astype('string').str.strip()


class TableReader:
    """A table whose columns are assigned to signals; arguments and errors as in `read_table`."""

    def __init__(
        self, path: Path, columns: Mapping[str, str], absent: Collection[str] = (),
        options: TableOptions = AS_SEEN,
    ) -> None:  # fmt: skip
        wanted = dict(columns)
        times = {name: wanted.pop(name) for name in (TIME, DATE) if name in wanted}
        by_signal = {signal_of(name): theirs for name, theirs in wanted.items()}
        self.path = path
        self._options = options
        self._file = look_at(path, options)
        time, self._date = self._time_places(times)
        self.long = self._long_form(by_signal)
        taken = {k for k in (time, self._date) if k is not None}
        if self.long is not None:
            matcher = Matcher(path, self.long.tags(self._file), 'tag')
        else:
            heading = self._file.heading
            matcher = Matcher(
                path, heading, taken=cell_values.quality_columns(heading.names) | taken
            )
        counted = bool(options.period) and self.long is None
        spared = {signal_of(name) for name in absent}
        no_time = self._without_times() if time is None and not counted else None
        found = matcher.match(by_signal, spared, no_time)
        self._time = time
        self._chosen: dict[str, Chosen] = {SIGNALS[s].column: found[s] for s in sorted(found)}
        self._quality = {} if self.long is not None else self._quality_places()
        self._marks = self._decided_marks()
        self._clock = RowClock(options) if time is None else self._time_reader(time)
        used = {c.place for c in self._chosen.values()} | set(self._quality.values())
        used |= taken if self.long is None else set()
        named = enumerate(matcher.names)
        # Columns (in a long table: tags) that are not used.
        self.ignored = tuple(name for k, name in named if k not in used and name)
        # names, units, grounds: by contract column name: the name in the file, the unit in the
        # file, the reason
        self.names = {name: c.theirs for name, c in self._chosen.items()}
        self.units = {n: c.unit.unit for n, c in self._chosen.items() if c.unit is not None}
        self.grounds = {name: c.ground for name, c in self._chosen.items() if c.ground}
        # By contract column name: counts of the texts that are no numbers. Complete when all
        # blocks were read.
        self.words: dict[str, Counter[str]] = {name: Counter() for name in self.names}
        self.empty: Counter[str] = Counter()
        self._marked_bad: Counter[str] = Counter()
        self._first_bad: dict[str, tuple[int, str]] = {}
        # Number of rows without a readable time. Complete when all blocks were read.
        self.bad_times = 0
        self.rows = 0
        self._first_bad_time = 0

    @property
    def bad_cells(self) -> dict[str, int]:
        """Return the number of cells that are no numbers, for columns that have any."""
        return {name: words.total() for name, words in self.words.items() if words}

    @property
    def share(self) -> float:
        """Return the fraction of the file that was read so far; 0 if unknown."""
        return self._file.share

    @property
    def time_zone(self) -> str:
        """Return the assumed zone of the times and its origin; valid after all blocks."""
        return self._clock.told_zone

    @property
    def time_words(self) -> str:
        """Return the time column and the format of the times, as a clause."""
        names = [self._file.names[k] for k in (self._date, self._time) if k is not None]
        if not names:
            return self._clock.words
        told = ' and '.join(f"'{name}'" if name else 'the column without a name' for name in names)
        return f'{told}, {self._clock.words}'

    @property
    def numeric_ignored(self) -> list[str]:
        """Return the ignored columns that hold numbers and more than one of them."""
        heading = self._file.heading
        cells: dict[str, list[str]] = {name: [] for name in self.ignored}
        if self.long is not None:
            for tag, cell in self._file.samples(self.long.tag, self.long.value):
                if tag in cells:
                    cells[tag].append(cell)
        else:
            cells = {name: cells_of(self._file, heading.names.index(name)) for name in cells}
        return [name for name, texts in cells.items() if self._vary(texts)]

    def _vary(self, texts: list[str]) -> bool:
        import pandas as pd

        values = to_numbers(pd.Series(texts, dtype=object), self._marks).values
        numbers = values[np.isfinite(values)]
        return 2 * len(numbers) > len(texts) and len(np.unique(numbers)) > 1

    @property
    def local_guess(self) -> bool:
        """Return True if the times have no zone, so that UTC was assumed."""
        return self._clock.told_zone.startswith('UTC (')

    def blocks(self) -> Iterator[RawBlock]:
        """Yield the rows that have a time, block by block; raises like `read_table`."""
        places = [k for k in (self._time, self._date) if k is not None]
        long, coded = self.long, False
        if long is not None:
            places += [k for k in (long.tag, long.value, long.quality) if k >= 0]
            coded = long.quality >= 0 and understands(cells_of(self._file, long.quality))
        else:
            places += [c.place for c in self._chosen.values()] + list(self._quality.values())
        for frame in self._file.blocks(places):
            time_ns = self._read_times(frame)
            block = RawBlock(time_ns)
            if long is not None:
                self._read_long(frame, long, coded, block)
            else:
                self._read_wide(frame, block)
            self.rows += len(frame)
            keep = time_ns != NEVER
            if block.present:
                keep &= np.any(list(block.present.values()), axis=0)
            if keep.any():
                yield block if keep.all() else block.at(keep)

    def notes(self) -> list[str]:
        """Return sentences about the data, after all blocks were read.

        Raises `InputError` as `TimeReader.finish`, for example if no row has a time.
        """
        notes = [*self._file.notes, *self._clock.finish()]
        for name, theirs in self.names.items():
            if n := self.words[name].total():
                row, text = self._first_bad[name]
                are = f"{n} cells of '{theirs}' are no numbers and count"
                one = f"1 cell of '{theirs}' is no number and counts"
                notes.append(
                    f"{one if n == 1 else are} as missing; the first is '{text}' in row {row + 1}."
                )
        for name, n in self._marked_bad.items():
            place = self._quality[name] if self.long is None else self.long.quality
            notes.append(
                f"The quality of '{self.names[name]}' is read from '{self._file.names[place]}', "
                f'by which {n} of its values {"is" if n == 1 else "are"} bad.'
            )
        if self.bad_times:
            notes.append(
                f'{self.bad_times} rows have no readable time and were left out, the first is '
                f'row {self._first_bad_time + 1}.'
            )
        return notes

    def understood(self) -> list[str]:
        """Return sentences about what was inferred: the columns of the signals and the zone."""
        said = []
        for name, ground in self.grounds.items():
            unit = self._chosen[name].unit
            known = f'in {unit.written}' if unit else 'unit not named'
            topic = next(i.topic for i in SIGNALS if i.column == name)
            said.append(f"'{self.names[name]}' is read as {topic} ({ground}, {known}).")
        if self.local_guess:
            said.append(
                'The times name no zone and are taken as UTC; for local time add --time-zone, '
                'such as --time-zone Europe/Berlin.'
            )
        elif self._options.time_zone or self.long is not None:
            said.append(f'Time zone: {self.time_zone}.')
        return said

    def _time_places(self, named: Mapping[str, str]) -> tuple[int | None, int | None]:
        time, date = time_columns(self._file.heading)
        if time is None and date is None:
            time = self._index_of_times()
        matcher = Matcher(self.path, self._file.heading)
        places = {TIME: time, DATE: date}
        for key, theirs in named.items():
            places[key] = matcher.find(theirs)
            if places[key] is None:
                raise matcher.missing(theirs, key)
        time, date = places[TIME], places[DATE]
        if time is None:
            return date, None
        # Raises if two columns have this name.
        matcher.find(self._file.names[time])
        if self._options.period and not self._holds_times(time, date):
            return None, None
        # A separate date is used only if the time column holds times of day.
        cells = cells_of(self._file, time)
        clock = sum(c.count(':') >= 1 and not any(m in c for m in '-/T') and len(c) <= 15
                    and c.find('.') not in range(5) for c in cells)  # fmt: skip
        return time, (date if date != time and 2 * clock > len(cells) else None)

    def _holds_times(self, time: int, date: int | None) -> bool:
        """Return False if no sampled cell is a time; numbers may be those of the rows."""
        import pandas as pd

        cells = time_samples(self._file, time, date)
        if len(numbers := as_numbers(cells)):
            return is_excel(numbers) or float(numbers.max()) >= _LEAST_UNIX_S
        try:
            clock = TimeReader(cells, str(self.path), self._file.names[time], self._options)
            return bool((clock.read(pd.Series(cells)) != NEVER).any())
        except InputError:
            return True  # an ambiguous time is refused by its own sentence

    def _without_times(self) -> Remedy:
        """Return the option to propose: the name of a column if one may hold times."""
        if any(stamps_in(cells_of(self._file, k)) for k in range(len(self._file.names))):
            return Remedy('column', f'{TIME}={THEIRS}')
        return Remedy('period', PERIOD)

    def _index_of_times(self) -> int | None:
        """Return the unnamed column that holds times, as pandas writes an index."""
        places = (k for k, name in enumerate(self._file.names) if name in NAMES_OF_AN_INDEX)
        return next((k for k in places if stamps_in(cells_of(self._file, k))), None)

    def _long_form(self, by_signal: Mapping[Signal, str]) -> LongForm | None:
        form = LongForm.of(self._file.heading)
        names = self._file.names
        if any(i.column in names or i.topic in names for i in SIGNALS):
            return None
        # If the user named columns of the table, it is a wide table.
        return None if any(theirs in names for theirs in by_signal.values()) else form

    def _quality_places(self) -> dict[str, int]:
        names, places = self._file.names, {}
        used = {c.place for c in self._chosen.values()}
        for name, chosen in self._chosen.items():
            own = f'{name}{cell_values.QUALITY_SUFFIX}'
            if chosen.theirs == name and own in names:
                places[name] = names.index(own)
                continue
            place = cell_values.quality_column(chosen.theirs, names)
            if place is None or place in used:
                continue
            if understands(cells_of(self._file, place)):
                places[name] = place
        return places

    def _decided_marks(self) -> Marks:
        if self._file.marks is not None:
            return self._file.marks
        places = {c.theirs: c.place for c in self._chosen.values()}
        if self.long is not None:
            places = {'value': self.long.value}
        for theirs, place in places.items():
            cells = cells_of(self._file, place)
            if decimal_mark(cells, self._file.separator) is None:
                example = next(c for c in cells if ',' in c)
                raise RefusedError(
                    self.path,
                    f"'{example}' in the column '{theirs}' may be a large number or one with "
                    'decimals; add --decimal comma if the comma is the decimal mark, or '
                    '--decimal point if it parts the thousands',
                    [Remedy('decimal', 'comma')],
                )
        return Marks()

    def _time_reader(self, time: int) -> TimeReader:
        name = self._file.names[time]
        clock = TimeReader(
            time_samples(self._file, time, self._date), str(self.path), name, self._options,
            zone_in(name),
        )  # fmt: skip
        abbreviated, place = local_zone_in(name)
        if abbreviated and not clock.zone:
            raise RefusedError(
                self.path,
                f"the times of the column '{name}' are local, and {abbreviated} does not say "
                'whether the clock is set forward in summer: add --time-zone with the place, such '
                f'as {place}, or the offset, such as +01:00',
                [Remedy('time-zone', place)],
            )
        return clock

    def _read_times(self, frame: pd.DataFrame) -> IntArray:
        if isinstance(self._clock, RowClock):
            return self._clock.at(self.rows, len(frame))
        assert self._time is not None
        time_ns = self._clock.read(time_cells(frame, self._time, self._date))
        bad = time_ns == NEVER
        if bad.any():
            if not self.bad_times:
                self._first_bad_time = self.rows + int(bad.argmax())
            self.bad_times += int(bad.sum())
        return time_ns

    def _read_wide(self, frame: pd.DataFrame, block: RawBlock) -> None:
        for name, chosen in self._chosen.items():
            block.columns[name] = self._numbers(name, frame[chosen.place])
            if name in self._quality:
                cells = frame[self._quality[name]]
                own = self.names[name] == name
                block.quality[name] = (
                    cell_values.to_quality(cells) if own else self._foreign(name, cells)
                )

    def _read_long(
        self, frame: pd.DataFrame, form: LongForm, coded: bool, block: RawBlock
    ) -> None:
        tags = frame[form.tag].astype('string').str.strip()
        for name, chosen in self._chosen.items():
            mine = (tags == chosen.theirs).fillna(False).to_numpy(dtype=bool)
            block.present[name] = mine
            block.columns[name] = np.full(len(frame), np.nan)
            block.columns[name][mine] = self._numbers(name, frame[form.value][mine])
            if coded:
                codes = np.full(len(frame), int(Quality.GOOD), dtype=np.uint8)
                codes[mine] = self._foreign(name, frame[form.quality][mine])
                block.quality[name] = codes

    def _foreign(self, name: str, cells: pd.Series[Any]) -> ByteArray:
        codes = cell_values.foreign_quality(cells)
        self._marked_bad[name] += int((codes == Quality.BAD).sum())
        return codes

    def _numbers(self, name: str, cells: pd.Series[Any]) -> FloatArray:
        column = to_numbers(cells, self._marks)
        self.words[name].update(column.words)
        self.empty[name] += column.empty
        if column.words and name not in self._first_bad:
            text = str(cells.iloc[column.first_bad_row]).strip()[:40]
            self._first_bad[name] = (self.rows + column.first_bad_row, text)
        return column.values
