# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The constants of a simulated unit: its curve, dynamics, noise and load programme.

The defaults are those of the simulation study of the paper, eqs. (30) (as printed
for the simulation) and (31), with the load programme of a 300 MW unit.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.records import FloatArray


def refuse_unless(what: str, *checks: tuple[bool | np.bool_, str]) -> None:
    """Raise an `InputError` with the message of the first check that failed."""
    for good, sentence in checks:
        if not good:
            raise InputError(f'This {what}: {sentence}.')


@dataclass(frozen=True, slots=True)
class Curve:
    """A piecewise-linear flow characteristic x = F(u), eq. (2)."""

    knots: FloatArray  # (J + 1,) increasing boundaries of the pieces, % MPa^(9/8)
    slopes: FloatArray  # (J,) MW per unit of u
    intercepts: FloatArray  # (J,) MW

    def __post_init__(self) -> None:
        if len(self.knots) != len(self.slopes) + 1 or len(self.slopes) != len(self.intercepts):
            raise InputError(
                'A curve of J pieces needs J + 1 ends of pieces, J slopes and J intercepts.'
            )
        if not (np.all(np.diff(self.knots) > 0.0) and np.all(self.slopes > 0.0)):
            raise InputError('The knots of a simulated curve must increase and its slopes be > 0.')

    def __call__(self, u: FloatArray) -> FloatArray:
        """Evaluate F; the outer pieces extend beyond the outer knots."""
        piece = np.searchsorted(self.knots[1:-1], u, side='right')
        return np.asarray(self.slopes[piece] * u + self.intercepts[piece])

    def inverse_table(self) -> tuple[FloatArray, FloatArray]:
        """Return ``(x, u)`` at the knots, for linear interpolation of F^-1."""
        x = self.slopes * self.knots[:-1] + self.intercepts
        last = self.slopes[-1] * self.knots[-1] + self.intercepts[-1]
        return np.append(x, last), self.knots

    @classmethod
    def through(cls, knots: FloatArray, powers_mw: FloatArray) -> Curve:
        """Return the continuous curve through the points ``(knots, powers_mw)``."""
        slopes = np.diff(powers_mw) / np.diff(knots)
        return cls(knots, slopes, powers_mw[:-1] - slopes * knots[:-1])


@dataclass(frozen=True, slots=True)
class Region:
    """First-order dynamics with delay, eq. (3), up to a power level in MW."""

    power_to_mw: float
    time_constant_s: float
    delay_s: float

    def __post_init__(self) -> None:
        if not (0.0 < self.time_constant_s < np.inf and 0.0 <= self.delay_s < np.inf):
            raise InputError(
                f'A region needs a time constant above 0 s and a delay of 0 s or more, '
                f'not {self.time_constant_s} and {self.delay_s}.'
            )


@dataclass(frozen=True, slots=True)
class Noise:
    """Disturbance of the power and errors of the sensors (standard deviations).

    ``wander_mw`` is a second, slower disturbance (0: absent). With
    ``load_dependence`` k the disturbance of the power is multiplied by
    1 + k (load - mean) / (high - mean), so that 0.5 means 1.5 times the noise
    at full load. Both are noise and no fault.
    """

    slow_mw: float = 2.0
    slow_time_s: float = 60.0
    white_mw: float = 2.2
    opening_percent: float = 0.02
    pressure_mpa: float = 0.01
    temperature_k: float = 0.2
    wander_mw: float = 0.0
    wander_time_s: float = 7200.0
    load_dependence: float = 0.0

    def __post_init__(self) -> None:
        times = (self.slow_time_s, self.wander_time_s)
        sizes = (self.slow_mw, self.white_mw, self.opening_percent, self.pressure_mpa,
                 self.temperature_k, self.wander_mw)  # fmt: skip
        refuse_unless(
            'noise cannot be simulated',
            (min(times) > 0.0, 'its times must be above 0 s'),
            (all(size >= 0.0 for size in sizes), 'its standard deviations must be 0 or more'),
            (np.isfinite(self.load_dependence), 'load_dependence must be a number'),
        )


