# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Refine curve, time constants, delays and regions together on all samples.

The special segments give F up to a term that eq. (14) of the paper neglects:
on a ramp the power lags by ``K_f eta_1 (T + tau)``, several MW. So F from the
exact partition is the start. Curve and regional dynamics are then fitted
together by the prediction error on all samples, whitened by an AR model of
the residual (the noise of the power is far from white). The regions are first
found on a grid. Their boundaries are found by line searches, since the cost is
not smooth in them; all other parameters by Levenberg-Marquardt. If rows are
slow, or another curve fits means over ten minutes clearly better, the curve is
fitted to these means.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.fit.kernels import square_sum
from valveflow_ros.fit.piece_selection import (
    choose_pieces,
    confidence,
    find_jumps,
    insert,
    shifted,
    supported_jumps,
)
from valveflow_ros.fit.problem import (
    LEAST_LAG,
    Problem,
    Samples,
    free_parameters,
    move,
    search_levels,
    within_bounds,
)
from valveflow_ros.fit.uncertainty import covariance_of
from valveflow_ros.fit.whitening import ORDER, fit_ar
from valveflow_ros.records import COARSE_STEP_S, BoolArray, ByteArray, FloatArray
from valveflow_ros.signals.static_form import exponents_near

# Correction of the errors of the measured input, which make the plant seem too slow.
#
# Least squares assumes that opening and pressure are exact. The noise of their sensors passes
# through the model but not through the plant, so the fit prefers a model that damps it: time
# constants become a few per cent too long. Simulation and extrapolation (Cook and Stefanski,
# J. Am. Stat. Assoc. 89, 1994) removes this bias: noise of the same size is added again, the fit
# changes by the bias that this noise causes, and this change is subtracted from the first fit.
#
# Values that a historian holds between two stored ones are wrong in another way: exponents of the
# pressure come out too small, by about 0.05. There the bias is the change of the fit to the power
# that the model itself would have stored (indirect inference: Gourieroux, Monfort and Renault,
# J. Appl. Econometrics 8, 1993).

_SEED = 20240229
_LEAST_PAIRS = 1000
_LEAST_DOUBLING = 0.85  # fraction of the expected growth of the movement from two rows to four
_MEDIAN_TO_SD = 0.6744897501960817


def relative_noise(u: FloatArray, usable: ByteArray) -> float:
    """Return the sd of the white noise of ``u``, as a fraction of ``u``.

    A second difference of values one row apart contains the noise and the random movement of the
    valve in one row; of values two rows apart, the same noise and twice the variance of movement.
    Extrapolation to zero rows gives the noise only. Straight ramps cancel in both; medians
    suppress jumps. Too few rows, no noise, or rows slower than the valve give 0.
    """
    run = usable > 0
    if len(u) < _LEAST_PAIRS:
        return 0.0
    good = run[8:] & run[6:-2] & run[5:-3] & run[4:-4] & run[3:-5] & run[2:-6] & run[:-8]
    with np.errstate(divide='ignore', invalid='ignore'):
        level = np.log(np.where(run & (u > 0.0), u, np.nan))
    middle = 2.0 * level[4:-4]
    bends = [(level[4 + k : len(u) - 4 + k] + level[4 - k : len(u) - 4 - k] - middle)[good]
             for k in (1, 2, 4)]  # fmt: skip
    known = np.isfinite(bends[0]) & np.isfinite(bends[1]) & np.isfinite(bends[2])
    if known.sum() < _LEAST_PAIRS:
        return 0.0
    # The median of |x| is 0.6745 sd; a second difference has six times the noise variance.
    one, two, four = ((np.median(np.abs(d[known])) / _MEDIAN_TO_SD) ** 2 for d in bends)
    # If rows are slower than the valve, the movement does not double and would look like noise.
    if two - one > 0.1 * one and four - two < _LEAST_DOUBLING * 2.0 * (two - one):
        return 0.0
    return float(np.sqrt(max(0.0, (2.0 * one - two) / 6.0)))


def corrected(
    samples: Samples, problem: Problem, model: RegionalModel, ar: FloatArray, free: BoolArray
) -> RegionalModel:
    """Remove the bias due to errors of the input; ``model`` has converged on ``problem``.

    The extrapolation is linear.
    """
    again = samples.simulated(model) if samples.held else _noisier(samples)
    if again is None:
        return model
    problem_with_errors = Problem(replace(again, group=problem.samples.group))
    moved, _ = move(problem_with_errors, model, ar, free, 2)
    return within_bounds(model, 2.0 * model.pack() - moved.pack(), problem.samples.step_s)


