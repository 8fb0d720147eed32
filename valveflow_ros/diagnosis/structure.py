# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test for remaining structure in the residual, and the variables on which it depends.

Minute means are sorted into cells by one, two or three variables at a time. The mean of each
cell, estimated on some blocks, is tested on other blocks. The variables do not include functions
of the measured power, because they would share its noise. Power control also feeds past noise
into the opening; therefore innovations are used, which are independent of the past.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.diagnosis.grids import FOLDS, SEALED_FOLD
from valveflow_ros.diagnosis.screening import Screening
from valveflow_ros.diagnosis.slow import Levels, Regression, half_hours, regressions
from valveflow_ros.fit.whitening import inflation
from valveflow_ros.records import BoolArray, FloatArray

# Fixed on `benchmarks.diagnosis_study`: healthy plants 61000 to 61047, where the largest gain was
# 6.2, and effects of 0.15 and 0.25 of the noise, 55362, 55363, 61100, 61101 and 61200 to 61202.
LEAST_GAIN, LEAST_SIGN, LEAST_MW2 = 12.0, 2.0, 0.02
_MINUTE_S = 60.0
_FINE, _MEDIUM, _COARSE, _TRIPLE, _RIPPLE = 24, 8, 4, 4, 48
_SHRINK = (4.0, 30.0)
_LAGS = 60
_ENOUGH = 0.75
_RESPONSE = 500  # means, of the noise model's answer to one innovation
_SLOW = (
    'load of the last hour', 'load of the last four hours', 'load of hours before',
    'travel of the last hour', 'pressure given u',
)  # fmt: skip
_SLOW_HATS = 5
# Log-likelihood by which a cause in time must exceed a dependence on the load of hours: seven true
# daily cycles of `benchmarks.diagnosis_study` (55320 to 62400) did by 15 to 55. The effect of the
# load of hours before, seed 62600, was named a daily cycle that did by 2.
_LEAD = 5.0
_IN_TRIPLES = ('u', 'pressure given u', 'temperature', 'ramp', 'opening')


@dataclass(frozen=True, slots=True)
class Structure:
    """The result of the cell test.

    Attributes
    ----------
    variables : tuple of str
    gain : float
        Gain in log-likelihood on held-out blocks, corrected for the correlation of the noise.
    sign : float
        t value of the gains of blocks: mean divided by standard error.
    explained_mw2 : float
        Variance explained on held-out blocks.
    """

    variables: tuple[str, ...]
    gain: float
    sign: float
    explained_mw2: float

    @property
    def there(self) -> bool:
        """Return True if the structure is significant."""
        return self.gain > LEAST_GAIN and self.sign > LEAST_SIGN and self.explained_mw2 > LEAST_MW2


def minutes(task: Task, series: FloatArray) -> tuple[FloatArray, BoolArray, np.ndarray, int]:
    """Return minute means, which of them are complete, their block, scored means per minute."""
    grids = task.grids
    rows = max(1, round(_MINUTE_S / grids.mean_s))
    m = len(series) // rows
    mean: FloatArray = series[: m * rows].reshape(m, rows).mean(axis=1)
    good: BoolArray = np.asarray(task.rows[: m * rows].reshape(m, rows).all(axis=1), dtype=bool)
    block = grids.block_of_sub[grids.sub[: m * rows : rows]]
    return mean, good, block, rows


