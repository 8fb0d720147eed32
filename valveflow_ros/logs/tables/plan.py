"""Decides, before a table is read, what its columns are and how they are written."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from valveflow_ros.logs.names import signal_of, signals_of
from valveflow_ros.logs.tables.cells import (
    QUALITY_SUFFIX,
    Marks,
    quality_column,
    quality_columns,
    understands,
)
from valveflow_ros.logs.tables.file import look_at
from valveflow_ros.logs.tables.layout import Heading, decimal_mark
from valveflow_ros.logs.tables.match import (
    DATE,
    TIME,
    Chosen,
    Matcher,
    local_zone_in,
    time_columns,
    zone_in,
)
from valveflow_ros.logs.tables.refusal import RefusedError, Remedy, TableOptions
from valveflow_ros.logs.tables.times import TimeReader
from valveflow_ros.logs.tables.words import folded, split_unit
from valveflow_ros.records import SIGNALS, Signal

if TYPE_CHECKING:
    from valveflow_ros.logs.tables.file import TableFile


# Tables with a row for each value: time, tag, value, as PI and its kin export them.

_TAG = re.compile(
    r'^(?:pi )?(?:tag|point|sensor|item|variable|signal|name|kks|channel)(?: ?(?:name|id))?$|'
    r'^(?:messstelle|kennzeichen|messstellenname|messgroesse|tag path)$'
)
_VALUE = re.compile(r'^(?:value|wert|messwert|val|reading|y|pv|avg|average|mean)$')
_UNIT = re.compile(r'^(?:unit|units|uom|eng units|engineering units|einheit|eu)$')
_QUALITY = re.compile(r'^(?:quality|status|qualitaet|quality code|guete|opc quality)$')
_ABOUT = re.compile(r'^(?:description|descriptor|beschreibung|bezeichnung|comment)$')


@dataclass(frozen=True, slots=True)
class LongForm:
    """Where tag, value and the rest stand; -1 where they do not."""

    tag: int
    value: int
    unit: int = -1
    quality: int = -1
    about: int = -1


def long_form(heading: Heading) -> LongForm | None:
    """Return the places of a long table's columns, ``None`` if it is none."""
    names = [folded(split_unit(name)[0]) for name in heading.names]

    def place(pattern: re.Pattern[str]) -> int:
        return next((k for k, name in enumerate(names) if pattern.search(name)), -1)

    tag, value = place(_TAG), place(_VALUE)
    if tag < 0 or value < 0:
        return None
    return LongForm(tag, value, place(_UNIT), place(_QUALITY), place(_ABOUT))


def tags_of(file: TableFile, form: LongForm) -> Heading:
    """Return the tags of a long table as if they were columns; reads all of their names."""
    places = [k for k in (form.tag, form.unit, form.about) if k >= 0]
    found: dict[str, tuple[str, str]] = {}
    for frame in file.blocks(places):
        text = frame.astype('string').fillna('')
        for row in text.drop_duplicates(form.tag).itertuples(index=False):
            cells = dict(zip(sorted(set(places)), row, strict=True))
            tag = cells[form.tag].strip()
            if tag and tag not in found:
                unit, about = cells.get(form.unit, ''), cells.get(form.about, '')
                found[tag] = (unit.strip(), about.strip())
    names = tuple(found)
    units = tuple(found[tag][0] or split_unit(tag)[1] for tag in names)
    return Heading(0, (), names, units, tuple(found[tag][1] for tag in names))


