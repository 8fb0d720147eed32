# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects that no cause of the catalogue explains, drawn and added to a simulated record.

Each is a function of what was measured (never of the noise), freed of what a curve of u could
take up, and scaled to a share of the noise of ten-second means. It is added to the power after
the simulation, so the power control does not see it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from valveflow_ros.plant.simulator import SimulatedLog
from valveflow_ros.records import FloatArray, SampleTable, Signal

_MEAN_S = 10.0
_HATS = 25


@dataclass(frozen=True)
class Measured:
    """Series of a record, one value a row, and chance; all but ``step_s`` are float64 (n,)."""

    rng: np.random.Generator
    step_s: float
    time_s: FloatArray
    clock_s: FloatArray
    u: FloatArray
    opening: FloatArray
    pressure: FloatArray
    temperature: FloatArray

    def slow(self, x: FloatArray, time_s: float) -> FloatArray:
        """Return a series behind a first-order lag."""
        keep = float(np.exp(-self.step_s / time_s))
        return lfilter([1.0 - keep], [1.0, -keep], x - x[0]) + x[0]

    def before(self, x: FloatArray, time_s: float) -> FloatArray:
        """Return a series as it was some time ago."""
        rows = min(round(time_s / self.step_s), len(x) - 1)
        return np.concatenate([np.full(rows, x[0]), x[: len(x) - rows]])

    def change(self, x: FloatArray, time_s: float) -> FloatArray:
        """Return by how much a series changed in some time."""
        return x - self.before(x, time_s)

    def period(self) -> FloatArray:
        """Draw a sine of 20 minutes to 5 hours."""
        wave = self.drawn(1200.0, 18_000.0)
        return np.sin(2.0 * np.pi * (self.time_s / wave + self.rng.random()))

    def drawn(self, low: float, high: float) -> float:
        """Draw a number, its logarithm uniform."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    @property
    def spare_pressure(self) -> FloatArray:
        """Return the pressure off its line over u."""
        return self.pressure - np.polyval(np.polyfit(self.u, self.pressure, 3), self.u)


def _z(x: FloatArray) -> FloatArray:
    return (x - x.mean()) / max(float(x.std()), 1e-12)


def _sawtooth(m: Measured) -> FloatArray:
    wave = m.rng.uniform(1.2, 2.6) * 86_400.0
    return np.mod(m.time_s / wave + m.rng.random(), 1.0) - 0.5


def _signs_of_three(m: Measured) -> FloatArray:
    ramp = m.change(m.u, 180.0)
    return np.sign(_z(m.temperature)) * np.sign(m.spare_pressure) * np.sign(ramp)


def _direction(m: Measured) -> FloatArray:
    moved = np.tanh(_z(m.change(m.opening, 1800.0)))
    return moved * np.sign(m.u - np.median(m.u))


def _travel(m: Measured) -> FloatArray:
    moved = np.abs(m.change(m.opening, 10.0))
    return _z(m.slow(np.minimum(moved, np.quantile(moved, 0.999)), 3600.0))


def _by_night_and_day(m: Measured) -> FloatArray:
    night = np.sign(np.cos(2.0 * np.pi * m.clock_s / 86_400.0))
    return np.tanh(_z(m.temperature)) * night


OUTSIDE: dict[str, Callable[[Measured], FloatArray]] = {
    'period': Measured.period,
    'square wave': lambda m: np.sign(m.period()),
    'sawtooth of days': _sawtooth,
    'sign(T) sign(p given u)': lambda m: np.sign(_z(m.temperature)) * np.sign(m.spare_pressure),
    'three signs': _signs_of_three,
    'T x ramp': lambda m: _z(m.temperature) * np.tanh(_z(m.change(m.u, 300.0))),
    'T squared': lambda m: np.minimum(_z(m.temperature) ** 2, 6.0),
    'T by night and day': _by_night_and_day,
    'ripple in p': lambda m: np.sin(m.pressure / m.rng.uniform(0.1, 0.25)),
    'ripple in T': lambda m: np.sin(m.temperature / m.rng.uniform(0.4, 1.0)),
    'ripple in u, sign of p': lambda m: (
        np.sin(m.u / m.rng.uniform(25.0, 60.0)) * np.sign(m.spare_pressure)
    ),
    'rise of p x T': lambda m: np.tanh(_z(m.change(m.pressure, 600.0))) * _z(m.temperature),
    'direction x load': _direction,
    'load of hours before': lambda m: _z(m.slow(m.u, m.drawn(3000.0, 12_000.0))),
    'load two hours ago': lambda m: np.sign(_z(m.before(m.u, 7200.0))),
    'travel of the valve': _travel,
}


# Slow changes that are no single cause of the catalogue, over the record's time x of 0 to 1.


def _two_steps(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    a = b = 0.0
    while b - a < 0.2:
        a, b = sorted(rng.uniform(0.15, 0.85, 2).tolist())
    share = rng.uniform(0.3, 0.7)
    return share * (x >= a) + (1.0 - share) * (x >= b)


def _two_changes(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Two changes that take hours each: S-shaped, mostly within 2 to 4 % of the record."""
    a, b = rng.uniform(0.15, 0.4), rng.uniform(0.55, 0.85)
    wide = rng.uniform(0.005, 0.015, 2)
    share = rng.uniform(0.3, 0.7)
    first, second = np.tanh((x - a) / wide[0]), np.tanh((x - b) / wide[1])
    return 0.5 * (share * first + (1.0 - share) * second)


