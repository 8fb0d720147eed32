# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Choice of the form of the static power: P = F(V p^m), or P = p^m F(V) + c.

Both are fitted to means inside special segments with the same number of breakpoints, and compared
on held-out stretches of time with the same whitening. The lag of the power on a ramp is a separate
column of the regression.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from valveflow_ros.curve.characteristic import FormEvidence
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.partition.partition import partition
from valveflow_ros.records import BoolArray, FloatArray, IntArray
from valveflow_ros.signals.static_form import (
    EXPONENTS,
    INTEGRATED_INPUT,
    LEAST_PRESSURE_RANGE,
    OPENING,
    StaticForm,
    exponents_near,
    pressure_range,
)

_MEAN_S = 60.0
_KNOTS = 10
_FOLDS, _STRETCHES = 5, 40
# Half a day has 50 to 250 of them. Fixed on half-days of units built from physics, numbers 301 to
# 308 of each kind, and of plants of the paper's kind, 401 to 420: the form was right in 40 of 44
# and "cannot be decided" in 4.
_LEAST_MEANS = 40
_MOST_MEANS = 6000
# Each grid covers the neighbourhood of the best value of the previous grid. The likelihood is not
# smooth: the result of a gradient search would depend on the unit of the pressure.
_EXPONENT_STEPS = 0.05, 0.01, 0.002
# Held-out errors are taken as Student's t with these degrees of freedom: otherwise one stretch
# outside the range of the others would dominate.
_FREEDOM = 4.0
# A form is decided by at least this log-likelihood gain, this many of its standard errors over
# stretches, and this difference of the two forms as fraction of the power's range.
_LEAST_GAIN, _LEAST_Z, _LEAST_APART = 12.0, 2.5, 0.003
# A searched exponent gains by chance over the given one: of 42 random plants with the given
# exponent, one seemed to have another, with a gain of 15.
_EXPONENT_GAIN, _EXPONENT_APART = 30.0, 0.001
# If undecided, the form over V is used if its gain exceeds this many standard errors.
_LIKELIER_Z = 1.5
# The same if the exponent of the paper's form is at an end of its range, as it is in units of the
# other form only: set after a look at 2335, 1306 and 93004 of `benchmarks.thermal_study`.
_DOUBTFUL_Z = 0.5
_CHOKED_EXPONENT = 1.0
_WORST = 0.05
_LEAST_IN_CELL, _EIGHTHS = 5, 8
_MISFIT, _MISFIT_OF_CELL = 0.01, 0.025  # of the power's range
_PROFILE_MEANS, _PROFILE_PIECES = 1500, 6


@dataclass(frozen=True, slots=True)
class FoundForm:
    """The form that the data require."""

    form: StaticForm
    offset_mw: float  # initial c of a fit; 0 for a form without c
    # None if the data are too few to compare a given form with the other.
    evidence: FormEvidence | None
    # A fit should not change the exponent: it is given, or the data do not determine it.
    exponent_held: bool


@dataclass(frozen=True, slots=True)
class _Means:
    """Means over a minute inside special segments; all (b,).

    ``goes_on`` is True if a mean follows the previous one without a gap.
    """

    opening: FloatArray
    pressure: FloatArray
    power: FloatArray
    rate: FloatArray
    goes_on: BoolArray

    def __len__(self) -> int:
        return len(self.power)


@dataclass(frozen=True, slots=True)
class _Fit:
    """A form with its best exponent."""

    form: StaticForm
    error: FloatArray
    static: FloatArray
    offset: float


