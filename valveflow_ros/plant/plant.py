# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The whole plant with its instruments, row by row."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from valveflow_ros.numerics import jit
from valveflow_ros.plant.effect import DAY_S, Hooks, LoopInputs
from valveflow_ros.plant.loop import ClosedLoop, Series
from valveflow_ros.plant.unit import Programme, UnitDescription
from valveflow_ros.records import FloatArray

# Random numbers and filters with a state that continues from part to part.
#
# Each random source has its own generator, made from the seed and the number of
# the source. So a longer run begins with the shorter one, a run in parts equals
# the run in one piece, and an effect does not change the random numbers of other
# sources.


class ChanceSource(enum.IntEnum):
    """The random sources; the number of a source is never used for another one."""

    LOAD = 1
    PULSES = 2
    PRESSURE = 3
    TEMPERATURE = 4
    JITTER = 5
    SLOW_NOISE = 6
    WHITE_NOISE = 7
    OPENING_SENSOR = 8
    PRESSURE_SENSOR = 9
    TEMPERATURE_SENSOR = 10
    WANDER_NOISE = 11


def generator(seed: int, source: ChanceSource) -> np.random.Generator:
    """Return the generator of one source."""
    return np.random.default_rng([seed, int(source)])


@jit
def _filter(drive: FloatArray, decay: float, gain: float, state: float) -> FloatArray:
    """Return s with ``s[t] = decay s[t-1] + gain drive[t]``, where s[-1] is ``state``."""
    out = np.empty_like(drive)
    for t in range(drive.size):
        state = decay * state + gain * drive[t]
        out[t] = state
    return out


class Wander:
    """An Ornstein-Uhlenbeck path of mean 0 and standard deviation 1, stationary from its start."""

    def __init__(self, rng: np.random.Generator, time_s: float, step_s: float) -> None:
        self._rng = rng
        self._decay = float(np.exp(-step_s / time_s))
        self._gain = float(np.sqrt(1.0 - self._decay**2))
        self._state = float(rng.standard_normal())

    def advance(self, count: int) -> FloatArray:
        """Return the next values, shape (count,)."""
        path = _filter(self._rng.standard_normal(count), self._decay, self._gain, self._state)
        if count:
            self._state = float(path[-1])
        return np.asarray(path)


class LowPass:
    """A first-order lag that starts in steady state with its first value."""

    def __init__(self, time_s: float, step_s: float) -> None:
        self._decay = float(np.exp(-step_s / time_s))
        self._state = np.nan

    def advance(self, signal: FloatArray) -> FloatArray:
        """Return the filtered values, same shape."""
        if signal.size == 0:
            return signal
        if np.isnan(self._state):
            self._state = float(signal[0])
        out = _filter(signal, self._decay, 1.0 - self._decay, self._state)
        self._state = float(out[-1])
        return np.asarray(out)


# Inputs from outside the unit: load programme, pressure, temperature, fast valve moves.

PULSE_EDGE_S = 4.0
PULSE_HOLD_S = (30.0, 120.0)
# Spray water reacts to a change of load: the temperature falls by this much per MW/min.
_TEMPERATURE_DIP_K = 0.3
_TEMPERATURE_DIP_S = 300.0


@dataclass(frozen=True, slots=True)
class Outside:
    """The inputs of the unit from outside, row by row; all float64 (n,).

    ``moves_percent`` is added to the opening that the load requires; with a
    manual drive it is the opening itself.
    """

    load_mw: FloatArray
    pressure_mpa: FloatArray
    temperature_degc: FloatArray
    moves_percent: FloatArray


class Drive(Protocol):
    """The operation of the unit: load programme or manual opening."""

    manual: bool  # the opening is set by hand and the power control is off

    def advance(self, first: int, count: int) -> Outside:
        """Return rows ``[first, first + count)``; must be called in the order of the rows."""


