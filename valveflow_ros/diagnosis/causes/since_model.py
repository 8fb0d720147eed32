# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The change between the record of a given model and the current record.

Half-hour means of the residual of the given model are regressed on the effect of each change: the
power per flow, the scale of the input, the zero of the power, or the curve, as hat functions of
the load. Each regression includes a slow disturbance (`slow`), with a penalty per parameter. A
single change is named only if it explains as much as the curve and clearly more than the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import Estimate, FittedCause
from valveflow_ros.diagnosis.causes.changes import ramp
from valveflow_ros.diagnosis.evidence import more_or_less, sealed_gain, where_largest
from valveflow_ros.diagnosis.extended import Extended, answer, drive
from valveflow_ros.diagnosis.fitting import Task, levels_along
from valveflow_ros.diagnosis.grids import Grids
from valveflow_ros.diagnosis.result import NamedCause
from valveflow_ros.diagnosis.slow import PENALTY, Regression, half_hours, regressions
from valveflow_ros.errors import short
from valveflow_ros.records import FloatArray

CURVE = 'curve_change'
_HATS = 5
_ROUNDS = 3
_SECANT = 0.004
_TOLD = 10.0  # log-likelihood by which one change must be better than another
_BETTER = 6.0  # by which the curve must be better than one change, and one change than none
# Two curves of one healthy unit differ by about this fraction of the largest power. If the weather
# changes the power from day to day, they differ by the size of these changes. Smaller changes are
# not reported, and the interval of a larger change is at least as wide.
_LEAST_SHARE = 0.0025
_OF_DAYS = 2.0
_LEAST_DAYS = 3
# A bend of the curve between its pieces also looks a little like one of these changes. Fixed on
# seeds 22001 to 22005 of benchmarks/reference_study.py and on the plant of docs/effects.
_LEAST_Z = 3.0
_EXPLAINED = 0.5  # reduction of the mean square residual, as a fraction of that of the change
_LOW, _HIGH = 0.05, 0.95  # quantiles of the load at which a change of the curve is reported
_FULL_LOAD = 0.9
_Z95 = 1.959963984540054


def _more_power(base: RegionalModel, g: float) -> RegionalModel:
    factor = 1.0 + g
    offset = None if base.offset_mw is None else factor * base.offset_mw
    return replace(base, left=factor * base.left, right=factor * base.right, offset_mw=offset)


def _more_input(base: RegionalModel, g: float) -> RegionalModel:
    return replace(base, knots=base.knots / (1.0 + g))


def _more_offset(base: RegionalModel, b_mw: float) -> RegionalModel:
    if base.offset_mw is not None:
        return replace(base, offset_mw=base.offset_mw + b_mw)
    return replace(base, left=base.left + b_mw, right=base.right + b_mw)


@dataclass(frozen=True, slots=True)
class _Kind:
    """A change with one parameter: its effect on a model, and its description."""

    act: Callable[[RegionalModel, float], RegionalModel]
    parameter: str
    unit: str
    sentence: str
    most: float


_KINDS = {
    'gain_change': _Kind(
        _more_power, 'g', '',
        'Since the model given was found the same flow gives {change} power at every load alike',
        0.5,
    ),
    'input_change': _Kind(
        _more_input, 'g', '',
        'Since the model given was found the same reading of opening and pressure passes {change} '
        'steam',
        0.5,
    ),
    'offset_change': _Kind(
        _more_offset, 'b_mw', 'MW',
        'Since the model given was found the power is {change} at every load', math.inf,
    ),
}  # fmt: skip
_DRIFTS = {
    'gain_drift': 'gain_change', 'input_drift': 'input_change',
    'output_offset_drift': 'offset_change',
}  # fmt: skip
SINCE_MODEL = (CURVE, *_KINDS)
_BEFORE = 'it changed before this record begins'
_EXPERIMENT = (
    'An hour on the flat end of the curve and an hour at low load: a change of the input vanishes '
    'on the flat end, one of the offset is the same at both.'
)


@dataclass(frozen=True, slots=True)
class Change:
    """The change since the log of the given model.

    Attributes
    ----------
    name : str
        'gain_change', 'input_change', 'offset_change' or 'curve_change'.
    given : Extended
        The given model as it is.
    before, changed : Extended
        It without and with the change, both with the drifts found, which count from the first row.
    parameters : dict
        By name, with 95 % intervals.
    sentence, meaning : str
    near : tuple of str
        Changes with one parameter that fit nearly as well.
    """

    name: str
    given: Extended
    before: Extended
    changed: Extended
    parameters: dict[str, Estimate]
    sentence: str
    meaning: str = ''
    near: tuple[str, ...] = ()

    def cause(self, task: Task, plain: Extended) -> NamedCause:
        """Return the change as a cause, with its gain on the sealed (test) blocks.

        Parameters
        ----------
        plain : Extended
            With a newly fitted curve, which is used for a change of the curve.
        """
        # The causes found are judged after it.
        pair = (self.given, plain) if self.name == CURVE else (self.before, self.changed)
        gain = sealed_gain(task, *pair, len(_KINDS) + 1)
        experiment = _EXPERIMENT if self.near else ''
        return NamedCause(
            self.name, self.sentence, self.parameters, gain, experiment, self.near,
            meaning=self.meaning,
        )  # fmt: skip


