# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Units of a gateway or a historian, and their conversion to the engine's units."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.records import FLOW_UNITS, SIGNALS, FloatArray, Signal


@dataclass(frozen=True, slots=True)
class Unit:
    """``engine value = scale * value + offset``."""

    scale: float
    offset: float = 0.0


_PSI_PA = 6894.757293168361  # NIST SP 811, table B.8
_KGF_CM2_PA = 98066.5  # NIST SP 811, table B.8
# Added to a gauge pressure: the standard atmosphere at sea level (ISO 2533).
AIR_MPA = 0.101325

_OPENING = {'%': Unit(1.0), 'percent': Unit(1.0), 'fraction': Unit(100.0)}
_PRESSURE = {
    'MPa': Unit(1.0),
    'kPa': Unit(1e-3),
    'Pa': Unit(1e-6),
    'bar': Unit(0.1),
    'psi': Unit(_PSI_PA * 1e-6),
}
_TEMPERATURE = {
    'degC': Unit(1.0),
    'K': Unit(1.0, -273.15),
    'degF': Unit(5.0 / 9.0, -160.0 / 9.0),
}
_POWER = {'MW': Unit(1.0), 'kW': Unit(1e-3), 'W': Unit(1e-6)}

UNITS: dict[Signal, dict[str, Unit]] = {
    Signal.VALVE_OPENING: _OPENING,
    Signal.MAIN_STEAM_PRESSURE: _PRESSURE,
    Signal.MAIN_STEAM_TEMPERATURE: _TEMPERATURE,
    Signal.GENERATED_POWER: _POWER,
    Signal.VALVE_COMMAND: _OPENING,
}

# Accepted if a user or a file names them, but never guessed: the values do not show if a
# pressure is gauge or absolute.
FURTHER: dict[Signal, dict[str, Unit]] = {
    Signal.MAIN_STEAM_PRESSURE: {
        'barg': Unit(0.1, AIR_MPA),
        'MPag': Unit(1.0, AIR_MPA),
        'kPag': Unit(1e-3, AIR_MPA),
        'psig': Unit(_PSI_PA * 1e-6, AIR_MPA),
        'kg/cm2': Unit(_KGF_CM2_PA * 1e-6),
        'mbar': Unit(1e-4),
    },
    Signal.GENERATED_POWER: {'GW': Unit(1e3)},
}

FURTHER[Signal.GENERATED_POWER] |= dict.fromkeys(FLOW_UNITS, Unit(1.0))
# The pressure difference across the valve instead of the pressure before it, in the notation of
# instrument makers ('psid').
DIFFERENCES = {f'{name}d': unit for name, unit in _PRESSURE.items()} | {'mbard': Unit(1e-4)}
FURTHER[Signal.MAIN_STEAM_PRESSURE] |= DIFFERENCES

# What the signals of a steam unit in operation usually read, in engine units.
_USUAL = {
    Signal.VALVE_OPENING: (3.0, 102.0),
    Signal.MAIN_STEAM_PRESSURE: (2.0, 35.0),
    Signal.MAIN_STEAM_TEMPERATURE: (350.0, 680.0),
    Signal.GENERATED_POWER: (3.0, 1800.0),
    Signal.VALVE_COMMAND: (3.0, 102.0),
}


def engine_unit(signal: Signal, name: str) -> str:
    """Return the unit of values after `convert` from the unit ``name``.

    The default unit, except that flows keep their unit, and pressure differences are in MPad.
    """
    if signal == Signal.GENERATED_POWER and name in FLOW_UNITS:
        return name
    if signal == Signal.MAIN_STEAM_PRESSURE and name in DIFFERENCES:
        return 'MPad'
    return SIGNALS[signal].unit


# Do not replace inside names of files ('power.csv'), keys ("power": ...), and columns, which are
# in quotes or after an equals sign.
_OUTPUT_WORDS = re.compile(
    r"""(?<![\w.\\=:'-])(?:MW(?P<more>²|\\u00b2|\^2|/)?"""
    r"""|(?P<made>[Gg]enerated )?(?<!/)(?P<power>[Pp]owers?))(?!\w|[.=:-]\w|"\s*:)"""
)

