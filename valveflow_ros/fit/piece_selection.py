# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Choice of the number of pieces from the whitened prediction error.

Eq. (24) of the paper uses the costs of the static fit only: it cannot return
one piece, and one strong breakpoint hides weak ones. With dynamics and an AR
model of the noise, the gain of a further breakpoint can be tested: its hinge
is filtered by the dynamics, whitened, made orthogonal to the model's tangents,
and correlated with the innovations. Breakpoints are added while the best one
gains enough log-likelihood after a full refit. They are removed while the loss
by removing the weakest one is small.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.fit.descent import descend
from valveflow_ros.fit.problem import CLOSEST_KNOTS, Problem, free_parameters, move
from valveflow_ros.fit.uncertainty import bend_certainty
from valveflow_ros.fit.whitening import whitened
from valveflow_ros.numerics import gram, product
from valveflow_ros.records import BoolArray, FloatArray

# Required log-likelihood gain of a breakpoint. It has two parameters and is searched along u;
# by chance the best of such a search gains 3 or 4, once in a thousand about 9.
KNEE_GAIN = 12.0
_SURE = 1e3  # upper limit of the gain, to avoid overflow
# Factor of the log-likelihood in the probabilities: a breakpoint may exist although the data
# hardly show it. Chosen on 66 random units of one to four days, of which 81 % were right;
# `benchmarks.coverage_study` tests it on others.
_ODDS_EXPONENT = 0.2
_CANDIDATES = 30
_BLOCKS = 60


@dataclass(frozen=True, slots=True)
class ChosenPieces:
    """A model with its number of pieces chosen."""

    model: RegionalModel
    # The gain in log-likelihood by the J-th piece, for each J from 2 on, with the robust variance;
    # the largest J is one more than the model's pieces if that was tried.
    worth: dict[int, float]


def insert(model: RegionalModel, knot: float) -> RegionalModel:
    """Add a knot without changing the curve."""
    k = int(np.clip(np.searchsorted(model.knots, knot) - 1, 0, model.pieces - 1))
    value = float(model.shape(np.array([knot]))[0])
    return replace(
        model,
        knots=np.insert(model.knots, k + 1, knot),
        left=np.insert(model.left, k + 1, value),
        right=np.insert(model.right, k, value),
    )


def _remove(model: RegionalModel, inner: int) -> RegionalModel:
    """Remove the inner knot number ``inner`` (from 0); its two pieces become one."""
    return replace(
        model,
        knots=np.delete(model.knots, inner + 1),
        left=np.delete(model.left, inner + 1),
        right=np.delete(model.right, inner),
    )