def since_model(
    task: Task, base: RegionalModel, named: tuple[FittedCause, ...] = ()
) -> Change | str:
    """Return the change since a model was found, or a sentence that none is known.

    Parameters
    ----------
    task : Task
        Only its open blocks are used.
    base : RegionalModel
        The given model; it is not refitted.
    named : tuple of FittedCause
        Causes found in the record: only what differs besides them is a change before it.
    """
    given = Extended(_as_it_began(task.grids, base, named), named)
    here = answer(task.grids, given)
    hats = _hats(here[task.rows])
    found = half_hours(
        task, given, task.rows, [np.interp(here, hats, row) for row in np.eye(_HATS)]
    )
    if not found.enough:
        return (
            'The record is too short to tell whether the unit changed since the model was found.'
        )
    none, curve = regressions(found, [(), range(_HATS)])
    fits = {name: _one(task, given, name) for name in _KINDS}
    score = {name: fit.likelihood - PENALTY for name, (_, fit) in fits.items()}
    best = max(score, key=lambda name: score[name])
    by_hats = curve.likelihood - _HATS * PENALTY
    near = tuple(n for n in score if n != best and score[best] - score[n] < _TOLD)
    value, fit = fits[best]
    changed = _levels_as_fit(task, given, _KINDS[best].act(base, value))
    moved = answer(task.grids, changed) - here
    alone = half_hours(task, given, task.rows, [moved]).free[:, 0]
    by_curve = found.free @ curve.coefficients
    least = max(
        _LEAST_SHARE * float(np.quantile(task.grids.power[task.rows], 0.99)),
        _OF_DAYS * _spread_of_days(found.power - by_curve, found.hours),
    )
    # Its difference from the curve must exceed the usual one between two curves of one unit.
    whole = by_hats - score[best] > _BETTER and _rms(by_curve - alone) > least
    there = max(by_hats, score[best]) - none.likelihood > _BETTER
    at = here[task.rows]
    if whole or near:
        change = _curve_change(given, curve, at, hats, () if whole else (best, *near), least)
        sure = _somewhere(curve, at, hats, least)
    else:
        change = _change(best, given, changed, value, fit, at, moved[task.rows], least)
        sure = all(_is_sure(e) for e in change.parameters.values())
    if not (
        there and sure and _explains(by_curve if whole or near else alone, found.power, least)
    ):
        size = _rms(by_curve)
        why = (
            f'Two records of one healthy unit may differ by {least:.2g} MW, also by the weather.'
            if size <= least
            else 'That cannot be distinguished from a slow variation of the power.'
        )
        return (
            f'Over the loads seen the record as a whole differs from the model given by '
            f'{size:.2g} MW (root mean square). {why}'
        )
    before = Extended(given.base, tuple(a for a in named if a.name in _DRIFTS))
    after = before.base if change.name == CURVE else _KINDS[best].act(before.base, value)
    return replace(
        change, given=Extended(base), before=before, changed=_levels_as_fit(task, before, after)
    )


def _as_it_began(
    grids: Grids, base: RegionalModel, named: tuple[FittedCause, ...]
) -> RegionalModel:
    """Return the curve with which the drifts named have no effect at the first row.

    They are relative to the middle of the record: what they did until then is no change before it.
    """
    first = float(ramp(grids, np.zeros(1))[0])
    for a in named:
        if a.name in _DRIFTS:
            base = _KINDS[_DRIFTS[a.name]].act(base, -first * a.values[0])
    return base


def _is_sure(estimate: Estimate) -> bool:
    """Return True if an estimate is further from zero than its error allows by chance."""
    error = (estimate.high - estimate.low) / (2.0 * _Z95)
    return abs(estimate.value) > _LEAST_Z * error


