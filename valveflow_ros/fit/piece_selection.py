# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The number of pieces, judged in the space where the noise is white.

Eq. (24) of the paper looks at the costs of the static fit alone: it cannot
answer one piece, and one strong knee hides weak ones. With dynamics and an AR
model of the noise in hand, a further knee can be tested for what it is worth:
its hinge is sent through the dynamics, whitened, freed of all that the model
explains already, and held against the innovations. Knees are added while the
best of them gains enough in log-likelihood after a full refit, and taken away
while the weakest loses too little.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.fit.descent import descend
from valveflow_ros.fit.problem import Problem, free_parameters, move
from valveflow_ros.fit.uncertainty import bend_certainty
from valveflow_ros.fit.whitening import whitened
from valveflow_ros.numerics import gram, product
from valveflow_ros.records import BoolArray, FloatArray

# Log-likelihood a knee must gain. A knee is two parameters found by a search along u;
# by chance the best of such a search gains 3 or 4, once in a thousand about 9.
KNEE_GAIN = 12.0
_SURE = 1e3  # worth beyond which nothing changes
# A unit of log-likelihood is believed by this much only: a knee that the data hardly show may
# be there all the same. Set on 66 random units of one to four days, of which 81 % came out
# right; `benchmarks.joint_selection_study` tries it on others.
_TEMPER = 0.2
_CANDIDATES = 30
_BLOCKS = 60


@dataclass(frozen=True, slots=True)
class Grown:
    """A model with its number of pieces chosen.

    Attributes
    ----------
    model : RegionalModel
    worth : dict
        For each J on the way, from 2 on, the log-likelihood that its J-th piece is worth,
        with the robust variance; J reaches one beyond the model's pieces where that could
        be tried.
    """

    model: RegionalModel
    worth: dict[int, float]


def _insert(model: RegionalModel, knot: float) -> RegionalModel:
    """Put a knot onto the curve without changing it."""
    k = int(np.clip(np.searchsorted(model.knots, knot) - 1, 0, model.pieces - 1))
    value = float(model.shape(np.array([knot]))[0])
    return replace(
        model,
        knots=np.insert(model.knots, k + 1, knot),
        left=np.insert(model.left, k + 1, value),
        right=np.insert(model.right, k, value),
    )


def _remove(model: RegionalModel, inner: int) -> RegionalModel:
    """Take the inner knot number ``inner`` (from 0) out; its pieces become one."""
    return replace(
        model,
        knots=np.delete(model.knots, inner + 1),
        left=np.delete(model.left, inner + 1),
        right=np.delete(model.right, inner),
    )


