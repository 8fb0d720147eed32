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
    effects: tuple[EffectSpec, ...] = ()
    given: bool = False
    outside_share: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Return what is to be named."""
        return tuple(e.name for e in self.effects)


@dataclass(frozen=True)
class Setting:
    """What an amplitude depends on; each look at a drawn property draws anew."""

    rng: np.random.Generator
    unit: UnitDescription
    days: float
    low: float = 2.0
    high: float = 4.0

    def _times(self, here: float, paper: float) -> float:
        """Draw a multiple of what is detectable, from this unit's noise and the paper's."""
        relative = here / paper * PAPER_RATED_MW / self.unit.programme.load_high_mw
        drawn = float(np.exp(self.rng.uniform(np.log(self.low), np.log(self.high))))
        return drawn * relative * float(np.sqrt(10.0 / self.days))

    @property
    def size(self) -> float:
        """Draw a multiple of what is detectable in ten days of the paper's unit, what lasts.

        It is hidden by the spectrum of the noise at low frequencies.
        """
        n, p = self.unit.noise, UnitDescription().noise
        here, paper = (float(x.slow_mw * np.sqrt(x.slow_time_s)) for x in (n, p))
        return self._times(here, paper)

    @property
    def quick(self) -> float:
        """Draw a multiple of what is detectable in ten days of the paper's unit, what is fast."""
        n = self.unit.noise
        return self._times(float(np.hypot(n.slow_mw, n.white_mw)), PAPER_NOISE_MW)

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


Values = dict[str, float]


def _choked(s: Setting) -> Values:
    plan = s.unit.programme
    pressure = float(plan.sliding_pressure_mpa(np.array([plan.load_high_mw]))[0])
    return {'kappa': s.rng.uniform(0.64, 0.72) * pressure / plan.load_high_mw}


def _curve_step(s: Setting) -> Values:
    first = s.rng.uniform(0.1, 0.5)
    return {
        's_mw': s.sign * 0.65 * s.size * s.mw, 'u_from': s.u(first),
        'u_to': s.u(first + s.rng.uniform(0.15, 0.3)), 't0_days': s.onset,
    }  # fmt: skip


def _curve_shape(s: Setting) -> Values:
    # In the middle of the longest piece: on a knee, the knee would take part of it.
    knots = s.unit.curve.knots
    k = int(np.argmax(np.diff(knots[: max(3, len(knots) - 1)])))
    width = s.rng.uniform(0.3, 0.5) * (knots[k + 1] - knots[k])
    height = s.sign * 0.6 * s.size * s.mw
    return {'h_mw': height, 'u0': 0.5 * (knots[k] + knots[k + 1]), 'width_u': width}


def _stiction(s: Setting) -> Values:
    band = s.quick  # 1 % is told from a mere slack
    return {'s_percent': band, 'j_percent': 0.7 * band}


def _reheater(s: Setting) -> Values:
    # What shows is the power that comes late, (1 - alpha) T.
    alpha = s.rng.uniform(0.25, 0.4)
    return {'alpha': alpha, 'time_s': 14.0 * s.quick / (1.0 - alpha)}


def _region_lag(s: Setting) -> Values:
    plan = s.unit.programme
    level = s.rng.uniform(0.35, 0.65) * (plan.load_high_mw - plan.load_low_mw) + plan.load_low_mw
    region = next(r for r in s.unit.regions if level < r.power_to_mw)
    factor = s.rng.uniform(2.0, 3.0) if s.rng.random() < 0.5 else s.rng.uniform(0.3, 0.5)
    return {
        'time_s': region.time_constant_s * factor, 'delay_s': region.delay_s, 'level_mw': level,
    }  # fmt: skip


def _intervals(s: Setting) -> Values:
    size = s.sign * 0.0018 * s.size
    return {
        'g': size, 'off_low_h': 12.0, 'off_high_h': 30.0, 'pattern': int(s.rng.integers(1, 10_000))
    }  # fmt: skip