def load_knots(
    rng: np.random.Generator, length_s: float, clock_s: float, plan: Programme
) -> tuple[FloatArray, FloatArray]:
    """Return corner points of the load set point: seconds and MW, holds and linear ramps.

    Targets follow a daily sine with its rising zero crossing at 09:00, and are
    sometimes at full load, where the curve is flat. ``clock_s`` is the time of
    day at second 0.
    """
    knots_s, knots_mw = [0.0], [plan.load_mean_mw]
    while knots_s[-1] < length_s:
        hold = plan.hold_min_s + rng.exponential(plan.hold_mean_extra_s)
        begin = knots_s[-1] + hold
        if rng.random() < plan.full_load_share:
            target = rng.uniform(plan.full_load_from_mw, plan.load_high_mw)
        else:
            phase = 2.0 * np.pi * ((clock_s + begin) / 3600.0 - 9.0) / 24.0
            target = plan.load_mean_mw + plan.load_daily_mw * np.sin(phase)
            target += rng.uniform(-plan.load_spread_mw, plan.load_spread_mw)
        target = float(np.clip(target, plan.load_low_mw, plan.load_high_mw))
        rate = rng.uniform(plan.ramp_low_mw_per_min, plan.ramp_high_mw_per_min) / 60.0
        knots_s += [begin, begin + max(1.0, abs(target - knots_mw[-1]) / rate)]
        knots_mw += [knots_mw[-1], target]
    return np.array(knots_s), np.array(knots_mw)


@dataclass(frozen=True, slots=True)
class Pulses:
    """Trapezoids that primary frequency control adds to the opening; float64 (k,) each."""

    start_s: FloatArray
    hold_s: FloatArray
    height_percent: FloatArray

    @classmethod
    def draw(cls, rng: np.random.Generator, length_s: float, plan: Programme) -> Pulses:
        """Draw a Poisson process of pulses of either sign."""
        rows = []
        now = rng.exponential(plan.pulse_every_s)
        while now < length_s:
            height = rng.uniform(plan.pulse_low_percent, plan.pulse_high_percent)
            sign = 1.0 if rng.random() < 0.5 else -1.0
            rows.append((now, rng.uniform(*PULSE_HOLD_S), sign * height))
            now += rng.exponential(plan.pulse_every_s)
        start, hold, height_percent = np.array(rows).reshape(-1, 3).T
        return cls(start, hold, height_percent)

    def at(self, times_s: FloatArray) -> FloatArray:
        """Return their sum in % at equally spaced times, shape (n,)."""
        added = np.zeros_like(times_s)
        if times_s.size == 0:
            return added
        end = self.start_s + self.hold_s + 2.0 * PULSE_EDGE_S
        for k in np.flatnonzero((self.start_s <= times_s[-1]) & (end >= times_s[0])):
            first, last = np.searchsorted(times_s, (self.start_s[k], end[k]))
            corners = np.cumsum((self.start_s[k], PULSE_EDGE_S, self.hold_s[k], PULSE_EDGE_S))
            height = self.height_percent[k]
            added[first:last] += np.interp(
                times_s[first:last], corners, (0.0, height, height, 0.0)
            )
        return added


class LoadProgramme:
    """The unit under power control, as in section IV of the paper and with frequency control."""

    manual = False

    def __init__(self, unit: UnitDescription, seed: int, length_s: float, clock_s: float) -> None:
        plan, h = unit.programme, unit.sample_period_s
        self._plan, self._step_s = plan, h
        self._knots = load_knots(generator(seed, ChanceSource.LOAD), length_s, clock_s, plan)
        self._pulses = Pulses.draw(generator(seed, ChanceSource.PULSES), length_s, plan)
        self._sliding = LowPass(plan.pressure_lag_s, h)
        self._rate = LowPass(_TEMPERATURE_DIP_S, h)
        self._pressure = Wander(generator(seed, ChanceSource.PRESSURE), plan.pressure_wander_s, h)
        self._temperature = Wander(
            generator(seed, ChanceSource.TEMPERATURE), plan.temperature_wander_s, h
        )
        self._jitter = Wander(generator(seed, ChanceSource.JITTER), plan.jitter_s, h)

    def advance(self, first: int, count: int) -> Outside:
        """Return rows ``[first, first + count)``."""
        plan, h = self._plan, self._step_s
        times_s = np.arange(first, first + count, dtype=np.float64) * h
        load = np.interp(times_s, *self._knots)
        before = np.interp(times_s - h, *self._knots)
        deviation = self._pressure.advance(count)
        pressure = self._sliding.advance(plan.sliding_pressure_mpa(load))
        pressure = pressure + plan.pressure_wander_mpa * deviation
        share = plan.temperature_pressure_correlation
        path = share * deviation + np.sqrt(1.0 - share**2) * self._temperature.advance(count)
        dip = _TEMPERATURE_DIP_K * self._rate.advance((load - before) / h * 60.0)
        temperature = plan.temperature_degc + plan.temperature_wander_k * path - dip
        moves = plan.jitter_percent * self._jitter.advance(count) + self._pulses.at(times_s)
        return Outside(load, pressure, temperature, moves)


