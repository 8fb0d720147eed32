"""A log as the engine wants it: readings in its own units, constants filled in."""

from __future__ import annotations

import json
from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from valveflow_ros.cli.console import Console
from valveflow_ros.cli.historian_open import LOOKING_ON, looked_through
from valveflow_ros.cli.options import Column, LogMapping
from valveflow_ros.cli.usage import UsageError
from valveflow_ros.errors import DataError, InputError
from valveflow_ros.logs import LogContents, open_log
from valveflow_ros.logs.tables.match import choosing, option
from valveflow_ros.logs.tables.refusal import THEIRS, RefusedError
from valveflow_ros.parameters import Settings
from valveflow_ros.records import SIGNALS, FloatArray, Quality, Readings, Signal
from valveflow_ros.signals.units import UNITS, air_in, convert, known_units, unit_of

# Values that cannot be what their unit says, and the unit they look like.


# What the signals of a steam unit in operation usually read, in engine units.
_USUAL = {
    Signal.VALVE_OPENING: (3.0, 102.0),
    Signal.MAIN_STEAM_PRESSURE: (2.0, 35.0),
    Signal.MAIN_STEAM_TEMPERATURE: (350.0, 680.0),
    Signal.GENERATED_POWER: (3.0, 1800.0),
    Signal.VALVE_COMMAND: (3.0, 102.0),
}
_MANY = 0.02  # share of impossible values that is worth a word


@dataclass(frozen=True, slots=True)
class Doubt:
    """A signal whose values do not suit its unit.

    Attributes
    ----------
    signal : Signal
    impossible : float
        Share of its values that the engine will reject.
    looks_like : str
        The unit that would suit, empty if none does.
    sentence : str
        What to tell a person, without the option that would help.
    """

    signal: Signal
    impossible: float
    looks_like: str
    sentence: str


def limits(signal: Signal, settings: Settings) -> tuple[float, float]:
    """Return the range outside of which a value is rejected."""
    name = 'valve_opening' if signal == Signal.VALVE_COMMAND else SIGNALS[signal].topic
    return settings.real(f'{name}_low'), settings.real(f'{name}_high')


def doubt(signal: Signal, written: FloatArray, unit: str, settings: Settings) -> Doubt | None:
    """Judge the values of one signal.

    Parameters
    ----------
    written : float64 (n,)
        As they stand in the log.
    unit : str
        The unit they are taken to have.
    """
    written = written[np.isfinite(written)]
    if not len(written):
        return None
    low, high = limits(signal, settings)
    taken = unit_of(signal, unit)
    values = written * taken.scale + taken.offset
    impossible = float(((values < low) | (values > high)).mean())
    looks_like = _better_unit(signal, written, unit, (low, high))
    if impossible < _MANY and not looks_like:
        return None
    info = SIGNALS[signal]
    runs = f'its values run from {written.min():g} to {written.max():g}'
    if impossible >= _MANY:
        share = 'all' if impossible == 1.0 else f'{100.0 * impossible:.0f} %'
        sentence = (
            f'{info.topic}: {runs} and are taken as {unit}; {share} of them are impossible '
            f'(outside {low:g} to {high:g} {info.unit}) and will be rejected.'
        )
    else:
        sentence = f'{info.topic}: {runs} and are taken as {unit}, which is unusual.'
    if looks_like:
        sentence += f' They look like {looks_like}.'
    return Doubt(signal, impossible, looks_like, sentence)


def _better_unit(
    signal: Signal, written: FloatArray, unit: str, allowed: tuple[float, float]
) -> str:
    """Return the unit in which the values would be usual when in their own they are not."""
    middle = float(np.median(written))
    low, high = _USUAL[signal]

    def usual(name: str) -> bool:
        other = unit_of(signal, name)
        values = written * other.scale + other.offset
        inside = (values >= allowed[0]) & (values <= allowed[1])
        return low <= middle * other.scale + other.offset <= high and bool(inside.mean() > 0.95)

    own = unit_of(signal, unit)
    if usual(unit):
        return ''
    for name, other in UNITS[signal].items():
        if other != own and usual(name):
            return name
    return ''


# Signals that were not logged: what a person says of them stands beside every reading.


def check_constants(constants: dict[Signal, float]) -> None:
    """Refuse constants that the engine would reject at each row.

    Raises
    ------
    UsageError
    """
    settings = Settings()
    for signal, value in constants.items():
        low, high = limits(signal, settings)
        if not low <= value <= high:
            info = SIGNALS[signal]
            others = ', '.join(list(UNITS[signal])[1:])
            raise UsageError(
                f'--constant {info.topic}: {value:g} {info.unit} is impossible ({low:g} to '
                f'{high:g} {info.unit}); for another unit write {info.topic}=VALUE:UNIT with one '
                f'of {others}.'
            )