class TablePlan:
    """What the columns of a table are.

    Parameters
    ----------
    path : Path
        The file.
    columns, absent, options
        As in `read_table`.

    Attributes
    ----------
    file : TableFile
    chosen : dict[str, Chosen]
        By contract column name.
    time, date : int, int or None
        Where the time stands, and the date if apart from it.
    quality : dict[str, int]
        Where the quality of a signal stands.
    long : LongForm or None
        Of a table with a row for each value.
    marks : Marks
        How numbers are written.
    clock : TimeReader
        Reads the times.
    ignored : tuple of str
        Columns (of a long table: tags) that are not used.

    Raises
    ------
    RecordingError, InputError
        As `read_table`.
    """

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, str],
        absent: Collection[str],
        options: TableOptions,
    ) -> None:
        wanted = dict(columns)
        times = {name: wanted.pop(name) for name in (TIME, DATE) if name in wanted}
        by_signal = {signal_of(name): theirs for name, theirs in wanted.items()}
        self.path = path
        self.options = options
        self.file = look_at(path, options)
        time, self.date = self._time_places(times)
        taken = [k for k in (time, self.date) if k is not None]
        self.long = self._long(by_signal)
        matcher = self._matcher(taken)
        found = matcher.match(by_signal, signals_of(absent))
        if found.open or time is None:
            raise matcher.refusal(found, no_time=time is None)
        self.time = time
        self.chosen: dict[str, Chosen] = {
            SIGNALS[signal].column: chosen for signal, chosen in sorted(found.signals.items())
        }
        self.quality = self._quality_places()
        self.marks = self._decided_marks()
        self.clock = self._time_reader()
        self.ignored = self._unused(matcher.names, taken)

    def _matcher(self, taken: list[int]) -> Matcher:
        heading = self.file.heading
        if self.long is not None:
            return Matcher(str(self.path), tags_of(self.file, self.long), 'tag')
        beside = quality_columns(heading.names)
        return Matcher(str(self.path), heading, taken=beside.union(taken))

    def _time_places(self, named: Mapping[str, str]) -> tuple[int | None, int | None]:
        time, date = time_columns(self.file.heading)
        matcher = Matcher(str(self.path), self.file.heading)
        places = {TIME: time, DATE: date}
        for key, theirs in named.items():
            place = matcher.find(theirs)
            if place is None:
                raise matcher.missing(theirs, key)
            places[key] = place
        time, date = places[TIME], places[DATE]
        if time is None:
            return date, None
        matcher.find(self.file.names[time])
        # A date beside it is wanted only where the time is one of the day alone.
        return time, (date if date != time and self._is_clock(time) else None)

    def _is_clock(self, place: int | None) -> bool:
        """Tell whether a column holds the time of day only, so that a date is wanted beside it."""
        cells = [] if place is None else self.cells(place)
        clock = sum(c.count(':') >= 1 and not any(m in c for m in '-/T') and len(c) <= 15
                    and c.find('.') not in range(5) for c in cells)  # fmt: skip
        return bool(cells) and 2 * clock > len(cells)

    def cells(self, place: int) -> list[str]:
        """Return what stands in a column in the rows that were looked at."""
        rows = self.file.rows
        return [row[place].strip() for row in rows if place < len(row) and row[place].strip()]

    def _long(self, by_signal: Mapping[Signal, str]) -> LongForm | None:
        form = long_form(self.file.heading)
        names = self.file.names
        if form is None or any(i.column in names or i.topic in names for i in SIGNALS):
            return None
        # A person who names columns of the table means a wide one.
        return None if any(theirs in names for theirs in by_signal.values()) else form

    def _quality_places(self) -> dict[str, int]:
        names, places = self.file.names, {}
        if self.long is not None:
            return {}
        for name, chosen in self.chosen.items():
            own = f'{name}{QUALITY_SUFFIX}'
            if chosen.theirs == name and own in names:
                places[name] = names.index(own)
                continue
            place = quality_column(chosen.theirs, names)
            used = place in {c.place for c in self.chosen.values()}
            if place is not None and not used and understands(self.cells(place)):
                places[name] = place
        return places

    def _decided_marks(self) -> Marks:
        if self.file.marks is not None:
            return self.file.marks
        if self.long is not None:
            places = {'value': self.long.value}
        else:
            places = {c.theirs: c.place for c in self.chosen.values()}
        for theirs, place in places.items():
            cells = self.cells(place)
            if decimal_mark(cells, self.file.separator) is None:
                example = next(c for c in cells if ',' in c)
                raise RefusedError(
                    self.path,
                    f"'{example}' in the column '{theirs}' may be a large number or one with "
                    'decimals; add --decimal comma if the comma is the decimal mark, or '
                    '--decimal point if it parts the thousands',
                    [Remedy('decimal', 'comma')],
                )
        return Marks()

    def _time_reader(self) -> TimeReader:
        name = self.file.names[self.time]
        samples = self.cells(self.time)
        if self.date is not None:
            rows = self.file.rows
            samples = [joined(row[self.date], row[self.time]) for row in rows
                       if max(self.date, self.time) < len(row)]  # fmt: skip
        clock = TimeReader(samples, str(self.path), name, self.options, zone_in(name))
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

    def _unused(self, names: tuple[str, ...], taken: list[int]) -> tuple[str, ...]:
        used = {c.place for c in self.chosen.values()} | set(self.quality.values())
        if self.long is None:
            used |= set(taken)
        return tuple(name for k, name in enumerate(names) if k not in used and name)


def joined(date: str, clock: str) -> str:
    """Return date and time of day as one text."""
    return f'{date.strip()[:11].strip()} {clock.strip()}'
