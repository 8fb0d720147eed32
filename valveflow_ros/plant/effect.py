# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects: a name, parameters with units and ranges, and a function that installs the effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import InputError
from valveflow_ros.parameters import Parameter, Value
from valveflow_ros.plant.unit import Region, UnitDescription
from valveflow_ros.records import NS_PER_S, SIGNALS, FloatArray, Signal

# The places of the plant at which an effect can act.

DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class LoopInputs:
    """Inputs of the closed loop for a part of a run; all float64 (n,).

    ``time_s`` counts from the first recorded row (the warm-up is negative),
    ``clock_s`` from a midnight UTC. An effect may only change ``gain`` (factor on
    x = F(u)), ``input_gain`` (factor on u) and ``offset_mw`` (added to the
    power).
    """

    time_s: FloatArray
    clock_s: FloatArray
    pressure_mpa: FloatArray
    temperature_degc: FloatArray
    gain: FloatArray
    input_gain: FloatArray
    offset_mw: FloatArray

    @classmethod
    def forced(
        cls, hooks: Hooks, time_s: FloatArray, clock_s: FloatArray, pressure_mpa: FloatArray,
        temperature_degc: FloatArray,
    ) -> LoopInputs:  # fmt: skip
        """Return the inputs from outside with what the effects of a run do to them."""
        one, outside = np.ones(time_s.size), (time_s, clock_s, pressure_mpa, temperature_degc)
        rows = cls(*outside, one, one.copy(), np.zeros(time_s.size))
        for change in hooks.forcing:
            change(rows)
        return rows


Change = Callable[[LoopInputs], NDArray[Any]]


@dataclass(frozen=True, slots=True)
class HistorianRows:
    """Rows before the historian stores them; columns are changed in place."""

    time_s: FloatArray
    columns: dict[Signal, FloatArray]


@dataclass(slots=True)
class ActuatorLimits:
    """Limits between two points of the actuator; the defaults have no effect."""

    rate_percent_per_s: float = np.inf
    band_percent: float = 0.0  # stick-slip parameters S and J
    jump_percent: float = 0.0
    top_percent: float = np.inf
    slack_percent: float = 0.0  # full width of a loose linkage


@dataclass(frozen=True, slots=True)
class AddedCurve:
    """MW added to x as a piecewise-linear function of u from ``from_s`` on, constant outside."""

    u: FloatArray
    x_mw: FloatArray
    from_s: float = -np.inf


@dataclass(slots=True)
class Hooks:
    """All settings that effects can change, created once for a run.

    The position sensor is between the two banks: the measured opening shows the
    effects of ``before_sensor`` (from command to sensor), but not those of
    ``after_sensor`` (from sensor to plug). ``forcing`` and ``writing`` change the rows
    of every part of the run.
    """

    unit: UnitDescription  # without any effect
    length_s: float  # of the recorded part
    regions: tuple[Region, ...]
    forcing: list[Callable[[LoopInputs], object]] = field(default_factory=list)
    writing: list[Callable[[HistorianRows], None]] = field(default_factory=list)
    before_sensor: ActuatorLimits = field(default_factory=ActuatorLimits)
    after_sensor: ActuatorLimits = field(default_factory=ActuatorLimits)
    added_curves: list[AddedCurve] = field(default_factory=list)
    lead_s: float = 0.0  # by which the power is stamped earlier than other signals
    kappa_mpa_per_mw: float = 0.0  # back pressure per power; 0: always choked
    critical_ratio: float = 0.546
    reheater_share: float = 1.0  # of the power, generated before the reheater
    reheater_s: float = 0.0
    _claimed: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, unit: UnitDescription, length_s: float) -> Hooks:
        """Return hooks without any effect."""
        return cls(unit, length_s, unit.regions)

    def scale_power(self, factor: Change) -> None:
        """Multiply x = F(u) by a factor in each row."""
        self.forcing.append(lambda rows: np.multiply(rows.gain, factor(rows), out=rows.gain))

    def add_power(self, part: Change) -> None:
        """Add MW to the power in each row."""
        self.forcing.append(lambda rows: np.add(rows.offset_mw, part(rows), out=rows.offset_mw))

    def scale_input(self, factor: Change) -> None:
        """Multiply u by a factor in each row."""
        self.forcing.append(
            lambda rows: np.multiply(rows.input_gain, factor(rows), out=rows.input_gain)
        )

    def bank(self, name: str, before_sensor: float) -> ActuatorLimits:
        """Reserve, for an effect, the bank on one side of the position sensor."""
        self.claim(name, 'before the sensor' if before_sensor else 'behind the sensor')
        return self.before_sensor if before_sensor else self.after_sensor

    def claim(self, name: str, place: str = '') -> None:
        """Reserve a place that can have one setting only; raises `InputError` if it is taken."""
        key = f'{name} {place}'
        if key in self._claimed:
            where = f' {place}' if place else ''
            raise InputError(f"Effect '{name}'{where} is given twice; it can act only once.")
        self._claimed.add(key)


def clock_at_ns(start_ns: int) -> float:
    """Return the seconds since the last midnight UTC at ``start_ns``."""
    return (start_ns % (int(DAY_S) * NS_PER_S)) / NS_PER_S


TEN_DAYS_S = 10.0 * DAY_S

ONSET = Parameter('t0_days', 5.0, 'd', 'When it happens, days after the first row.', 0.0, 400.0)
BEFORE_SENSOR = Parameter(
    'before_sensor', 0, '',
    '1: between command and position sensor; 0: between position sensor and plug.', 0, 1,
)  # fmt: skip
SIGNAL = Parameter(
    'signal', 'generated_power', '', 'The signal whose record is faulty.',
    choices=tuple(info.topic for info in SIGNALS),
)  # fmt: skip


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


def _starts(values: Values) -> float:
    return float(dict(values.pairs).get('t0_days', 0.0))


def not_above(*pairs: tuple[str, str]) -> Callable[[Values], str]:
    """Return a check that the first parameter of each pair does not exceed the second."""

    def problem(values: Values) -> str:
        said = (f'{low} must not exceed {top}' for low, top in pairs if values[low] > values[top])
        return next(said, '')

    return problem


_no_problem = not_above()


@dataclass(frozen=True, slots=True)
class Effect:
    """A possible fault of a plant or of its record."""

    name: str
    summary: str
    # Defaults are a medium amplitude: detectable in ten days, hard to see by eye.
    parameters: tuple[Parameter, ...]
    install: Callable[[Values, Hooks], None]
    starts_days: Callable[[Values], float] = _starts  # a run that ends before is refused
    # A conflict between the values, as the end of a sentence; empty if there is none.
    problem: Callable[[Values], str] = _no_problem


def effect(
    summary: str, *parameters: Parameter, **more: Any
) -> Callable[[Callable[[Values, Hooks], None]], Effect]:
    """Make an `Effect` of the function that installs it; it has the function's name."""
    return lambda install: Effect(install.__name__, summary, parameters, install, **more)


def ramp(time_s: FloatArray) -> FloatArray:
    """Return a ramp that is 0 up to the first row and 1 ten days later."""
    return np.asarray(np.maximum(time_s, 0.0) / TEN_DAYS_S)


def step(time_s: FloatArray, values: Values) -> FloatArray:
    """Return 0 before the onset and 1 after it."""
    return np.where(time_s >= values['t0_days'] * DAY_S, 1.0, 0.0)