def with_constants(readings: Readings, constants: dict[Signal, float]) -> Readings:
    """Put each constant beside every reading of a measured signal.

    Raises
    ------
    DataError
        If no signal is measured.
    """
    if not constants:
        return readings
    kept = ~np.isin(readings.signal, [int(s) for s in constants])
    readings = Readings(
        readings.time_ns[kept], readings.signal[kept], readings.value[kept],
        readings.quality[kept],
    )  # fmt: skip
    measured = [i.signal for i in SIGNALS if i.required and i.signal not in constants]
    lead = next((s for s in measured if (readings.signal == s).any()), None)
    if lead is None:
        raise DataError('Every signal is a constant or missing; nothing is left to learn from.')
    beside = np.flatnonzero(readings.signal == lead)
    for signal, value in sorted(constants.items()):
        n = len(beside)
        readings = Readings(
            np.insert(readings.time_ns, beside, readings.time_ns[beside]),
            np.insert(readings.signal, beside, np.full(n, int(signal), dtype=np.int8)),
            np.insert(readings.value, beside, np.full(n, value)),
            np.insert(readings.quality, beside, np.full(n, int(Quality.GOOD), dtype=np.uint8)),
        )
        beside = beside + np.arange(1, n + 1)
    return readings


# A column is not the signal it is named after if most of its values cannot be.
_MOST = 0.5
_BY_TOPIC = {info.topic: info for info in SIGNALS}


@dataclass(frozen=True, slots=True)
class LogInput:
    """What was read, and how it was understood.

    Attributes
    ----------
    contents : LogContents
        As it stands in the file.
    readings : Readings
        In engine units; constants stand at the times of another signal.
    units : dict
        The unit each measured signal was taken to have.
    constants : dict
        Value of each constant signal, engine units.
    doubts : list of Doubt
        Signals whose values do not suit their unit.
    """

    contents: LogContents
    readings: Readings
    units: dict[Signal, str]
    constants: dict[Signal, float]
    doubts: list[Doubt]

    def name_of(self, signal: Signal) -> str:
        """Return the topic or column a signal comes from, empty if it is not there."""
        return '' if signal in self.constants else self.contents.signals.get(signal, '')


def open_input(path: Path, mapping: LogMapping, console: Console) -> LogInput:
    """Open a log, convert it, and say aloud what looks wrong.

    Raises
    ------
    RecordingError, InputError, DataError
        The log cannot be read, a column is missing, a unit unknown.
    """
    contents = open_with(path, mapping, console)
    for sentence in contents.warnings:
        console.warn(sentence)
    for sentence in contents.understood:
        console.say(sentence)
    told = units_told(contents)
    units = {s: unit_for(s, mapping, told) for s in contents.signals}
    constants = {_BY_TOPIC[c.name].signal: c.value for c in mapping.constants.values()}
    check_constants(constants)
    for signal in sorted(units.keys() - constants.keys()):
        note = air_note(signal, units[signal], contents.signals[signal])
        if note:
            console.say(note)
    readings = _converted(contents.readings, units)
    doubts = _doubts(contents, units, constants)
    refuse_guesses(path, doubts, contents.grounds, contents.signals)
    for found in doubts:
        console.warn(advice(found, contents.signals[found.signal]))
    for signal in constants.keys() & contents.signals.keys():
        console.warn(
            f"{SIGNALS[signal].topic} stands in the log as '{contents.signals[signal]}' too; "
            'the constant is used instead.'
        )
    return LogInput(contents, with_constants(readings, constants), units, constants, doubts)


def open_with(path: Path, mapping: LogMapping, console: Console) -> LogContents:
    """Open a log under the names of ``--column``; raises like `open_input`."""

    def look(said: LogMapping) -> LogContents:
        columns, strange = names_for(said)
        try:
            return open_log(path, columns=columns, absent=list(said.constants), table=said.table)
        except InputError as error:
            if not strange:
                raise
            raise unknown_unit(strange[0]) from error

    def again(said: LogMapping) -> LogContents:
        console.progress(0.02, LOOKING_ON)
        return look(said)

    return looked_through(path, look, mapping, again)


def names_for(mapping: LogMapping) -> tuple[dict[str, str], list[Column]]:
    """Return contract name to their name, and the columns whose unit is unknown.

    Where what follows the last colon is no unit, the colon is taken to belong
    to the column's name.
    """
    strange = [c for c in mapping.columns.values() if not _is_known(c)]
    columns = {c.name: c.whole if c in strange else c.theirs for c in mapping.columns.values()}
    return columns, strange