def _late_drift(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    a = rng.uniform(0.3, 0.6)
    return np.maximum(x - a, 0.0) / (1.0 - a)


def _wash(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    a = rng.uniform(0.4, 0.8)
    return np.where(x < a, x / a, 0.0)


def _random_walk(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    walk = np.cumsum(rng.normal(size=121))
    walk -= walk.mean()
    return np.interp(120.0 * x, np.arange(121), walk / np.abs(walk).max())


SLOW: dict[str, Callable[[FloatArray, np.random.Generator], FloatArray]] = {
    'two steps': _two_steps,
    'fouling': lambda x, rng: 1.0 - np.exp(-x / rng.uniform(0.15, 0.3)),
    'late drift': _late_drift,
    'drift then wash': _wash,
    'switching offset': lambda x, rng: np.floor(x * rng.integers(5, 9) + rng.random()) % 2.0,
    'random walk': _random_walk,
    'two changes over hours': _two_changes,
}
_SLOW_SHARE = (0.01, 0.02)  # of the power


def _with_power(log: SimulatedLog, added: FloatArray) -> SimulatedLog:
    values = log.table.values.copy()
    values[:, Signal.GENERATED_POWER] += added
    return replace(log, table=SampleTable(log.table.time_ns, values, log.table.quality))


def slowly(log: SimulatedLog, label: str, seed: int) -> SimulatedLog:
    """Return the record with a slow change of 1 to 2 % of the power; an offset has no load."""
    rng = np.random.default_rng([seed, *map(ord, label)])
    power = log.table.column(Signal.GENERATED_POWER)
    size = rng.uniform(*_SLOW_SHARE) * rng.choice([-1.0, 1.0])
    course = size * SLOW[label](np.arange(len(power)) / len(power), rng)
    of = float(np.nanmean(power)) if label == 'switching offset' else power
    return _with_power(log, of * course)


def added_to(log: SimulatedLog, label: str, seed: int, share: float) -> SimulatedLog:
    """Return the record with an effect of ``share`` times the noise's sd in its power."""
    table = log.table
    v, p, t = (
        table.column(s)
        for s in (Signal.VALVE_OPENING, Signal.MAIN_STEAM_PRESSURE, Signal.MAIN_STEAM_TEMPERATURE)
    )
    time_s = (table.time_ns - table.time_ns[0]) / 1e9
    clock_s = (table.time_ns % (86_400 * 10**9)) / 1e9
    rng = np.random.default_rng([seed, *map(ord, label)])
    step = float(time_s[1] - time_s[0])
    measured = Measured(rng, step, time_s, clock_s, v * p**log.unit.pressure_exponent, v, p, t)
    series = _net(OUTSIDE[label](measured), measured.u)
    rows = max(1, round(_MEAN_S / step))
    return _with_power(
        log, share * _sd_of_means(log.noise_mw, rows) / _sd_of_means(series, rows) * series
    )


def _net(x: FloatArray, u: FloatArray) -> FloatArray:
    """Take away what a curve of u could explain."""
    knots = np.quantile(u, np.linspace(0.0, 1.0, _HATS)) + 1e-6 * np.arange(_HATS)
    hats = np.column_stack([np.interp(u[::10], knots, row) for row in np.eye(_HATS)])
    found = np.linalg.lstsq(hats, x[::10], rcond=None)[0]
    return x - np.interp(u, knots, found)


def _sd_of_means(x: FloatArray, rows: int) -> float:
    whole = len(x) // rows * rows
    return float(x[:whole].reshape(-1, rows).mean(axis=1).std())
