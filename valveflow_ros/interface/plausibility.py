# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Values that are implausible for their unit, and signals that were not logged."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from valveflow_ros.errors import DataError, UsageError
from valveflow_ros.logs.tables.match import choosing, option
from valveflow_ros.logs.tables.refusal import THEIRS, RefusedError, Remedy
from valveflow_ros.parameters import PARAMETERS, Settings
from valveflow_ros.records import (
    FLOW_UNITS,
    SIGNALS,
    BoolArray,
    FloatArray,
    IntArray,
    Quality,
    Readings,
    Signal,
)
from valveflow_ros.signals.units import DIFFERENCES, FURTHER, UNITS, air_in, better_units, unit_of

# A pressure must be positive; the temperature is absolute zero.
_LEAST_MPA, _COLDEST_DEGC = 1e-6, -273.15
_VACUUM_MPA = 0.001, 0.1  # range of the pressure in a condenser
_MANY = 0.02  # fraction of impossible values that is reported
_MOST = 0.5  # above this fraction, the unit or the column is wrong


@dataclass(frozen=True, slots=True)
class Doubt:
    """A signal whose values are implausible for its unit."""

    signal: Signal
    impossible: float  # fraction of its values that the engine will reject
    # A unit in which the values are usual, empty if there is none; of several units the one that
    # brings the values nearest to the middle of the usual range. ``also`` has the others.
    looks_like: str
    sentence: str  # the message for the user, without the option that solves the problem
    also: tuple[str, ...] = ()
    # In the unit that was told, the values are usual for another quantity: it is rather the column
    # that is wrong than the unit.
    other: bool = False

    def advice(self, theirs: str) -> str:
        """Return the message with the exact option that helps; ``theirs`` is the column."""
        if not self.looks_like:
            return self.sentence
        topic = SIGNALS[self.signal].topic
        fitting = self.looks_like, *self.also
        chosen = [option(topic, theirs, unit) for unit in fitting]
        gauge = [f'{unit}g' for unit in fitting if f'{unit}g' in FURTHER.get(self.signal, ())]
        instead = f', with {" or ".join(gauge)} if it is a gauge pressure' if gauge else ''
        if self.other:
            return (
                f'{self.sentence} Name the right column with --column {topic}={THEIRS}[:unit]; if '
                f'the unit is wrong, add {" or ".join(chosen)}{instead}'
            )
        return f'{self.sentence} If so, add {" or ".join(chosen)}{instead}'

    def remedy(self, theirs: str) -> Remedy:
        """Return the option that helps, with a placeholder if the column is wrong."""
        topic = SIGNALS[self.signal].topic
        if self.other or not self.looks_like:
            return choosing(topic, THEIRS)
        return choosing(topic, theirs, self.looks_like)


def limits(signal: Signal, settings: Settings) -> tuple[float, float]:
    """Return the range outside which a value is rejected."""
    name = 'valve_opening' if signal == Signal.VALVE_COMMAND else SIGNALS[signal].topic
    return settings.real(f'{name}_low'), settings.real(f'{name}_high')


def limits_beside_steam(
    units: Mapping[Signal, str], constants: Mapping[Signal, float]
) -> dict[str, Any]:
    """Return the limits of values, as parameters, that differ from those of a steam unit.

    A flow may be of any fluid and a pressure difference may be small. A temperature that the
    user gives as a constant is accepted.
    """
    found: dict[str, Any] = {}
    if units.get(Signal.MAIN_STEAM_PRESSURE) in DIFFERENCES:
        found['main_steam_pressure_low'] = _LEAST_MPA
    if (told := constants.get(Signal.MAIN_STEAM_TEMPERATURE)) is not None:
        usual = float(PARAMETERS['main_steam_temperature_low'].default)
        found['main_steam_temperature_low'] = max(min(told, usual), _COLDEST_DEGC)
    if units.get(Signal.GENERATED_POWER) in FLOW_UNITS:
        names = ('main_steam_pressure', 'main_steam_temperature', 'generated_power')
        for name in names:
            low, high = PARAMETERS[f'{name}_low'].low, PARAMETERS[f'{name}_high'].high
            found |= {f'{name}_low': low, f'{name}_high': high}
        found['main_steam_pressure_low'] = _LEAST_MPA
    return found


def doubt(
    signal: Signal, written: FloatArray, unit: str, settings: Settings, steam: bool = True
) -> Doubt | None:
    """Check the values of one signal; return None if they are plausible.

    ``written`` are in ``unit``, that of the log; ``settings`` hold the limits of possible values;
    ``steam``: also expect the usual ranges of a steam unit.
    """
    written = written[np.isfinite(written)]
    if not len(written):
        return None
    low, high = limits(signal, settings)
    taken = unit_of(signal, unit)
    values = written * taken.scale + taken.offset
    impossible = float(((values < low) | (values > high)).mean())
    fitting = better_units(signal, written, unit, (low, high)) if steam else ()
    looks_like = fitting[0] if fitting else ''
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
    told = signal == Signal.MAIN_STEAM_PRESSURE and unit not in (info.unit, *DIFFERENCES)
    other = (
        steam
        and told
        and bool(_VACUUM_MPA[0] < float(values.min()) <= float(values.max()) < _VACUUM_MPA[1])
    )
    if other:
        sentence += ' That is the pressure of a condenser, not of main steam'
        wrong = f', unless {unit} is wrong and they are in {" or ".join(fitting)}'
        sentence += f'{wrong}.' if looks_like else '.'
    elif looks_like:
        sentence += f' They look like {" or ".join(fitting)}.'
    return Doubt(signal, impossible, looks_like, sentence, fitting[1:], other)