def _noisier(samples: Samples) -> Samples | None:
    """Return the rows with more of the noise of their input; None if it has none."""
    r = np.random.default_rng(_SEED)

    def more(values: FloatArray) -> FloatArray | None:
        share = relative_noise(values, samples.usable)
        return values * (1.0 + share * r.standard_normal(len(values))) if share else None

    u = more(samples.u)
    scale = None if samples.scale is None else more(samples.scale)
    if u is None and scale is None:
        return None
    return replace(
        samples,
        u=samples.u if u is None else u, scale=samples.scale if scale is None else scale,
    )  # fmt: skip


# Find the regions of different dynamics: number, boundaries, and approximate values.

_GRID_T_S = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0)
_GRID_DELAY_S = (0.0, 4.0, 12.0, 30.0)
_MAX_REGIONS = 3
_CELLS = 60
_LEAST_CELLS = 4
# Required log-likelihood gain of a further region (T, tau, level); by chance three
# parameters gain about 1.5, and the search over levels a few more.
_REGION_GAIN = 15.0


def _first_regions(problem: Problem, model: RegionalModel) -> list[RegionalModel]:
    """Return an initial model for each number of regions, from a grid of (T, tau).

    Each pair is simulated over all rows. Then levels are chosen such that the sum
    of squares is minimal if each range of flow has its own best pair. The
    filter's memory across a level is neglected here.
    """
    shortest = LEAST_LAG * problem.samples.step_s
    pairs = [(max(t, shortest), d) for t in _GRID_T_S for d in _GRID_DELAY_S if d <= t]
    flow = model.static(np.where(problem.usable > 0, problem.u, np.nan), problem.scale)
    flow = flow.reshape(-1, problem.samples.group).mean(axis=1)
    squares = []
    for t, d in pairs:
        one = replace(
            model, levels=np.empty(0), time_constants=np.array([t]), delays=np.array([d])
        )
        residual, weight = problem.answer(one)
        squares.append(np.where(weight > 0, residual**2, 0.0))
    keep = np.isfinite(flow) & (weight > 0)
    edges = np.quantile(flow[keep], np.linspace(0.0, 1.0, _CELLS + 1))
    cell = np.clip(np.searchsorted(edges, flow[keep], side='right') - 1, 0, _CELLS - 1)
    table = np.array([np.bincount(cell, q[keep], minlength=_CELLS) for q in squares])
    sums = np.concatenate([np.zeros((len(pairs), 1)), np.cumsum(table, axis=1)], axis=1)
    starts = []
    for regions in range(1, _MAX_REGIONS + 1):
        cuts = _best_cuts(sums, regions, least=_LEAST_CELLS)
        spans = list(zip([0, *cuts], [*cuts, _CELLS], strict=True))
        best = [pairs[int(np.argmin(sums[:, b] - sums[:, a]))] for a, b in spans]
        starts.append(
            replace(
                model, levels=np.array([edges[c] for c in cuts]),
                time_constants=np.array([t for t, _ in best]),
                delays=np.array([d for _, d in best]),
            )
        )  # fmt: skip
    return starts


def _best_cuts(sums: FloatArray, regions: int, least: int) -> list[int]:
    """Divide the cells into ``regions`` ranges, each with its best pair, at minimal cost."""
    cells = sums.shape[1] - 1
    cost = np.full((regions + 1, cells + 1), np.inf)
    back = np.zeros((regions + 1, cells + 1), dtype=np.int64)
    cost[0, 0] = 0.0
    for r in range(1, regions + 1):
        for end in range(r * least, cells + 1):
            for begin in range((r - 1) * least, end - least + 1):
                value = cost[r - 1, begin] + (sums[:, end] - sums[:, begin]).min()
                if value < cost[r, end]:
                    cost[r, end], back[r, end] = value, begin
    cuts, end = [], cells
    for r in range(regions, 1, -1):
        end = int(back[r, end])
        cuts.append(end)
    return cuts[::-1]


def _settle_down(
    problem: Problem, model: RegionalModel, free: BoolArray, rounds: int
) -> tuple[RegionalModel, float, FloatArray]:
    """Alternate between the fit of parameters, of levels, and of the AR model."""
    ar = np.zeros(ORDER)
    cost = np.inf
    for round_ in range(rounds):
        model, cost = move(problem, model, ar, free, 3)
        model, cost = search_levels(problem, model, ar, cost)
        if round_ < rounds - 1:
            residual, weight = problem.answer(model)
            ar = fit_ar(residual, weight)
    return model, cost, ar