def unknown_unit(column: Column) -> UsageError:
    """Return the error for a unit nobody knows."""
    known = ', '.join(known_units(_BY_TOPIC[column.name].signal))
    return UsageError(
        f"Unit '{column.unit}' is unknown for {column.name}: use one of {known} "
        f"(and the log has nothing called '{column.whole}')."
    )


def _is_known(column: Column) -> bool:
    return not column.unit or column.unit in known_units(_BY_TOPIC[column.name].signal)


def unit_for(signal: Signal, mapping: LogMapping, told: dict[Signal, str] | None = None) -> str:
    """Return the unit a signal of the log is taken to have.

    What the person says stands above what the recording says of itself, and
    that above the unit of the contract.
    """
    info = SIGNALS[signal]
    column = mapping.columns.get(info.topic)
    if column and column.unit and _is_known(column):
        return column.unit
    return (told or {}).get(signal, info.unit)


def units_told(contents: LogContents) -> dict[Signal, str]:
    """Return the units a recording of the monitor was made with.

    The monitor records what the gateway sent, as it was sent, and its own
    parameters beside it. Stamped samples carry the units of the contract. The
    columns of a table may name their units.
    """
    if contents.units:
        return dict(contents.units)
    try:
        parameters = json.loads(contents.attachments['parameters.json'])
        named = {s: parameters.get(f'{SIGNALS[s].topic}_unit') for s in contents.signals}
    except (KeyError, ValueError, AttributeError):
        return {}
    return {
        signal: unit
        for signal, unit in named.items()
        if unit in UNITS[signal] and not contents.signals[signal].endswith('plant_sample')
    }


def air_note(signal: Signal, unit: str, theirs: str) -> str:
    """Return the sentence on what is added to a gauge pressure, empty for other units."""
    air = air_in(signal, unit)
    if not air:
        return ''
    return (
        f"'{theirs}' is a gauge pressure ({unit}); {air:.6g} {unit.removesuffix('g')} of air, the "
        'standard atmosphere, are added to make it absolute.'
    )


def refuse_guesses(
    path: object, doubts: Iterable[Doubt], grounds: Container[Signal], names: dict[Signal, str]
) -> None:
    """Refuse the columns that were found by their names and whose values speak against it.

    Raises
    ------
    RefusedError
        With the options that would help.
    """
    problems, remedies = [], []
    for found in doubts:
        if found.signal in grounds and (found.looks_like or found.impossible > _MOST):
            theirs = names[found.signal]
            topic = SIGNALS[found.signal].topic
            said = advice(found, theirs)
            remedy = choosing(topic, theirs, found.looks_like)
            if not found.looks_like:
                chosen = option(topic, theirs, SIGNALS[found.signal].unit)
                said += f' If it is that signal all the same, add {chosen}; if not, name the right'
                said += f' one with --column {topic}={THEIRS}[:unit]'
                remedy = choosing(topic, THEIRS)
            said = said.removeprefix(f'{topic}: ')
            problems.append(f"'{theirs}' reads like {topic}, but {said}")
            remedies.append(remedy)
    if problems:
        raise RefusedError(path, problems, remedies, last=True)


def advice(found: Doubt, theirs: str) -> str:
    """Return the sentence about a doubtful signal, with the exact option that helps."""
    if not found.looks_like:
        return found.sentence
    chosen = option(SIGNALS[found.signal].topic, theirs, found.looks_like)
    return f'{found.sentence} If so, add {chosen}'


def steps_of(readings: Readings) -> dict[Signal, float]:
    """Return the median time between readings of each signal that has several, in s."""
    return steps_of_each(readings.by_signal())


def steps_of_each(parts: dict[int, Readings]) -> dict[Signal, float]:
    """Return the same of readings that are taken apart already."""
    steps: dict[Signal, float] = {}
    for signal, part in parts.items():
        gaps = np.diff(part.time_ns)
        if gaps.min(initial=1) <= 0:
            gaps = gaps[gaps > 0]
        if len(gaps):
            steps[Signal(signal)] = float(np.median(gaps)) / 1e9
    return steps


def _converted(readings: Readings, units: dict[Signal, str]) -> Readings:
    value = readings.value
    for signal, unit in units.items():
        if unit == SIGNALS[signal].unit:
            continue
        mine = readings.signal == signal
        value = value.copy() if value is readings.value else value
        value[mine] = convert(signal, unit, value[mine])
    return replace(readings, value=value)


def _doubts(
    contents: LogContents, units: dict[Signal, str], constants: Iterable[Signal]
) -> list[Doubt]:
    settings = Settings()
    readings = contents.readings
    judged = [s for s in sorted(contents.signals) if s not in constants]
    found = [doubt(s, readings.value[readings.signal == s], units[s], settings) for s in judged]
    return [d for d in found if d is not None]