def variables(task: Task, model: Extended) -> dict[str, FloatArray]:
    """Return the variables on which the residual might depend, one value per minute."""
    grids = task.grids

    def minute(rows: FloatArray) -> FloatArray:
        return minutes(task, grids.means(rows))[0]

    u, p, t = minute(grids.u), minute(grids.pressure), minute(grids.temperature)
    time_s = minute(grids.time_s)
    opening = grids.coarse(np.where(np.isfinite(grids.v), grids.v, 0.0))
    v = minute(opening)
    shape = np.polyfit(u, p, 3)
    busy = minute(np.abs(np.diff(opening, prepend=opening[:1])))

    def since(x: FloatArray, back: int) -> FloatArray:
        return np.asarray(x - np.concatenate([np.full(min(back, len(x)), x[0]), x[:-back]]))

    def past(x: FloatArray, length: int) -> FloatArray:
        total = np.cumsum(np.concatenate([[0.0], x]))
        at = np.arange(len(x))
        first = np.maximum(at - length, 0)
        return np.asarray((total[at] - total[first]) / np.maximum(at - first, 1))

    return {
        'u': u, 'opening': v, 'pressure': p,
        'pressure given u': p - np.polyval(shape, u), 'temperature': t,
        'time': time_s, 'time of day': grids.clock_s(time_s), 'ramp': since(u, 3),
        'slow ramp': since(u, 15), 'pressure change': since(p, 10),
        'temperature change': since(t, 20), 'valve travel': busy,
        'load of the last hour': past(u, 60),
        'load of the last four hours': past(u, 240),
        'load of hours before': past(np.concatenate([np.full(60, u[0]), u[:-60]]), 120),
        'travel of the last hour': past(np.minimum(busy, np.quantile(busy, 0.999)), 60),
    }  # fmt: skip


def _cells(values: FloatArray, good: BoolArray, count: int) -> np.ndarray:
    edges = np.quantile(values[good], np.linspace(0.0, 1.0, count + 1)[1:-1])
    return np.searchsorted(edges, values, side='right')


def _tables(
    values: dict[str, FloatArray], good: BoolArray
) -> list[tuple[tuple[str, ...], np.ndarray]]:
    """Return (variables, cell of every minute) for every table to be tested."""
    medium = {n: _cells(v, good, _MEDIUM) for n, v in values.items()}
    coarse = {n: _cells(v, good, _TRIPLE) for n, v in values.items()}
    tables: list[tuple[tuple[str, ...], np.ndarray]] = [
        ((n,), _cells(v, good, _FINE)) for n, v in values.items()
    ]
    for a, b in itertools.combinations(values, 2):
        tables.append(((a, b), medium[a] * _MEDIUM + medium[b]))
    for a, b, c in itertools.combinations([n for n in _IN_TRIPLES if n in values], 3):
        tables.append(((a, b, c), (coarse[a] * _TRIPLE + coarse[b]) * _TRIPLE + coarse[c]))
    for name in [n for n in ('u', 'opening', 'pressure') if n in values]:
        ripple = _cells(values[name], good, _RIPPLE)
        tables.append(((name,), ripple))
        for other in [n for n in ('pressure given u', 'temperature', 'ramp') if n in values]:
            tables.append(((name, other), ripple * _COARSE + coarse[other]))
    if 'u' in values and 'pressure given u' in values:
        ripple = _cells(values['u'], good, 2 * _RIPPLE)
        side = _cells(values['pressure given u'], good, 2)
        tables.append((('u', 'pressure given u'), ripple * 2 + side))
    return tables


def _held_out(cell: np.ndarray, rest: FloatArray, fold: np.ndarray, shrink: float) -> FloatArray:
    """Return the gain in squared MW of every row, with cell means from the other folds."""
    count = int(cell.max()) + 1
    gain = np.zeros(len(rest))
    sums = np.array([np.bincount(cell[fold == f], rest[fold == f], count) for f in range(FOLDS)])
    rows = np.array([np.bincount(cell[fold == f], minlength=count) for f in range(FOLDS)])
    for f in range(FOLDS):
        here = fold == f
        mean = (sums.sum(axis=0) - sums[f]) / (rows.sum(axis=0) - rows[f] + shrink)
        level = mean[cell[here]]
        gain[here] = 2.0 * level * rest[here] - level**2
    return gain