def find_form(
    opening: FloatArray,
    pressure: FloatArray,
    power: FloatArray,
    spans: IntArray,
    period_s: float,
    exponent: float,
    axis: str = 'auto',
    held: StaticForm | None = None,
    known: StaticForm | None = None,
) -> FoundForm | None:
    """Return the form that the data require; None if they are too few to compare forms.

    Raises `DataError` if the means are too few to find the exponent or c of the fixed form.

    Parameters
    ----------
    opening, pressure, power : float64 (n,)
        Rows in %, MPa and MW, NaN if unknown.
    spans : int64 (k, 2)
        First and end row of each special segment.
    period_s : float
        Step of the rows.
    exponent : float
        m of the paper's form unless the data require another.
    axis : str
        'auto', or a fixed form: 'integrated_input' with the given exponent, or 'opening'.
    held : StaticForm, optional
        Use this form, and compare it with the other one.
    known : StaticForm, optional
        The form from earlier data of the same valve; it is kept unless the data show another.
    """
    means = _means_of(opening, pressure, power, spans, period_s)
    if axis == INTEGRATED_INPUT and held is None:
        held = StaticForm(INTEGRATED_INPUT, exponent)
    if len(means) < _LEAST_MEANS:
        if axis == OPENING or (held or known or StaticForm()).scaled:
            raise TooFewSamplesError(
                'Means over a minute in special segments, to find the numbers of p^m F(V) + c',
                len(means), _LEAST_MEANS, 'A longer log would help.',
            )  # fmt: skip
        return None if held is None else FoundForm(held, 0.0, None, True)
    within = exponents_near(exponent)
    ideal = _CHOKED_EXPONENT if within == EXPONENTS else exponent
    choked = known.exponent if known is not None and known.scaled else ideal
    usual = known if known is not None and not known.scaled else None
    given_paper = usual or StaticForm(INTEGRATED_INPUT, exponent)
    paper = _with_exponent(means, given_paper)
    moves = pressure_range(means.pressure) >= LEAST_PRESSURE_RANGE
    scaled = (
        _best(means, OPENING, within) if moves else _fitted(means, StaticForm(OPENING, choked))
    )
    if known is not None and known.scaled:
        scaled = _with_exponent(means, known)
    given = held is not None
    if held is not None:
        paper, scaled = (
            _fitted(means, held) if fit.form.axis == held.axis else fit for fit in (paper, scaled)
        )
    elif axis == OPENING:
        held = scaled.form
    gain, sure, told = _told(means, scaled, paper)
    if held is None and moves and (_at_end(scaled, within) or not told):
        # The exponent is not determined: use that of ideal choked flow.
        scaled = _fitted(means, StaticForm(OPENING, choked))
        gain, sure, told = _told(means, scaled, paper)
    searched = paper.form.exponent != given_paper.exponent
    doubtful = searched and _at_end(paper, exponents_near(given_paper.exponent))
    takes_scaled = gain > _LEAST_GAIN and sure > (_DOUBTFUL_Z if doubtful else _LIKELIER_Z)
    if known is not None and known.scaled:
        takes_scaled = not _told(means, paper, scaled)[2]
    if held is not None:
        takes_scaled = held.scaled
    chosen, other = (scaled, paper) if takes_scaled else (paper, scaled)
    if not takes_scaled:
        gain, _, told = _told(means, paper, scaled)
    apart = np.abs(chosen.static - other.static)
    at = int(np.argsort(apart)[int(0.99 * len(apart))])
    evidence = FormEvidence(
        chosen=chosen.form.axis,
        told=told,
        log_likelihood_gain=gain,
        rmse_mw=_root(chosen.error),
        rmse_other_mw=_root(other.error),
        other=other.form.words,
        apart_mw=_root(apart, 0.0),
        worst=(float(means.opening[at]), float(means.pressure[at]), float(apart[at])),
        contradicted=held is not None and _told(means, other, chosen)[2],
    )
    offset = _offset(means, chosen) if chosen.form.scaled else 0.0
    return FoundForm(chosen.form, offset, evidence, given or not (told and moves))


def _at_end(fit: _Fit, within: tuple[float, float]) -> bool:
    """Return True if the exponent of a fit is at an end of its range."""
    return min(abs(fit.form.exponent - end) for end in within) < 1e-6


@dataclass(frozen=True, slots=True)
class Misfit:
    """The error of a curve that repeats at the same openings and pressures."""

    rms_mw: float  # root mean square over the visited range, without noise that does not repeat
    # Opening in %, pressure in MPa, and measured minus predicted power there in MW.
    worst: tuple[float, float, float]