def _thinnest(problem: Problem, model: RegionalModel) -> float:
    """Return the fraction of rows in the smallest region."""
    used = problem.usable > 0
    flow = model.static(problem.u[used], problem.scale[used])
    region = np.searchsorted(model.levels, flow, side='right')
    return float(np.bincount(region, minlength=model.regions).min() / max(len(flow), 1))


def find_regions(problem: Problem, model: RegionalModel) -> tuple[RegionalModel, FloatArray]:
    """Add regions while each gains enough; return the model and the AR of its residual.

    Parameters
    ----------
    problem : Problem
    model : RegionalModel
        A curve without jumps; its dynamics are not used.
    """
    best: tuple[RegionalModel, FloatArray] | None = None
    for candidate in _first_regions(problem, model):
        free = free_parameters(candidate)
        trial, _, ar = _settle_down(problem, candidate, free, rounds=3)
        if best is not None:
            # Both are compared with the whitening of the larger model.
            if problem.gain(best[0], trial, ar) < _REGION_GAIN:
                break
            if _thinnest(problem, trial) < _LEAST_CELLS / _CELLS:
                break
        best = (trial, ar)
    assert best is not None
    return best


_LEAST_ROWS, _LEAST_S = 600, 3600.0
# Memory of the AR model: the sum of white and slow noise needs many coefficients.
_MEMORY_S = 40.0
# Rounds of the search for the exponent of the pressure, its largest step, and the step in standard
# errors that ends it.
_EXPONENT_ROUNDS, _EXPONENT_MOST, _EXPONENT_NEAR = 5, 0.05, 0.2
# An exponent is clearly better if it differs by this many standard errors; at the start of the
# search they contain a misfit and are larger.
_EXPONENT_Z, _EXPONENT_FIRST_Z = 4.0, 1.5
_EXPONENT_FAR = 0.01
_NARROWEST = 0.01  # of the range of u: narrower pieces are joined before the search
# One lag describes fast movements only roughly, and the load controller answers the power within a
# row. If the noise is slow, the fit rests on fast movements, and both bend the curve; means over
# this time are free of that. They contain less about a plant whose fast movements fit as well, so
# they must gain this log-likelihood. The plants 9700 to 9709 of `benchmarks.coverage_study` gained
# 4 at most, over 2 and 5 days. Inside coarse rows the valve moves, and near a breakpoint the mean
# of F is not F of the mean: there long means are always used. Of the intervals of breakpoints of
# plants 36000 to 36029 of `--recording minute`, 94 % contain the truth then, and 79 % without.
_LONG_S, _LONG_GAIN = 600.0, 15.0
# Log-likelihood of a further breakpoint in long means: one of 1278 was missed on the unit 5105 of
# `benchmarks.thermal_study`; at 50 none is added on 40 plants of the paper's kind, 38000 to 38039.
_LONG_KNEE_GAIN = 50.0
_LONG_LEAST_S = 150.0  # in short or interrupted records; shorter means contain fast movements
_LONG_LEAST_MW = 0.03  # the averaged rows are not more exact than this
_LONG_EACH = 10  # at least so many innovations for each parameter,
_LONG_SHARE = 0.75  # and with so much of the rows: gaps cost means


@dataclass(frozen=True, slots=True)
class Refined:
    """The result of a refinement."""

    model: RegionalModel
    # Of the packed parameters, (P, P); block scores allow for correlation beyond the AR model.
    covariance: FloatArray
    level_stderr: FloatArray  # float64 (I - 1,), of the levels between regions, MW
    # True for the free packed parameters, (P,); jumps not supported by the data are not free.
    free: BoolArray
    # Of the residual of the last fit, (k,); its rows are means over 2 s, or single rows.
    ar: FloatArray
    innovation_mw: float  # sd of that residual after whitening
    # Error of the prediction due to the errors of the parameters, root mean square.
    prediction_mw: float
    residual_mw: FloatArray  # (m,), of the means
    weight: ByteArray  # (m,), 1 where it was scored
    row_sd_mw: float  # sd of the residual of single rows
    # Probability of each number of pieces; empty when it was given.
    confidence: dict[int, float] = field(default_factory=dict)
    # Length of the means to which the curve was fitted, 0 if the last fit was to all rows.
    long_s: float = 0.0
    # exponent_moved, exponent_stderr: change of the exponent of the pressure from its start, and
    # its standard error, NaN if it was not free
    exponent_moved: float = 0.0
    exponent_stderr: float = math.nan


