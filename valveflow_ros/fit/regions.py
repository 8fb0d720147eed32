"""Find the regions of different dynamics: how many, where, and roughly which."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.fit.problem import Problem, free_parameters, move, search_levels
from valveflow_ros.fit.whitening import ORDER, fit_ar, whitened
from valveflow_ros.records import BoolArray, FloatArray

_GRID_T_S = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0)
_GRID_DELAY_S = (0.0, 4.0, 12.0, 30.0)
_MAX_REGIONS = 3
_CELLS = 60
_LEAST_CELLS = 4
# A further region (T, tau, level) must gain this in log-likelihood; three
# parameters of pure chance gain about 1.5, and the search over levels a few more.
_REGION_GAIN = 15.0


def _first_regions(problem: Problem, model: RegionalModel) -> list[RegionalModel]:
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


def _settle_down(
    problem: Problem, model: RegionalModel, free: BoolArray, rounds: int
) -> tuple[RegionalModel, float, FloatArray]:
    """Alternate between parameters, levels and whitening."""
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
    """Return the least share of rows that a region has."""
    flow = model.static(problem.u[problem.usable > 0])
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
        free = free_parameters(model.pieces, candidate.regions)
        trial, _, ar = _settle_down(problem, candidate, free, rounds=3)
        if best is not None:
            # Judged under one whitening, that of the larger model.
            small, large = problem.cost(best[0], ar), problem.cost(trial, ar)
            residual, weight = problem.answer(trial)
            count = len(whitened(residual, weight, ar))
            if 0.5 * count * np.log(small / max(large, 1e-300)) < _REGION_GAIN:
                break
            if _thinnest(problem, trial) < _LEAST_CELLS / _CELLS:
                break
        best = (trial, ar)
    assert best is not None
    return best
