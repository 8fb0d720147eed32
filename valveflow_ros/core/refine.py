"""Refine curve, time constants, delays and regions together on all samples.

The special segments give F up to a term that eq. (14) of the paper drops:
on a ramp the power lags by ``K_f eta_1 (T + tau)``, several MW. So F from the
exact partition is the start, and curve and regional dynamics are then fitted
together by the prediction error on all samples, whitened by an AR model of
the residual (the noise of the power is far from white). The regions are found
first on a grid; their boundary is searched along a line, since the cost is
not smooth in it; everything else moves by Levenberg-Marquardt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.core import regional_kernel as kernel
from valveflow_ros.core.model import RegionalModel
from valveflow_ros.core.whitening import ORDER, fit_ar, whitened
from valveflow_ros.records import ByteArray, FloatArray

_GRID_T_S = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0)
_GRID_DELAY_S = (0.0, 4.0, 12.0, 30.0)
_LEVEL_STEPS_MW = (6.0, 3.0, 1.5, 0.8, 0.4)
_MAX_REGIONS = 3
# A further region (T, tau, level) must gain this in log-likelihood; three
# parameters of pure chance gain about 1.5, and the search over levels a few more.
_REGION_GAIN = 15.0
_JUMP_WALD = 20.0


@dataclass(frozen=True, slots=True)
class Samples:
    """All rows of the window, as the model needs them.

    Attributes
    ----------
    u, power_mw : float64 (n,)
    usable : uint8 (n,)
        0 where a row has no data; a gap restarts the filters.
    step_s : float
    settle_s : float
        Rows this long after a gap are not scored.
    group : int
        Rows averaged before scoring.
    """

    u: FloatArray
    power_mw: FloatArray
    usable: ByteArray
    step_s: float
    settle_s: float
    group: int

    @property
    def means(self) -> int:
        """Return the number of scored means."""
        return len(self.u) // self.group


@dataclass(frozen=True, slots=True)
class Refined:
    """The outcome.

    Attributes
    ----------
    model : RegionalModel
    covariance : float64 (P, P)
        Of the packed parameters, robust against what the AR model leaves (block scores).
    free : bool (P,)
        Which packed parameters were free; jumps not supported by the data are not.
    ar : float64 (4,)
    innovation_mw : float
        sd of the whitened residual of the means.
    residual_mw : float64 (m,), weight : uint8 (m,)
        Residual of the means and whether it was scored.
    """

    model: RegionalModel
    covariance: FloatArray
    free: FloatArray
    ar: FloatArray
    innovation_mw: float
    residual_mw: FloatArray
    weight: ByteArray


class _Problem:
    """Measured means, and what a model makes of them."""

    def __init__(self, samples: Samples) -> None:
        self.samples = samples
        m = samples.means
        cut = m * samples.group
        self.settle = round(samples.settle_s / samples.step_s)
        self.u = np.ascontiguousarray(samples.u[:cut])
        self.usable = np.ascontiguousarray(samples.usable[:cut])
        power = np.where(self.usable > 0, samples.power_mw[:cut], 0.0)
        self.power = power.reshape(m, samples.group).mean(axis=1)

    def answer(self, model: RegionalModel) -> tuple[FloatArray, ByteArray]:
        """Return residual means (m,) and their weight."""
        s = self.samples
        prediction = np.empty(len(self.u))
        settled = np.empty(len(self.u), dtype=np.uint8)
        x = model.static(np.where(self.usable > 0, self.u, 0.0))
        kernel.respond(
            x, self.usable, model.levels, model.decays(s.step_s), model.delays / s.step_s,
            self.settle, prediction, settled,
        )  # fmt: skip
        weight = settled.reshape(-1, s.group).all(axis=1).astype(np.uint8)
        means = np.where(np.isfinite(prediction), prediction, 0.0).reshape(-1, s.group).mean(axis=1)
        return np.where(weight > 0, self.power - means, 0.0), weight

    def tangents(self, model: RegionalModel) -> tuple[FloatArray, FloatArray, ByteArray]:
        """Return residual (m,), Jacobian of the prediction (m, P) and weight (m,)."""
        s = self.samples
        m = s.means
        answer = np.empty(m)
        jacobian = np.empty((m, 3 * model.pieces - 1 + 2 * model.regions))
        weight = np.empty(m, dtype=np.uint8)
        kernel.tangents(
            self.u, self.usable, model.knots, model.left, model.right, model.levels,
            model.time_constants, model.delays, s.step_s, self.settle, s.group,
            answer, jacobian, weight,
        )  # fmt: skip
        return np.where(weight > 0, self.power - answer, 0.0), jacobian, weight

    def cost(self, model: RegionalModel, ar: FloatArray) -> float:
        """Return the sum of squared innovations."""
        residual, weight = self.answer(model)
        e = whitened(residual, weight, ar)
        return float((e * e).sum())


def _first_regions(problem: _Problem, model: RegionalModel) -> list[RegionalModel]:
    """Return a start for each number of regions, from a grid of (T, tau).

    Each pair is run over everything; then levels are chosen so that the sum of
    squares is least when each stretch of flow takes its own best pair. The
    filter's memory across a level is neglected here.
    """
    pairs = [(t, d) for t in _GRID_T_S for d in _GRID_DELAY_S if d <= t]
    flow = model.static(np.where(problem.usable > 0, problem.u, np.nan))
    flow = flow.reshape(-1, problem.samples.group).mean(axis=1)
    squares = []
    for t, d in pairs:
        one = replace(
            model, levels=np.empty(0), time_constants=np.array([t]), delays=np.array([d])
        )
        residual, weight = problem.answer(one)
        squares.append(np.where(weight > 0, residual**2, 0.0))
    keep = np.isfinite(flow) & (weight > 0)
    edges = np.quantile(flow[keep], np.linspace(0.0, 1.0, 61))
    cell = np.clip(np.searchsorted(edges, flow[keep], side='right') - 1, 0, 59)
    table = np.array([np.bincount(cell, q[keep], minlength=60) for q in squares])
    sums = np.concatenate([np.zeros((len(pairs), 1)), np.cumsum(table, axis=1)], axis=1)
    starts = []
    for regions in range(1, _MAX_REGIONS + 1):
        cuts = _best_cuts(sums, regions, least=4)
        spans = list(zip([0, *cuts], [*cuts, 60], strict=True))
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
    """Cut the cells into ``regions`` stretches, each with its best pair; least cost."""
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


def _in_bounds(model: RegionalModel, samples: Samples) -> bool:
    """Tell whether a model is one a plant can have and a filter can run."""
    span = model.knots[-1] - model.knots[0]
    return bool(
        np.all(np.diff(model.knots) > 0.004 * span)
        and np.all(model.time_constants >= 0.1 * samples.step_s)
        and np.all(model.time_constants <= 3600.0)
        and np.all(model.delays >= 0.0)
        and np.all(model.delays <= 600.0)
    )


def _move(
    problem: _Problem, model: RegionalModel, ar: FloatArray, free: FloatArray, steps: int
) -> tuple[RegionalModel, float]:
    """Levenberg-Marquardt in the free parameters, levels held."""
    damping = 1e-4
    cost = problem.cost(model, ar)
    for _ in range(steps):
        residual, jacobian, weight = problem.tangents(model)
        both = whitened(np.column_stack([jacobian[:, free], residual]), weight, ar)
        j, e = both[:, :-1], both[:, -1]
        normal, slope = j.T @ j, j.T @ e
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-12 * np.diag(normal).max()))
        normal = normal / np.outer(scale, scale)
        better = None
        for _ in range(6):
            step = np.linalg.solve(
                normal + damping * np.eye(len(scale)), slope / scale
            ) / scale  # fmt: skip
            packed = model.pack()
            packed[free] += step
            n_delays = model.regions
            packed[-n_delays:] = np.maximum(packed[-n_delays:], 0.0)
            trial = model.unpack(packed)
            if _in_bounds(trial, problem.samples):
                value = problem.cost(trial, ar)
                if value < cost:
                    better = (trial, value)
                    break
            damping *= 10.0
        if better is None:
            break
        gain = cost - better[1]
        model, cost = better
        damping = max(damping / 10.0, 1e-8)
        if gain < 1e-7 * cost:
            break
    return model, cost


def _search_levels(
    problem: _Problem, model: RegionalModel, ar: FloatArray, cost: float
) -> tuple[RegionalModel, float]:
    """Move each level along a line, the step shrinking, while the cost falls."""
    for k in range(len(model.levels)):
        for step in _LEVEL_STEPS_MW:
            for sign in (1.0, -1.0):
                while True:
                    levels = model.levels.copy()
                    levels[k] += sign * step
                    if np.any(np.diff(levels) <= 1.0):
                        break
                    trial = model.with_levels(levels)
                    value = problem.cost(trial, ar)
                    if value >= cost:
                        break
                    model, cost = trial, value
    return model, cost


def _settle_down(
    problem: _Problem, model: RegionalModel, free: FloatArray, rounds: int
) -> tuple[RegionalModel, float, FloatArray]:
    """Alternate between parameters, levels and whitening."""
    ar = np.zeros(ORDER)
    cost = np.inf
    for round_ in range(rounds):
        model, cost = _move(problem, model, ar, free, 3)
        model, cost = _search_levels(problem, model, ar, cost)
        if round_ < rounds - 1:
            residual, weight = problem.answer(model)
            ar = fit_ar(residual, weight)
    return model, cost, ar


def refine(samples: Samples, start: RegionalModel) -> Refined:
    """Fit curve and dynamics together, from ``start``'s curve.

    Parameters
    ----------
    samples : Samples
        All rows of the window.
    start : RegionalModel
        The curve of the exact partition; its dynamics are not used.

    Returns
    -------
    Refined
    """
    problem = _Problem(samples)
    joined = _join(start)
    free = _free(joined.pieces, 1, jumps=np.zeros(joined.pieces - 1, dtype=bool))
    best: tuple[RegionalModel, float, FloatArray] | None = None
    for candidate in _first_regions(problem, joined):
        free = _free(joined.pieces, candidate.regions, np.zeros(joined.pieces - 1, dtype=bool))
        model, _, ar = _settle_down(problem, candidate, free, rounds=3)
        if best is not None:
            # Judged under one whitening, that of the larger model.
            small, large = problem.cost(best[0], ar), problem.cost(model, ar)
            residual, weight = problem.answer(model)
            count = len(whitened(residual, weight, ar))
            if 0.5 * count * np.log(small / large) < _REGION_GAIN:
                break
        best = (model, 0.0, ar)
    assert best is not None
    model, _, ar = best
    free = _free(model.pieces, model.regions, _jumps_supported(problem, model, ar))
    model, cost = _move(problem, model, ar, free, 6)
    model, cost = _search_levels(problem, model, ar, cost)
    model, cost = _move(problem, model, ar, free, 6)
    return _conclude(problem, model, free, ar)


def _join(model: RegionalModel) -> RegionalModel:
    """Close the jumps of a curve: at each inner knot both ends take their mean."""
    middle = 0.5 * (model.right[:-1] + model.left[1:])
    return replace(
        model,
        left=np.append(model.left[0], middle),
        right=np.append(middle, model.right[-1]),
    )


def _free(pieces: int, regions: int, jumps: FloatArray) -> FloatArray:
    """Return the mask of free parameters in packed order."""
    return np.concatenate(
        [np.ones(2 * pieces, dtype=bool), jumps, np.ones(2 * regions, dtype=bool)]
    )


def _jumps_supported(problem: _Problem, model: RegionalModel, ar: FloatArray) -> FloatArray:
    """Test each inner knot for a jump by its Wald statistic in the joint regression."""
    residual, jacobian, weight = problem.tangents(model)
    both = whitened(np.column_stack([jacobian, residual]), weight, ar)
    j, e = both[:, :-1], both[:, -1]
    used = np.linalg.norm(j, axis=0) > 0.0
    inverse = np.linalg.pinv(j[:, used].T @ j[:, used])
    step = np.zeros(j.shape[1])
    variance = np.full(j.shape[1], np.inf)
    step[used] = inverse @ (j[:, used].T @ e)
    variance[used] = np.diag(inverse) * float(e @ e) / max(len(e), 1)
    places = slice(2 * model.pieces, 3 * model.pieces - 1)
    return np.asarray(step[places] ** 2 / variance[places] > _JUMP_WALD)


def _conclude(
    problem: _Problem, model: RegionalModel, free: FloatArray, ar: FloatArray
) -> Refined:
    """Form the covariance: inverse normal matrix, widened by block scores."""
    residual, jacobian, weight = problem.tangents(model)
    both = whitened(np.column_stack([jacobian[:, free], residual]), weight, ar)
    j, e = both[:, :-1], both[:, -1]
    inverse = np.linalg.pinv(j.T @ j)
    variance = float(e @ e) / max(len(e) - j.shape[1], 1)
    blocks = max(1, min(60, len(e) // 50))
    scores = np.array([s.sum(axis=0) for s in np.array_split(j * e[:, None], blocks)])
    robust = inverse @ (scores.T @ scores) @ inverse
    plain = inverse * variance
    # Few blocks make the robust form noisy; it may widen, never narrow.
    widen = np.sqrt(np.maximum(1.0, np.diag(robust) / np.maximum(np.diag(plain), 1e-300)))
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(free, free)] = plain * np.outer(widen, widen)
    return Refined(model, covariance, free, ar, float(np.sqrt(variance)), residual, weight)
