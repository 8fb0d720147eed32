"""Jumps of the curve: pieces are joined unless the data say otherwise.

A continuous curve imitates a jump by a short steep piece. So each short piece is held against a
jump in its place, which has one parameter less. Where a jump stands the cost is not smooth in the
knot's place, which is therefore searched along a line with both neighbouring lines held.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.fit.problem import Problem, free_parameters, move
from valveflow_ros.records import BoolArray, FloatArray

_SHORT = 0.06  # of the range of u
_STEPS = (0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)  # of the range of u
# A short piece may be this much better in log-likelihood before a jump is refused; its further
# parameter gains half of one by chance, and the search for the place about one.
_ALLOWANCE = 2.0
_JUMP_WALD = 20.0


def find_jumps(
    problem: Problem, model: RegionalModel, ar: FloatArray, cost: float
) -> tuple[RegionalModel, BoolArray, float]:
    """Replace short pieces by jumps where those do as well.

    Parameters
    ----------
    problem : Problem
    model : RegionalModel
        Continuous and converged.
    ar : float64 (k,)
    cost : float
        Sum of squared innovations of ``model``.

    Returns
    -------
    model : RegionalModel
    jumps : bool (J - 1,)
        Which inner knots have one.
    cost : float
    """
    jumps = np.zeros(model.pieces - 1, dtype=bool)
    rows = max(1, int(problem.answer(model)[1].sum()))
    piece = 1
    while piece < model.pieces - 1:
        if np.diff(model.knots)[piece] < _SHORT * (model.knots[-1] - model.knots[0]):
            places = np.delete(jumps, piece)
            places[piece - 1] = True
            trial, value = _settle(problem, _collapsed(model, piece), places, ar, piece - 1)
            better = 0.5 * rows * np.log(max(value, 1e-300) / max(cost, 1e-300)) < _ALLOWANCE
            if better and _wald(problem, trial, ar)[piece - 1] > _JUMP_WALD:
                model, jumps, cost = trial, places, value
                continue
        piece += 1
    return model, jumps, cost


def supported_jumps(problem: Problem, model: RegionalModel, ar: FloatArray) -> BoolArray:
    """Tell which inner knots have a jump that the data ask for, shape (J - 1,)."""
    return np.asarray(_wald(problem, model, ar) > _JUMP_WALD)


def _wald(problem: Problem, model: RegionalModel, ar: FloatArray) -> FloatArray:
    """Return the Wald statistic of a jump at each inner knot, shape (J - 1,).

    The jump that stands there counts, and what the joint regression would add to it.
    """
    sums, rows = problem.normal(model, ar)
    used = np.append(np.diag(sums)[:-1] > 0.0, False)
    inverse = np.linalg.pinv(sums[np.ix_(used, used)])
    step = np.zeros(len(used) - 1)
    variance = np.full(len(used) - 1, np.inf)
    step[used[:-1]] = inverse @ sums[used, -1]
    variance[used[:-1]] = np.diag(inverse) * sums[-1, -1] / max(rows, 1)
    places = slice(2 * model.pieces, 3 * model.pieces - 1)
    jump = model.left[1:] - model.right[:-1] + step[places]
    return np.asarray(jump**2 / variance[places])


def _collapsed(model: RegionalModel, piece: int) -> RegionalModel:
    """Take an inner piece out; its neighbours go on to its middle."""
    middle = 0.5 * (model.knots[piece] + model.knots[piece + 1])
    slopes, intercepts = model.slopes(), model.intercepts()
    left, right = np.delete(model.left, piece), np.delete(model.right, piece)
    right[piece - 1] = slopes[piece - 1] * middle + intercepts[piece - 1]
    left[piece] = slopes[piece + 1] * middle + intercepts[piece + 1]
    knots = np.delete(model.knots, piece)
    knots[piece] = middle
    return replace(model, knots=knots, left=left, right=right)


def _settle(
    problem: Problem, model: RegionalModel, jumps: BoolArray, ar: FloatArray, knot: int
) -> tuple[RegionalModel, float]:
    """Alternate between the knot's place and everything else."""
    free = free_parameters(model.pieces, model.regions, jumps)
    free[model.pieces + 1 :][: model.pieces - 1][jumps] = False
    cost = problem.cost(model, ar)
    for _ in range(3):
        model, cost = _search_place(problem, model, ar, cost, knot)
        model, cost = move(problem, model, ar, free, 4)
    return model, cost


def _search_place(
    problem: Problem, model: RegionalModel, ar: FloatArray, cost: float, knot: int
) -> tuple[RegionalModel, float]:
    """Move an inner knot along its lines while the cost falls."""
    span = model.knots[-1] - model.knots[0]
    for share in _STEPS:
        for step in (share * span, -share * span):
            while True:
                trial = _moved(model, knot, step)
                if np.any(np.diff(trial.knots) <= 0.004 * span):
                    break
                value = problem.cost(trial, ar)
                if not value < cost:
                    break
                model, cost = trial, value
    return model, cost


def _moved(model: RegionalModel, knot: int, step: float) -> RegionalModel:
    """Move an inner knot, the lines on both sides of it held."""
    slopes = model.slopes()
    knots, left, right = model.knots.copy(), model.left.copy(), model.right.copy()
    knots[knot + 1] += step
    right[knot] += slopes[knot] * step
    left[knot + 1] += slopes[knot + 1] * step
    return replace(model, knots=knots, left=left, right=right)