@dataclass(frozen=True, slots=True)
class Programme:
    """The operation of the unit: load targets, ramps, sliding pressure, frequency pulses."""

    load_mean_mw: float = 228.0
    load_daily_mw: float = 32.0
    load_spread_mw: float = 50.0
    load_low_mw: float = 160.0
    load_high_mw: float = 293.5
    full_load_from_mw: float = 286.0
    full_load_share: float = 0.15
    hold_min_s: float = 600.0
    hold_mean_extra_s: float = 900.0
    ramp_low_mw_per_min: float = 2.5
    ramp_high_mw_per_min: float = 6.0
    pressure_low_mpa: float = 10.5
    pressure_rise_mpa: float = 5.8
    pressure_span_mw: float = 130.0
    pressure_lag_s: float = 200.0
    pressure_wander_mpa: float = 0.25
    pressure_wander_s: float = 900.0
    temperature_degc: float = 539.0
    temperature_wander_k: float = 2.0
    temperature_wander_s: float = 1800.0
    temperature_pressure_correlation: float = 0.0
    jitter_percent: float = 0.3
    jitter_s: float = 20.0
    pulse_every_s: float = 1500.0
    pulse_low_percent: float = 1.0
    pulse_high_percent: float = 4.0
    feedback: bool = True
    feedback_s: float = 900.0
    feedback_slope_mw: float = 0.15
    feedback_limit_u: float = 150.0
    feedback_off_above_mw: float = 289.0

    def __post_init__(self) -> None:
        low, high = self.load_low_mw, self.load_high_mw
        times = (self.pressure_lag_s, self.pressure_wander_s, self.temperature_wander_s,
                 self.jitter_s, self.pulse_every_s, self.feedback_s)  # fmt: skip
        pressures = (self.pressure_low_mpa, self.pressure_low_mpa + self.pressure_rise_mpa)
        refuse_unless(
            'programme cannot be simulated',
            (low < self.load_mean_mw < high, 'load_mean_mw must lie between lowest and highest'),
            (low <= self.full_load_from_mw <= high, 'full_load_from_mw must lie between them'),
            (0.0 <= self.full_load_share <= 1.0, 'full_load_share must be 0 to 1'),
            (self.load_spread_mw >= 0.0, 'load_spread_mw must be 0 or more'),
            (min(self.hold_min_s, self.hold_mean_extra_s) >= 0.0, 'holds must be 0 s or more'),
            (0.0 < self.ramp_low_mw_per_min <= self.ramp_high_mw_per_min,
             'ramps must be above 0 and the slowest not faster than the fastest'),
            (min(pressures) > 0.0 and self.pressure_span_mw > 0.0,
             'pressures and pressure_span_mw must be above 0'),
            (min(times) > 0.0, 'its times must be above 0 s'),
            (abs(self.temperature_pressure_correlation) <= 1.0,
             'temperature_pressure_correlation must be -1 to 1'),
            (0.0 <= self.pulse_low_percent <= self.pulse_high_percent,
             'pulses must be 0 or more and the lowest not above the highest'),
            (self.feedback_slope_mw > 0.0 and self.feedback_limit_u >= 0.0,
             'feedback_slope_mw must be above 0, feedback_limit_u 0 or more'),
        )  # fmt: skip

    def sliding_pressure_mpa(self, load_mw: FloatArray) -> FloatArray:
        """Return the pressure set point at a load, in MPa."""
        share = (load_mw - self.load_low_mw) / self.pressure_span_mw
        return np.asarray(self.pressure_low_mpa + self.pressure_rise_mpa * share)


def paper_curve() -> Curve:
    """Return F of the simulation investigation in Section IV."""
    return Curve(
        np.array([1050.0, 1250.0, 1600.0, 1900.0, 2600.0]),
        np.array([0.24, 0.18, 0.09, 0.01]),
        np.array([-100.0, -25.0, 119.0, 271.0]),
    )


def paper_regions() -> tuple[Region, ...]:
    """Return G_1 and G_2 of eq. (31), switching at 240 MW."""
    return (Region(240.0, 10.0, 3.0), Region(np.inf, 80.0, 10.0))


@dataclass(frozen=True, slots=True)
class UnitDescription:
    """A whole simulated unit."""

    curve: Curve = field(default_factory=paper_curve)
    regions: tuple[Region, ...] = field(default_factory=paper_regions)
    noise: Noise = field(default_factory=Noise)
    programme: Programme = field(default_factory=Programme)
    pressure_exponent: float = 1.125
    sample_period_s: float = 1.0

    def __post_init__(self) -> None:
        if not 0.01 <= self.sample_period_s <= 60.0:
            raise InputError(
                f'The sample period must lie between 0.01 and 60 s, not {self.sample_period_s}.'
            )
        ends = [region.power_to_mw for region in self.regions]
        if not ends or ends[-1] != np.inf or not all(a < b for a, b in itertools.pairwise(ends)):
            raise InputError(
                'The regions of a unit must follow each other upwards in power, '
                'and the last one must have no upper end.'
            )


# Other plausible units, so that the program is not tuned to the unit of the paper.

_EXPONENT = 1.125
# The paper's unit, from which programmes in MW and u are scaled.
_PAPER_RATED_MW = 300.0
_PAPER_LOAD_SPAN_MW = 133.5
_PAPER_U_SPAN = 1200.0