def structure(task: Task, model: Extended, wandering: FloatArray | None = None) -> Structure:
    """Search for structure in the residual of a model, by cells and then over hours.

    Parameters
    ----------
    wandering : float64 (m,), optional
        A slow disturbance in MW, which is subtracted first. If no structure remains, the whole
        residual is tested again, without the time and the time of day as variables.
    """
    everything = task.residual(model)
    values = variables(task, model)
    slow = {name: values[name] for name in _SLOW}
    if wandering is not None:
        values.pop('time')
    left = _tabulated(task, everything - (0.0 if wandering is None else wandering), values)
    if left.there:
        return left
    if wandering is not None:
        values.pop('time of day')
        whole = _tabulated(task, everything, values)
        if whole.there:
            return whole
    over_hours = _over_hours(task, model, slow)
    return over_hours if over_hours is not None and over_hours.there else left


def _over_hours(task: Task, model: Extended, values: dict[str, FloatArray]) -> Structure | None:
    """Search for a dependence on what changes over hours; None if there is none.

    Whitening leaves little of such an effect. So half-hour means of the residual are regressed on
    piecewise-linear functions of one variable at a time, beside a wander of free variance and
    time scale. Every two coefficients must gain the logarithm of the number of means in
    log-likelihood (Schwarz, Ann. Stat. 6, 1978).
    """
    columns = _slow_columns(task, values)
    found, places, fits = _regressed(task, model, columns)
    if not fits:
        return None
    none, *fits = fits
    k = max(range(len(fits)), key=lambda k: fits[k].likelihood)
    gain = fits[k].likelihood - none.likelihood
    if gain <= 0.5 * _SLOW_HATS * float(np.log(len(found.power))):
        return None
    hats = found.free[:, places[k]]
    noise = np.einsum('ki,ij,kj->k', hats, fits[k].covariance, hats)
    explained = float(np.var(hats @ fits[k].coefficients) - noise.mean())
    return Structure((list(columns)[k],), gain, float('inf'), explained)


def likelier_over_hours(task: Task, model: Extended, effect: FloatArray, size: int) -> str:
    """Return what changes over hours and explains the power nearly as well as a cause in time.

    Or '', if nothing does.

    A unit that runs by a daily programme repeats each day all that its load does to it, and a
    change of the programme imitates a step or a drift. The comparison is that of `structure` over
    hours.

    Parameters
    ----------
    task : Task
    model : Extended
        The model without the cause, fitted again.
    effect : float64 (m,)
        What the cause adds to the power of this model, MW.
    size : int
        Number of its parameters.
    """
    values = variables(task, model)
    columns = {'': [effect]} | _slow_columns(task, {name: values[name] for name in _SLOW})
    found, places, fits = _regressed(task, model, columns)
    if not fits:
        return ''
    numbers = (size, *map(len, places[1:]))
    scores = [
        fit.likelihood - fits[0].likelihood - 0.5 * number * float(np.log(len(found.power)))
        for fit, number in zip(fits[1:], numbers, strict=True)
    ]
    scores[0] -= _LEAD
    best = int(np.argmax(scores))
    return list(columns)[best] if scores[best] > 0.0 else ''


def _slow_columns(task: Task, values: dict[str, FloatArray]) -> dict[str, list[FloatArray]]:
    """Return piecewise-linear basis functions (m,) of each variable, given by the minute."""
    rows, each = task.rows, max(1, round(_MINUTE_S / task.grids.mean_s))
    columns = {}
    for name, minute in values.items():
        x = np.repeat(minute, each)
        x = np.append(x, np.full(len(rows) - len(x), x[-1]))
        knots = np.quantile(x[rows], np.linspace(0.02, 0.98, _SLOW_HATS))
        if np.all(np.diff(knots) > 0.0):
            columns[name] = [np.interp(x, knots, hat) for hat in np.eye(_SLOW_HATS)]
    return columns


