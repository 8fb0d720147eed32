"""The whole plant with its instruments, row after row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from valveflow_ros.plant.chance import Source, Wander, generator
from valveflow_ros.plant.hooks import DAY_S, Forcing, Hooks
from valveflow_ros.plant.loop import ClosedLoop, Series
from valveflow_ros.plant.programme import Drive
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import FloatArray


class Rows(NamedTuple):
    """What happened and what the instruments showed; float64 (n,) each.

    ``*_read`` are values with the sensors' noise, not rounded; ``power`` is
    free of noise and ``noise`` is what a meter shows on top of it.
    """

    command: FloatArray
    opening_read: FloatArray
    pressure_read: FloatArray
    temperature_read: FloatArray
    power: FloatArray
    noise: FloatArray
    load: FloatArray
    plug: FloatArray
    u: FloatArray

    def part(self, start: int, end: int) -> Rows:
        """Return rows ``[start, end)``."""
        return Rows(*(column[start:end] for column in self))

    def followed_by(self, other: Rows) -> Rows:
        """Return these rows and the other ones."""
        return Rows(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


class Disturbance:
    """The noise of the power: a slow part, a white part, and more where asked for."""

    def __init__(self, unit: UnitDescription, seed: int) -> None:
        h, self._noise, self._plan = unit.sample_period_s, unit.noise, unit.programme
        noise = self._noise
        self._slow = Wander(generator(seed, Source.SLOW_NOISE), noise.slow_time_s, h)
        self._wander = Wander(generator(seed, Source.WANDER_NOISE), noise.wander_time_s, h)
        self._white = generator(seed, Source.WHITE_NOISE)

    def advance(self, load_mw: FloatArray) -> FloatArray:
        """Return the next values in MW, one a row of the load."""
        noise, plan, n = self._noise, self._plan, load_mw.size
        sum_mw = noise.slow_mw * self._slow.advance(n)
        sum_mw += noise.white_mw * self._white.standard_normal(n)
        if noise.wander_mw > 0.0:
            sum_mw += noise.wander_mw * self._wander.advance(n)
        if noise.load_dependence != 0.0:
            above = (load_mw - plan.load_mean_mw) / (plan.load_high_mw - plan.load_mean_mw)
            sum_mw *= np.maximum(1.0 + noise.load_dependence * above, 0.0)
        return sum_mw


class Plant:
    """A unit, somebody who drives it, its effects and its instruments.

    ``first_row`` is the number of the first row, the first recorded one being
    0; ``clock_s`` is the time of day of row 0.
    """

    def __init__(
        self, hooks: Hooks, drive: Drive, seed: int, first_row: int, clock_s: float
    ) -> None:
        self._hooks = hooks
        self._drive = drive
        self._row = self._first_row = first_row
        self._clock_s = clock_s
        self._loop = ClosedLoop(hooks, drive.manual)
        self._disturbance = Disturbance(hooks.unit, seed)
        self._opening = generator(seed, Source.OPENING_SENSOR)
        self._pressure = generator(seed, Source.PRESSURE_SENSOR)
        self._temperature = generator(seed, Source.TEMPERATURE_SENSOR)

    def advance(self, count: int) -> Rows:
        """Return the next ``count`` rows."""
        unit, hooks = self._hooks.unit, self._hooks
        outside = self._drive.advance(self._row - self._first_row, count)
        time_s = np.arange(self._row, self._row + count, dtype=np.float64) * unit.sample_period_s
        self._row += count
        forcing = Forcing(
            time_s,
            np.mod(self._clock_s + time_s, DAY_S),
            outside.pressure_mpa,
            outside.temperature_degc,
            np.ones(count),
            np.ones(count),
            np.zeros(count),
        )
        for change in hooks.forcing:
            change(forcing)
        noise_mw = self._disturbance.advance(outside.load_mw)
        motion = self._loop.advance(
            Series(
                time_s,
                outside.load_mw,
                outside.pressure_mpa,
                outside.pressure_mpa**unit.pressure_exponent,
                outside.moves_percent,
                noise_mw,
                forcing.gain,
                forcing.input_gain,
                forcing.offset_mw,
            )
        )
        sensors = unit.noise
        return Rows(
            motion.command,
            motion.sensor + sensors.opening_percent * self._opening.standard_normal(count),
            outside.pressure_mpa + sensors.pressure_mpa * self._pressure.standard_normal(count),
            outside.temperature_degc
            + sensors.temperature_k * self._temperature.standard_normal(count),
            motion.power,
            noise_mw,
            outside.load_mw,
            motion.plug,
            motion.u,
        )