def _candidates(problem: Problem, model: RegionalModel) -> FloatArray:
    """Return places for a new knee: quantiles and an even grid, away from knots and ends."""
    u = problem.u[problem.usable > 0]
    spread = np.quantile(u, np.linspace(0.02, 0.98, _CANDIDATES // 2))
    even = np.linspace(spread[0], spread[-1], _CANDIDATES // 2)
    places = np.unique(np.concatenate([spread, even]))
    low, high = model.knots[0], model.knots[-1]
    distance = np.abs(places[:, None] - model.knots[None, :]).min(axis=1)
    away = (distance > 0.02 * (high - low)) & (places > low) & (places < high)
    return np.asarray(places[away])


def _best_knee(problem: Problem, model: RegionalModel, ar: FloatArray) -> tuple[float, float]:
    """Return the most promising place for a knee and its score gain."""
    places = _candidates(problem, model)
    if not len(places):
        return float('nan'), 0.0
    dense = model
    for place in places:
        dense = _insert(dense, float(place))
    _, hats, _ = problem.tangents(dense)
    hats = hats[:, : dense.pieces + 1]
    hinges = product(
        np.ascontiguousarray(hats), np.maximum(dense.knots[:, None] - places[None, :], 0.0)
    )
    residual, own, weight = problem.tangents(model)
    own = own[:, free_parameters(model)]
    table = whitened(np.column_stack([own, hinges, residual]), weight, ar)
    # What the model explains already is taken out of hinges and residual alike.
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
    # What the AR model leaves of correlation shows between blocks; the larger variance counts.
    variance = np.maximum(plain, (blocks**2).sum(axis=0) - total / _BLOCKS)
    gain = 0.5 * total / np.maximum(variance, 1e-300)
    best = int(np.argmax(gain))
    return float(places[best]), float(gain[best])


def _gain(problem: Problem, small: RegionalModel, large: RegionalModel, ar: FloatArray) -> float:
    """Return the log-likelihood that ``large`` gains over ``small``."""
    residual, weight = problem.answer(large)
    count = len(whitened(residual, weight, ar))
    return float(
        0.5 * count * np.log(problem.cost(small, ar) / max(problem.cost(large, ar), 1e-300))
    )


def choose_pieces(problem: Problem, model: RegionalModel, ar: FloatArray, most: int) -> Grown:
    """Add and remove knees until each is worth its place.

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
    return Grown(model, worth)


def _grown(
    problem: Problem, model: RegionalModel, ar: FloatArray, most: int, worth: dict[int, float]
) -> RegionalModel:
    """Add the most promising knee while it gains enough."""
    while model.pieces < most:
        place, gain = _best_knee(problem, model, ar)
        worth[model.pieces + 1] = gain
        if gain < KNEE_GAIN:
            break
        trial = _insert(model, place)
        trial, _ = move(problem, trial, ar, free_parameters(trial), 8)
        worth[model.pieces + 1] = gain = min(gain, _gain(problem, model, trial, ar))
        if gain < KNEE_GAIN:
            break
        model = trial
    return model


def _pruned(
    problem: Problem, model: RegionalModel, ar: FloatArray, worth: dict[int, float]
) -> RegionalModel:
    """Take the weakest knee away while that costs too little."""
    while model.pieces > 1:
        certainty = bend_certainty(problem, model, ar)
        weakest = int(np.argmin(certainty))
        trial = _remove(model, weakest)
        trial, _ = move(problem, trial, ar, free_parameters(trial), 8)
        least = min(float(certainty[weakest]), _gain(problem, trial, model, ar))
        # With J pieces each bend was worth at least this: taking more away costs more.
        others = np.sort(np.delete(certainty, weakest))
        for j, value in enumerate([least, *others.tolist()]):
            worth[model.pieces - j] = float(value)
        if least >= KNEE_GAIN:
            break
        model = trial
    return model


def _split(problem: Problem, model: RegionalModel, ar: FloatArray) -> tuple[RegionalModel, float]:
    """Return the best model with one knee more, put into the middle of a piece, and its worth.

    One knot may stand for two knees, between them; a further knee then gains nothing where
    the others stay, and much once they have moved.
    """
    best, most = model, -math.inf
    for place in 0.5 * (model.knots[:-1] + model.knots[1:]):
        trial = _insert(model, float(place))
        trial, _ = move(problem, trial, ar, free_parameters(trial), 12)
        gain = _gain(problem, model, trial, ar)
        if gain > most:
            best, most = trial, gain
    if most >= KNEE_GAIN:
        most = min(most, float(bend_certainty(problem, best, ar).min()))
    return best, most


def confidence(worth: dict[int, float], most: int) -> dict[int, float]:
    """Return how probable each number of pieces is, from what each piece is worth.

    Parameters
    ----------
    worth : dict
        As in `Grown`.
    most : int
        Largest number of pieces asked for.

    Returns
    -------
    dict
        Probabilities of J = 1 .. ``most``, summing to 1.

    Notes
    -----
    A piece worth `KNEE_GAIN` makes J and J - 1 equally probable; each unit of
    log-likelihood beyond it changes the odds by ``exp(_TEMPER)``. Beyond the last piece
    that was tried a further one is taken for worth as much as that one.
    """
    last = max(worth, default=1)
    odds = [0.0]
    for j in range(2, most + 1):
        value = worth.get(j, worth.get(last, 0.0) if j > last else math.inf)
        odds.append(odds[-1] + _TEMPER * (min(value, _SURE) - KNEE_GAIN))
    weight = np.exp(np.array(odds) - max(odds))
    return {j: float(w) for j, w in enumerate(weight / weight.sum(), start=1)}


def shifted(likely: dict[int, float], by: int) -> dict[int, float]:
    """Return probabilities moved to ``by`` more pieces, from 1 on.

    Where two knees turn out to be the ends of one jump, or a piece is split
    later, all numbers mean one piece more or less than when they were weighed.
    """
    moved = {j + by: share for j, share in likely.items() if j + by >= 1}
    total = sum(moved.values())
    return {j: share / total for j, share in moved.items()} if total > 0.0 else {}


def evidence_words(pieces: int, likely: dict[int, float]) -> str:
    """Say on what evidence the joint fit took its number of pieces."""
    words = (
        f'J = {pieces} was taken by what each breakpoint gains in the whitened prediction error '
        f'of all rows (at least {KNEE_GAIN:g} in log-likelihood)'
    )
    if pieces in likely:
        percent = 100.0 * likely[pieces]
        sure = f'{percent:.3g} %' if percent < 99.95 else 'more than 99.9 %'
        words += f'; its probability is {sure}'
    return f'{words}.'


# Jumps of the curve: pieces are joined unless the data say otherwise.
#
# A continuous curve imitates a jump by a short steep piece. So each short piece is held against a
# jump in its place, which has one parameter less. Where a jump stands the cost is not smooth in
# the knot's place, which is therefore searched along a line with both neighbouring lines held.

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
        return None if np.any(np.diff(trial.knots) <= 0.004 * span) else trial

    for share, sign in itertools.product(_STEPS, (1.0, -1.0)):
        model, cost = descend(
            model,
            cost,
            lambda m: problem.cost(m, ar),
            partial(moved, by=sign * share * span),
        )
    return model, cost


def _moved(model: RegionalModel, knot: int, step: float) -> RegionalModel:
    """Move an inner knot, the lines on both sides of it held."""
    slopes = model.slopes()
    knots, left, right = model.knots.copy(), model.left.copy(), model.right.copy()
    knots[knot + 1] += step
    right[knot] += slopes[knot] * step
    left[knot + 1] += slopes[knot + 1] * step
    return replace(model, knots=knots, left=left, right=right)