def _regressed(
    task: Task, model: Extended, columns: dict[str, list[FloatArray]]
) -> tuple[Levels, list[range], list[Regression]]:
    """Regress half-hour means on nothing and on each group of columns; none if there are few."""
    found = half_hours(task, model, task.rows, [c for group in columns.values() for c in group])
    if not columns or not found.enough:
        return found, [], []
    ends = list(itertools.accumulate(len(group) for group in columns.values()))
    places = [range(a, b) for a, b in itertools.pairwise([0, *ends])]
    return found, places, regressions(found, [(), *places])


def _tabulated(task: Task, series: FloatArray, values: dict[str, FloatArray]) -> Structure:
    """Return the table with the largest gain, or a nearly equal one with fewer variables."""
    white = np.zeros(len(series))
    white[task.rows] = task.innovations(series)
    rest, good, block, rows = minutes(task, white)
    values = {n: v for n, v in values.items() if np.std(v[good]) > 1e-9}
    good &= block % FOLDS != SEALED_FOLD
    wide = inflation(rest, good.astype(np.uint8), _LAGS)
    noise = float(np.var(rest[good])) * wide
    fold, at = block[good] % FOLDS, block[good]
    tried: list[tuple[Structure, np.ndarray]] = []
    for names, cell in _tables(values, good):
        for shrink in _SHRINK:
            gain = _held_out(cell[good], rest[good], fold, shrink * wide)
            by_block = np.bincount(at, gain)[np.bincount(at) > 0]
            spread = float(by_block.std(ddof=1)) * np.sqrt(len(by_block))
            sign = float(by_block.sum() / spread) if spread > 0.0 else 0.0
            found = Structure(names, float(gain.sum()) / (2.0 * noise), sign, float(gain.mean()))
            tried.append((found, cell))
    best = max(tried, key=lambda each: each[0].gain)
    if best[0].gain > 0.0:
        # The fewest variables that do nearly as well.
        good_ones = [each for each in tried if each[0].gain >= _ENOUGH * best[0].gain]
        fewest = min(len(s.variables) for s, _ in good_ones)
        best = max(
            (e for e in good_ones if len(e[0].variables) == fewest), key=lambda e: e[0].gain
        )
    found, cell = best
    count = np.bincount(cell[good], minlength=int(cell.max()) + 1)
    level = np.bincount(cell[good], rest[good], len(count)) / np.maximum(count, 1)
    lost = _whitening_loss(level[cell], good, rows, task.ar)
    return replace(found, explained_mw2=found.explained_mw2 * lost)


def _whitening_loss(effect: FloatArray, good: BoolArray, rows: int, ar: FloatArray) -> float:
    """Return the variance of an effect over that of its innovations, from the innovations.

    Whitening keeps the size of an effect that comes and goes within the correlation time of the
    noise, and reduces one that lasts.
    """
    response = np.zeros(_RESPONSE)
    response[0] = 1.0
    for t in range(1, _RESPONSE):
        back = response[max(t - len(ar), 0) : t][::-1]
        response[t] = float(ar[: len(back)] @ back)
    effect, m = effect - float(effect[good].mean()), len(effect)
    whole = np.convolve(np.repeat(effect, rows), response)[: m * rows]
    whole = whole.reshape(m, rows).mean(axis=1)
    small = float(np.var(effect[good]))
    return float(np.var(whole[good])) / small if small > 0.0 else 1.0


# A hidden period: one line of the residual spectrum far above its neighbours.

LARGEST_P = 1e-5
_MEAN_S = 60.0
_NEIGHBOURS = 101
_SHORTEST_S, _LONGEST_S = 240.0, 5.5 * 3600.0


@dataclass(frozen=True, slots=True)
class Period:
    """The strongest line: its period in s, its p-value, its variance in MW^2."""

    period_s: float
    p_value: float
    variance_mw2: float

    @property
    def there(self) -> bool:
        """Return True if the line is significant."""
        return self.p_value < LARGEST_P

    @property
    def words(self) -> str:
        """Return the period as the name of a variable."""
        return f'time, with a period of {self.period_s / 60.0:.3g} min'


