# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Plants to be diagnosed: what is hidden in them is drawn, and so is the plant itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import UnitDescription, random_unit

PAPER_NOISE_MW, PAPER_RATED_MW = 3.0, 300.0


@dataclass(frozen=True)
class Case:
    """A plant, what is hidden in it, and whether an earlier model of it is at hand."""

    kind: str
    label: str
    seed: int
    unit: UnitDescription
    effects: tuple[EffectSpec, ...]
    names: tuple[str, ...]
    given: bool = False
    outside_share: float = 0.0


@dataclass(frozen=True)
class Setting:
    """What an amplitude depends on."""

    rng: np.random.Generator
    unit: UnitDescription
    days: float
    low: float = 2.0
    high: float = 4.0

    def _relative(self, here: float, paper: float) -> float:
        rated = self.unit.programme.load_high_mw
        return here / paper * PAPER_RATED_MW / rated

    @property
    def noise(self) -> float:
        """Return the long-run sd of this unit's noise relative to the paper's, per rated power.

        What lasts is hidden by the spectrum of the noise at low frequencies.
        """
        n, p = self.unit.noise, UnitDescription().noise
        return self._relative(
            n.slow_mw * np.sqrt(n.slow_time_s), p.slow_mw * np.sqrt(p.slow_time_s)
        )

    @property
    def quick_noise(self) -> float:
        """Return the sd of this unit's noise relative to the paper's, per rated power."""
        n = self.unit.noise
        return self._relative(float(np.hypot(n.slow_mw, n.white_mw)), PAPER_NOISE_MW)

    @property
    def times(self) -> float:
        """Draw a multiple of the smallest detectable amplitude."""
        return float(np.exp(self.rng.uniform(np.log(self.low), np.log(self.high))))

    @property
    def size(self) -> float:
        """Draw a multiple of what is detectable in ten days of the paper's unit, what lasts."""
        return self.times * self.noise * float(np.sqrt(10.0 / self.days))

    @property
    def quick(self) -> float:
        """Draw a multiple of what is detectable in ten days of the paper's unit, what is fast."""
        return self.times * self.quick_noise * float(np.sqrt(10.0 / self.days))

    @property
    def sign(self) -> float:
        """Draw a sign."""
        return 1.0 if self.rng.random() < 0.5 else -1.0

    @property
    def onset(self) -> float:
        """Draw an onset in days, away from both ends."""
        return float(self.rng.uniform(0.25, 0.75) * self.days)

    @property
    def mw(self) -> float:
        """Return the size of the unit relative to the paper's."""
        return self.unit.programme.load_high_mw / PAPER_RATED_MW

    def u(self, share: float) -> float:
        """Return a place on the curve between its outermost inner ends."""
        low, high = self.unit.curve.knots[0], self.unit.curve.knots[-1]
        margin = 0.08 * (high - low)
        return float(low + margin + share * (high - low - 2.0 * margin))


def _text(name: str, **values: float) -> str:
    return f'{name}:' + ','.join(f'{k}={v:.6g}' for k, v in values.items())


def _choked(s: Setting) -> str:
    plan = s.unit.programme
    pressure = float(plan.sliding_pressure_mpa(np.array([plan.load_high_mw]))[0])
    ratio = s.rng.uniform(0.64, 0.72)
    return _text('choked', kappa=ratio * pressure / plan.load_high_mw)


def _curve_step(s: Setting) -> str:
    first = s.rng.uniform(0.1, 0.5)
    return _text(
        'curve_step', s_mw=s.sign * 0.65 * s.size * s.mw, u_from=s.u(first),
        u_to=s.u(first + s.rng.uniform(0.15, 0.3)), t0_days=s.onset,
    )  # fmt: skip


def _curve_shape(s: Setting) -> str:
    # In the middle of the longest piece: on a knee, the knee would take part of it.
    knots = s.unit.curve.knots
    k = int(np.argmax(np.diff(knots[: max(3, len(knots) - 1)])))
    width = s.rng.uniform(0.3, 0.5) * (knots[k + 1] - knots[k])
    return _text(
        'curve_shape', h_mw=s.sign * 0.6 * s.size * s.mw, u0=0.5 * (knots[k] + knots[k + 1]),
        width_u=width,
    )  # fmt: skip


def _stiction(s: Setting) -> str:
    band = s.quick  # 1 % is told from a mere slack
    return _text('stiction', s_percent=band, j_percent=0.7 * band)


def _clock(s: Setting) -> str:
    least = min(r.delay_s for r in s.unit.regions)
    return _text('clock', d_s=least + 10.0 * s.quick)


def _reheater(s: Setting) -> str:
    # What shows is the power that comes late, (1 - alpha) T.
    alpha = s.rng.uniform(0.25, 0.4)
    return _text('reheater', alpha=alpha, time_s=14.0 * s.quick / (1.0 - alpha))


def _region_lag(s: Setting) -> str:
    plan = s.unit.programme
    level = s.rng.uniform(0.35, 0.65) * (plan.load_high_mw - plan.load_low_mw) + plan.load_low_mw
    region = next(r for r in s.unit.regions if level < r.power_to_mw)
    factor = s.rng.uniform(2.0, 3.0) if s.rng.random() < 0.5 else s.rng.uniform(0.3, 0.5)
    return _text(
        'region_lag', time_s=region.time_constant_s * factor, delay_s=region.delay_s,
        level_mw=level,
    )  # fmt: skip