def refine(
    samples: Samples, start: RegionalModel, most_pieces: int | None = None,
    exponent: float | None = None,
    usual: float | None = None,
) -> Refined:  # fmt: skip
    """Fit curve and dynamics together, from ``start``'s curve.

    Raises `TooFewSamplesError` if too few rows are far enough after a gap.

    Parameters
    ----------
    samples : Samples
        All rows of the window.
    start : RegionalModel
        The curve of the exact partition; its dynamics are not used.
    most_pieces : int, optional
        Choose also the number of pieces, up to this maximum. ``start`` should then have too many
        pieces rather than too few: the AR model takes the misfit of a too simple curve for noise.
        By default the number of ``start`` is kept, except that pieces narrower than a hundredth
        of the range are joined with others.
    exponent : float, optional
        Start of the exponent of the pressure if it is free.
    usual : float, optional
        An exponent that is taken unless another one is clearly better.

    Returns
    -------
    Refined
    """
    model, likely, moved, fitted = _outlined(samples, start, most_pieces, exponent, usual)
    limits = (0.0, 0.0) if exponent is None else _changes_allowed(exponent)
    samples = samples.with_exponent(moved)
    problem = Problem(samples)
    searched = model.pieces
    fine = Problem(samples.finer())
    order = int(np.clip(round(_MEMORY_S / (fine.samples.step_s * fine.samples.group)), ORDER, 20))
    free = free_parameters(model)
    for steps in (2, 3):
        residual, weight = fine.answer(model)
        ar = fit_ar(residual, weight, order)
        model, cost = move(fine, model, ar, free, steps)
        model, cost = search_levels(fine, model, ar, cost)
    model, cost = move(fine, model, ar, free, 3)
    if most_pieces is None:
        jumps = supported_jumps(fine, model, ar)
    else:
        model, jumps, cost = find_jumps(fine, model, ar, cost)
    free = free_parameters(model, jumps)
    if jumps.any():
        model, cost = move(fine, model, ar, free, 4)
    model = corrected(samples, fine, model, ar, free)
    long = _long_means(samples, fine, model, free)
    if long is not None:
        if fitted:
            curve, within = _of_curve(model, free), (limits[0] - moved, limits[1] - moved)
            model, by, fitted = _with_exponent(
                long, model, within, curve, _change_to(usual, exponent, moved)
            )
            long = long.with_exponent(by)
            moved, samples = moved + by, samples.with_exponent(by)
            problem, fine = Problem(samples), Problem(samples.finer())
        model = _fitted_to(long, model, free)
        if most_pieces is not None and not jumps.any():
            model = _with_more_pieces(long, model, most_pieces)
            free = free_parameters(model)
    found = _conclude(problem, fine, model, free, ar, fitted, long)
    return replace(
        found, confidence=shifted(likely, model.pieces - searched), exponent_moved=moved
    )


def _long_means(
    samples: Samples, fine: Problem, model: RegionalModel, free: BoolArray
) -> Samples | None:
    """Return the rows as long means, if there are enough and another curve fits them better."""
    rows = int(fine.answer(model)[1].sum()) * fine.samples.group * fine.samples.step_s
    if samples.held:
        return None  # values that a historian holds are wrong for minutes
    must = samples.step_s >= COARSE_STEP_S
    length = _LONG_S
    while length >= max(_LONG_LEAST_S, 2.0 * samples.step_s):
        long = samples.slower(length)
        problem = Problem(long)
        before, weight = problem.answer(model)
        ar = fit_ar(before, weight)
        means = int(square_sum(before, weight, ar)[1])
        if means >= _LONG_EACH * free.sum() and means * length >= _LONG_SHARE * rows:
            trial, _ = move(problem, model, ar, _of_curve(model, free), 3)
            change = (problem.answer(trial)[0] - before)[weight > 0]
            other = np.sqrt(np.mean(change**2)) > _LONG_LEAST_MW * problem.size
            better = other and problem.gain(model, trial, ar) > _LONG_GAIN
            return long if must or better else None
        length /= 2.0
    return None


def _fitted_to(long: Samples, model: RegionalModel, free: BoolArray) -> RegionalModel:
    """Fit the curve to long means."""
    problem = Problem(long)
    for _ in range(2):
        model, _ = move(problem, model, fit_ar(*problem.answer(model)), _of_curve(model, free), 3)
    return model


