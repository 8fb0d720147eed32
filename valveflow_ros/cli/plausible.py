"""Values that cannot be what their unit says, and the unit they look like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.records import SIGNALS, FloatArray, Signal
from valveflow_ros.signals.unit_table import UNITS, unit_of

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