def _intervals(s: Setting) -> str:
    return (
        _text('intervals', g=s.sign * 0.0018 * s.size, off_low_h=12.0, off_high_h=30.0)
        + f',pattern={int(s.rng.integers(1, 10_000))}'
    )


EFFECTS: dict[str, Callable[[Setting], str]] = {
    'temperature': lambda s: _text('temperature', k=-0.00033 * s.size),
    'exponent': lambda s: _text('exponent', dm=s.sign * 0.02 * s.size),
    'choked': _choked,
    'gain_drift': lambda s: _text('gain_drift', g=s.sign * 0.0021 * s.size * 10.0 / s.days),
    'input_drift': lambda s: _text('input_drift', g=s.sign * 0.0018 * s.size * 10.0 / s.days),
    'output_offset_drift': lambda s: _text(
        'output_offset_drift', b_mw=s.sign * 0.5 * s.size * s.mw * 10.0 / s.days
    ),
    'gain_step': lambda s: _text('gain_step', g=s.sign * 0.0014 * s.size, t0_days=s.onset),
    'input_step': lambda s: _text('input_step', g=s.sign * 0.0014 * s.size, t0_days=s.onset),
    'curve_step': _curve_step,
    'intervals': _intervals,
    'diurnal': lambda s: _text('diurnal', a=0.0009 * s.size, peak_h=s.rng.uniform(0.0, 24.0)),
    'backlash': lambda s: _text('backlash', w_percent=0.09 * s.quick),
    'stiction': _stiction,
    'rate_limit': lambda s: _text('rate_limit', r_percent_per_s=0.3 / s.quick),
    'saturation': lambda s: _text('saturation', max_percent=s.rng.uniform(80.0, 85.0)),
    'region_lag': _region_lag,
    'reheater': _reheater,
    'clock': _clock,
    'curve_shape': _curve_shape,
}

PAIRS = (
    ('backlash', 'gain_drift'), ('temperature', 'gain_step'), ('diurnal', 'backlash'),
    ('exponent', 'input_step'), ('curve_shape', 'gain_drift'), ('rate_limit', 'temperature'),
)  # fmt: skip
TRIPLES = (
    ('backlash', 'gain_drift', 'temperature'), ('temperature', 'gain_step', 'diurnal'),
    ('exponent', 'backlash', 'input_step'), ('curve_shape', 'gain_drift', 'rate_limit'),
)  # fmt: skip


def _unit(rng: np.random.Generator) -> UnitDescription:
    """Draw a unit; every third is the paper's."""
    return UnitDescription() if rng.random() < 1.0 / 3.0 else random_unit(rng)


def hidden(names: tuple[str, ...], seed: int, days: float, times: tuple[float, float]) -> Case:
    """Return a plant with effects hidden in it."""
    rng = np.random.default_rng([seed, *(ord(c) for c in '+'.join(names))])
    setting = Setting(rng, _unit(rng), days, *times)
    effects = tuple(EffectSpec.parse(EFFECTS[name](setting)) for name in names)
    return Case(
        ('hidden', 'pair', 'triple')[len(names) - 1], '+'.join(names), seed, setting.unit, effects,
        names, given='region_lag' in names,
    )  # fmt: skip


CONFOUNDED = (
    'temperature, T follows p', 'exponent, T follows p', 'gain_step', 'gain_drift',
    'backlash, earlier model', 'region_lag',
)  # fmt: skip


def confounded(label: str, seed: int, days: float, times: tuple[float, float]) -> Case:
    """Return a plant whose effect is easily taken for another."""
    name = label.partition(',')[0]
    case = hidden((name,), seed, days, times)
    if label.endswith('T follows p'):
        plan = replace(case.unit.programme, temperature_pressure_correlation=0.8)
        case = replace(case, unit=replace(case.unit, programme=plan))
    given = case.given or label.endswith('earlier model')
    return replace(case, kind='confounded', label=label, given=given)


LEAST_SHARE, LARGEST_SHARE = 0.33, 0.6  # of the noise's sd: 11 to 36 % of its variance


def outside(label: str, seed: int) -> Case:
    """Return a plant with something in its record that no cause of the catalogue explains."""
    rng = np.random.default_rng([seed, len(label)])
    share = float(rng.uniform(LEAST_SHARE, LARGEST_SHARE))
    return Case('outside', label, seed, _unit(rng), (), (), outside_share=share)


def slow(label: str, seed: int) -> Case:
    """Return a plant whose power changes slowly, in a shape that no one cause has."""
    rng = np.random.default_rng([seed, len(label), 1])
    return Case('slow', label, seed, _unit(rng), (), ())


def null(seed: int) -> Case:
    """Return a plant with nothing hidden, but tempting."""
    rng = np.random.default_rng([seed, 0])
    unit = _unit(rng)
    kind = ('clean', 'no feedback', 'load noise', 'ar 600 s', 'slow 2 h', 'T follows p')[seed % 6]
    noise, plan = unit.noise, unit.programme
    scale = plan.load_high_mw / PAPER_RATED_MW
    if kind == 'no feedback':
        plan = replace(plan, feedback=False)
    elif kind == 'load noise':
        noise = replace(noise, load_dependence=float(rng.uniform(-0.4, 0.6)))
    elif kind == 'ar 600 s':
        noise = replace(noise, slow_time_s=600.0)
    elif kind == 'slow 2 h':
        noise = replace(noise, wander_mw=float(rng.uniform(0.6, 1.2)) * scale)
    elif kind == 'T follows p':
        plan = replace(plan, temperature_pressure_correlation=0.8)
    return Case('null', kind, seed, replace(unit, noise=noise, programme=plan), (), ())
