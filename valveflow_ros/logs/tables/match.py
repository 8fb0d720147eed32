# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Assigns the columns of a table to signals, and refuses ambiguous tables."""

from __future__ import annotations

import re
import zoneinfo
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from valveflow_ros.errors import InputError, listed
from valveflow_ros.logs.tables import words
from valveflow_ros.logs.tables.file import Heading
from valveflow_ros.logs.tables.refusal import THEIRS, RefusedError, Remedy
from valveflow_ros.logs.tables.words import EXACT, Spelling, folded, split_unit
from valveflow_ros.records import SIGNALS, Signal

TIME, DATE = 'time', 'date'
# Column names of the unnamed index of a DataFrame.
NAMES_OF_AN_INDEX = ('', 'Unnamed: 0', '__index_level_0__')
_TIME_WORDS = re.compile(
    r'time ?stamp|zeit ?stempel|date ?time|datum ?(?:und ?)?(?:uhr)?zeit|^(?:\w+ )?time$|'
    r'^(?:local |utc |lokale |abtast)?(?:time|zeit)\b|^uhrzeit$|^ts$|^t$|^sample time$|^clock$'
)
_DATE_WORDS = re.compile(r'^(?:date|datum|day|tag)$')
_CLOCK_WORDS = re.compile(r'^(?:time|zeit|uhrzeit|clock|time of day)$')
_STAMP = re.compile(r'\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[T ]\s*\d{1,2}:\d{2}.*')
_LOCAL = {
    **dict.fromkeys(('CET', 'MEZ', 'CEST', 'MESZ'), 'Europe/Berlin'),
    'EET': 'Europe/Helsinki', 'WET': 'Europe/Lisbon', 'BST': 'Europe/London',
    **dict.fromkeys(('EST', 'EDT'), 'America/New_York'),
    **dict.fromkeys(('CST', 'CDT'), 'America/Chicago'),
    **dict.fromkeys(('PST', 'PDT'), 'America/Los_Angeles'),
}  # fmt: skip
PERIOD = '60s'
_USUAL_DEGC = 540
_THERMOMETER = re.compile(r'(?i)t[eitcr]{0,2}[ _.-]?\d|t[eit][_.-]')
_GROUNDS = {
    EXACT: '', words.CLEAR: 'by its name', words.LIKELY: 'by its name', words.TAG: 'by its tag'
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Chosen:
    """A column chosen for a signal: its index from 0, its name and its unit in the file.

    ``ground`` is the reason for the choice; empty if the name is exact or given by the user.
    """

    place: int
    theirs: str
    unit: Spelling | None = None
    ground: str = ''


class Matcher:
    """Assigns columns (in a long table: tags) to signals.

    ``what`` is ``column`` or ``tag``; ``taken`` are columns that have another use, such as the
    time.
    """

    def __init__(
        self, path: Path, heading: Heading, what: str = 'column', taken: Collection[int] = ()
    ) -> None:
        self.path = path
        self.names = heading.names
        self.what = what
        self._units = heading.units
        self._about = heading.about
        self._taken = set(taken)

    def find(self, theirs: str) -> int | None:
        """Return the column with this name, with or without its unit; None if there is none.

        Raises `InputError` if several columns have this name.
        """
        wanted = theirs.strip()
        same = [k for k, name in enumerate(self.names) if name == wanted]
        same = same or [k for k, n in enumerate(self.names) if split_unit(n)[0] == wanted]
        if len(same) > 1:
            raise InputError(f"{self.path}: there are several {self.what}s called '{wanted}'.")
        return same[0] if same else None

    def match(
        self, wanted: Mapping[Signal, str], spared: Collection[Signal], no_time: Remedy | None
    ) -> dict[Signal, Chosen]:
        """Return the column of each signal.

        ``wanted`` are the columns named by the user, ``spared`` the signals that may be missing;
        ``no_time`` is the option to propose if the time is missing. All problems are raised in
        one `RefusedError`.
        Raises `InputError` if several columns have the same name.
        """
        chosen: dict[Signal, Chosen] = {}
        absent: dict[Signal, str] = {}
        for signal, theirs in wanted.items():
            place = self.find(theirs)
            if place is None:
                absent[signal] = theirs
            else:
                unit = self.unit_of(place)
                if signal == Signal.GENERATED_POWER:
                    unit = unit or words.flow_spelled(self._units[place])
                chosen[signal] = Chosen(place, self.names[place], unit)
        marked = self._marked({c.place for c in chosen.values()})
        several: list[str] = []
        missing: list[str] = []
        remedies: list[Remedy] = []
        for info in SIGNALS:
            if info.signal in chosen or info.signal in absent:
                continue
            mark = max((m[info.signal] for m in marked if info.signal in m), default=0.0)
            best = [k for k, m in enumerate(marked) if m.get(info.signal) == mark]
            # The user replaces this signal by a constant, so only an exact name is used.
            if info.signal in spared and mark < EXACT:
                continue
            if len(best) == 1:
                ground = _GROUNDS.get(mark, 'by its unit alone')
                place = best[0]
                chosen[info.signal] = Chosen(place, self.names[place], self.unit_of(place), ground)
            elif best and mark == EXACT:
                raise InputError(
                    f"{self.path}: there are several {self.what}s called '{self.names[best[0]]}'."
                )
            elif best and info.required:
                names = [self.names[k] for k in best]
                options = ' or '.join(option(info.topic, name) for name in names[:4])
                which = listed([f"'{name}'" for name in names[:8]])
                several.append(f'{which} could each be {info.topic}: add {options}')
                remedies.append(choosing(info.topic, names[0]))
            elif info.required and info.signal not in spared:
                missing.append(info.topic)
        self._propose(missing, several, remedies, chosen)
        if absent or several or missing or no_time is not None:
            raise self._refusal(absent, several, missing, remedies, no_time, chosen)
        return chosen

    def _propose(
        self, missing: list[str], several: list[str], remedies: list[Remedy],
        chosen: Mapping[Signal, Chosen],
    ) -> None:  # fmt: skip
        """Propose a column for a missing signal if it is the only one left in a suitable unit.

        A last column without a unit whose name begins as the tag of a thermometer (ISA-5.1) does
        is proposed as the temperature, if only that is missing.
        """
        cold = SIGNALS[Signal.MAIN_STEAM_TEMPERATURE].topic
        for info in SIGNALS:
            only = self._only_in_unit_of(info.signal, chosen) if info.topic in missing else None
            why, otherwise = 'in a unit of it', ''
            if only is None and missing == [cold] and info.topic == cold:
                left = [self.names[k] for k in self._unused(chosen) if not self._units[k]]
                only = left[0] if len(left) == 1 and _THERMOMETER.match(left[0]) else None
                why, otherwise = 'left', f', else --constant {cold}={_USUAL_DEGC}'
            if only is not None:
                missing.remove(info.topic)
                several.append(
                    f"no {self.what} was recognised as {info.topic}, but '{only}' alone is {why}: "
                    f'if that is it, add {option(info.topic, only)}{otherwise}'
                )
                remedies.append(choosing(info.topic, only))

    def _unused(self, chosen: Mapping[Signal, Chosen]) -> list[int]:
        """Return the places of the columns with a name that are no time and no signal yet."""
        taken = {*self._taken, *(c.place for c in chosen.values())}
        return [k for k, name in enumerate(self.names) if k not in taken and name]

    def _only_in_unit_of(self, signal: Signal, chosen: Mapping[Signal, Chosen]) -> str | None:
        """Return the only unused column with a unit of the signal; None if not exactly one."""
        found = [self.names[k] for k in self._unused(chosen) if self._may_be(signal, k)]
        return found[0] if len(found) == 1 else None

    def _may_be(self, signal: Signal, place: int) -> bool:
        unit = self.unit_of(place)
        if unit is None and signal == Signal.GENERATED_POWER:
            unit = words.flow_spelled(self._units[place])
        return unit is not None and unit.dimension == words.DIMENSIONS[signal]

    def _refusal(
        self, absent: Mapping[Signal, str], several: list[str], missing: list[str],
        remedies: list[Remedy], no_time: Remedy | None, chosen: Mapping[Signal, Chosen],
    ) -> RefusedError:  # fmt: skip
        """Return one error for everything that could not be decided."""
        times = [] if no_time is None else [TIME]
        topics = [SIGNALS[s].topic for s in absent] + missing + times
        parts = [*several]
        if topics:
            told = [f"there is no {self.what} '{theirs}'" for theirs in absent.values()]
            if unknown := listed(missing + times, 'or'):
                told.append(f'no {self.what} was recognised as {unknown}')
            unit = '' if topics == [TIME] else '[:unit]'
            options = ' '.join(f'--column {name}={THEIRS}{unit}' for name in topics)
            constant = self._as_constant(missing, chosen)
            apart = f', or say with --period {PERIOD} how far apart the rows are' if times else ''
            parts.append(
                f'{", ".join(told)}; the {self.what}s are: {self._have(chosen)}. Name '
                f'yours with {options}{constant}{apart}'
            )
        remedies += [self._naming(topic, chosen) for topic in topics if topic != TIME]
        remedies += [] if no_time is None else [no_time]
        return RefusedError(self.path, '; '.join(parts), remedies)

    def _as_constant(self, missing: Collection[str], chosen: Mapping[Signal, Chosen]) -> str:
        """Return the end of the sentence on signals that need no column; '' if each needs one."""
        cold, steam = (
            SIGNALS[s].topic for s in (Signal.MAIN_STEAM_TEMPERATURE, Signal.MAIN_STEAM_PRESSURE)
        )
        usual = f'--constant {cold}={_USUAL_DEGC}'
        if steam not in missing:
            return f', or the usual temperature with {usual}' if cold in missing else ''
        added = [f'--constant {steam}=1', *([usual] if cold in missing else [])]
        power = chosen.get(Signal.GENERATED_POWER)
        topic = SIGNALS[Signal.GENERATED_POWER].topic
        if power is not None and power.unit is None:
            added.append(option(topic, split_unit(power.theirs)[0], 't/h'))
        elif topic in missing:
            added.append(option(topic, THEIRS, 't/h'))
        return f'; for a control valve with opening and flow only, add {" ".join(added)}'

    def _naming(self, topic: str, chosen: Mapping[Signal, Chosen]) -> Remedy:
        """Return the option for a signal that was not found.

        The temperature is often not recorded, and beside a flow as output neither is the pressure.
        """
        if topic == SIGNALS[Signal.MAIN_STEAM_TEMPERATURE].topic:
            return Remedy('constant', f'{topic}={_USUAL_DEGC}')
        power = Signal.GENERATED_POWER
        output = chosen[power].theirs if power in chosen else self._only_in_unit_of(power, chosen)
        is_flow = output is not None and words.flow_spelled(self._units[self.names.index(output)])
        if topic == SIGNALS[Signal.MAIN_STEAM_PRESSURE].topic and is_flow:
            return Remedy('constant', f'{topic}=1')
        return choosing(topic, THEIRS)

    def missing(self, theirs: str, name: str) -> RefusedError:
        """Return the error for a time column that the user named and that does not exist."""
        return RefusedError(
            self.path,
            f"there is no {self.what} '{theirs}'; the {self.what}s are: {self._have()}. "
            f'Name yours with --column {name}={THEIRS}',
            [Remedy('column', f'{name}={THEIRS}')],
        )

    def _have(self, chosen: Mapping[Signal, Chosen] = MappingProxyType({})) -> str:
        known = {c.place: SIGNALS[signal].topic for signal, c in chosen.items()}
        return ', '.join(
            f'{name} ({known[k]})'
            if k in known and name != known[k]
            else name or 'one without a name'
            for k, name in enumerate(self.names[:40])
        )

    def unit_of(self, place: int) -> Spelling | None:
        """Return the unit of a column in the file; None if absent or unknown."""
        if not self._units[place]:
            return None
        told = f'{self.names[place]} {self._about[place]}'
        return words.of_gauge(words.spelling(self._units[place]), told)

    def _marked(self, used: Collection[int]) -> list[dict[Signal, float]]:
        found: list[dict[Signal, float]] = []
        for place, name in enumerate(self.names):
            foreign = words.is_foreign(self._units[place])
            if place in self._taken or place in used or not name or foreign:
                found.append({})
                continue
            bare = split_unit(name)[0]
            everything = words.marks(bare, self._about[place], self.unit_of(place))
            # A column is one signal only, so only its best marks are kept.
            most = max(everything.values(), default=0.0)
            found.append({s: m for s, m in everything.items() if m == most})
        return found


def option(topic: str, theirs: str, unit: str = '') -> str:
    """Return the option that selects a column, quoted for a shell."""
    return str(choosing(topic, theirs, unit))


def choosing(topic: str, theirs: str, unit: str = '') -> Remedy:
    """Return the option that selects a column."""
    return Remedy('column', f'{topic}={theirs}' + (f':{unit}' if unit else ''))


def time_columns(heading: Heading) -> tuple[int | None, int | None]:
    """Return the indices of the time column and of a separate date column; None if absent."""
    names = heading.names
    if TIME in names:
        return names.index(TIME), (names.index(DATE) if DATE in names else None)
    if DATE in names and not any(_is_time(name) for name in names if name != DATE):
        return None, names.index(DATE)
    bare = [folded(split_unit(name)[0]) for name in names]
    date = next((k for k, name in enumerate(bare) if _DATE_WORDS.search(name)), None)
    clock = next((k for k, name in enumerate(bare) if _CLOCK_WORDS.search(name)), None)
    if date is not None and clock is not None:
        return clock, date
    found = next((k for k, name in enumerate(names) if _is_time(name)), None)
    return (found, None) if found is not None else (None, date)


def stamps_in(cells: list[str]) -> bool:
    """Return True if most cells of a column are dates with a time of day."""
    stamps = sum(bool(_STAMP.fullmatch(cell.strip())) for cell in cells)
    return bool(cells) and 2 * stamps > len(cells)


def _is_time(name: str) -> bool:
    return bool(_TIME_WORDS.search(folded(split_unit(_without_zone(name))[0])))


def zone_in(name: str) -> str:
    """Return the time zone in the name of a time column; empty if there is none."""
    found = re.search(r'[\[({ ](UTC|GMT|[A-Z][A-Za-z]+/[\w/+-]+|(?:UTC)?[+-]\d{1,2}(?::?\d{2})?)'
                      r'[\])} ]*$', name)  # fmt: skip
    if not found:
        return ''
    # 'PI Date/Time' looks like a zone but is none.
    named = '/' not in found[1] or found[1] in zoneinfo.available_timezones()
    return found[1] if named else ''


def local_zone_in(name: str) -> tuple[str, str]:
    """Return the abbreviation of a zone in a name, and a place where it is used.

    The abbreviation does not say whether the clock changes to summer time.
    """
    found = re.search(rf'\b({"|".join(_LOCAL)})\b', name)
    return (found[1], _LOCAL[found[1]]) if found else ('', '')


def _without_zone(name: str) -> str:
    return re.sub(r'[\[({ ]+(?:UTC|GMT|CES?T|MES?Z|local|lokal)[\])} ]*$', '', name,
                  flags=re.IGNORECASE)  # fmt: skip
