# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The slow part of the residual: a drift of the power over hours and days.

The residual is averaged over sub-blocks of half an hour and modelled as the sum of three parts:
what the curve could still explain (hat functions of the load with free coefficients), a slow
disturbance of the plant's gain ("wander"), and noise. The wander is a stationary first-order
process (Ornstein-Uhlenbeck) of unknown variance and time scale:

    r_i = z_i a + P_i w_i + e_i,   cov(w_i, w_j) = s^2 exp(-|t_i - t_j| / T)

with P_i the mean load relative to that of the record. Variance and time scale are found on a grid
by maximum likelihood; the size of the wander by restricted maximum likelihood. The coefficients
and the variance of the noise have closed solutions.

Other changes of the power in time have a shape: steps, a drift that begins late, an exponential.
Shapes are added to the mean of the same process and compared by the likelihood with a penalty per
parameter. A step takes place at once or within four hours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.extended import Extended, answer
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.diagnosis.grids import Grids
from valveflow_ros.records import BoolArray, FloatArray, IntArray

_TIME_SCALES_H = (0.5, 1.0, 3.0, 8.0, 24.0, 72.0, 240.0)
_RATIOS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0, 10_000.0)
_HATS = 9
_SMALLEST = 1e-3
_HALF = 0.5  # fraction of the usual number of means that a sub-block must have
_MOST_ROWS = 500  # longer records are averaged over several sub-blocks
_LEAST_ROWS = 40
_SLOWEST_OF_NOISE_H = 2.0
_LEAST_DRIFT_GAIN = 16.0
LEAST_DRIFT_MW = 0.05


@dataclass(frozen=True, slots=True)
class Levels:
    """Half-hour means of the residual of a model.

    Attributes
    ----------
    hours : float64 (k,)
        Middle of each, hours since the first row.
    power : float64 (k,)
        MW.
    load : float64 (k,)
        Mean load relative to that of the record.
    free : float64 (k, p)
        What curve and pressure could explain, as an orthonormal basis.
    noise : float64 (k,)
        Relative variance of each mean.
    """

    hours: FloatArray
    power: FloatArray
    load: FloatArray
    free: FloatArray
    noise: FloatArray

    @property
    def enough(self) -> bool:
        """Return True if there are enough means to separate a wander from the curve."""
        rows, columns = self.free.shape
        return bool(rows - columns >= _LEAST_ROWS)


def levels(
    task: Task, model: Extended, rows: BoolArray, careful: bool
) -> tuple[Levels, FloatArray]:
    """Return means over groups of sub-blocks, and those of the covariates, (k, covariates).

    Parameters
    ----------
    careful : bool
        Free functions of the input and of the pressure are used too, not only of the load. Under
        load control and sliding pressure they absorb much of a drift: the pressure follows the
        load set point, the opening what was needed to reach it.
    """
    grids = task.grids
    here = answer(grids, model)
    inputs = [here]
    if careful:
        inputs += [grids.means(grids.u), grids.means(grids.pressure)]
    free = [hat for x in inputs for hat in _hats(x, rows)]
    usual = float(np.mean(here[rows]))
    beside = [deviation(grids, name) * here / usual for name in grids.covariates]
    found = half_hours(task, model, rows, [*free, *beside])
    columns = found.free[:, len(free) :]
    return replace(found, free=_basis(found.free[:, : len(free)])), columns


def half_hours(
    task: Task, model: Extended, rows: BoolArray, columns: Sequence[FloatArray]
) -> Levels:
    """Return means over groups of sub-blocks; ``free`` holds those of the given columns (m,)."""
    grids = task.grids
    sub = grids.sub // max(1, -(-grids.subs // _MOST_ROWS))
    here = answer(grids, model)
    count = np.bincount(sub[rows], minlength=int(sub[-1]) + 1)
    kept = np.flatnonzero(count >= max(1.0, _HALF * float(np.median(count[count > 0]))))

    def mean(x: np.ndarray) -> FloatArray:
        total = np.bincount(sub[rows], x[rows], minlength=len(count))
        return np.asarray(total[kept] / count[kept])

    time_h = (np.arange(len(here)) + 0.5) * grids.mean_s / 3600.0
    free = np.array([mean(column) for column in columns]).T.reshape(len(kept), len(columns))
    return Levels(
        mean(time_h), mean(task.residual(model)), mean(here) / float(np.mean(here[rows])),
        free, float(count[kept].mean()) / count[kept],
    )  # fmt: skip


