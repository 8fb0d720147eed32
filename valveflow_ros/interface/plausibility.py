# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Values that cannot be what their unit says, and signals that were not logged."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from valveflow_ros.errors import DataError, UsageError
from valveflow_ros.logs.tables.match import choosing, option
from valveflow_ros.logs.tables.refusal import THEIRS, RefusedError
from valveflow_ros.parameters import PARAMETERS, Settings
from valveflow_ros.records import FLOW_UNITS, SIGNALS, FloatArray, Quality, Readings, Signal
from valveflow_ros.signals.units import DIFFERENCES, UNITS, air_in, better_units, unit_of

# A pressure must be positive, and nothing is colder than this.
_LEAST_MPA, _COLDEST_DEGC = 1e-6, -273.15
_MANY = 0.02  # share of impossible values that is reported
_MOST = 0.5  # with so many, a column is not the signal it is named after


@dataclass(frozen=True, slots=True)
class Doubt:
    """A signal whose values do not suit its unit.

    Attributes
    ----------
    signal : Signal
    impossible : float
        Share of its values that the engine will reject.
    looks_like : str
        The unit that would suit, empty if none does; of several the one in which the values
        come nearest to the middle of what is usual.
    sentence : str
        What to tell a person, without the option that would help.
    also : tuple of str
        Further units that would suit.
    """

    signal: Signal
    impossible: float
    looks_like: str
    sentence: str
    also: tuple[str, ...] = ()

    def advice(self, theirs: str) -> str:
        """Return the sentence with the exact option that helps; ``theirs`` is the column."""
        if not self.looks_like:
            return self.sentence
        topic = SIGNALS[self.signal].topic
        chosen = [option(topic, theirs, unit) for unit in (self.looks_like, *self.also)]
        return f'{self.sentence} If so, add {" or ".join(chosen)}'


def limits(signal: Signal, settings: Settings) -> tuple[float, float]:
    """Return the range outside of which a value is rejected."""
    name = 'valve_opening' if signal == Signal.VALVE_COMMAND else SIGNALS[signal].topic
    return settings.real(f'{name}_low'), settings.real(f'{name}_high')


def limits_beside_steam(
    units: Mapping[Signal, str], constants: Mapping[Signal, float]
) -> dict[str, float]:
    """Return the limits of values, as parameters, that are not those of a steam unit's signals.

    A flow may be of any fluid; a pressure difference may be small; a person knows how warm it is
    who gives that as a constant.
    """
    found: dict[str, float] = {}
    if units.get(Signal.MAIN_STEAM_PRESSURE) in DIFFERENCES:
        found['main_steam_pressure_low'] = _LEAST_MPA
    if (told := constants.get(Signal.MAIN_STEAM_TEMPERATURE)) is not None:
        usual = float(PARAMETERS['main_steam_temperature_low'].default)
        found['main_steam_temperature_low'] = max(min(told, usual), _COLDEST_DEGC)
    if units.get(Signal.GENERATED_POWER) in FLOW_UNITS:
        names = ('main_steam_pressure', 'main_steam_temperature', 'generated_power')
        for name in names:
            low, high = PARAMETERS[f'{name}_low'].low, PARAMETERS[f'{name}_high'].high
            assert low is not None
            assert high is not None
            found |= {f'{name}_low': low, f'{name}_high': high}
        found['main_steam_pressure_low'] = _LEAST_MPA
    return found


def doubt(
    signal: Signal, written: FloatArray, unit: str, settings: Settings, steam: bool = True
) -> Doubt | None:
    """Judge the values of one signal.

    Parameters
    ----------
    written : float64 (n,)
        As they stand in the log.
    unit : str
        The unit they are taken to have.
    settings : Settings
        With the limits of what is possible.
    steam : bool
        What is usual in a steam unit can be expected, too.
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
    if looks_like:
        sentence += f' They look like {" or ".join(fitting)}.'
    return Doubt(signal, impossible, looks_like, sentence, fitting[1:])


def refuse_impossible(path: object, doubts: Iterable[Doubt], names: dict[Signal, str]) -> None:
    """Refuse a table in which every main steam pressure is impossible, or a unit surely wrong.

    That is one in which most values of a signal are impossible and that another would suit.

    Raises
    ------
    RefusedError
        With the options that would help.
    """
    for found in doubts:
        lost = found.signal == Signal.MAIN_STEAM_PRESSURE and found.impossible >= 1.0
        if not lost and not (found.looks_like and found.impossible > _MOST):
            continue
        topic, theirs = SIGNALS[found.signal].topic, names[found.signal]
        said, remedy = found.advice(theirs), choosing(topic, theirs, found.looks_like)
        if not found.looks_like:
            said = (
                f'{said.removesuffix(".")}; name the right column with --column '
                f'{topic}={THEIRS}[:unit], or give --constant {topic}=VALUE'
            )
            remedy = choosing(topic, THEIRS)
        raise RefusedError(path, f"'{theirs}' is taken for {said}", [remedy], last=True)


def refuse_guesses(
    path: object, doubts: Iterable[Doubt], guessed: Container[Signal], names: dict[Signal, str]
) -> None:
    """Refuse the columns that were found by their names and whose values speak against it.

    Raises
    ------
    RefusedError
        With the options that would help.
    """
    problems, remedies = [], []
    for found in doubts:
        if found.signal in guessed and (found.looks_like or found.impossible > _MOST):
            theirs = names[found.signal]
            topic = SIGNALS[found.signal].topic
            said = found.advice(theirs)
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


def air_note(signal: Signal, unit: str, theirs: str) -> str:
    """Return the sentence on what is added to a gauge pressure, empty for other units."""
    air = air_in(signal, unit)
    if not air:
        return ''
    return (
        f"'{theirs}' is a gauge pressure ({unit}); {air:.6g} {unit.removesuffix('g')} of air, the "
        'standard atmosphere, are added to make it absolute.'
    )


def check_constants(constants: dict[Signal, float], settings: Settings) -> None:
    """Refuse constants that the engine would reject at each row with these limits.

    Raises
    ------
    UsageError
    """
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