def find_misfit(
    opening: FloatArray,
    pressure: FloatArray,
    residual: FloatArray,
    power: FloatArray,
    spans: IntArray,
    period_s: float,
) -> Misfit | None:
    """Return the repeated error of a curve; None if it is small.

    It is small below 1 % of the range of the power in the mean, and below 2.5 % in each cell.

    Parameters
    ----------
    opening, pressure, residual, power : float64 (n,)
        Rows in %, MPa and MW; the residual is measured power minus static power of the curve.
    spans, period_s
        As for `find_form`.

    Notes
    -----
    Each cell of opening and pressure has one mean from even and one from odd eighths of the time.
    Their product estimates the squared error of the curve, since independent noise has mean 0.
    """
    means = _means_of(opening, pressure, residual, spans, period_s)
    ramp = _means_of(opening, pressure, power, spans, period_s)
    if len(means) < _LEAST_MEANS or len(means) != len(ramp):
        return None
    square = float((ramp.rate**2).sum())
    rest = means.power - ramp.rate * (float((ramp.rate * means.power).sum()) / max(square, 1e-12))
    cell = _place(means.opening, 6) * 5 + _place(means.pressure, 5)
    odd = np.arange(len(rest)) * _EIGHTHS // len(rest) % 2 > 0
    halves = []
    for half in (odd, ~odd):
        count = np.bincount(cell[half], minlength=30)
        total = np.bincount(cell[half], rest[half], minlength=30)
        halves.append((count, total / np.maximum(count, 1)))
    (n1, m1), (n2, m2) = halves
    n = np.where((n1 >= _LEAST_IN_CELL) & (n2 >= _LEAST_IN_CELL), n1 + n2, 0)
    if not n.any():
        return None
    common = m1 * m2
    rms = math.sqrt(max(0.0, float((n * common).sum() / n.sum())))
    worst, extent = int(np.argmax(np.where(n > 0, common, -np.inf))), float(np.ptp(ramp.power))
    if not (rms > _MISFIT * extent or common[worst] > (_MISFIT_OF_CELL * extent) ** 2):
        return None
    there = cell == worst
    return Misfit(rms, (
        float(np.median(means.opening[there])), float(np.median(means.pressure[there])),
        float(rest[there].mean()),
    ))  # fmt: skip


def _place(x: FloatArray, parts: int) -> IntArray:
    """Return the index of the quantile class of each value, of ``parts`` classes."""
    edges = np.quantile(x, np.linspace(0.0, 1.0, parts + 1)[1:-1])
    return np.asarray(np.searchsorted(edges, x, side='right'))


def _with_exponent(means: _Means, given: StaticForm) -> _Fit:
    """Return a fit with the given exponent, or with another one that is significantly better."""
    near = exponents_near(given.exponent)
    free, fitted = _best(means, given.axis, near), _fitted(means, given)
    gain, _, told = _told(means, free, fitted, _EXPONENT_APART)
    return free if told and gain > _EXPONENT_GAIN else fitted


