# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit an extended model by prediction error: tangents, Gauss-Newton, line searches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.cause import Cause, FittedCause, Kind, Stage, Values
from valveflow_ros.diagnosis.extended import (
    Extended,
    answer,
    drive,
    flow_of,
    lags_of,
    means_through,
    region_path,
    response,
)
from valveflow_ros.diagnosis.grids import ORDER, Grids
from valveflow_ros.fit.descent import descend, gauss_newton
from valveflow_ros.fit.kernels import tangents
from valveflow_ros.fit.problem import (
    free_parameters,
    stretches,
    with_level_moved,
    within_bounds,
    within_reach,
)
from valveflow_ros.fit.whitening import fit_ar
from valveflow_ros.numerics import cores, each_in_threads, jit, run_in_threads
from valveflow_ros.records import BoolArray, FloatArray

# Causes that depend on unmeasured noise: simulations with several noise realisations.
#
# A sticking valve slips when the distance to the command exceeds a threshold, and the noise of the
# position sensor decides on which side of it a row lies. A single simulated path soon leaves the
# true one, until both slip again. So several paths with different noise are simulated. The power
# measured *before* a row gives the weight of each path in that row. Old rows count less, so that
# a wrong path can regain weight.
#
# This is the fixed-share forecaster (Herbster and Warmuth, Machine Learning 32, 1998, 151). It
# does not use the row that it predicts, so it gains nothing if the cause is absent.

_EVERY = 7  # rows are enough for a median
_OF_NORMAL = 0.455  # the median of a squared standard normal variable
_SHARED = 0.005  # weight redistributed at every mean: one change in half an hour


@jit
def beliefs(
    white: FloatArray, good: BoolArray, variance: float, shared: float, out: FloatArray
) -> None:
    """Compute the weights of several predictions in every row.

    Parameters
    ----------
    white : float64 (k, m)
        Whitened residuals of every prediction.
    good : bool (m,)
        Rows whose whitened residuals count.
    variance : float
        Variance of a whitened residual if the prediction is right.
    shared : float
        Fraction of the weight that is distributed equally at every row.
    out : float64 (k, m)
        Weights; each column sums to 1.
    """
    count = white.shape[0]
    belief = np.full(count, 1.0 / count)
    for t in range(white.shape[1]):
        out[:, t] = belief
        if not good[t]:
            continue
        least = np.min(white[:, t] ** 2)
        total = 0.0
        for k in range(count):
            belief[k] *= np.exp(-(white[k, t] ** 2 - least) / (2.0 * variance))
            total += belief[k]
        for k in range(count):
            belief[k] = (1.0 - shared) * belief[k] / total + shared / count


def drawn(model: Extended) -> FittedCause | None:
    """Return the cause of a model that uses noise realisations; None if there is none."""
    return next((a for a in model.active if a.cause.draws), None)


