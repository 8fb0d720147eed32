# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the user specifies about a log: names, units, constants, and the format of a table."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from valveflow_ros.errors import InputError, UsageError, ValveflowError
from valveflow_ros.logs.tables.refusal import (
    AS_SEEN,
    THEIRS,
    RefusedError,
    Remedy,
    TableOptions,
)
from valveflow_ros.logs.tables.words import unit_named
from valveflow_ros.records import SIGNALS, Signal, zone_of
from valveflow_ros.signals.units import convert, known_units, units_of

Answer = TypeVar('Answer')
_TIMES = ('time', 'date')
_BY_NAME = {name: info for info in SIGNALS for name in (info.topic, info.column)}
_TABLE = ('time-zone', 'date-order', 'decimal', 'sheet', 'max-unpacked', 'period')
# Placeholder for a signal that is not named yet, used to find all further open questions.
_STAND_IN = {
    'valve_opening': 50.0,
    'main_steam_pressure': 15.0,
    'main_steam_temperature': 540.0,
    'generated_power': 300.0,
    'valve_command': 50.0,
}
_MOST_LOOKS = 12
# Progress message, because each further attempt may read the whole table.
LOOKING_ON = 'looking for what else the table leaves open'


@dataclass(frozen=True, slots=True)
class Column:
    """One ``name=THEIRS[:unit]``; the name is the topic of a signal, or 'time' or 'date'.

    An empty unit means the engine's own. ``whole`` is everything after the equals sign: a column's
    name may itself contain a colon.
    """

    name: str
    theirs: str
    unit: str
    whole: str

    @property
    def known(self) -> bool:
        """Return True if the unit is valid for the signal, or none was given."""
        return not self.unit or self.unit in known_units(_BY_NAME[self.name].signal)


@dataclass(frozen=True, slots=True)
class LogMapping:
    """Columns and constants by topic name.

    Constants are in the engine's units; ``units`` are the units given by the user.
    """

    columns: dict[str, Column] = field(default_factory=dict)
    constants: dict[str, float] = field(default_factory=dict)
    table: TableOptions = AS_SEEN
    units: dict[str, str] = field(default_factory=dict)

    @property
    def constant_units(self) -> dict[Signal, str]:
        """Return the units in which the constants were given, by signal."""
        return {_BY_NAME[name].signal: unit for name, unit in self.units.items()}

    @property
    def constant_signals(self) -> dict[Signal, float]:
        """Return the constants by signal."""
        return {_BY_NAME[name].signal: value for name, value in self.constants.items()}

    def names(self) -> dict[str, str]:
        """Return the name in the log of each column that was named.

        If the text after the last colon is no unit, the colon is taken as a part of the
        column's name.
        """
        return {c.name: c.theirs if c.known else c.whole for c in self.columns.values()}

    def unsaid(self, signals: Iterable[Signal]) -> set[Signal]:
        """Return those of the signals whose unit the user did not give with ``--column``."""
        said = {c.name for c in self.columns.values() if c.unit}
        return {signal for signal in signals if SIGNALS[signal].topic not in said}

    def open_with(self, look: Callable[[dict[str, str]], Answer]) -> Answer:
        """Return ``look(names)``; if it fails, `UsageError` names a unit that is unknown."""
        try:
            return look(self.names())
        except InputError as error:
            unknown = next((c for c in self.columns.values() if not c.known), None)
            if unknown is None:
                raise
            units = units_of(_BY_NAME[unknown.name].signal, unknown.unit)
            raise UsageError(
                f"Unit '{unknown.unit}' is unknown for {unknown.name}: {units}. The log has "
                f"nothing called '{unknown.whole}' either."
            ) from error

    def unit_of(self, signal: Signal, told: dict[Signal, str]) -> str:
        """Return the assumed unit of a signal.

        The user's unit has precedence over the unit that the log contains (``told``), and
        that over the default unit.
        """
        info = SIGNALS[signal]
        column = self.columns.get(info.topic)
        if column and column.unit and column.known:
            return column.unit
        return told.get(signal, info.unit)


def read_mapping(columns: Sequence[str], constants: Sequence[str], **table: str) -> LogMapping:
    """Read the user's specification of a log; raises `UsageError`.

    Parameters
    ----------
    columns, constants : sequence of str
        Each ``NAME=THEIRS[:UNIT]`` or ``NAME=VALUE[:UNIT]``.
    **table : str
        Format of a table: ``time_zone``, ``date_order``, ``decimal``, ``sheet``, ``max_unpacked``,
        ``period``.
    """
    found = LogMapping(table=table_options(table))
    for text in columns:
        column = _column(text)
        if column.name in found.columns:
            raise UsageError(f'--column {column.name} is given twice.')
        found.columns[column.name] = column
    for text in constants:
        name, value, unit = _constant(text)
        if name in found.constants:
            raise UsageError(f'--constant {name} is given twice.')
        if name in found.columns:
            raise UsageError(f'{name} is given both as --column and as --constant; leave one out.')
        found.constants[name] = value
        found.units[name] = unit
    return found


def table_options(said: Mapping[str, str]) -> TableOptions:
    """Return the options of a table by name; raises `UsageError`."""
    try:
        options = replace(AS_SEEN, **{name: value.strip() for name, value in said.items()})
        zone_of(options.time_zone)
    except InputError as error:
        raise UsageError(str(error)) from None
    return options