def period(task: Task, model: Extended) -> Period:
    """Test the largest ordinate of the periodogram (Fisher's test, on a local noise floor).

    Each ordinate is divided by the median of its neighbours, which flattens the spectrum of
    smooth noise. The ordinates are then exponentially distributed, and the largest of n exceeds
    z by chance with probability n exp(-z).
    """
    grids = task.grids
    rows = max(1, round(_MEAN_S / grids.mean_s))
    m = len(grids.power) // rows
    rest = np.where(grids.scored, task.residual(model), 0.0)[: m * rows]
    rest = rest.reshape(m, rows).mean(axis=1)
    rest = rest - rest.mean()
    power = np.abs(np.fft.rfft(rest * np.hanning(m))) ** 2
    width = min(_NEIGHBOURS, max(5, len(power) // 8 * 2 + 1))
    floor = median_filter(power, width, mode='nearest') / np.log(2.0)
    ratio = power / np.maximum(floor, 1e-300)
    span = m * rows * grids.mean_s
    ratio[: int(span / _LONGEST_S) + 1] = 0.0
    ratio[int(span / _SHORTEST_S) :] = 0.0
    k = int(np.argmax(ratio))
    # The window correlates neighbouring ordinates; dividing by 1.3 allows for this.
    chance = min(1.0, len(power) * float(np.exp(-min(ratio[k] / 1.3, 700.0))))
    near = slice(max(k - 2, 0), k + 3)
    share = float(np.maximum(power[near] - floor[near], 0.0).sum())
    variance = 2.0 * share / (m * float((np.hanning(m) ** 2).sum()))
    return Period(span / max(k, 1), chance, variance)


# A slow disturbance of the power that is not a cause: coal, vacuum, ambient conditions.

LEAST_WANDER_GAIN = 16.0
_WIDTHS_H = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
_WANDER_SHRINK = (0.3, 1.0, 3.0)


@dataclass(frozen=True, slots=True)
class Wander:
    """The slow disturbance ("wander") of the power level.

    Attributes
    ----------
    gain : float
        Gain in log-likelihood on sub-blocks whose level was estimated from others.
    rms_mw, time_scale_s : float
    level : float64 (subs,)
        The relative level of each sub-block.
    """

    gain: float
    rms_mw: float
    time_scale_s: float
    level: FloatArray

    @property
    def there(self) -> bool:
        """Return True if the disturbance is significant."""
        return self.gain > LEAST_WANDER_GAIN


def wander(screening: Screening) -> Wander:
    """Estimate the level of each sub-block from its neighbours, and the gain.

    Kernels of several widths are tried. Each sub-block is predicted without its own data, so that
    the noise inside it gives no gain.
    """
    own, toward = screening.gain_by_sub
    middle_h = screening.grids.sub_middle_s / 3600.0
    distance = np.abs(middle_h[:, None] - middle_h[None, :])
    np.fill_diagonal(distance, np.inf)
    usual = float(np.median(own[own > 0.0])) if np.any(own > 0.0) else 1.0
    best = Wander(0.0, 0.0, 0.0, np.zeros(len(own)))
    for width in _WIDTHS_H:
        weight = np.exp(-0.5 * (distance / width) ** 2)
        for shrink in _WANDER_SHRINK:
            level = (weight @ toward) / (weight @ own + shrink * usual)
            gain = float(np.sum(2.0 * level * toward - level**2 * own)) / (
                2.0 * screening.variance
            )
            if gain > best.gain:
                power = float(np.mean(screening.here[screening.grids.scored]))
                rms = float(np.sqrt(np.mean(level[own > 0.0] ** 2))) * power
                best = Wander(gain, rms, width * 3600.0, level)
    return best