def _believed(
    grids: Grids, model: Extended, a: FittedCause, ar: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals and weights of all realisations, both (k, m)."""
    rest = np.empty((a.cause.draws, len(grids.power)))

    def work(k: int) -> None:
        one = replace(model, active=tuple(_single(b, k) if b is a else b for b in model.active))
        rest[k] = np.where(grids.scored, grids.power - answer(grids, one), 0.0)

    run_in_threads(work, [(k,) for k in range(a.cause.draws)], cores())
    white = rest.copy()
    for lag, factor in enumerate(ar, start=1):
        white[:, lag:] -= factor * rest[:, :-lag]
    out = np.empty_like(rest)
    beliefs(white, grids.whole, _variance(white[:, grids.whole]), _SHARED, out)
    return rest, out


def believed_residual(grids: Grids, model: Extended, a: FittedCause, ar: FloatArray) -> FloatArray:
    """Return the residual of the weighted mean of all realisations in MW, shape (m,).

    Parameters
    ----------
    a : FittedCause
        The cause of the model that uses noise realisations.
    ar : float64 (p,)
        AR coefficients of the noise.
    """
    rest, belief = _believed(grids, model, a, ar)
    return np.asarray(np.einsum('km,km->m', rest, belief))


@dataclass(frozen=True, slots=True, eq=False)
class _Path:
    """The weighted mean path of the plug in one record, for fixed parameter values.

    Two of them are never equal: results are cached by the function that gives them.
    """

    path: FloatArray
    values: Values
    usual: Callable[..., FloatArray]

    def __call__(self, v: FloatArray, values: Values, grids: Grids) -> FloatArray:
        """Return the stored path; for another record or other values, apply the cause."""
        if values == self.values and len(v) == len(self.path):
            return self.path
        return self.usual(v, values, grids)


def held(grids: Grids, model: Extended, ar: FloatArray) -> Extended:
    """Return the model with the weighted mean path in place of the realisations.

    The parameters of that cause are fixed; the others can then be fitted at the usual speed.
    """
    a = drawn(model)
    if a is None or a.cause.draw is None or a is not _first_of_opening(model):
        return model
    _, belief = _believed(grids, model, a, ar)
    rows = np.minimum(np.arange(len(grids.v)) * len(grids.power) // len(grids.v),
                      len(grids.power) - 1)  # fmt: skip
    path = np.zeros(len(grids.v))
    for k in range(a.cause.draws):
        path += belief[k][rows] * a.cause.draw(k)(grids.v, a.values, grids)
    unknowns = tuple(replace(u, kind=Kind.HELD) for u in a.cause.unknowns)
    act = _Path(path, a.values, a.cause.act)
    return model.having(
        replace(a, cause=replace(a.cause, act=act, draws=0, draw=None, unknowns=unknowns))
    )


def free(model: Extended, causes: Mapping[str, Cause]) -> Extended:
    """Return the model with every cause as defined in the catalogue."""
    return replace(
        model, active=tuple(replace(a, cause=causes[a.name]) for a in model.active)
    )  # fmt: skip


def _first_of_opening(model: Extended) -> FittedCause:
    """Return the cause that acts on the measured opening itself."""
    return min(model.at(Stage.OPENING), key=lambda a: a.cause.order)


def _single(a: FittedCause, draw: int) -> FittedCause:
    """Return the cause with one of its noise realisations; ``extra`` holds the number of it."""
    assert a.cause.draw is not None
    return replace(
        a, cause=replace(a.cause, act=a.cause.draw(draw), draws=0), extra=(float(draw),)
    )


def _variance(white: FloatArray) -> float:
    """Return the variance at times when a realisation is right, which is most of the time."""
    squares = white[:, ::_EVERY] ** 2
    return max(float(np.median(np.median(squares, axis=1))) / _OF_NORMAL, 1e-12)


# Of the range of the curve. A value of the curve stays if its standard error would be larger.
_LEAST_KNOWN = 0.02
_LEVEL_STEPS_MW = (6.0, 3.0, 1.5, 0.8, 0.4)
_LINE_SHARES = (1.0, 0.5, 0.25, 0.1, 0.05)
_SLOW_MEANS = 720  # two hours
_LARGEST_SUM = 0.9
_SMALL, _KNOT_STEP = 1e-6, 1e-3


@dataclass(frozen=True, slots=True)
class Task:
    """The inputs of a fit: the record, the rows used, the whitening, the free parameters.

    ``fixed_dynamics`` keeps time constants, delays and levels fixed, as for a given model.
    """

    grids: Grids
    rows: BoolArray
    ar: FloatArray
    fixed_dynamics: bool = False

    def innovations(self, series: FloatArray) -> FloatArray:
        """Return the used rows of a series (m,) or table (m, k), whitened."""
        if series.ndim == 2:
            white = np.empty((int(self.rows.sum()), series.shape[1]))
            kernels.innovations(np.ascontiguousarray(series), self.ar, self.rows, white)
            return white
        out = series.copy()
        for k, a in enumerate(self.ar, start=1):
            out[k:] -= a * series[:-k]
        return np.asarray(out[self.rows])

    def residual(self, model: Extended) -> FloatArray:
        """Return measured minus predicted means in MW, shape (m,); 0 where not scored."""
        if (a := drawn(model)) is not None:
            return believed_residual(self.grids, model, a, self.ar)
        return np.where(self.grids.scored, self.grids.power - answer(self.grids, model), 0.0)

    def cost(self, model: Extended) -> float:
        """Return the sum of squared innovations."""
        e = self.innovations(self.residual(model))
        return float(e @ e)


def whitening(grids: Grids, residual: FloatArray) -> FloatArray:
    """Return AR coefficients of a residual after removing its slow part, shape (4,).

    A misfit that lasts for hours must not be treated as correlation of the noise: whitening
    would remove it, and its cause could not be found.
    """
    weight = grids.open_rows.astype(np.float64)
    kernel = np.ones(min(_SLOW_MEANS, max(1, len(residual) // 4)))
    level = np.convolve(residual * weight, kernel, 'same')
    level /= np.maximum(np.convolve(weight, kernel, 'same'), 1.0)
    ar = fit_ar(
        np.where(weight > 0, residual - level, 0.0), grids.open_rows.astype(np.uint8), ORDER
    )
    total = float(ar.sum())
    return ar * (_LARGEST_SUM / total) if total > _LARGEST_SUM else ar


def base_mask(task: Task, model: Extended) -> BoolArray:
    """Return which packed parameters of curve and dynamics are free."""
    free = free_parameters(model.base)
    if task.fixed_dynamics:
        delays = model.base.delay_places
        free[delays.start - model.base.regions : delays.stop] = False
    elif 'clock' in model.names:
        # Only the delay minus the clock offset is observable, so the shortest delay is fixed.
        free[model.base.delay_places.start + int(np.argmin(model.base.delays))] = False
    return free


def base_tangents(task: Task, model: Extended) -> FloatArray:
    """Return derivatives of the means by the free parameters of curve and dynamics, (m, P).

    The inputs of the curve and the regions of the rows are kept.
    """
    grids, base, regional = task.grids, model.base, model.regional
    driven = drive(grids, model)
    scale, added = driven.scale, np.full(len(driven.u), base.offset)
    if driven.added is not None:
        added += driven.added
    if driven.gain is not None:
        scale, added = scale * driven.gain, added * driven.gain
    late = lags_of(model)
    group = 1 if late else grids.group
    means = len(driven.u) // group
    table = np.empty((means, regional.size))
    nothing = np.zeros(means)

    def stretch(begin: int, first: int, end: int) -> None:
        tangents(
            driven.u, scale, added, grids.usable, nothing, regional.knots, regional.left,
            regional.right, regional.levels, regional.time_constants, regional.delays,
            grids.step_s, 0, group, begin, first, end, np.empty(end - first), table[first:end],
            np.empty(end - first, dtype=np.uint8),
        )  # fmt: skip

    run_in_threads(stretch, stretches(regional, means, group, grids.step_s, 0), cores())
    if late:
        table = means_through(grids, late, table)
    table = _by_base(table, model).take(np.flatnonzero(base_mask(task, model)), axis=1)
    jumps = np.flatnonzero(base.left[1:] != base.right[:-1])
    gain = None if base.offset_mw is None else driven.gain
    if gain is None and not len(jumps):
        return table
    x = flow_of(model, driven)
    path = region_path(model, x)
    if gain is not None:
        table[:, -1] = response(grids, model, gain, path)
    for k in jumps:
        # Rows that a moved knot carries over its jump have no derivative.
        knots, by = base.knots.copy(), _KNOT_STEP * np.ptp(base.knots)
        knots[k + 1] += by
        moved = flow_of(replace(model, base=replace(base, knots=knots)), driven)
        table[:, base.pieces + 1 + k] = response(grids, model, (moved - x) / by, path)
    return table


def _by_base(table: FloatArray, model: Extended) -> FloatArray:
    """Return derivatives by the base, from those by the dynamics that causes made of it."""
    if not model.at(Stage.DYNAMICS):
        return table
    here, packed, columns = model.regional.pack(), model.base.pack(), []
    for p, value in enumerate(packed):
        moved = packed.copy()
        moved[p] += _SMALL * (1.0 + abs(value))
        other = replace(model, base=model.base.unpack(moved)).regional.pack()
        columns.append((other - here) / (moved[p] - value))
    return np.asarray(table @ np.column_stack(columns))


def _slots(model: Extended) -> list[tuple[int, int]]:
    """Return (cause, parameter) of every parameter fitted by Gauss-Newton."""
    return [
        (c, k)
        for c, a in enumerate(model.active)
        for k, u in enumerate(a.cause.unknowns)
        if u.kind in (Kind.SMOOTH, Kind.ROUGH)
    ]


def _shifted(model: Extended, c: int, k: int, by: float) -> Extended:
    a = model.active[c]
    values = list(a.values)
    values[k] += by
    return model.having(replace(a, values=a.cause.clipped(tuple(values))))


def cause_tangents(task: Task, model: Extended) -> FloatArray:
    """Return derivatives of the means by the parameters of the causes, (m, Q)."""
    grids = task.grids
    slots = _slots(model)
    path = region_path(model, flow_of(model, drive(grids, model)))

    def column(slot: tuple[int, int]) -> FloatArray:
        c, k = slot
        stage = model.active[c].cause.stage
        keep = None if stage == Stage.DYNAMICS else path
        h = model.active[c].cause.unknowns[k].step_on(grids)
        up, down = _shifted(model, c, k, h), _shifted(model, c, k, -h)
        width = up.active[c].values[k] - down.active[c].values[k]
        change = answer(grids, up, None, keep) - answer(grids, down, None, keep)
        return np.asarray(change / max(width, 1e-12))

    return np.column_stack([np.empty((len(grids.power), 0)), *each_in_threads(column, slots)])


def level_tangents(task: Task, model: Extended) -> FloatArray:
    """Return derivatives by the levels, where rows may change their region, (m, I - 1)."""
    if task.fixed_dynamics or not len(model.base.levels):
        return np.empty((len(task.grids.power), 0))
    columns = []
    for k in range(len(model.base.levels)):
        up, down = model.base.levels.copy(), model.base.levels.copy()
        up[k], down[k] = up[k] + task.grids.size, down[k] - task.grids.size
        high = answer(task.grids, replace(model, base=model.base.with_levels(up)))
        low = answer(task.grids, replace(model, base=model.base.with_levels(down)))
        columns.append(0.5 * (high - low))
    return np.column_stack(columns)


def levels_along(before: RegionalModel, after: RegionalModel, scale: float = 1.0) -> RegionalModel:
    """Move the levels with the curve, so that the regions change at the same u as before.

    If a level stays while the curve moves by 1 MW, the cost rises more than most causes reduce it.
    If the flow also depends on the pressure, this holds at one pressure with p^e = ``scale``.
    """
    if not len(before.levels) or np.any(before.right <= before.left):
        return after
    x = scale * np.append(before.left, before.right[-1]) + before.offset
    inside = (before.levels > x[0]) & (before.levels < x[-1])
    u = np.interp(before.levels, x, before.knots)
    moved = after.static(u, scale) - before.static(u, scale)
    levels = np.where(inside, before.levels + moved, before.levels)
    return after.with_levels(levels) if np.all(np.diff(levels) > 0.0) else after


def _stepped(task: Task, model: Extended, step: FloatArray) -> Extended:
    """Return the model after a step, within bounds."""
    free = np.flatnonzero(base_mask(task, model))
    packed = model.base.pack()
    packed[free] += step[: len(free)]
    base = within_bounds(model.base, packed, task.grids.step_s)
    scale = float(np.median(task.grids.scale))
    moved = replace(model, base=levels_along(model.base, base, scale))
    for (c, k), by in zip(_slots(model), step[len(free) :], strict=True):
        moved = _shifted(moved, c, k, float(by))
    return moved


def improve(
    task: Task, model: Extended, steps: int, frozen_base: FloatArray | None = None
) -> tuple[Extended, float]:
    """Apply Levenberg-Marquardt to curve, dynamics and causes.

    Parameters
    ----------
    frozen_base : float64 (rows, P), optional
        Whitened tangents of curve and dynamics, kept constant; they change little, and their
        computation takes most of the time.
    """
    frozen_sums = None if frozen_base is None else frozen_base.T @ frozen_base

    def equations(model: Extended) -> tuple[FloatArray, FloatArray]:
        base, sums = frozen_base, frozen_sums
        if base is None or sums is None:
            base = task.innovations(base_tangents(task, model))
            sums = base.T @ base
        causes = task.innovations(cause_tangents(task, model))
        rest, across = task.innovations(task.residual(model)), base.T @ causes
        normal = np.block([[sums, across], [across.T, causes.T @ causes]])
        slope = np.append(base.T @ rest, causes.T @ rest)
        # A piece that only the sealed blocks visit would otherwise become anything.
        error = _LEAST_KNOWN * np.ptp(np.concatenate([model.base.left, model.base.right]))
        known = np.diag(normal)[: model.base.pieces + 1] * error**2 * len(rest)
        unknown = np.flatnonzero(known < rest @ rest)
        normal[unknown], normal[:, unknown], slope[unknown] = 0.0, 0.0, 0.0
        return within_reach(
            model.base, base_mask(task, model), normal, slope, task.grids.step_s
        )  # fmt: skip

    return gauss_newton(
        model, task.cost, equations, lambda m, step: _stepped(task, m, step), steps,
        trials=5, least_gain=1e-6,
    )  # fmt: skip


def search_levels(
    task: Task, model: Extended, cost: float, steps: tuple[float, ...] = _LEVEL_STEPS_MW
) -> tuple[Extended, float]:
    """Adjust each level between regions with a line search."""
    size = task.grids.size

    def moved(model: Extended, level: int, by: float) -> Extended | None:
        base = with_level_moved(model.base, level, by * size, size)
        return None if base is None else replace(model, base=base)

    for k in range(0 if task.fixed_dynamics else len(model.base.levels)):
        for step, sign in itertools.product(steps, (1.0, -1.0)):
            model, cost = descend(model, cost, task.cost, partial(moved, level=k, by=sign * step))
    return model, cost


def _directions(cause: Cause, grids: Grids) -> list[Values]:
    """Return the search directions of parameters of kind ``LINE``: each, and in pairs."""
    lines = [k for k, u in enumerate(cause.unknowns) if u.kind is Kind.LINE]
    out = []
    for k in lines:
        out.append({k: 1.0})
    for k, other in itertools.combinations(lines, 2):
        out += [{k: 1.0, other: 1.0}, {k: 1.0, other: -1.0}]
    return [
        tuple(d.get(k, 0.0) * u.step_on(grids) for k, u in enumerate(cause.unknowns)) for d in out
    ]  # fmt: skip


def _along(model: Extended, c: int, direction: Values, by: float) -> Extended:
    for k, size in enumerate(direction):
        if size:
            model = _shifted(model, c, k, by * size)
    return model


def search_lines(task: Task, model: Extended, cost: float) -> tuple[Extended, float]:
    """Adjust every parameter of kind ``LINE`` with a line search."""
    return _search_lines(task, model, cost, range(len(model.active)))


def _search_lines(
    task: Task, model: Extended, cost: float, causes: Iterable[int]
) -> tuple[Extended, float]:
    for c in causes:
        directions = _directions(model.active[c].cause, task.grids)
        for share in _LINE_SHARES if directions else ():
            for direction, sign in itertools.product(directions, (1.0, -1.0)):
                model, cost = descend(
                    model, cost, task.cost,
                    partial(_along, c=c, direction=direction, by=sign * share),
                )  # fmt: skip
    return model, cost


def search_onsets(task: Task, model: Extended) -> Extended:
    """Adjust the onsets with a line search; everything else stays fixed."""
    dated = [c for c, a in enumerate(model.active) if any(u.dated for u in a.cause.unknowns)]
    return _search_lines(task, model, task.cost(model), dated)[0]


def settle(task: Task, model: Extended, rounds: int, steps: int) -> tuple[Task, Extended, float]:
    """Alternate between parameters, levels, line searches and whitening until convergence."""
    cost = np.inf
    for _ in range(rounds):
        model, cost = improve(task, model, steps)
        model, cost = search_levels(task, model, cost)
        model, cost = search_lines(task, model, cost)
        task = replace(task, ar=whitening(task.grids, task.residual(model)))
    model, cost = improve(task, model, 2)
    return task, model, cost
