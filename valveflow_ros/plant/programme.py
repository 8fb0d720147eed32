"""The outside of the unit: load programme, pressure, temperature, fast valve moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from valveflow_ros.plant.chance import LowPass, Source, Wander, generator
from valveflow_ros.plant.unit import Programme, UnitDescription
from valveflow_ros.records import FloatArray

PULSE_EDGE_S = 4.0
PULSE_HOLD_S = (30.0, 120.0)
# Spraying follows a change of load: the temperature falls by this much per MW/min.
_TEMPERATURE_DIP_K = 0.3
_TEMPERATURE_DIP_S = 300.0


@dataclass(frozen=True, slots=True)
class Outside:
    """What acts on the unit, row by row; all float64 (n,).

    ``moves_percent`` is added to the opening that the load asks for; under a
    manual drive it is the opening itself.
    """

    load_mw: FloatArray
    pressure_mpa: FloatArray
    temperature_degc: FloatArray
    moves_percent: FloatArray


class Drive(Protocol):
    """Somebody who drives the unit."""

    @property
    def manual(self) -> bool:
        """Whether the opening is set by hand, the power control being off."""

    def advance(self, first: int, count: int) -> Outside:
        """Return rows ``[first, first + count)``; to be called for rows in their order."""


def load_knots(
    rng: np.random.Generator, length_s: float, clock_s: float, plan: Programme
) -> tuple[FloatArray, FloatArray]:
    """Return corner points of the load set point: seconds and MW, holds and linear ramps.

    Targets follow a daily sine that is at its mean, rising, at 09:00, and now
    and then sit at full load, where the curve is flat. ``clock_s`` is the time
    of day at second 0.
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
        """Return their sum in % at evenly spaced times, shape (n,)."""
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
    """The unit under power control, as section IV of the paper and a grid would drive it."""

    def __init__(self, unit: UnitDescription, seed: int, length_s: float, clock_s: float) -> None:
        plan, h = unit.programme, unit.sample_period_s
        self._plan = plan
        self._step_s = h
        self._knots = load_knots(generator(seed, Source.LOAD), length_s, clock_s, plan)
        self._pulses = Pulses.draw(generator(seed, Source.PULSES), length_s, plan)
        self._sliding = LowPass(plan.pressure_lag_s, h)
        self._rate = LowPass(_TEMPERATURE_DIP_S, h)
        self._pressure = Wander(generator(seed, Source.PRESSURE), plan.pressure_wander_s, h)
        self._temperature = Wander(
            generator(seed, Source.TEMPERATURE), plan.temperature_wander_s, h
        )
        self._jitter = Wander(generator(seed, Source.JITTER), plan.jitter_s, h)

    @property
    def manual(self) -> bool:
        """The power control is on."""
        return False

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
