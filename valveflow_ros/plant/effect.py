"""What an effect is: a name, parameters with units and ranges, and a way to take hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from valveflow_ros.config import Parameter, Value
from valveflow_ros.plant.hooks import DAY_S, Hooks
from valveflow_ros.records import SIGNALS, FloatArray, Signal

TEN_DAYS_S = 10.0 * DAY_S

ONSET = Parameter('t0_days', 5.0, 'd', 'When it happens, days after the first row.', 0.0, 400.0)
BEFORE_SENSOR = Parameter(
    'before_sensor',
    0,
    '',
    '1: between command and position sensor; 0: between position sensor and plug.',
    0,
    1,
)
SIGNAL = Parameter(
    'signal',
    'generated_power',
    '',
    'The signal whose record is faulty.',
    choices=tuple(info.topic for info in SIGNALS),
)


@dataclass(frozen=True, slots=True)
class Values:
    """The values of all parameters of one effect, in the order of its table."""

    pairs: tuple[tuple[str, Value], ...]

    def __getitem__(self, name: str) -> float:
        """Return a number."""
        return float(dict(self.pairs)[name])

    def signal(self) -> Signal:
        """Return the signal named by the parameter `SIGNAL`."""
        topic = dict(self.pairs)['signal']
        return next(info.signal for info in SIGNALS if info.topic == topic)


def _at_once(values: Values) -> float:
    return 0.0


def at_onset(values: Values) -> float:
    """Return the start of an effect that has the parameter `ONSET`, in days."""
    return values['t0_days']


def _no_problem(values: Values) -> str:
    return ''


@dataclass(frozen=True, slots=True)
class Effect:
    """Something that can be wrong with a plant or with its record.

    Attributes
    ----------
    name : str
        The catalogue's word for it.
    summary : str
        One sentence.
    parameters : tuple of Parameter
        Defaults are a middling amplitude: clearly there in ten days, hard to see by eye.
    install : callable
        Takes the values and puts the effect on the `Hooks` of a run.
    starts_days : callable
        When it begins to act; a run that ends before is refused.
    problem : callable
        What is wrong with the values together, as the end of a sentence; empty if nothing.
    """

    name: str
    summary: str
    parameters: tuple[Parameter, ...]
    install: Callable[[Values, Hooks], None]
    starts_days: Callable[[Values], float] = _at_once
    problem: Callable[[Values], str] = _no_problem


def ramp(time_s: FloatArray) -> FloatArray:
    """Return a ramp that is 0 up to the first row and 1 ten days later."""
    return np.asarray(np.maximum(time_s, 0.0) / TEN_DAYS_S)


def step(time_s: FloatArray, values: Values) -> FloatArray:
    """Return 0 before the onset and 1 from it on."""
    return np.where(time_s >= values['t0_days'] * DAY_S, 1.0, 0.0)