def _with_more_pieces(long: Samples, model: RegionalModel, most: int) -> RegionalModel:
    """Add breakpoints that long means show clearly and fast movements did not; no jumps."""
    problem = Problem(long)
    ar = fit_ar(*problem.answer(model))
    while model.pieces < most:
        trials = []
        for place in 0.5 * (model.knots[:-1] + model.knots[1:]):
            trial = insert(model, float(place))
            curve = _of_curve(trial, free_parameters(trial))
            trials.append(move(problem, trial, ar, curve, 12)[0])
        best = min(trials, key=lambda m: problem.cost(m, ar))
        if problem.gain(model, best, ar) < _LONG_KNEE_GAIN:
            break
        model = best
    return model


def _of_curve(model: RegionalModel, free: BoolArray) -> BoolArray:
    """Return the free parameters without those of the dynamics."""
    curve = free.copy()
    curve[model.dynamic_places] = False
    return curve


def search(
    samples: Samples,
    start: RegionalModel,
    most_pieces: int | None,
    exponent: float | None = None,
    usual: float | None = None,
) -> tuple[RegionalModel, float]:
    """Find regions and pieces on averaged rows: `refine` without its last fit.

    Return the model, and the change of the exponent of the pressure. Raises `TooFewSamplesError`
    as `refine` does.
    """
    model, _, moved, _ = _outlined(samples, start, most_pieces, exponent, usual)
    return model, moved


def _outlined(
    samples: Samples,
    start: RegionalModel,
    most_pieces: int | None,
    exponent: float | None,
    usual: float | None,
) -> tuple[RegionalModel, dict[int, float], float, bool]:
    """Search on coarse rows, if there are enough of them; tell if the exponent was fitted."""
    _, weight = Problem(samples).answer(
        replace(start, levels=np.empty(0), time_constants=np.ones(1), delays=np.zeros(1))
    )
    rows, least = int(weight.sum()) * samples.group, least_rows(samples.step_s)
    if rows < least:
        raise TooFewSamplesError(
            'Rows that follow each other for longer than the transient', rows, least
        )
    coarse = samples.coarser()
    model, likely = _search(Problem(coarse), _join(start), most_pieces)
    if exponent is None or samples.pressure_mpa is None:
        return model, likely, 0.0, False
    parameters = int(free_parameters(model).sum())
    slow = (
        samples.step_s >= COARSE_STEP_S and not samples.held
        and rows * samples.step_s >= _LONG_EACH * parameters * _LONG_S
    )  # fmt: skip
    model, moved, fitted = _with_exponent(
        samples.slower(_LONG_S) if slow else coarse,
        model,
        _changes_allowed(exponent),
        free_parameters(model),
        _change_to(usual, exponent, 0.0),
    )
    if fitted and samples.held:
        model, moved = _without_hold(samples, model, moved, _changes_allowed(exponent))
    if samples.scale is None and abs(moved) > _EXPONENT_FAR:
        # The pieces of a curve with another exponent may be others.
        begin = coarse.model_with_exponent(_join(start), moved)
        model, likely = _search(Problem(coarse.with_exponent(moved)), begin, most_pieces)
    return model, likely, moved, fitted


def _with_exponent(
    rows: Samples, model: RegionalModel, limits: tuple[float, float], free: BoolArray,
    usual: float | None = None,
) -> tuple[RegionalModel, float, bool]:  # fmt: skip
    """Return a model with the exponent that fits best, and the change of it within ``limits``.

    ``usual`` is a change that is taken unless another one is clearly better. The last value tells
    if the change was fitted.
    """
    start = model
    by = wanted = 0.0
    error = math.nan
    for _ in range(_EXPONENT_ROUNDS):
        problem = Problem(rows.with_exponent(by))
        ar = fit_ar(*problem.answer(model))
        found = covariance_of(problem, model, free, ar, final=False, exponent=True)
        step, error = found.step, found.exponent_stderr
        wanted = by if step is None else by + float(step[-1])  # perhaps beyond the limits
        if step is None or abs(step[-1]) < _EXPONENT_NEAR * error:
            break
        if usual == by == 0.0 and abs(step[-1]) < _EXPONENT_FIRST_Z * error:
            break
        trial = float(np.clip(by + np.clip(step[-1], -_EXPONENT_MOST, _EXPONENT_MOST), *limits))
        # Exponent, curve and c are nearly interchangeable: damped steps would move them apart.
        share = (trial - by) / step[-1]
        change = share * step[: model.size]
        change[model.dynamic_places] = 0.0
        moved = within_bounds(model, model.pack() + change, rows.step_s)
        model = rows.model_with_exponent(moved, trial - by)
        model, _ = move(Problem(rows.with_exponent(trial)), model, ar, free, 3)
        by = trial
    if usual is None or abs(wanted - usual) > _EXPONENT_Z * error:
        return model, by, True
    return (rows.model_with_exponent(model, usual - by) if usual else start), usual, False