def _column(text: str) -> Column:
    name, whole = _split('column', text)
    if name in _TIMES:
        return Column(name, whole, '', whole)
    signal = _signal(name, 'column')
    theirs, colon, unit = whole.rpartition(':')
    if not colon or not theirs or not unit.strip():
        return Column(SIGNALS[signal].topic, whole, '', whole)
    return Column(SIGNALS[signal].topic, theirs.strip(), _unit(signal, unit), whole)


def _constant(text: str) -> tuple[str, float, str]:
    name, rest = _split('constant', text)
    signal = _signal(name, 'constant')
    number, colon, unit = rest.partition(':')
    try:
        value = float(number)
    except ValueError:
        raise UsageError(f"--constant {name}: '{number}' is no number.") from None
    if not math.isfinite(value):
        raise UsageError(f'--constant {name}: the value must be finite.')
    unit = _unit(signal, unit) if colon else SIGNALS[signal].unit
    if colon:
        try:
            value = float(convert(signal, unit, np.array([value]))[0])
        except InputError as error:
            raise UsageError(f'--constant {name}: {error}') from None
    return SIGNALS[signal].topic, value, unit


def _split(option: str, text: str) -> tuple[str, str]:
    name, equals, rest = text.partition('=')
    if not equals or not name.strip() or not rest.strip():
        raise UsageError(f"--{option} '{text}' is not of the form NAME=... .")
    return name.strip(), rest.strip()


def _unit(signal: Signal, text: str) -> str:
    """Return the canonical name of a unit, or the text itself if it is no known unit."""
    written = text.strip()
    known = {spelling.lower(): spelling for spelling in known_units(signal)}
    return known.get(written.lower()) or unit_named(signal, written) or written


def _signal(name: str, option: str) -> Signal:
    """Return the signal with this topic name or column name."""
    if name in _BY_NAME:
        return _BY_NAME[name].signal
    known = [info.topic for info in SIGNALS] + (list(_TIMES) if option == 'column' else [])
    topics, columns = ([getattr(i, kind) for i in SIGNALS] for kind in ('topic', 'column'))
    near = difflib.get_close_matches(name, [*topics, *columns, *_TIMES], n=1)
    hint = f" did you mean '{near[0]}'?" if near else f' use one of {", ".join(known)}.'
    raise UsageError(f"--{option} '{name}': there is no signal of that name,{hint}")


def gather_refusals(
    path: object,
    look: Callable[[LogMapping], Answer],
    mapping: LogMapping,
    again: Callable[[LogMapping], object],
) -> Answer:
    """Return the result of ``look``; if it is refused, collect all open questions of the table.

    ``again`` then continues as if the user had answered, so that one `RefusedError` contains all
    questions that would otherwise have come one after another.
    """
    try:
        return look(mapping)
    except RefusedError as refused:
        found = [refused]
    remedies = list(found[0].remedies)
    for _ in range(_MOST_LOOKS):
        if found[-1].last:
            break
        try:
            mapping = _answered(mapping, found[-1].remedies)
            again(mapping)
            break
        except RefusedError as refused:
            if not set(refused.remedies) - set(remedies):
                break
            found.append(refused)
            remedies += refused.remedies
        except ValveflowError:
            # The earlier questions come first.
            break
    # A later option overrides an earlier one for the same subject.
    newest = list({subject(remedy): remedy for remedy in remedies}.values())
    raise merge_refusals(path, found, newest) from None


def _answered(mapping: LogMapping, remedies: Iterable[Remedy]) -> LogMapping:
    """Return the mapping with these options added; options without a value yet are left out."""
    columns, constants, table = dict(mapping.columns), dict(mapping.constants), mapping.table
    for remedy in remedies:
        if remedy.option in _TABLE:
            table = replace(table, **{remedy.option.replace('-', '_'): remedy.value})
            continue
        if remedy.option == 'constant':
            name, value, _ = _constant(remedy.value)
            columns.pop(name, None)
            constants[name] = value
            continue
        column = _column(remedy.value)
        if column.theirs != THEIRS:
            columns[column.name] = column
        elif column.name in _STAND_IN:
            columns.pop(column.name, None)
            constants[column.name] = _STAND_IN[column.name]
        else:
            raise UsageError(f'--column {column.name}={THEIRS} has to be answered first.')
    return LogMapping(columns, constants, table, mapping.units)


def merge_refusals(
    path: object, refused: Sequence[RefusedError], remedies: Sequence[Remedy] | None = None
) -> RefusedError:
    """Return one refusal with the messages of all of these."""
    problems = []
    for one in refused:
        about = one.where.removeprefix(str(path)).lstrip(': ')
        problems += [f'{about}: {problem}' if about else problem for problem in one.problems]
    every = [r for one in refused for r in one.remedies] if remedies is None else list(remedies)
    return RefusedError(path, problems, every, last=True)


def subject(remedy: Remedy) -> str:
    """Return the subject of an option: a later option with the same subject replaces it."""
    of_signal = remedy.option in ('column', 'constant')
    return remedy.value.partition('=')[0].strip() if of_signal else remedy.option