_LOADS = re.compile(
    r"(?<![\w='])((?:at|each|full|high|low|mean|of|one|other|several|that|the|this) )load(s?)\b"
)


def in_unit(text: str, unit: str) -> str:
    """Return a sentence or page about power in MW as one about a flow in ``unit``.

    Keys and names of files and columns (``rmse_mw``, ``generated_power``) are not changed. If
    ``unit`` is not a unit of flow, the text is returned unchanged.
    """
    if unit not in FLOW_UNITS:
        return text

    def told(found: re.Match[str]) -> str:
        if word := found['power']:
            flow = 'Flow' if (found['made'] or word)[0].isupper() else 'flow'
            return flow + word[5:]
        more = found['more'] or ''
        divides = found.start() > 0 and found.string[found.start() - 1] == '/'
        return f'({unit}){more}' if divides or more else unit

    text = _LOADS.sub(r'\1flow\2', text)
    return _OUTPUT_WORDS.sub(told, text)


def known_units(signal: Signal) -> dict[str, Unit]:
    """Return every unit that a signal of a log may have."""
    return {**UNITS[signal], **FURTHER.get(signal, {})}


def air_in(signal: Signal, name: str) -> float:
    """Return the air pressure to add to a gauge pressure, in its unit; 0 for other units."""
    unit = unit_of(signal, name)
    return unit.offset / unit.scale if unit.offset == AIR_MPA else 0.0


def unit_of(signal: Signal, name: str) -> Unit:
    """Return a unit by its name, which is not case-sensitive.

    Raises `InputError` if the unit is not valid for this signal; the message lists the valid
    units.
    """
    for spelling, unit in known_units(signal).items():
        if spelling.lower() == name.strip().lower():
            return unit
    units = units_of(signal, name)
    raise InputError(f"Unit '{name}' is unknown for {SIGNALS[signal].topic}: {units}.")


def units_of(signal: Signal, name: str) -> str:
    """Return the units of a signal, and of which other signals ``name`` is a unit, in words."""
    others = [
        info.topic for info in SIGNALS
        if any(name.strip().lower() == known.lower() for known in known_units(info.signal))
    ]  # fmt: skip
    theirs = f" ('{name}' is a unit of {' and '.join(others)})" if others else ''
    return f'use one of {", ".join(known_units(signal))}{theirs}'


def convert(signal: Signal, name: str, values: FloatArray) -> FloatArray:
    """Convert ``values`` from the unit ``name`` to the engine's unit."""
    unit = unit_of(signal, name)
    return np.asarray(values, dtype=np.float64) * unit.scale + unit.offset


def better_units(
    signal: Signal, written: FloatArray, unit: str, allowed: tuple[float, float]
) -> tuple[str, ...]:
    """Return the units in which the values would be usual when in their own they are not.

    Parameters
    ----------
    signal : Signal
    written : float64 (n,)
        Finite values as they were sent.
    unit : str
        The unit they are taken to have.
    allowed : tuple of float
        Lowest and highest possible value, in the engine's unit.
    """
    middle = float(np.median(written))
    low, high = _USUAL[signal]

    def middle_in(name: str) -> float:
        return middle * unit_of(signal, name).scale + unit_of(signal, name).offset

    def usual(name: str) -> bool:
        other = unit_of(signal, name)
        values = written * other.scale + other.offset
        inside = (values >= allowed[0]) & (values <= allowed[1])
        return low <= middle_in(name) <= high and bool(inside.mean() > 0.95)

    own = unit_of(signal, unit)
    if usual(unit):
        return ()
    # Of two names of one unit the first.
    others = {other: name for name, other in reversed(UNITS[signal].items()) if other != own}
    return tuple(sorted(
        (name for name in reversed(others.values()) if usual(name)),
        key=lambda name: abs(math.log(middle_in(name) ** 2 / (low * high))),
    ))  # fmt: skip
