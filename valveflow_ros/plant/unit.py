"""What is fixed about a simulated unit: its curve, its dynamics, its noise and its habits.

The defaults are the simulation study of the paper, eqs. (30) (as printed for
the simulation) and (31), with the load programme of a 300 MW unit.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.records import FloatArray


def _refuse_unless(what: str, *checks: tuple[bool | np.bool_, str]) -> None:
    """Raise with the sentence of the first check that failed."""
    for good, sentence in checks:
        if not good:
            raise InputError(f'This {what} cannot be simulated: {sentence}.')


@dataclass(frozen=True, slots=True)
class Curve:
    """A piecewise-linear flow characteristic x = F(u), eq. (2).

    Attributes
    ----------
    knots : float64 (J + 1,)
        Boundaries of the pieces, % MPa^(9/8), increasing.
    slopes, intercepts : float64 (J,)
        MW per unit of u, and MW.
    """

    knots: FloatArray
    slopes: FloatArray
    intercepts: FloatArray

    def __post_init__(self) -> None:
        """Refuse what is no rising curve."""
        if len(self.knots) != len(self.slopes) + 1 or len(self.slopes) != len(self.intercepts):
            raise InputError('A curve of J pieces needs J + 1 knots, J slopes and J intercepts.')
        if not (np.all(np.diff(self.knots) > 0.0) and np.all(self.slopes > 0.0)):
            raise InputError('The knots of a simulated curve must increase and its slopes be > 0.')

    def __call__(self, u: FloatArray) -> FloatArray:
        """Evaluate F; the outer pieces go on beyond the outer knots."""
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
        """Refuse what is no first-order lag with delay."""
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
    1 + k (load - mean) / (high - mean), so that 0.5 means half as much again
    at full load. Neither is a cause of anything: both are noise.
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
        """Refuse sizes below zero and times of zero."""
        times = (self.slow_time_s, self.wander_time_s)
        sizes = (
            self.slow_mw,
            self.white_mw,
            self.opening_percent,
            self.pressure_mpa,
            self.temperature_k,
            self.wander_mw,
        )
        _refuse_unless(
            'noise',
            (min(times) > 0.0, 'its times must be above 0 s'),
            (all(size >= 0.0 for size in sizes), 'its standard deviations must be 0 or more'),
            (np.isfinite(self.load_dependence), 'load_dependence must be a number'),
        )


@dataclass(frozen=True, slots=True)
class Programme:
    """How the unit is driven: load targets, ramps, sliding pressure, frequency pulses."""

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
        """Refuse habits that contradict each other."""
        low, high = self.load_low_mw, self.load_high_mw
        times = (
            self.pressure_lag_s,
            self.pressure_wander_s,
            self.temperature_wander_s,
            self.jitter_s,
            self.pulse_every_s,
            self.feedback_s,
        )
        pressures = (self.pressure_low_mpa, self.pressure_low_mpa + self.pressure_rise_mpa)
        _refuse_unless(
            'programme',
            (low < self.load_mean_mw < high, 'load_mean_mw must lie between lowest and highest'),
            (low <= self.full_load_from_mw <= high, 'full_load_from_mw must lie between them'),
            (0.0 <= self.full_load_share <= 1.0, 'full_load_share must be 0 to 1'),
            (self.load_spread_mw >= 0.0, 'load_spread_mw must be 0 or more'),
            (min(self.hold_min_s, self.hold_mean_extra_s) >= 0.0, 'holds must be 0 s or more'),
            (
                0.0 < self.ramp_low_mw_per_min <= self.ramp_high_mw_per_min,
                'ramps must be above 0 and the slowest not faster than the fastest',
            ),
            (
                min(pressures) > 0.0 and self.pressure_span_mw > 0.0,
                'pressures and pressure_span_mw must be above 0',
            ),
            (min(times) > 0.0, 'its times must be above 0 s'),
            (
                abs(self.temperature_pressure_correlation) <= 1.0,
                'temperature_pressure_correlation must be -1 to 1',
            ),
            (
                0.0 <= self.pulse_low_percent <= self.pulse_high_percent,
                'pulses must be 0 or more and the lowest not above the highest',
            ),
            (
                self.feedback_slope_mw > 0.0 and self.feedback_limit_u >= 0.0,
                'feedback_slope_mw must be above 0, feedback_limit_u 0 or more',
            ),
        )

    def sliding_pressure_mpa(self, load_mw: FloatArray) -> FloatArray:
        """Return the pressure set point that belongs to a load, in MPa."""
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
        """Refuse what cannot be simulated."""
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