def deviation(grids: Grids, name: str) -> FloatArray:
    """Return covariate minus its usual value at the load, (m,), in its unit."""
    about, here = grids.covariates[name]
    return grids.means(about.terms(grids.u, grids.pressure, here)[0])


def _hats(x: FloatArray, rows: BoolArray) -> Iterator[FloatArray]:
    low, high = np.quantile(x[rows], (0.01, 0.99))
    knots = np.linspace(float(low), float(high) + 1e-9 * (1.0 + abs(float(high))), _HATS)
    return (np.interp(x, knots, row) for row in np.eye(_HATS))


def _basis(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis: the columns are dependent, as hat functions sum to one."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, sizes > _SMALLEST * sizes[0]])


@dataclass(frozen=True, slots=True)
class _Fit:
    """A wander: log-likelihoods, time scale in h, variance relative to that of the noise."""

    likelihood: float
    restricted: float
    hours: float
    ratio: float


def _covariance(found: Levels, hours: float) -> FloatArray:
    apart = np.abs(found.hours[:, None] - found.hours[None, :])
    return np.asarray(np.exp(-apart / hours) * np.outer(found.load, found.load))


def _fits(found: Levels, column: FloatArray | None = None) -> Iterator[tuple[_Fit, float]]:
    """Yield every wander of the grid, and the log-likelihood gain of an additional column."""
    k, p = found.free.shape
    flat = found.power, *(found.free.T), *(() if column is None else (column,))
    table = np.column_stack(flat)
    for white, level, hours, ratio in _wanders(found, table):
        basis, size = np.linalg.qr(white[:, 1 : 1 + p])
        left = white - basis @ (basis.T @ white)
        rest = left[:, 0]
        cost = float(rest @ rest)
        fit = _Fit(
            -level - 0.5 * k * float(np.log(cost / k)),
            -level - 0.5 * (k - p) * float(np.log(cost / (k - p)))
            - float(np.log(np.abs(np.diag(size))).sum()),
            hours, ratio,
        )  # fmt: skip
        more = 0.0
        if column is not None:
            own, toward = float(left[:, -1] @ left[:, -1]), float(left[:, -1] @ rest)
            explained = toward * toward / own if own > 0.0 else 0.0
            more = -0.5 * k * float(np.log(max(1.0 - explained / cost, 1e-300)))
        yield fit, more


def _wanders(
    found: Levels, table: FloatArray, most_h: float = math.inf
) -> Iterator[tuple[FloatArray, float, float, float]]:
    """Yield whitened columns, half the log determinant, time scale and ratio of every wander."""
    for hours in (h for h in _TIME_SCALES_H if h <= most_h):
        for ratio in (0.0, *_RATIOS) if hours == _TIME_SCALES_H[0] else _RATIOS:
            white = np.empty_like(table)
            level = kernels.whiten_wander(
                found.hours, found.load, found.noise, ratio, hours, table, white
            )
            yield white, level, hours, ratio


@dataclass(frozen=True, slots=True)
class Regression:
    """Coefficients (p,), covariance (p, p), and log-likelihood of a regression with a wander."""

    likelihood: float
    coefficients: FloatArray
    covariance: FloatArray


def regressions(found: Levels, choices: Sequence[Sequence[int]]) -> list[Regression]:
    """Regress the power on some of the free columns, each time with the best wander.

    The time scale of the wander is at most a fourth of the record. A longer one could not be
    distinguished from the change of the whole record.

    Parameters
    ----------
    choices : sequence of sequence of int
        The columns of each regression; an empty sequence means a wander only.
    """
    best: list[Regression | None] = [None] * len(choices)
    k = len(found.power)
    most_h = float(np.ptp(found.hours)) / 4.0
    table = np.column_stack([found.power, found.free])
    for white, level, _, _ in _wanders(found, table, most_h):
        for i, columns in enumerate(choices):
            basis, size = np.linalg.qr(white[:, [1 + j for j in columns]])
            toward = basis.T @ white[:, 0]
            rest = white[:, 0] - basis @ toward
            cost = float(rest @ rest)
            likelihood = -level - 0.5 * k * float(np.log(cost / k))
            known = best[i]
            if known is None or likelihood > known.likelihood:
                back = np.linalg.inv(size)
                variance = cost / (k - len(columns))
                best[i] = Regression(likelihood, back @ toward, variance * back @ back.T)
    return [one for one in best if one is not None]


def covariate_gain(task: Task, model: Extended, name: str) -> float:
    """Return the log-likelihood gain of a covariate in a model with a slow wander of the power.

    Variance and time scale of the wander are optimised with and without the covariate. With a
    covariate that the power follows, no wander or a much smaller one remains; with one that is
    only similar by chance, it stays as large as before.
    """
    found, columns = levels(task, model, task.rows, careful=True)
    if not found.enough:
        return 0.0
    place = list(task.grids.covariates).index(name)
    tried = list(_fits(found, columns[:, place]))
    without = max(fit.likelihood for fit, _ in tried)
    return max(fit.likelihood + more for fit, more in tried) - without


@dataclass(frozen=True, slots=True)
class Drift:
    """Size of the unexplained drift of the power over hours and days.

    Attributes
    ----------
    gain : float
        Gain in log-likelihood by the wander.
    rms_mw : float
        Root mean square of the wander about its mean over the record, in MW.
    time_scale_s : float
        Time in which its autocorrelation falls to 1/e.
    least_mw : float
        Smaller drifts are ignored.
    """

    gain: float
    rms_mw: float
    time_scale_s: float
    least_mw: float = LEAST_DRIFT_MW

    @property
    def there(self) -> bool:
        """Return True if the drift is significant and slow."""
        slow = self.time_scale_s >= 3600.0 * _SLOWEST_OF_NOISE_H
        return slow and self.gain > _LEAST_DRIFT_GAIN and self.rms_mw > self.least_mw


def drift(task: Task, model: Extended) -> Drift:
    """Estimate the slow wander of the power in the residual of a model.

    Its size is the expected root mean square of P_i w_i about its mean over the record, given the
    data: the square of the estimate plus the remaining variance. The curve has absorbed the part
    of the wander that correlates with the load by chance; its expected square is included.
    """
    found, _ = levels(task, model, task.grids.whole, careful=False)
    if not found.enough:
        return Drift(0.0, 0.0, 0.0)
    tried = [fit for fit, _ in _fits(found)]
    best = max(tried, key=lambda fit: fit.restricted)
    none = next(fit for fit in tried if fit.ratio == 0.0)
    if best.ratio == 0.0:
        return Drift(0.0, 0.0, 0.0)
    k, p = found.free.shape
    wander = best.ratio * _covariance(found, best.hours)
    factor = cho_factor(np.diag(found.noise) + wander, lower=True)
    held = cho_solve(factor, found.free)
    # V^-1 without the part that the curve can explain.
    seen = cho_solve(factor, np.eye(k)) - held @ np.linalg.solve(found.free.T @ held, held.T)
    noise_mw2 = float(found.power @ seen @ found.power) / (k - p)
    level = wander @ (seen @ found.power)
    left = noise_mw2 * (wander - wander @ seen @ wander)
    unseen = float(np.trace(left) / k - left.mean())
    rms = float(np.sqrt(np.var(level) + unseen))
    least_mw = LEAST_DRIFT_MW * task.grids.size
    return Drift(best.restricted - none.restricted, rms, 3600.0 * best.hours, least_mw)


# The shape of a change in time.
#
# Each shape is P_i f(t_i). A step at a wrong time, or a drift with a step, can imitate many other
# shapes. So the causes in time are compared with the shapes, and with a wander alone.

PENALTY = 5.0  # log-likelihood that each parameter chosen from the data must gain
_OF_WANDER = 2.0 * 2.0  # penalty for its variance and its time scale, which are found on a grid
_MOMENTS = 96
_EDGE = 0.04  # fraction of the record at each end without onsets
_APART = 2  # least distance between two steps, in times of the grid
_SPREADS_H = (0.0, 4.0)  # duration of a step; two steps have the same one
_RATES = (0.08, 0.12, 0.18, 0.27, 0.4, 0.6)  # time constants relative to the length of the record
NO_SHAPE, NAMED_SHAPE = 'wander', 'named'
OF_WANDER = 'the power varies slowly all the time, which would look the same'
# Causes that change the level of the power in time, and equivalent shapes, by their families.
LEVELS = (
    'gain_drift', 'output_offset_drift', 'input_drift', 'gain_step', 'input_step', 'curve_step',
    'intervals',
)  # fmt: skip
_SHAPES = {
    ('drift',): ('drift',), ('step',): ('step',), ('drift', 'step'): ('drift and step',),
    ('drift', 'drift'): ('drift',),
}  # fmt: skip
# Gain in log-likelihood by which another shape must exceed one cause; for several it is 0. True
# causes of `benchmarks.diagnosis_study`, 41 of the seeds 71000 to 71203, were exceeded by 0.4 at
# most; drifts named for other slow changes by 3 to 6 (67700 to 67703).
ANOTHER_SHAPE = 2.0


@dataclass(frozen=True, slots=True)
class Course:
    """The change of the power in time, as one of the shapes.

    Attributes
    ----------
    name : str
        'drift', 'step', 'late drift', 'exponential', 'drift and step', 'drift and back',
        'there and back', 'two steps', 'drift and two steps'; `NO_SHAPE` for a wander alone and
        `NAMED_SHAPE` for the named causes.
    score : float
        Log-likelihood minus the penalty for its parameters.
    mw : tuple of float
        Sizes at the mean load, in MW; for an exponential the change until the end.
    at_s : tuple of float
        Times in s since the first row; for an exponential the time constant.
    rms_mw : float
        Root mean square about its mean over the record.
    spread_s : float
        Duration of each of its steps, centred on `at_s`; 0 for a sudden step.
    """

    name: str
    score: float
    mw: tuple[float, ...] = ()
    at_s: tuple[float, ...] = ()
    rms_mw: float = 0.0
    spread_s: float = 0.0


@dataclass(frozen=True, slots=True)
class _Shape:
    """Columns of a shape, (k, columns), and its description."""

    name: str
    columns: FloatArray
    at_s: tuple[float, ...]
    numbers: int
    spread_s: float = 0.0


def _shapes(found: Levels, changes_h: Sequence[float]) -> list[_Shape]:
    """Return every shape of one column; steps first, by duration and then time.

    They begin at the times of a grid and at the given ones: shapes with coarser times than those
    of the named causes would be at a disadvantage.
    """
    t, load = found.hours, found.load
    span = float(t[-1] - t[0])
    low, high = t[0] + _EDGE * span, t[-1] - _EDGE * span
    given = [h for h in changes_h if low < h < high]
    moments = np.unique([*np.linspace(low, high, _MOMENTS), *given])
    even = (t - t[0]) / span
    after = t[:, None] >= moments
    steps = [
        _Shape('step', column * load, (3600.0 * float(at),), 3 if spread else 2, 3600.0 * spread)
        for spread in _SPREADS_H if spread <= 2.0 * _EDGE * span  # step inside the record
        for column, at in zip(
            np.clip((t[:, None] - moments) / max(spread, 1e-9) + 0.5, 0.0, 1.0).T,
            moments, strict=True,
        )
    ]  # fmt: skip
    begins = np.maximum(t[:, None] - moments, 0.0) / (t[-1] - moments)
    ends = np.where(after, 0.0, (t[:, None] - t[0]) / (moments - t[0]))
    rates = span * np.array(_RATES)
    falls = 1.0 - np.exp(-(t[:, None] - t[0]) / rates)
    others = [
        _Shape(name, column * load, (3600.0 * float(at),), 2)
        for name, columns, when in (
            ('late drift', begins, moments),
            ('drift and back', ends, moments),
            ('exponential', falls, rates),
        )
        for column, at in zip(columns.T, when, strict=True)
    ]
    return [*steps, *others, _Shape('drift', even * load, (), 1)]


def courses(
    task: Task, model: Extended, names: Sequence[str], rows: BoolArray
) -> dict[str, Course]:
    """Return the best fit of each shape, by name; empty if the record is too short.

    Parameters
    ----------
    task : Task
    model : Extended
    names : sequence of str
        Causes in time that the model contains. They are removed, and their joint effect is one
        more shape, `NAMED_SHAPE`, with a penalty for their parameters.
    rows : bool (m,)
        The means to be used.
    """
    without = model
    for name in names:
        without = without.without(name)
    found, _ = levels(task, without, rows, careful=False)
    if not found.enough:
        return {}
    named = [a for a in model.active if a.name in names]
    single = _shapes(found, [h for a in named for h in a.changes_h])
    if names:
        full, _ = levels(task, model, rows, careful=False)
        numbers = sum(a.size for a in named)
        single.append(_Shape(NAMED_SHAPE, found.power - full.power, (), numbers))
    columns = np.column_stack([s.columns for s in single])
    best: dict[str, tuple[float, tuple[int, ...], FloatArray]] = {}
    for offer in _scored(found, single, columns):
        if offer[0] not in best or offer[1] > best[offer[0]][0]:
            best[offer[0]] = offer[1:]
    return {
        name: _course(name, score, chosen, sizes, single, found)
        for name, (score, chosen, sizes) in best.items()
    }


def of_causes(model: Extended, names: Sequence[str]) -> tuple[str, ...]:
    """Return the shapes that stand for causes in time of a model."""
    families = tuple(sorted(a.cause.family for a in model.active if a.name in names))
    return (NAMED_SHAPE, *_SHAPES.get(families, ()))


def wander_lead(task: Task, model: Extended) -> float:
    """Return by how much a slow disturbance exceeds the causes in time, on the rows of the fit.

    It is 0 with intervals, whose times are found anew when all blocks count, and with one
    `curve_step` alone, which also depends on the load.
    """
    names = [name for name in model.names if name in LEVELS]
    no_level = 'intervals' in names or names == ['curve_step']
    tried = {} if no_level else courses(task, model, names, task.rows)
    mine = [tried[shape].score for shape in of_causes(model, names) if shape in tried]
    return tried[NO_SHAPE].score - max(mine) if mine else 0.0


def _scored(
    found: Levels, single: list[_Shape], columns: FloatArray
) -> Iterator[tuple[str, float, tuple[int, ...], FloatArray]]:
    """Yield name, score, columns and sizes of the best fit of every shape, for every wander."""
    k, p = found.free.shape
    table = np.column_stack([found.power, found.free, columns])
    kinds = np.array([s.name for s in single])
    paid = PENALTY * np.array([s.numbers for s in single])
    drift_at = int(np.flatnonzero(kinds == 'drift')[0])
    all_spreads_s = np.array([s.spread_s for s in single])
    spreads_s = dict.fromkeys(all_spreads_s[kinds == 'step'].tolist())
    least_s = 3600.0 * _APART * float(np.ptp(found.hours)) * (1.0 - 2.0 * _EDGE) / (_MOMENTS - 1)
    for white, half, _, ratio in _wanders(found, table):
        basis, _ = np.linalg.qr(white[:, 1 : 1 + p])
        left = white - basis @ (basis.T @ white)
        rest, own = left[:, 0], left[:, 1 + p :]
        gram, toward = own.T @ own, own.T @ rest
        cost = float(rest @ rest)
        level = -half - (_OF_WANDER if ratio else 0.0)

        def worth(gain: FloatArray, cost: float = cost, level: float = level) -> FloatArray:
            rest = np.maximum(cost - gain, 1e-9 * cost)
            return np.asarray(level - 0.5 * k * np.log(rest / k))

        yield NO_SHAPE, float(worth(np.zeros(1))[0]), (), np.empty(0)
        size = np.maximum(np.diag(gram), 1e-12)
        score = worth(toward**2 / size) - paid
        for name in dict.fromkeys(kinds):
            mine = np.flatnonzero(kinds == name)
            j = int(mine[score[mine].argmax()])
            yield str(name), float(score[j]), (j,), toward[[j]] / size[j]
        for spread_s in spreads_s:
            steps = np.flatnonzero((kinds == 'step') & (all_spreads_s == spread_s))
            more = PENALTY * (spread_s > 0.0)
            gain, a, b = _pairs(gram, toward, np.full(len(steps), drift_at), steps)
            j = int(gain.argmax())
            chosen = drift_at, int(steps[j])
            score = worth(gain) - 3 * PENALTY - more
            yield 'drift and step', float(score[j]), chosen, np.array([a[j], b[j]])
            # The second step begins after the first: their sizes are real changes of the power.
            at_s = np.array([single[j].at_s[0] for j in steps])
            one, two = steps[0] + np.array(np.triu_indices(len(steps), 1))
            apart = at_s[two - steps[0]] - at_s[one - steps[0]] >= max(least_s, spread_s)
            one, two = one[apart], two[apart]
            gain, a, b = _pairs(gram, toward, one, two)
            j = int(gain.argmax())
            chosen = int(one[j]), int(two[j])
            score = worth(gain) - 4 * PENALTY - more
            yield 'two steps', float(score[j]), chosen, np.array([a[j], b[j]])
            # The same two steps beside a drift: what they explain of its rest.
            along = gram[:, drift_at] / size[drift_at]
            gain, a, b = _pairs(
                gram - np.outer(along, gram[drift_at]), toward - along * toward[drift_at], one, two
            )
            j = int(gain.argmax())
            even = toward[drift_at] - a[j] * gram[drift_at, one[j]] - b[j] * gram[drift_at, two[j]]
            score = worth(gain + toward[drift_at] ** 2 / size[drift_at]) - 5 * PENALTY - more
            sizes = np.array([even / size[drift_at], a[j], b[j]])
            three = drift_at, int(one[j]), int(two[j])
            yield 'drift and two steps', float(score[j]), three, sizes
            # The same two steps with equal size and opposite sign.
            square = np.maximum(gram[one, one] + gram[two, two] - 2.0 * gram[one, two], 1e-12)
            less = toward[one] - toward[two]
            gain = less**2 / square
            j = int(gain.argmax())
            chosen = int(one[j]), int(two[j])
            sizes = less[j] / square[j] * np.array([1.0, -1.0])
            score = worth(gain) - 3 * PENALTY - more
            yield 'there and back', float(score[j]), chosen, sizes


def _pairs(
    gram: FloatArray, toward: FloatArray, one: IntArray, two: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the gain of pairs of columns, and their two coefficients."""
    g11, g22, g12 = gram[one, one], gram[two, two], gram[one, two]
    b1, b2 = toward[one], toward[two]
    det = np.maximum(g11 * g22 - g12 * g12, 1e-9 * g11 * g22 + 1e-300)
    a, b = (g22 * b1 - g12 * b2) / det, (g11 * b2 - g12 * b1) / det
    return a * b1 + b * b2, a, b


def _course(
    name: str, score: float, chosen: tuple[int, ...], sizes: FloatArray, single: list[_Shape],
    found: Levels,
) -> Course:  # fmt: skip
    if not chosen or name == NAMED_SHAPE:
        return Course(name, score)
    made = sum(
        (mw * single[j].columns / found.load for j, mw in zip(chosen, sizes, strict=True)),
        np.zeros(len(found.hours)),
    )
    at_s = tuple(at for j in chosen for at in single[j].at_s)
    if name == 'exponential':
        sizes = made[-1:] - made[:1]
    spread_s = max(single[j].spread_s for j in chosen)
    return Course(name, score, tuple(sizes.tolist()), at_s, float(np.std(made)), spread_s)