def _without_hold(
    samples: Samples, model: RegionalModel, moved: float, limits: tuple[float, float]
) -> tuple[RegionalModel, float]:
    """Remove the bias of held rows from a model and from the change of its exponent."""
    rows = samples.with_exponent(moved).simulated(model).coarser()
    within = limits[0] - moved, limits[1] - moved
    other, bias, _ = _with_exponent(rows, model, within, free_parameters(model))
    by = float(np.clip(-bias, *within))
    other = rows.model_with_exponent(other, -bias)
    trial = within_bounds(model, 2.0 * model.pack() - other.pack(), rows.step_s)
    return rows.model_with_exponent(trial, by), moved + by


def _change_to(usual: float | None, exponent: float | None, moved: float) -> float | None:
    """Return the change of a moved exponent that leads to the usual one."""
    return None if usual is None or exponent is None else usual - exponent - moved


def _changes_allowed(exponent: float) -> tuple[float, float]:
    """Return the lowest and highest change of an exponent from its start."""
    low, high = exponents_near(exponent)
    return low - exponent, high - exponent


def least_rows(step_s: float) -> int:
    """Return the number of rows that a refinement needs: one hour, and at least `_LEAST_ROWS`."""
    return max(_LEAST_ROWS, round(_LEAST_S / step_s))


def _search(
    problem: Problem, start: RegionalModel, most_pieces: int | None
) -> tuple[RegionalModel, dict[int, float]]:
    """Find regions and, on request, the number of pieces with the probability of each number."""
    model, ar = find_regions(problem, start)
    if most_pieces is None:
        return model, {}
    grown = choose_pieces(problem, model, ar, most_pieces)
    return grown.model, confidence(grown.worth, most_pieces)


def _join(model: RegionalModel) -> RegionalModel:
    """Close the jumps of a curve, and remove knots that are too close to others to be moved.

    At each inner knot both ends take their mean. The exact partition may make a
    piece of very few samples.
    """
    values = np.concatenate(
        [model.left[:1], 0.5 * (model.right[:-1] + model.left[1:]), model.right[-1:]]
    )
    least = _NARROWEST * (model.knots[-1] - model.knots[0])
    keep = [0]
    for k in range(1, len(model.knots) - 1):
        if model.knots[k] - model.knots[keep[-1]] >= least <= model.knots[-1] - model.knots[k]:
            keep.append(k)
    keep.append(len(model.knots) - 1)
    return replace(
        model, knots=model.knots[keep], left=values[keep][:-1], right=values[keep][1:]
    )  # fmt: skip


def _conclude(
    problem: Problem, fine: Problem, model: RegionalModel, free: BoolArray, ar: FloatArray,
    exponent: bool, long: Samples | None,
) -> Refined:  # fmt: skip
    """Add the residual and the uncertainty of the parameters."""
    certainty = covariance_of(fine, model, free, ar, exponent=exponent)
    if long is not None:
        slow, curve = Problem(long), _of_curve(model, free)
        own = covariance_of(slow, model, curve, fit_ar(*slow.answer(model)), exponent=exponent)
        covariance, dynamic = own.covariance.copy(), model.dynamic_places
        covariance[dynamic, dynamic] = certainty.covariance[dynamic, dynamic]
        certainty = replace(
            certainty, covariance=covariance, prediction_mw=own.prediction_mw,
            exponent_stderr=own.exponent_stderr,
        )  # fmt: skip
    residual, weight = problem.answer(model)
    return Refined(
        model, certainty.covariance, certainty.level_stderr, free, ar, certainty.innovation_mw,
        certainty.prediction_mw, residual, weight, _row_sd(fine, model),
        long_s=0.0 if long is None else long.group * long.step_s,
        exponent_stderr=certainty.exponent_stderr,
    )  # fmt: skip


def _row_sd(problem: Problem, model: RegionalModel) -> float:
    """Return the sd of the residual of single rows, MW."""
    residual, weight = Problem(replace(problem.samples, group=1)).answer(model)
    return float(np.std(residual[weight > 0]))