def _spread_of_days(left: FloatArray, hours: FloatArray) -> float:
    """Return the standard deviation of daily means; 0 with fewer than three days."""
    day = (hours // 24.0).astype(int)
    count = np.bincount(day)
    full = count >= 0.5 * count.max()
    means = np.bincount(day, left)[full] / count[full]
    return float(np.std(means, ddof=1)) if len(means) >= _LEAST_DAYS else 0.0


def _rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _explains(moved: FloatArray, left: FloatArray, least: float) -> bool:
    """Return True if a change is large and reduces the residual, unlike a slow disturbance."""
    size = _rms(moved) ** 2
    less = float(np.mean(left**2) - np.mean((left - moved) ** 2))
    return size > least**2 and less > _EXPLAINED * size


def _hats(here: FloatArray) -> FloatArray:
    low, high = np.quantile(here, (0.01, 0.99)).tolist()
    return np.linspace(low, high, _HATS)


def _one(task: Task, given: Extended, name: str) -> tuple[float, Regression]:
    """Fit a change with one parameter; return its value and the last regression."""
    kind, value = _KINDS[name], 0.0
    for _ in range(_ROUNDS):
        model = replace(given, base=kind.act(given.base, value))
        found = half_hours(task, model, task.rows, [_column(task, model, name, value)])
        (fit,) = regressions(found, [(0,)])
        value = float(np.clip(value + fit.coefficients[0], -kind.most, kind.most))
    return value, fit


def _column(task: Task, model: Extended, name: str, value: float) -> FloatArray:
    """Return the derivative of the prediction by the parameter of a change, (m,)."""
    grids = task.grids
    if name == 'offset_change':
        return np.ones(len(grids.power))
    if name == 'gain_change':
        return answer(grids, model) / (1.0 + value)
    driven = drive(grids, model)
    up, down = (
        answer(grids, model, replace(driven, u=driven.u * (1.0 + step)))
        for step in (_SECANT, -_SECANT)
    )
    return (up - down) / (2.0 * _SECANT * (1.0 + value))


def _levels_as_fit(task: Task, given: Extended, changed: RegionalModel) -> Extended:
    """Return the changed model with levels at the same MW or the same u as before."""
    bases = (changed, levels_along(given.base, changed, _scale(task)))
    return min((replace(given, base=base) for base in bases), key=task.cost)


def _scale(task: Task) -> float:
    grids = task.grids
    return float(np.mean(grids.scale[grids.usable > 0]))


def _change(
    name: str, given: Extended, changed: Extended, value: float, fit: Regression,
    here: FloatArray, moved: FloatArray, least: float,
) -> Change:  # fmt: skip
    kind = _KINDS[name]
    alike = least * abs(value) / float(np.sqrt(np.mean(moved**2)))
    error = math.hypot(_Z95 * math.sqrt(fit.covariance[0, 0]), alike)
    low, high = value - error, value + error
    sign = 'more' if value > 0.0 else 'less'
    unit, factor = ('MW', 1.0) if kind.unit else ('%', 100.0)
    size, *ends = (f'{factor * abs(x):.3g}' for x in (value, *sorted((low, high), key=abs)))
    said = kind.sentence.format(change=f'{size} {unit} {sign}')
    sentence = f'{said} (95 % interval {ends[0]} to {ends[1]} {unit}); {_BEFORE}.'
    full = float(np.quantile(here, _FULL_LOAD))
    by = float(np.mean(moved[here >= full]))
    meaning = f'At full load (from {full:.0f} MW on) this makes {more_or_less(by)}'
    meaning += where_largest(here, by, lambda rows: float(np.mean(moved[rows]))) + '.'
    return Change(
        name, given, given, changed, {kind.parameter: Estimate(value, low, high, kind.unit)},
        sentence, meaning,
    )  # fmt: skip


def _curve_change(
    given: Extended, fit: Regression, here: FloatArray, hats: FloatArray, near: tuple[str, ...],
    least: float,
) -> Change:  # fmt: skip
    parameters, told = {}, []
    for name, share in (('low_load_mw', _LOW), ('high_load_mw', _HIGH)):
        load = float(np.quantile(here, share))
        value, error = _at_load(fit, load, hats, least)
        parameters[name] = Estimate(value, value - error, value + error, 'MW')
        told.append(
            f'by {value:+.2g} MW or {100.0 * value / load:+.2g} % (95 % interval '
            f'{value - error:+.2g} to {value + error:+.2g} MW) at {short(load)} MW'
        )
    sentence = (
        f'Since the model given was found the power at the same opening and pressure has changed, '
        f'{" and ".join(told)}; {_BEFORE}.'
    )
    return Change(CURVE, given, given, given, parameters, sentence, near=near)


def _at_load(fit: Regression, load: float, hats: FloatArray, least: float) -> tuple[float, float]:
    """Return the change of the curve at a load, and half of its 95 % interval."""
    row = np.array([np.interp(load, hats, one) for one in np.eye(_HATS)])
    error = math.hypot(_Z95 * math.sqrt(float(row @ fit.covariance @ row)), least)
    return float(row @ fit.coefficients), error


def _somewhere(fit: Regression, here: FloatArray, hats: FloatArray, least: float) -> bool:
    """Return True if the change of the curve is larger than its error at some load."""
    loads = np.quantile(here, np.linspace(_LOW, _HIGH, 2 * _HATS - 1)).tolist()
    return any(abs(mw) > error for mw, error in (_at_load(fit, x, hats, least) for x in loads))