def _candidates(problem: Problem, model: RegionalModel) -> FloatArray:
    """Return candidate breakpoints: quantiles and a uniform grid, away from knots and ends."""
    u = problem.u[problem.usable > 0]
    spread = np.quantile(u, np.linspace(0.02, 0.98, _CANDIDATES // 2))
    even = np.linspace(spread[0], spread[-1], _CANDIDATES // 2)
    places = np.unique(np.concatenate([spread, even]))
    low, high = model.knots[0], model.knots[-1]
    distance = np.abs(places[:, None] - model.knots[None, :]).min(axis=1)
    away = (distance > 0.02 * (high - low)) & (places > low) & (places < high)
    return np.asarray(places[away])


def _best_knee(problem: Problem, model: RegionalModel, ar: FloatArray) -> tuple[float, float]:
    """Return the best position of a further breakpoint and its gain by the score test."""
    places = _candidates(problem, model)
    if not len(places):
        return float('nan'), 0.0
    dense = model
    for place in places:
        dense = insert(dense, float(place))
    _, hats, _ = problem.tangents(dense)
    hats = hats[:, : dense.pieces + 1]
    hinges = product(
        np.ascontiguousarray(hats), np.maximum(dense.knots[:, None] - places[None, :], 0.0)
    )
    residual, own, weight = problem.tangents(model)
    own = own[:, free_parameters(model)]
    table = whitened(np.column_stack([own, hinges, residual]), weight, ar)
    # Remove what the model already explains from the hinges and from the residual.
    n = own.shape[1]
    sums = gram(table)
    scale = np.sqrt(np.maximum(np.diag(sums)[:n], 1e-300))
    explained = np.linalg.pinv(sums[:n, :n] / np.outer(scale, scale)) @ (
        sums[:n, n:] / scale[:, None]
    )
    rest = table[:, n:] - product(np.ascontiguousarray(table[:, :n] / scale), explained)
    hinges, e = rest[:, :-1], rest[:, -1]
    scores = hinges * e[:, None]
    total = scores.sum(axis=0) ** 2
    plain = (hinges**2).sum(axis=0) * float((e * e).sum()) / len(e)
    blocks = np.array([part.sum(axis=0) for part in np.array_split(scores, _BLOCKS)])
    # Correlation left by the AR model increases the variance of block sums: use the larger one.
    variance = np.maximum(plain, (blocks**2).sum(axis=0) - total / _BLOCKS)
    gain = 0.5 * total / np.maximum(variance, 1e-300)
    best = int(np.argmax(gain))
    return float(places[best]), float(gain[best])


def choose_pieces(
    problem: Problem, model: RegionalModel, ar: FloatArray, most: int
) -> ChosenPieces:
    """Add and remove breakpoints until each of them gains enough log-likelihood.

    Parameters
    ----------
    problem : Problem
    model : RegionalModel
        Refined, without jumps.
    ar : float64 (4,)
    most : int
        Largest number of pieces.
    """
    worth: dict[int, float] = {}
    model = _grown(problem, model, ar, most, worth)
    model = _pruned(problem, model, ar, worth)
    while model.pieces < most:
        larger, gain = _split(problem, model, ar)
        worth[model.pieces + 1] = max(gain, worth.get(model.pieces + 1, -math.inf))
        if gain < KNEE_GAIN:
            break
        model = larger
    return ChosenPieces(model, worth)


def _grown(
    problem: Problem, model: RegionalModel, ar: FloatArray, most: int, worth: dict[int, float]
) -> RegionalModel:
    """Add the best breakpoint while it gains enough log-likelihood."""
    while model.pieces < most:
        place, gain = _best_knee(problem, model, ar)
        worth[model.pieces + 1] = gain
        if gain < KNEE_GAIN:
            break
        trial = insert(model, place)
        trial, _ = move(problem, trial, ar, free_parameters(trial), 8)
        worth[model.pieces + 1] = gain = min(gain, problem.gain(model, trial, ar))
        if gain < KNEE_GAIN:
            break
        model = trial
    return model


def _pruned(
    problem: Problem, model: RegionalModel, ar: FloatArray, worth: dict[int, float]
) -> RegionalModel:
    """Remove the weakest breakpoint while the loss in log-likelihood is below the limit."""
    while model.pieces > 1:
        certainty = bend_certainty(problem, model, ar)
        weakest = int(np.argmin(certainty))
        trial = _remove(model, weakest)
        trial, _ = move(problem, trial, ar, free_parameters(trial), 8)
        least = min(float(certainty[weakest]), problem.gain(trial, model, ar))
        # With J pieces each breakpoint gained at least this: removing more of them costs more.
        others = np.sort(np.delete(certainty, weakest))
        for j, value in enumerate([least, *others.tolist()]):
            worth[model.pieces - j] = float(value)
        if least >= KNEE_GAIN:
            break
        model = trial
    return model


def _split(problem: Problem, model: RegionalModel, ar: FloatArray) -> tuple[RegionalModel, float]:
    """Return the best model with a breakpoint added in the middle of a piece, and its gain.

    One fitted breakpoint may stand between two true ones. A further one then gains nothing while
    the others stay fixed, but much after they have moved.
    """
    best, most = model, -math.inf
    for place in 0.5 * (model.knots[:-1] + model.knots[1:]):
        trial = insert(model, float(place))
        trial, _ = move(problem, trial, ar, free_parameters(trial), 12)
        gain = problem.gain(model, trial, ar)
        if gain > most:
            best, most = trial, gain
    if most >= KNEE_GAIN:
        most = min(most, float(bend_certainty(problem, best, ar).min()))
    return best, most


def confidence(worth: dict[int, float], most: int) -> dict[int, float]:
    """Return the probability of each number of pieces from the gain of each piece.

    Parameters
    ----------
    worth : dict
        As in `ChosenPieces`.
    most : int
        Largest number of pieces in the result.

    Returns
    -------
    dict
        Probabilities of J = 1 .. ``most``, summing to 1.

    Notes
    -----
    If a piece gains `KNEE_GAIN`, J and J - 1 are equally probable; each further unit of
    log-likelihood multiplies the odds by ``exp(_ODDS_EXPONENT)``. Pieces that were not tried
    are assumed to gain as much as the last one that was tried.
    """
    last = max(worth, default=1)
    odds = [0.0]
    for j in range(2, most + 1):
        value = worth.get(j, worth.get(last, 0.0) if j > last else math.inf)
        odds.append(odds[-1] + _ODDS_EXPONENT * (min(value, _SURE) - KNEE_GAIN))
    weight = np.exp(np.array(odds) - max(odds))
    return {j: float(w) for j, w in enumerate(weight / weight.sum(), start=1)}


def shifted(likely: dict[int, float], by: int) -> dict[int, float]:
    """Return the probabilities for ``by`` more pieces, restricted to 1 or more and normalised.

    If two breakpoints are found to be the ends of one jump, or a piece is split
    later, all numbers of pieces change by one.
    """
    moved = {j + by: share for j, share in likely.items() if j + by >= 1}
    total = sum(moved.values())
    return {j: share / total for j, share in moved.items()} if total > 0.0 else {}


def evidence_words(pieces: int, likely: dict[int, float]) -> str:
    """Return a sentence on the evidence for the number of pieces."""
    each = 'no breakpoint' if pieces == 1 else 'each breakpoint'
    words = (
        f'J = {pieces}: {each} reduces the prediction error of all rows clearly (by at least '
        f'{KNEE_GAIN:g} in log-likelihood)'
    )
    if pieces in likely:
        percent = 100.0 * likely[pieces]
        sure = f'{percent:.3g} %' if percent < 99.95 else 'more than 99.9 %'
        words += f'; its probability is {sure}'
    return f'{words}.'


# Jumps of the curve: pieces are joined unless the data require a jump.
#
# A continuous curve imitates a jump by a short steep piece. So each short piece is compared with a
# jump at its position, which has one parameter less. The cost is not smooth in the position of a
# jump, which is therefore found by a line search with both neighbouring lines kept fixed.

_SHORT = 0.06  # of the range of u
_STEPS = (0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)  # of the range of u
# A jump is refused if the short piece is better by more than this in log-likelihood; by chance
# its further parameter gains 0.5, and the search for its position about 1.
_ALLOWANCE = 2.0
_JUMP_WALD = 20.0


def find_jumps(
    problem: Problem, model: RegionalModel, ar: FloatArray, cost: float
) -> tuple[RegionalModel, BoolArray, float]:
    """Replace short pieces by jumps if these fit equally well.

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
        True for each inner knot with a jump.
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
    """Return True for each inner knot at which the data require a jump, shape (J - 1,)."""
    return np.asarray(_wald(problem, model, ar) > _JUMP_WALD)


def _wald(problem: Problem, model: RegionalModel, ar: FloatArray) -> FloatArray:
    """Return the Wald statistic of a jump at each inner knot, shape (J - 1,).

    It tests the jump of the model plus its change by one step of the joint regression.
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
    """Remove an inner piece; its neighbours are extended to its middle."""
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
    """Alternate between the search of the knot's position and the fit of all other parameters."""
    free = free_parameters(model, jumps)
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

    def moved(model: RegionalModel, by: float) -> RegionalModel | None:
        trial = _moved(model, knot, by)
        # Others may be as close as that already, but for rounding.
        return None if np.diff(trial.knots).min() < 0.999 * CLOSEST_KNOTS * span else trial

    for share, sign in itertools.product(_STEPS, (1.0, -1.0)):
        model, cost = descend(
            model,
            cost,
            lambda m: problem.cost(m, ar),
            partial(moved, by=sign * share * span),
        )
    return model, cost


def _moved(model: RegionalModel, knot: int, step: float) -> RegionalModel:
    """Move an inner knot; the lines on both sides are kept fixed."""
    slopes = model.slopes()
    knots, left, right = model.knots.copy(), model.left.copy(), model.right.copy()
    knots[knot + 1] += step
    right[knot] += slopes[knot] * step
    left[knot + 1] += slopes[knot + 1] * step
    return replace(model, knots=knots, left=left, right=right)