EFFECTS: dict[str, Callable[[Setting], Values]] = {
    'temperature': lambda s: {'k': -0.00033 * s.size},
    'exponent': lambda s: {'dm': s.sign * 0.02 * s.size},
    'choked': _choked,
    'gain_drift': lambda s: {'g': s.sign * 0.0021 * s.size * 10.0 / s.days},
    'input_drift': lambda s: {'g': s.sign * 0.0018 * s.size * 10.0 / s.days},
    'output_offset_drift': lambda s: {'b_mw': s.sign * 0.5 * s.size * s.mw * 10.0 / s.days},
    'gain_step': lambda s: {'g': s.sign * 0.0014 * s.size, 't0_days': s.onset},
    'input_step': lambda s: {'g': s.sign * 0.0014 * s.size, 't0_days': s.onset},
    'curve_step': _curve_step,
    'intervals': _intervals,
    'diurnal': lambda s: {'a': 0.0009 * s.size, 'peak_h': s.rng.uniform(0.0, 24.0)},
    'backlash': lambda s: {'w_percent': 0.09 * s.quick},
    'stiction': _stiction,
    'rate_limit': lambda s: {'r_percent_per_s': 0.3 / s.quick},
    'saturation': lambda s: {'max_percent': s.rng.uniform(80.0, 85.0)},
    'region_lag': _region_lag,
    'reheater': _reheater,
    'clock': lambda s: {'d_s': min(r.delay_s for r in s.unit.regions) + 10.0 * s.quick},
    'curve_shape': _curve_shape,
}


def drawn(name: str, setting: Setting) -> EffectSpec:
    """Draw the size of an effect, and what else is to be known of it."""
    values = EFFECTS[name](setting)
    return EffectSpec.parse(f'{name}:' + ','.join(f'{k}={v:.6g}' for k, v in values.items()))


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


_AGAINST_A_MODEL = frozenset(('region_lag', 'curve_shape'))


def hidden(names: tuple[str, ...], seed: int, days: float, times: tuple[float, float]) -> Case:
    """Return a plant with effects hidden in it."""
    label = '+'.join(names)
    rng = np.random.default_rng([seed, *map(ord, label)])
    setting = Setting(rng, _unit(rng), days, *times)
    effects = tuple(drawn(name, setting) for name in names)
    kind = ('hidden', 'pair', 'triple')[len(names) - 1]
    # The program judges neither without an earlier model.
    given = not _AGAINST_A_MODEL.isdisjoint(names)
    return Case(kind, label, seed, setting.unit, effects, given)


CONFOUNDED = (
    'temperature, T follows p', 'exponent, T follows p', 'gain_step', 'gain_drift',
    'backlash, earlier model', 'region_lag',
)  # fmt: skip


def _t_follows_p(unit: UnitDescription) -> UnitDescription:
    return replace(unit, programme=replace(unit.programme, temperature_pressure_correlation=0.8))


def confounded(label: str, seed: int, days: float, times: tuple[float, float]) -> Case:
    """Return a plant whose effect is easily taken for another."""
    case = hidden((label.partition(',')[0],), seed, days, times)
    unit = _t_follows_p(case.unit) if label.endswith('T follows p') else case.unit
    given = case.given or label.endswith('earlier model')
    return replace(case, kind='confounded', label=label, unit=unit, given=given)


SHARES = (0.33, 0.6)  # of the noise's sd: 11 to 36 % of its variance


def outside(label: str, seed: int, shares: tuple[float, float] = SHARES) -> Case:
    """Return a plant with something in its record that no cause of the catalogue explains.

    Its standard deviation is a share of that of the noise, drawn between two limits.
    """
    rng = np.random.default_rng([seed, len(label)])
    share = float(rng.uniform(*shares))
    return Case('outside', label, seed, _unit(rng), outside_share=share)


def slow(label: str, seed: int) -> Case:
    """Return a plant whose power changes slowly, in a shape that no one cause has."""
    return Case('slow', label, seed, _unit(np.random.default_rng([seed, len(label), 1])))


def null(seed: int) -> Case:
    """Return a plant with nothing hidden, but tempting."""
    rng = np.random.default_rng([seed, 0])
    unit = _unit(rng)
    kind = ('clean', 'no feedback', 'load noise', 'ar 600 s', 'slow 2 h', 'T follows p')[seed % 6]
    noise, plan = unit.noise, unit.programme
    if kind == 'no feedback':
        unit = replace(unit, programme=replace(plan, feedback=False))
    elif kind == 'load noise':
        drawn_share = float(rng.uniform(-0.4, 0.6))
        unit = replace(unit, noise=replace(noise, load_dependence=drawn_share))
    elif kind == 'ar 600 s':
        unit = replace(unit, noise=replace(noise, slow_time_s=600.0))
    elif kind == 'slow 2 h':
        wander_mw = float(rng.uniform(0.6, 1.2)) * (plan.load_high_mw / PAPER_RATED_MW)
        unit = replace(unit, noise=replace(noise, wander_mw=wander_mw))
    elif kind == 'T follows p':
        unit = _t_follows_p(unit)
    return Case('null', kind, seed, unit)
