"""Units at the border: what a gateway or a historian may send, and what the engine works in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.records import SIGNALS, FloatArray, Signal


@dataclass(frozen=True, slots=True)
class Unit:
    """``engine value = scale * value + offset``."""

    scale: float
    offset: float = 0.0


_PSI_PA = 6894.757293168361  # NIST SP 811, table B.8

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


def unit_of(signal: Signal, name: str) -> Unit:
    """Look a unit up by its name; capitals do not matter.

    Raises
    ------
    InputError
        The unit is not one this signal can have; the sentence lists those it can.
    """
    known = UNITS[signal]
    for spelling, unit in known.items():
        if spelling.lower() == name.strip().lower():
            return unit
    raise InputError(
        f"Unit '{name}' is unknown for {SIGNALS[signal].topic}: use one of {', '.join(known)}."
    )


def convert(signal: Signal, name: str, values: FloatArray) -> FloatArray:
    """Convert ``values`` from the unit ``name`` to the engine's unit."""
    unit = unit_of(signal, name)
    return np.asarray(values, dtype=np.float64) * unit.scale + unit.offset