def _means_of(
    opening: FloatArray, pressure: FloatArray, power: FloatArray, spans: IntArray, period_s: float
) -> _Means:
    """Return one-minute means inside segments, without those that contain a NaN."""
    rows = np.column_stack([opening, pressure, power])
    length = max(1, round(_MEAN_S / period_s))
    parts = []
    for first, end in spans.tolist():
        whole = (end - first) // length
        if whole < 1:
            continue
        mean = rows[first : first + whole * length].reshape(whole, length, 3).mean(axis=1)
        rate = np.gradient(mean[:, 2], length * period_s) if whole > 1 else np.zeros(1)
        goes_on = np.arange(whole) > 0
        parts.append(np.column_stack([mean, rate, goes_on]))
    table = np.concatenate([np.empty((0, 5)), *parts])
    known = np.isfinite(table).all(axis=1) & (table[:, 1] > 0.0)
    table[1:, 4] *= known[:-1]
    table = table[known]
    if len(table) > _MOST_MEANS:
        # Keep whole runs, because the whitening needs neighbours.
        run = np.arange(len(table)) // 20
        keep = run % -(-len(table) // _MOST_MEANS) == 0
        table[1:, 4] *= keep[:-1]
        table = table[keep]
    v, p, y, rate, goes_on = table.T
    return _Means(v, p, y, rate, goes_on > 0.0)


def _best(means: _Means, axis: str, within: tuple[float, float]) -> _Fit:
    """Return a fit with the exponent that has the smallest error on held-out stretches."""

    def cost(exponent: float) -> float:
        return float(_surprise(_fitted(means, StaticForm(axis, exponent)).error).sum())

    low, high = within
    best = low
    for step in _EXPONENT_STEPS:
        best = min(np.arange(low, high + 1e-9, step).round(4).tolist(), key=cost)
        low, high = max(within[0], best - step), min(within[1], best + step)
    return _fitted(means, StaticForm(axis, best))


def _fitted(means: _Means, form: StaticForm) -> _Fit:
    """Return the errors on held-out stretches, and the fit to all means."""
    u, scale = form.of_rows(means.opening, means.pressure)
    shape = _hinges(u)
    x = shape if scale is None else np.column_stack([scale[:, None] * shape, np.ones(len(u))])
    x = np.column_stack([x, -means.rate])
    y = means.power
    fold = np.arange(len(y)) * _STRETCHES // len(y) % _FOLDS
    norm = np.sqrt((x**2).mean(axis=0))
    x = x / np.where(norm > 0.0, norm, 1.0)
    sums = np.array([x[fold == k].T @ np.column_stack([x, y])[fold == k] for k in range(_FOLDS)])
    error = np.empty(len(y))
    for k in range(_FOLDS):
        rest = sums.sum(axis=0) - sums[k]
        out = fold == k
        error[out] = y[out] - x[out] @ _solved(rest)
    best = _solved(sums.sum(axis=0))
    lag = x[:, -1] * best[-1]
    offset = 0.0 if scale is None else float(best[-2] / norm[-2])
    return _Fit(form, error, x @ best - lag, offset)


def _solved(sums: FloatArray) -> FloatArray:
    """Solve normal equations whose last column is the right hand side."""
    n = sums.shape[0]
    return np.asarray(np.linalg.lstsq(sums[:, :n], sums[:, n], rcond=1e-12)[0])


def _hinges(x: FloatArray) -> FloatArray:
    """Return a constant, ``x``, and one hinge at each inner quantile."""
    knots = np.quantile(x, np.linspace(0.0, 1.0, _KNOTS + 2)[1:-1])
    return np.column_stack([np.ones(len(x)), x, np.maximum(x[:, None] - knots, 0.0)])


def _surprise(error: FloatArray, scale: float | None = None) -> FloatArray:
    """Return minus the log-likelihood of each error; the default scale is the robust sd of all."""
    s = 1.4826 * float(np.median(np.abs(error))) if scale is None else scale
    s = max(s, 1e-9)
    return np.asarray(0.5 * (_FREEDOM + 1.0) * np.log1p((error / s) ** 2 / _FREEDOM) + math.log(s))


def _told(
    means: _Means, one: _Fit, other: _Fit, least_apart: float = _LEAST_APART
) -> tuple[float, float, bool]:
    """Return the log-likelihood gain of ``one``, gain / standard error, and if ``one`` is proven.

    Both errors are whitened with the lag-one correlation of the smaller one.
    """
    best = min((one, other), key=lambda fit: float(np.median(np.abs(fit.error))))
    pairs = np.flatnonzero(means.goes_on)
    before, now = best.error[pairs - 1], best.error[pairs]
    power = float((before * before).sum())
    share = float(np.clip((before * now).sum() / power, 0.0, 0.95)) if power > 0.0 else 0.0
    white = []
    for fit in (one, other):
        e = fit.error.copy()
        e[pairs] -= share * fit.error[pairs - 1]
        white.append(e)
    scale = 1.4826 * min(float(np.median(np.abs(e))) for e in white)
    gains = _surprise(white[1], scale) - _surprise(white[0], scale)
    stretches = np.array([part.sum() for part in np.array_split(gains, _STRETCHES)])
    spread = float(stretches.std(ddof=1)) * math.sqrt(_STRETCHES)
    gain = float(stretches.sum())
    sure = gain / spread if spread > 0.0 else 0.0
    apart = _root(one.static - other.static, 0.0)
    enough = apart > least_apart * float(np.ptp(means.power))
    return gain, sure, bool(gain > _LEAST_GAIN and sure > _LEAST_Z and enough)


def _offset(means: _Means, fit: _Fit) -> float:
    """Return c of the best partition, searched in an interval around c of the hinge fit.

    For each c the partition is exact.
    """
    step = max(1, len(means) // _PROFILE_MEANS)
    u, scale = fit.form.of_rows(means.opening[::step], means.pressure[::step])
    assert scale is not None
    y = means.power[::step]
    room = 0.1 * float(np.ptp(means.power))

    def cost(c: float) -> float:
        part = partition(u, (y - c) / scale, _PROFILE_PIECES, max(2, len(u) // 50),
                         weight=scale**2, threads=1)  # fmt: skip
        return float(part.cost[-1])

    found = minimize_scalar(
        cost, bounds=(fit.offset - room, fit.offset + room), method='bounded',
        options={'xatol': 0.02},
    )  # fmt: skip
    return float(found.x)


def _root(error: FloatArray, without: float = _WORST) -> float:
    """Return the root mean square without the largest errors, a fraction ``without``."""
    least = np.sort(np.abs(error))[: max(1, round((1.0 - without) * len(error)))]
    return float(np.sqrt(np.mean(least**2)))
