# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The evidence for a cause, its gain on sealed (test) blocks, and intervals of its sizes."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, stdtr

from valveflow_ros.diagnosis.cause import Estimate, FittedCause, Kind, Stage, Unknown
from valveflow_ros.diagnosis.causes import causes_for
from valveflow_ros.diagnosis.extended import Extended, answer
from valveflow_ros.diagnosis.fitting import (
    Task,
    base_tangents,
    cause_tangents,
    free,
    level_tangents,
)
from valveflow_ros.diagnosis.grids import DAY_S, FOLDS, ORDER, SEALED_FOLD
from valveflow_ros.diagnosis.screening import Screening, nuisance
from valveflow_ros.fit.whitening import fit_ar, inflation
from valveflow_ros.numerics import each_in_threads
from valveflow_ros.records import BoolArray, FloatArray, IntArray

# Hidden states: estimated again when a model is judged or used.


def inferred(task: Task, model: Extended, allowed: BoolArray) -> Extended:
    """Return the model with its hidden states estimated from the allowed sub-blocks.

    Parameters
    ----------
    task : Task
        Its rows may be used, together with ``allowed``.
    allowed : bool (subs,)
    """
    for a in model.active:
        if a.cause.infer is not None:
            screening = Screening(task, model.without(a.name))
            model = model.having(replace(a, extra=a.cause.infer(screening, a, allowed)))
    return model


def fair_residual(task: Task, model: Extended) -> FloatArray:
    """Return the residual in MW, shape (m,), with hidden states estimated from other sub-blocks.

    The state inside a sealed block cannot be found from outside it. So the even sub-blocks give
    the state of the odd ones and vice versa: no row is judged by a state estimated from it. The
    size of the effect stays as fitted elsewhere.
    """
    return _crossed(replace(task, rows=task.grids.whole), model)


def fair_open_residual(task: Task, model: Extended) -> FloatArray:
    """Return the same residual with the states estimated from rows of the task only."""
    return _crossed(task, model)


def _crossed(task: Task, model: Extended) -> FloatArray:
    if all(a.cause.infer is None for a in model.active):
        return task.residual(model)
    odd = np.arange(task.grids.subs) % 2 == 1
    by_even, by_odd = each_in_threads(
        lambda allowed: task.residual(inferred(task, model, allowed)), [~odd, odd]
    )
    return np.where(odd[task.grids.sub], by_even, by_odd)


_LAGS = 3
_RIDGE = 1e-4  # of the squared norm of a column
_MEMORY_S = 1200.0
# Fixed on the healthy plants 72000 to 72059 of `benchmarks.diagnosis_study`, of which one passed.
# What passes is tested on the sealed blocks besides.
LEAST_GAIN, LEAST_SIGN = 8.0, 1.0
_WALD_LEVEL, _WALD_EACH = 7.0, 4.0