def refuse_impossible(path: object, doubts: Iterable[Doubt], names: dict[Signal, str]) -> None:
    """Refuse a table if all values of a signal are impossible, or a unit is surely wrong.

    A unit is surely wrong if most values are impossible in it and usual in another unit. Raises
    `RefusedError` with the options that would help.
    """
    problems, remedies = [], []
    for found in doubts:
        lost = SIGNALS[found.signal].required and found.impossible >= 1.0
        if not lost and not (found.looks_like and found.impossible > _MOST):
            continue
        topic, theirs = SIGNALS[found.signal].topic, names[found.signal]
        said = found.advice(theirs)
        if not found.looks_like:
            said = (
                f'{said.removesuffix(".")}; name the right column with --column '
                f'{topic}={THEIRS}[:unit]'
            )
            if found.signal in (Signal.MAIN_STEAM_PRESSURE, Signal.MAIN_STEAM_TEMPERATURE):
                said += f', or give --constant {topic}=VALUE'
        problems.append(f"'{theirs}' is taken for {said}")
        remedies.append(found.remedy(theirs))
    if problems:
        raise RefusedError(path, problems, remedies, last=True)


def refuse_guesses(
    path: object, doubts: Sequence[Doubt], guessed: Container[Signal],
    unsaid: Container[Signal], names: dict[Signal, str], strict: bool = False,
) -> None:  # fmt: skip
    """Refuse columns that were found by their names and whose values contradict this.

    If there is one among the ``guessed``, or with ``strict``, those of ``unsaid``, whose unit the
    user did not give, are refused in the same message. Raises `RefusedError` with the options
    that would help.
    """
    doubts = [found for found in doubts if found.looks_like or found.impossible > _MOST]
    if not strict and not any(found.signal in guessed for found in doubts):
        return
    problems, remedies = [], []
    for found in doubts:
        if found.signal not in unsaid:
            continue
        topic, theirs = SIGNALS[found.signal].topic, names[found.signal]
        said = found.advice(theirs).removeprefix(f'{topic}: ')
        if not found.looks_like:
            chosen = option(topic, theirs, SIGNALS[found.signal].unit)
            said += f' If it is that signal all the same, add {chosen}; if not, name the right'
            said += f' one with --column {topic}={THEIRS}[:unit]'
        problems.append(f"'{theirs}' reads like {topic}, but {said}")
        remedies.append(found.remedy(theirs))
    if problems:
        raise RefusedError(path, problems, remedies, last=True)


def air_note(signal: Signal, unit: str, theirs: str) -> str:
    """Return a sentence on the air pressure added to a gauge pressure, empty for other units."""
    air = air_in(signal, unit)
    if not air:
        return ''
    return (
        f"'{theirs}' is a gauge pressure ({unit}); {air:.6g} {unit.removesuffix('g')} of air, the "
        'standard atmosphere, are added to make it absolute.'
    )


def check_constants(constants: dict[Signal, float], settings: Settings) -> None:
    """Raise `UsageError` if a constant is outside these limits."""
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


def selected(readings: Readings, rows: BoolArray | IntArray) -> Readings:
    """Return some readings: by a mask, or by their places in any order."""
    return Readings(
        readings.time_ns[rows], readings.signal[rows], readings.value[rows],
        readings.quality[rows],
    )  # fmt: skip


def joined(parts: Iterable[Readings]) -> Readings:
    """Return readings one part behind the other."""
    columns = zip(*((r.time_ns, r.signal, r.value, r.quality) for r in parts), strict=True)
    return Readings(*map(np.concatenate, columns))


def with_constants(readings: Readings, constants: dict[Signal, float]) -> Readings:
    """Add each constant at every reading of a measured signal; `DataError` if none is measured."""
    if not constants:
        return readings
    readings = selected(readings, ~np.isin(readings.signal, [int(s) for s in constants]))
    measured = [i.signal for i in SIGNALS if i.required and i.signal not in constants]
    lead = next((s for s in measured if (readings.signal == s).any()), None)
    if lead is None:
        raise DataError('Every signal is a constant or missing; nothing is left to learn from.')
    beside = np.flatnonzero(readings.signal == lead)
    for signal, value in sorted(constants.items()):
        readings = Readings(
            np.insert(readings.time_ns, beside, readings.time_ns[beside]),
            np.insert(readings.signal, beside, int(signal)),
            np.insert(readings.value, beside, value),
            np.insert(readings.quality, beside, int(Quality.GOOD)),
        )
        beside = beside + np.arange(1, len(beside) + 1)
    return readings