def random_unit(rng: np.random.Generator) -> UnitDescription:
    """Draw a unit of 200 to 660 MW with 2 to 6 pieces and 1 to 3 regions.

    Its curve covers the range of its load programme: an opening of 60 to 72 %
    at the lowest load and pressure, and of 88 to 95 % at full load. Neighbouring
    slopes differ by a factor of at least 1.33. The sample period is 1 or 2 s.
    """
    rated = rng.uniform(200.0, 660.0)
    pressure_low, pressure_high = rng.uniform(8.5, 11.5), rng.uniform(15.5, 17.0)
    u_low = rng.uniform(60.0, 72.0) * pressure_low**_EXPONENT
    u_full = rng.uniform(88.0, 95.0) * pressure_high**_EXPONENT
    curve = _curve(rng, rated, u_low, u_full)
    low, near_full, full = curve(u_low + np.array([0.0, 0.7, 1.0]) * (u_full - u_low))
    return UnitDescription(
        curve, _regions(rng, low, full), _noise(rng, rated),
        _programme(rng, (low, near_full, full), (pressure_low, pressure_high), u_full - u_low),
        _EXPONENT, float(rng.choice([1.0, 2.0])),
    )  # fmt: skip


def _curve(rng: np.random.Generator, rated: float, u_low: float, u_full: float) -> Curve:
    """Draw a continuous curve with all inner knots in the operating range of the unit."""
    J = int(rng.integers(2, 7))
    widths = 0.6 / J + 0.4 * rng.dirichlet(np.full(J, 2.0))
    slopes = [1.0]
    for _ in range(J - 1):
        # The slopes mostly decrease; sometimes the next valve opens late.
        flatter = rng.random() < 0.8 and slopes[-1] > 0.08
        slopes.append(slopes[-1] * rng.uniform(*((0.4, 0.75) if flatter else (1.35, 1.8))))
    inner = np.append(0.0, np.cumsum(widths))
    rise = np.append(0.0, np.cumsum(np.array(slopes) * widths))
    knots = u_low + inner * (u_full - u_low)
    low, full = rated * rng.uniform(0.45, 0.55), rated * rng.uniform(0.95, 1.0)
    powers = low + rise / rise[-1] * (full - low)
    curve, margin = Curve.through(knots, powers), 0.1 * (u_full - u_low)
    # The outermost knots lie further out on their pieces, because noise moves u beyond them.
    knots[[0, -1]] += (-margin, margin)
    return Curve(knots, curve.slopes, curve.intercepts)


def _regions(rng: np.random.Generator, low: float, full: float) -> tuple[Region, ...]:
    """Draw one to three regions; those at higher power are slower."""
    count = int(rng.integers(1, 4))
    inner = low + (np.arange(1, count) + rng.uniform(-0.2, 0.2, count - 1)) / count * (full - low)
    regions = []
    time_s, delay_s = rng.uniform(6.0, 15.0), rng.uniform(1.0, 4.0)
    for power_to in [*inner, np.inf]:
        regions.append(Region(float(power_to), time_s, delay_s))
        time_s, delay_s = time_s * rng.uniform(1.8, 3.0), delay_s * rng.uniform(1.2, 2.0)
    return tuple(regions)


def _noise(rng: np.random.Generator, rated: float) -> Noise:
    """Draw disturbances of 0.5 to 1.5 times those of the paper's unit."""
    scale = rated / _PAPER_RATED_MW
    return Noise(
        slow_mw=2.0 * scale * rng.uniform(0.5, 1.5), slow_time_s=rng.uniform(30.0, 120.0),
        white_mw=2.2 * scale * rng.uniform(0.5, 1.5), opening_percent=rng.uniform(0.01, 0.03),
        pressure_mpa=rng.uniform(0.005, 0.015), temperature_k=rng.uniform(0.1, 0.3),
    )  # fmt: skip


def _programme(
    rng: np.random.Generator,
    loads_mw: tuple[float, float, float],
    pressures_mpa: tuple[float, float],
    u_span: float,
) -> Programme:
    """Scale the programme of the paper's unit to another unit, with other weather and grid."""
    low, near_full, full = loads_mw
    scale = (full - low) / _PAPER_LOAD_SPAN_MW
    return Programme(
        load_mean_mw=low + 68.0 * scale, load_daily_mw=32.0 * scale, load_spread_mw=50.0 * scale,
        load_low_mw=low, load_high_mw=full, full_load_from_mw=near_full,
        ramp_low_mw_per_min=2.5 * scale, ramp_high_mw_per_min=6.0 * scale,
        pressure_low_mpa=pressures_mpa[0], pressure_rise_mpa=pressures_mpa[1] - pressures_mpa[0],
        pressure_span_mw=full - low, pressure_wander_mpa=rng.uniform(0.15, 0.3),
        temperature_degc=rng.uniform(535.0, 542.0), jitter_percent=rng.uniform(0.2, 0.4),
        pulse_every_s=rng.uniform(1000.0, 2000.0), feedback=bool(rng.random() < 0.8),
        feedback_slope_mw=(full - low) / u_span, feedback_limit_u=150.0 * u_span / _PAPER_U_SPAN,
        feedback_off_above_mw=full - 4.5 * scale,
    )  # fmt: skip