def _by_block(task: Task, table: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Return products summed over blocks (blocks, P, P) and the blocks that have rows."""
    grids = task.grids
    block = grids.block_of_sub[grids.sub[task.rows]]
    edges = np.searchsorted(block, np.arange(grids.block_of_sub[-1] + 2))
    spans = [(a, b) for a, b in itertools.pairwise(edges) if b > a]
    have = np.flatnonzero(np.diff(edges) > 0)
    return np.stack([table[a:b].T @ table[a:b] for a, b in spans]), have


def held_out(task: Task, model: Extended) -> FloatArray:
    """Return the sum of squared innovations of each block, with parameters fitted without it.

    The parameters of each fold are one Gauss-Newton step from the common optimum, with the sums of
    the other folds. Parameters that these hardly determine (a breakpoint in one block) stay.
    """
    table = np.column_stack([nuisance(task, model), task.innovations(task.residual(model))])
    sums, blocks = _by_block(task, table)
    fold = blocks % FOLDS
    out = np.empty(len(blocks))
    for f in range(FOLDS):
        if f == SEALED_FOLD or not np.any(fold == f):
            continue
        train = sums[fold != f].sum(axis=0)
        normal = train[:-1, :-1] + _RIDGE * np.eye(len(train) - 1)
        step = np.linalg.solve(normal, train[:-1, -1])
        for b in np.flatnonzero(fold == f):
            own = sums[b]
            out[b] = own[-1, -1] - 2.0 * step @ own[:-1, -1] + step @ own[:-1, :-1] @ step
    return out


def long_run_variance(scores: FloatArray) -> float:
    """Return the Newey-West variance of the sum of block scores."""
    centred = scores - scores.mean()
    total = float(centred @ centred)
    for k in range(1, min(_LAGS, len(scores) - 1) + 1):
        total += 2.0 * (1.0 - k / (_LAGS + 1.0)) * float(centred[k:] @ centred[:-k])
    return max(total, 0.1 * float(centred @ centred))


_LOADS = 8  # classes of load in which the effect of a cause is compared
_LARGER = 1.3  # factor by which it is larger at another load than at full load, to be told


def more_or_less(mw: float) -> str:
    """Return a change of the power in words."""
    return f'{abs(mw):.2g} MW {"more" if mw > 0.0 else "less"}'


def where_largest(
    power: FloatArray, at_full_load: float, size_of: Callable[[BoolArray], float]
) -> str:
    """Return words on the load where an effect is largest; '' if that is about full load.

    Parameters
    ----------
    power : float64 (m,)
        MW without the effect.
    at_full_load : float
        Size of the effect there, MW.
    size_of : callable
        Size of the effect, MW, in some of the rows, as a mask (m,).
    """
    edges = np.quantile(power, np.linspace(0.0, 1.0, _LOADS + 1))
    classes = [(power >= low) & (power <= high) for low, high in itertools.pairwise(edges)]
    sizes = [size if np.isfinite(size := size_of(rows)) else 0.0 for rows in classes]
    most = int(np.argmax(np.abs(sizes)))
    if abs(sizes[most]) < _LARGER * abs(at_full_load):
        return ''
    load = float(np.median(power[classes[most]]))
    return f'; at {load:.0f} MW, where it is largest, {more_or_less(sizes[most])}'


@dataclass(frozen=True, slots=True)
class Evidence:
    """The evidence for a cause.

    Attributes
    ----------
    gain : float
        Log-likelihood gained on held-out blocks.
    wald : float
        Squared size of the effect divided by its robust variance.
    sign : float
        t value of the gains of single blocks: mean divided by standard error.
    size : int
        Number of values chosen from the data; each raises the Wald statistic by chance.
    """

    gain: float
    wald: float
    sign: float
    size: int

    @property
    def least_wald(self) -> float:
        """Return the smallest sufficient ``wald``."""
        return _WALD_LEVEL + _WALD_EACH * self.size

    @property
    def enough(self) -> bool:
        """Return True if all three conditions are met."""
        return self.gain > LEAST_GAIN and self.wald > self.least_wald and self.sign > LEAST_SIGN

    def reason(self) -> str:
        """Return which conditions are not met."""
        told = []
        if not self.gain > LEAST_GAIN:
            told.append(
                'it improves the prediction of held-out data too little '
                f'({self.gain:+.1f} in log-likelihood, {LEAST_GAIN:.0f} needed)'
            )
        if not self.wald > self.least_wald:
            told.append(
                f'its size is too uncertain (Wald statistic {self.wald:.1f}, '
                f'{self.least_wald:.0f} needed)'
            )
        if not self.sign > LEAST_SIGN:
            told.append(
                f'it helps in too few blocks (t = {self.sign:.1f}, {LEAST_SIGN:.1f} needed)'
            )
        return '; '.join(told)


def colour(task: Task, e: FloatArray) -> float:
    """Return the variance inflation of long means of innovations, relative to white noise.

    If the noise has a longer memory than the AR model, the significance of slow effects is
    overestimated; log-likelihoods are divided by this factor.
    """
    rows = max(2, round(_MEMORY_S / task.grids.mean_s))
    return inflation(e, np.ones(len(e), dtype=np.uint8), min(rows, max(2, len(e) // 10)))


def weigh(task: Task, without: Extended, model: Extended, size: int) -> Evidence:
    """Compare two fitted models with the same whitening.

    Parameters
    ----------
    size : int
        Number of values that ``model`` has more than ``without``.
    """
    e = task.innovations(task.residual(model))
    variance = float(e @ e) / len(e) * colour(task, e)
    gains = held_out(task, without) - held_out(task, model)
    spread = float(gains.std(ddof=1)) if len(gains) > 1 else 0.0
    sign = float(gains.mean()) / spread * np.sqrt(len(gains)) if spread > 0.0 else 0.0
    gain = float(gains.sum()) / (2.0 * variance) - _hindsight(task, model, e) / (2.0 * variance)
    return Evidence(gain, _wald(task, without, model, e), float(sign), size)


def _hindsight(task: Task, model: Extended, e: FloatArray) -> float:
    """Return the part explained by a hidden state only because it was fitted to the same rows."""
    if all(a.cause.infer is None for a in model.active):
        return 0.0
    fair = task.innovations(fair_open_residual(task, model))
    return max(float(fair @ fair - e @ e), 0.0)


def _wald(task: Task, without: Extended, model: Extended, e: FloatArray) -> float:
    """Return the squared robust t value of the difference between two models."""
    grids = task.grids
    column = task.innovations(answer(grids, model) - answer(grids, without))
    n = nuisance(task, without)
    column = column - n @ (np.linalg.pinv(n.T @ n, hermitian=True) @ (n.T @ column))
    before = task.innovations(task.residual(without))
    block = grids.block_of_sub[grids.sub[task.rows]]
    scores = np.bincount(block, column * e).astype(np.float64)[np.bincount(block) > 0]
    variance = max(long_run_variance(scores), float(e @ e) / len(e) * float(column @ column))
    return float((column @ before) ** 2 / max(variance, 1e-300))


# The gain of a cause on test blocks to which nothing was fitted; they only confirm.

LARGEST_P = 0.05
_LEAST_PARTS = 8
_NO_CHANGE = 1e-3  # of the mean sum of squares of the change in a part
_LEAST_SEGMENT_MEANS = 3


@dataclass(frozen=True, slots=True)
class Gain:
    """RMSE in MW on the sealed blocks without and with a cause, and the p-value of the gain."""

    rmse_before: float
    rmse_after: float
    p_value: float

    @property
    def reduction(self) -> float:
        """Return 1 - after / before."""
        return 1.0 - self.rmse_after / self.rmse_before if self.rmse_before > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class SegmentGain:
    """One special segment inside sealed blocks: number, times in ns, RMSE before and after."""

    number: int
    start_ns: int
    end_ns: int
    rmse_before: float
    rmse_after: float


def rmse(task: Task, model: Extended, rows: BoolArray) -> float:
    """Return the root mean square of the residual over rows."""
    return float(np.sqrt(np.mean(fair_residual(task, model)[rows] ** 2)))


def sealed_gain(
    task: Task, before: Extended, after: Extended, tried: int, tested: int = 1
) -> Gain:
    """Compare two models, both fitted to the open blocks, on the sealed ones.

    Parameters
    ----------
    tried, tested : int
        Number of causes tried on the open blocks and tested on the sealed ones.
    """
    rows = task.grids.sealed_rows
    old, new = fair_residual(task, before), fair_residual(task, after)
    rests = _told_rests(task, old, new, _while_unsure(task, after))
    sizes = [float(np.sqrt(np.mean(rest[rows] ** 2))) for rest in (old, new)]
    return Gain(sizes[0], sizes[1], chance_of_gain(*rests, tried, tested))


def chances_over(
    task: Task, smaller: list[Extended], model: Extended, tried: int, most: int
) -> FloatArray:
    """Return the chance of the gain of a model over each smaller one on the sealed blocks.

    Shape (k, most): for k smaller models, if 1 to ``most`` causes count as tested there.
    """
    unsure, new = _while_unsure(task, model), fair_residual(task, model)
    counts = range(1, most + 1)

    def chances(before: Extended) -> list[float]:
        rests = _told_rests(task, fair_residual(task, before), new, unsure)
        return [chance_of_gain(*rests, tried, tested) for tested in counts]

    return np.array(each_in_threads(chances, smaller))


def _told_rests(
    task: Task, old: FloatArray, new: FloatArray, unsure: BoolArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return two residuals whitened, (n,), on the sealed rows that count, and their sub-blocks.

    Times at which the onset may lie according to the open blocks do not count: there the models
    cannot know whether the change has happened.
    """
    rows = task.grids.sealed_rows
    told = rows & ~unsure
    if len(np.unique(task.grids.sub[told])) >= _LEAST_PARTS:
        rows = told
    sealed = replace(task, rows=rows)
    return sealed.innovations(old), sealed.innovations(new), task.grids.sub[rows]


def _while_unsure(task: Task, model: Extended) -> BoolArray:
    """Return the means at times where an onset may lie, shape (m,)."""
    day = task.grids.means(task.grids.time_s) / DAY_S
    out = np.zeros(len(day), dtype=bool)
    innovations = task.innovations(task.residual(model))
    variance = float(innovations @ innovations) / len(innovations)
    for a in model.active:
        for k, unknown in enumerate(a.cause.unknowns):
            if not unknown.dated:
                continue

            def cost(value: float, a: FittedCause = a, k: int = k) -> float:
                values = (*a.values[:k], value, *a.values[k + 1 :])
                return task.cost(model.having(replace(a, values=values)))

            here, step = a.values[k], unknown.step_on(task.grids)
            most = cost(here) + _JUMP95 * variance * colour(task, innovations)
            low, high = (_last_place(cost, here, way * step, unknown, most) for way in (-1.0, 1.0))
            out |= (day >= low) & (day <= high)
    return out


def gain_of_form(task: Task, model: Extended, task_new: Task, new: Extended) -> Gain:
    """Compare models of two forms on the sealed blocks of the same rows.

    Both residuals are whitened with the AR model of the new one.
    """
    rows = task.grids.sealed_rows & task_new.grids.sealed_rows
    old_rest, new_rest = fair_residual(task, model), fair_residual(task_new, new)
    scored = rows.astype(np.uint8)
    sealed = replace(task_new, rows=rows, ar=fit_ar(new_rest, scored, ORDER))
    rests = sealed.innovations(old_rest), sealed.innovations(new_rest)
    chance = chance_of_gain(*rests, task.grids.sub[rows])
    before, after = (float(np.sqrt(np.mean(e[rows] ** 2))) for e in (old_rest, new_rest))
    return Gain(before, after, chance)


def chance_of_gain(
    before: FloatArray, after: FloatArray, part: IntArray, tried: int = 1, tested: int = 1
) -> float:
    """Return the p-value of the gain of one model over another on rows that neither was fitted to.

    The score of a part (half an hour) is the sum of residual before times its change. A model
    fitted to other rows is independent of the noise here, so the score has mean 0 if the change is
    no improvement, and a variance proportional to the sum of squares of the change. The factor is
    the variance of the rows times the dispersion of the parts after the change, which is above 1
    if their rows are correlated or something else acts; the sum of the scores is Student's.

    Parameters
    ----------
    before, after : float64 (n,)
        Residuals of the two models.
    part : int64 (n,)
        Number of the part of each row.
    tried, tested : int
        Number of changes tried on other rows, and tested on these. Independent parts need a
        correction for the second only. If the dispersion is more than a chance of 5 % allows,
        what is left may repeat itself from part to part, here and where the change was chosen:
        then the first counts.
    """
    change = before - after
    own, scores, left = (
        np.bincount(part, x * change).astype(np.float64) for x in (change, before, after)
    )
    acts = own > _NO_CHANGE * own.mean()
    parts, variance = int(acts.sum()), float(after @ after) / max(len(after), 1)
    if parts < 2 or not variance > 0.0:
        return 1.0
    squares = left[acts] ** 2 / (variance * own[acts])
    even, weighted = float(squares.mean()), float(np.average(squares, weights=own[acts]))
    error = np.sqrt(variance * max(1.0, even, weighted) * float(own.sum()))
    number = tested if even <= chdtri(parts, LARGEST_P) / parts else max(tried, tested)
    return min(1.0, number * float(stdtr(parts - 1, -scores.sum() / error)))


def noise_floor(task: Task, model: Extended, explained_mw2: float) -> float:
    """Return an estimate of the RMSE on the sealed blocks due to noise alone.

    The contributions of parameter errors and of remaining structure are subtracted, down to what
    the rows just before do not predict.
    """
    rows = task.grids.sealed_rows
    columns = np.column_stack([base_tangents(task, model), cause_tangents(task, model)])
    table = task.innovations(columns)
    norm = np.sqrt((table**2).sum(axis=0))
    norm[norm <= 1e-9 * norm.max()] = np.inf
    e = task.innovations(task.residual(model))
    inverse = np.linalg.pinv((table / norm).T @ (table / norm), hermitian=True)
    unpredicted = float(e @ e) / len(e)
    inverse *= unpredicted
    sealed = columns[rows] / norm
    spread = float(np.einsum('ij,jk,ik->i', sealed, inverse, sealed).mean())
    whole = rmse(task, model, rows) ** 2
    left = whole - spread - max(explained_mw2, 0.0)
    return float(np.sqrt(max(left, min(unpredicted, whole))))


def by_segment(
    task: Task, before: Extended, after: Extended, spans_ns: IntArray
) -> tuple[SegmentGain, ...]:
    """Return RMSE before and after in every special segment that lies in sealed blocks.

    Parameters
    ----------
    spans_ns : int64 (k, 2)
        First and last time of each segment.
    """
    grids = task.grids
    old, new = fair_residual(task, before), fair_residual(task, after)
    places = (spans_ns - grids.start_ns) / (grids.mean_s * 1e9)
    out = []
    for number, (a, b) in enumerate(places):
        first, end = max(0, int(np.ceil(a))), min(len(old), int(b))
        inside = np.zeros(len(old), dtype=bool)
        inside[first:end] = True
        inside &= grids.sealed_rows
        if end - first < _LEAST_SEGMENT_MEANS or inside.sum() < end - first:
            continue
        out.append(
            SegmentGain(
                number + 1, int(spans_ns[number, 0]), int(spans_ns[number, 1]),
                float(np.sqrt(np.mean(old[inside] ** 2))),
                float(np.sqrt(np.mean(new[inside] ** 2))),
            )
        )  # fmt: skip
    return tuple(out)


# Uncertainty of the parameters of the causes: 95 % intervals.
#
# Smooth parameters: sandwich estimator from the joint Gauss-Newton matrix and scores summed over
# blocks. Dead bands and limits: profile likelihood, widened by the same ratio of robust to plain
# variance. Where the likelihood has jumps (onset, level, stick band), the likelihood ratio is not
# chi-square: the maximum of two random walks that fall away from the true value is below c with
# probability (1 - exp(-c / 2))^2, which is 0.95 at c = 7.35 (Siegmund, Adv. Appl. Prob. 20, 1988,
# 645; Eo and Morley, Quant. Econ. 6, 2015, 463). For causes of the opening, two standard
# deviations of the noise of the opening are added.
#
# A first-order lag stands for the dynamics of the unit, so the errors of what shows in fast moves
# are not those of noise alone. Of 15 profile intervals for a valve or a reheater, in the sets
# 82001, 93001 and 94001 of `benchmarks.naming`, 9 held the true size; at twice their width 14.
# The breakpoints beside a bend take a part of it, in more than one way: of 27 intervals in the
# studies 55320 to 55382 of `benchmarks.diagnosis_study` 14 held the true value. The interval of
# its height is widened too; those of its place and width are the wider ones of both kinds.


_Z95 = 1.959963984540054
_CHI95 = 3.841458820694124
_JUMP95 = 7.352
_NOISES = 2.0
_WIDER = 2.0
_ANSWERED_AT_ONCE = 0.3  # largest share of the power that a turbine makes ahead of its reheater
_PLACES, _MISSES = 120, 8
_DOUBLINGS, _HALVINGS = 12, 7
_PROFILE_BLOCK_SUBS = 2


class Certainty:
    """The joint linearisation of a fitted model; all intervals are computed from it."""

    def __init__(self, task: Task, model: Extended) -> None:
        model = free(model, causes_for(task.grids))
        self.task, self.model = task, model
        causes = cause_tangents(task, model)
        table = task.innovations(
            np.column_stack([causes, base_tangents(task, model), level_tangents(task, model)])
        )
        norm = np.sqrt((table**2).sum(axis=0))
        norm[norm <= 1e-9 * norm.max()] = np.inf
        self.table = table / norm
        self.norm = norm
        self.causes = causes.shape[1]
        self.e = task.innovations(task.residual(model))
        self.variance = float(self.e @ self.e) / len(self.e)
        self.inverse = np.linalg.pinv(self.table.T @ self.table, hermitian=True)
        grids = task.grids
        self._colour = colour(task, self.e)
        self._group = grids.sub[task.rows] // _PROFILE_BLOCK_SUBS

    def _widening(self, column: FloatArray) -> float:
        """Return robust divided by plain variance of the coefficient of a column, at least 1."""
        scores = np.bincount(self._group, column * self.e).astype(np.float64)
        scores = scores[np.bincount(self._group) > 0]
        plain = self.variance * float(column @ column)
        return max(1.0, long_run_variance(scores) / max(plain, 1e-300))

    def smooth(self) -> list[float]:
        """Return a standard error for every parameter fitted by Gauss-Newton."""
        out = []
        for k in range(self.causes):
            influence = self.table @ self.inverse[:, k]
            error = np.sqrt(max(self.inverse[k, k], 0.0) * self.variance)
            out.append(float(error * np.sqrt(self._widening(influence)) / self.norm[k]))
        return out

    def profile(self, c: int, k: int, own: int | None) -> tuple[float, float]:
        """Return the ends of the 95 % profile likelihood interval.

        Parameters
        ----------
        c, k : int
            Cause and parameter.
        own : int or None
            Column of this parameter in the table, which is excluded from the other parameters.
        """
        mine = {own}
        if self.model.active[c].cause.unknowns[k].dated:
            # A size fitted at another onset would replace the cause: exclude its column too.
            mine = set(self._columns_of(c))
        keep = [j for j in range(self.table.shape[1]) if j not in mine]
        others = self.table[:, keep]
        cause = self.model.active[c].cause
        unknown, here = cause.unknowns[k], self.model.active[c].values[k]
        inverse = np.linalg.pinv(others.T @ others, hermitian=True)

        def cost(value: float) -> float:
            a = self.model.active[c]
            values = list(a.values)
            values[k] = value
            e = self.task.innovations(
                self.task.residual(self.model.having(replace(a, values=tuple(values))))
            )
            toward = others.T @ e
            return float(e @ e) - float(toward @ inverse @ toward)

        step = unknown.step_on(self.task.grids)
        if unknown.kind is Kind.LINE:
            most = cost(here) + _JUMP95 * self.variance * self._colour
            low, high = (_last_place(cost, here, sign * step, unknown, most)
                         for sign in (-1.0, 1.0))  # fmt: skip
        else:
            influence = self.table @ self.inverse[:, own] if own is not None else np.ones(1)
            most = cost(here) + _CHI95 * self.variance * self._widening(influence)
            low = _crossing(cost, here, -step, unknown.low, most)
            high = _crossing(cost, here, step, unknown.high, most)
        if cause.stage is Stage.OPENING and unknown.unit == '%':
            margin = _NOISES * self.task.grids.reference.opening_noise
            low, high = max(low - margin, unknown.low), min(high + margin, unknown.high)
        return low, high

    def _early_by(self) -> float:
        """Return how much earlier than its first-order lag a unit with a reheater answers, s.

        A share s at once and the rest with a lag T is 1 - (1 - s) exp(-t / T), which is the
        answer of the lag alone from ``-T ln(1 - s)`` on.
        """
        shortest = float(np.min(self.model.base.time_constants))
        return -shortest * float(np.log(1.0 - _ANSWERED_AT_ONCE))

    def _columns_of(self, c: int) -> range:
        """Return the columns of a cause in the table: its parameters fitted by Gauss-Newton."""
        moved = [sum(u.kind is not Kind.LINE for u in a.cause.unknowns) for a in self.model.active]
        return range(sum(moved[:c]), sum(moved[: c + 1]))

    def intervals(self) -> dict[str, dict[str, Estimate]]:
        """Return all estimates by cause and parameter."""
        errors = self.smooth()
        out: dict[str, dict[str, Estimate]] = {}
        column = 0
        for c, a in enumerate(self.model.active):
            out[a.name] = {}
            for k, unknown in enumerate(a.cause.unknowns):
                value = a.values[k]
                own = None if unknown.kind is Kind.LINE else column
                bend, smooth = a.name == 'curve_shape', unknown.kind is Kind.SMOOTH
                low = high = value
                if own is not None and (bend or smooth):
                    low, high = value - _Z95 * errors[column], value + _Z95 * errors[column]
                if not smooth:
                    ends = self.profile(c, k, own)
                    low, high = min(low, ends[0]), max(high, ends[1])
                rough = not (smooth or unknown.dated or a.cause.stage is Stage.FLOW)
                if rough or (bend and smooth):
                    low = max(value - _WIDER * (value - low), unknown.low)
                    high = min(value + _WIDER * (high - value), unknown.high)
                if unknown.concealed:
                    low = max(low - self._early_by(), unknown.low)
                column += own is not None
                out[a.name][unknown.name] = Estimate(
                    value, low, high + unknown.concealed, unknown.unit,
                    self.task.grids.start_ns if unknown.dated else None,
                )  # fmt: skip
        return out


def _crossing(
    cost: Callable[[float], float], here: float, step: float, bound: float, most: float
) -> float:
    """Return where the cost exceeds ``most``, by doubling steps from ``here`` and bisection."""
    inside, outside = here, here
    stride = 0.05 * step
    for _ in range(_DOUBLINGS):
        outside = here + stride
        beyond = outside <= bound if step < 0.0 else outside >= bound
        if beyond:
            outside = bound
        if cost(outside) > most:
            break
        if beyond:
            return bound
        inside, stride = outside, 2.0 * stride
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        inside, outside = (inside, middle) if cost(middle) > most else (middle, outside)
    return outside


def _last_place(
    cost: Callable[[float], float], here: float, step: float, unknown: Unknown, most: float
) -> float:
    """Return the last value in one direction whose cost is below ``most``.

    The cost is not smooth: the search continues over a few values of higher cost; its steps
    grow with the distance.
    """
    stride, place, last, misses = 0.02 * step, here, here, 0
    for count in range(_PLACES):
        place += stride
        if not unknown.low <= place <= unknown.high:
            return unknown.low if step < 0.0 else unknown.high
        if cost(place) <= most:
            last, misses = place, 0
        else:
            misses += 1
        if misses >= _MISSES:
            break
        if count % 10 == 9 and misses == 0:
            stride *= 2.0
    return last + stride if last != here else here + np.sign(step) * abs(stride)