class PlantRows(NamedTuple):
    """The true and the measured values; float64 (n,) each.

    ``*_read`` are values with the sensors' noise, not rounded; ``power`` has
    no noise, and the measured power is ``power`` plus ``noise``.
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

    def part(self, start: int, end: int) -> PlantRows:
        """Return rows ``[start, end)``."""
        return PlantRows(*(column[start:end] for column in self))

    def followed_by(self, other: PlantRows) -> PlantRows:
        """Return these rows and the other ones."""
        return PlantRows(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


class Disturbance:
    """The noise of the power: a slow part, a white part, and optional further parts."""

    def __init__(self, unit: UnitDescription, seed: int) -> None:
        h, self._noise, self._plan = unit.sample_period_s, unit.noise, unit.programme
        noise = self._noise
        self._slow = Wander(generator(seed, ChanceSource.SLOW_NOISE), noise.slow_time_s, h)
        self._wander = Wander(generator(seed, ChanceSource.WANDER_NOISE), noise.wander_time_s, h)
        self._white = generator(seed, ChanceSource.WHITE_NOISE)

    def advance(self, load_mw: FloatArray) -> FloatArray:
        """Return the next values in MW, one per row of the load."""
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
    """A unit, its drive, its effects and its instruments.

    ``first_row`` is the number of the first row, the first recorded one being
    0; ``clock_s`` is the time of day of row 0.
    """

    def __init__(
        self, hooks: Hooks, drive: Drive, seed: int, first_row: int, clock_s: float
    ) -> None:
        self._hooks, self._drive, self._clock_s = hooks, drive, clock_s
        self._row = self._first_row = first_row
        self._loop = ClosedLoop(hooks, drive.manual)
        self._disturbance = Disturbance(hooks.unit, seed)
        self._sensors = [
            generator(seed, source)
            for source in (ChanceSource.OPENING_SENSOR, ChanceSource.PRESSURE_SENSOR,
                           ChanceSource.TEMPERATURE_SENSOR)
        ]  # fmt: skip

    def advance(self, count: int) -> PlantRows:
        """Return the next ``count`` rows."""
        unit, hooks = self._hooks.unit, self._hooks
        outside = self._drive.advance(self._row - self._first_row, count)
        time_s = np.arange(self._row, self._row + count, dtype=np.float64) * unit.sample_period_s
        self._row += count
        forcing = LoopInputs.forced(
            hooks, time_s, np.mod(self._clock_s + time_s, DAY_S), outside.pressure_mpa,
            outside.temperature_degc,
        )  # fmt: skip
        noise_mw = self._disturbance.advance(outside.load_mw)
        motion = self._loop.advance(Series(
            time_s, outside.load_mw, outside.pressure_mpa,
            outside.pressure_mpa**unit.pressure_exponent, outside.moves_percent, noise_mw,
            forcing.gain, forcing.input_gain, forcing.offset_mw,
        ))  # fmt: skip
        sizes = unit.noise
        opening, pressure, temperature = (s.standard_normal(count) for s in self._sensors)
        return PlantRows(
            motion.command, motion.sensor + sizes.opening_percent * opening,
            outside.pressure_mpa + sizes.pressure_mpa * pressure,
            outside.temperature_degc + sizes.temperature_k * temperature, motion.power, noise_mw,
            outside.load_mw, motion.plug, motion.u,
        )  # fmt: skip
