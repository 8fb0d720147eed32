"""Hammerstein identification as its literature does it, tuned on data of its own.

Knots, values and one linear block are estimated together by the prediction
error over all rows: what ``nlhw`` of the System Identification Toolbox does, to
which the paper compares (Section IV). Starts come from several sets of knots;
orders and delay are searched; orders and the model of the noise are chosen by how
well the last part of the identification data is simulated from the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.baselines.hammerstein import HammersteinModel, tangents
from valveflow_ros.baselines.judged import cut_samples, run_mse
from valveflow_ros.fit.descent import gauss_newton
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.whitening import fit_ar, whitened
from valveflow_ros.numerics import gram
from valveflow_ros.records import FloatArray

OUTPUT_ERROR: FloatArray = np.empty(0)
_NARROWEST = 0.004  # of the range of u: as narrow as the proposed method lets a piece be
_DELAY_STEPS_S = (8.0, 4.0, 2.0, 1.0)
# Where the search begins: least squares on a grid.
_GRID_T_S = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0)
_GRID_DELAY_S = (0.0, 5.0, 15.0, 30.0)
_SEED = 20240229  # of the random knots; a fit is a pure function of its data
_RANDOM_STARTS = 4
_LEAST_PART = 0.05
_KEPT_STARTS = 3
ORDERS = ((1, 1), (2, 2), (3, 3))  # taps n_b and poles n_f
_NEW_POLE = 0.5

Progress = Callable[[str], None]


def move(
    samples: Samples, model: HammersteinModel, ar: FloatArray, steps: int
) -> tuple[HammersteinModel, float]:
    """Levenberg-Marquardt over values, knots and both polynomials, the delay held.

    Parameters
    ----------
    ar : float64 (k,)
        Of the noise of the means; empty is the output error, which calls all noise white.
    """

    def cost(model: HammersteinModel) -> float:
        residual, _, weight = tangents(samples, model, columns=0)
        e = whitened(residual, weight, ar)
        return float((e * e).sum())

    def equations(model: HammersteinModel) -> tuple[FloatArray, FloatArray]:
        residual, jacobian, weight = tangents(samples, model)
        sums = gram(whitened(np.column_stack([jacobian, residual]), weight, ar))
        return sums[:-1, :-1], sums[:-1, -1]

    def shifted(model: HammersteinModel, step: FloatArray) -> HammersteinModel | None:
        moved = model.unpack(model.pack() + step)
        least = _NARROWEST * (moved.knots[-1] - moved.knots[0])
        return moved if np.all(np.diff(moved.knots) > least) and moved.stable() else None

    return gauss_newton(model, cost, equations, shifted, steps, least_gain=1e-6)


def search_delay(
    samples: Samples, model: HammersteinModel, ar: FloatArray, best: float, steps: int = 4
) -> tuple[HammersteinModel, float]:
    """Move the delay by whole rows, everything else refitted, while that helps."""
    rows = sorted({max(1, round(s / model.step_s)) for s in _DELAY_STEPS_S}, reverse=True)
    for size in rows:
        for sign in (1, -1):
            while model.delay + sign * size >= 0:
                shifted = replace(model, delay=model.delay + sign * size)
                trial, value = move(samples, shifted, ar, steps)
                if not value < best * (1.0 - 1e-7):
                    break
                model, best = trial, value
    return model, best


def knots_to_try(u: FloatArray, pieces: int) -> list[FloatArray]:
    """Return sets of J + 1 knots over the range of ``u``: even, by quantiles, at random."""
    low, high = float(u.min()), float(u.max())
    even = np.linspace(low, high, pieces + 1)
    by_share = np.quantile(u, np.linspace(0.0, 1.0, pieces + 1))
    # Quantiles that are nowhere closer than a twentieth of an even spacing.
    widths = np.maximum(np.diff(by_share), 0.05 * (high - low) / pieces)
    inner = low + (high - low) * np.cumsum(widths / widths.sum())[:-1]
    tried = [even, 0.5 * (even + by_share), np.concatenate([[low], inner, [high]])]
    rng = np.random.default_rng(_SEED)
    for _ in range(_RANDOM_STARTS if pieces > 1 else 0):
        widths = _LEAST_PART + rng.dirichlet(np.ones(pieces))
        inner = low + (high - low) * np.cumsum(widths / widths.sum())[:-1]
        tried.append(np.concatenate([[low], inner, [high]]))
    return tried if pieces > 1 else tried[:1]


def first_order(
    knots: FloatArray, time_constant_s: float, delay_s: float, step_s: float
) -> HammersteinModel:
    """Return a model with one pole and a flat curve."""
    return HammersteinModel(
        knots=knots, values=np.zeros(len(knots)), numerator=np.empty(0),
        denominator=np.array([-np.exp(-step_s / time_constant_s)]),
        delay=round(delay_s / step_s), step_s=step_s,
    )  # fmt: skip


def with_best_values(samples: Samples, model: HammersteinModel) -> tuple[HammersteinModel, float]:
    """Return the model with the values at the knots that fit best, and its squared error.

    For a given linear block and given knots the output is linear in the values.
    """
    zero = replace(model, values=np.zeros_like(model.values))
    residual, jacobian, weight = tangents(samples, zero, columns=model.pieces + 1)
    sums = gram(whitened(np.column_stack([jacobian, residual]), weight, np.empty(0)))
    # A knot without samples beside it is not told by the data; it then takes the least value.
    values = np.linalg.pinv(sums[:-1, :-1], rcond=1e-10, hermitian=True) @ sums[:-1, -1]
    left = float(sums[-1, -1] - values @ sums[:-1, -1])
    return replace(model, values=values), left


def starts(samples: Samples, pieces: int) -> list[HammersteinModel]:
    """Return one start for each set of knots, the best of the grid of (T, tau), best first.

    Parameters
    ----------
    samples : Samples
        May be coarse.
    """
    u = samples.u[samples.usable > 0]
    found = []
    for knots in knots_to_try(u, pieces):
        tried = [
            with_best_values(samples, first_order(knots, t, d, samples.step_s))
            for t in _GRID_T_S for d in _GRID_DELAY_S
        ]  # fmt: skip
        found.append(min(tried, key=lambda pair: pair[1]))
    return [model for model, _ in sorted(found, key=lambda pair: pair[1])]


@dataclass(frozen=True, slots=True)
class HammersteinFit:
    """The model and how it was chosen.

    Attributes
    ----------
    model : HammersteinModel
    noise : str
        'output error' or 'autoregressive'.
    tried : tuple of (n_b, n_f, noise, mean squared error in MW^2 on the part held out)
    """

    model: HammersteinModel
    noise: str
    tried: tuple[tuple[int, int, str, float], ...]


def fit_hammerstein(
    samples: Samples, pieces: int, progress: Progress = lambda _: None
) -> HammersteinFit:
    """Identify a Hammerstein model of ``pieces`` pieces.

    Raises
    ------
    TooFewSamplesError
        Too few rows lie far enough behind a gap.
    """
    learn, judge = cut_samples(samples)
    progress('Hammerstein model: starts')
    coarse = _at_coarse(learn, pieces)
    progress('Hammerstein model: orders')
    candidates = _orders(learn, coarse)
    tried = [(len(m.b), len(m.denominator), noise, run_mse(m, judge)) for noise, m in candidates]
    best = int(np.argmin([t[-1] for t in tried]))
    noise, model = candidates[best]
    progress('Hammerstein model: all data')
    model = _on_all(samples, model, noise)
    return HammersteinFit(model, noise, tuple(tried))


def _at_coarse(samples: Samples, pieces: int) -> HammersteinModel:
    """Return the best of several starts, moved on coarse rows, at the step of the rows."""
    coarse = samples.coarser()
    moved = [move(coarse, s, OUTPUT_ERROR, 15) for s in starts(coarse, pieces)[:_KEPT_STARTS]]
    model, _ = min(moved, key=lambda pair: pair[1])
    factor = model.step_s / samples.step_s
    pole = np.maximum(-model.denominator, 1e-6) ** (1.0 / factor)
    return replace(
        model, denominator=-pole, delay=round(model.delay * factor), step_s=samples.step_s
    )


def _orders(samples: Samples, model: HammersteinModel) -> list[tuple[str, HammersteinModel]]:
    """Return a model of each order, each begun at the one before, under both noises."""
    found: list[tuple[str, HammersteinModel]] = []
    for n_b, n_f in ORDERS:
        model, best = move(samples, grown(model, n_b, n_f), OUTPUT_ERROR, 12)
        if not found:
            model, _ = search_delay(samples, model, OUTPUT_ERROR, best)
        found += [('output error', model), ('autoregressive', _whitened(samples, model))]
    return found


def _whitened(samples: Samples, model: HammersteinModel) -> HammersteinModel:
    """Refit under an AR model of the noise, which is far from white."""
    residual, _, weight = tangents(samples, model, columns=0)
    return move(samples, model, fit_ar(residual, weight), 8)[0]


def grown(model: HammersteinModel, n_b: int, n_f: int) -> HammersteinModel:
    """Add taps and poles that change nothing yet: a tap of 0, or a pole on a zero."""
    b, f = model.b, np.concatenate([[1.0], model.denominator])
    while len(f) - 1 < n_f and len(b) < n_b:
        f, b = np.convolve(f, [1.0, -_NEW_POLE]), np.convolve(b, [1.0, -_NEW_POLE])
    b = np.append(b, np.zeros(n_b - len(b)))
    f = np.append(f, np.zeros(n_f + 1 - len(f)))
    return replace(model, denominator=f[1:], numerator=b[1:])


def _on_all(samples: Samples, model: HammersteinModel, noise: str) -> HammersteinModel:
    """Refit on all rows."""
    u = samples.u[samples.usable > 0]
    knots = model.knots.copy()
    knots[0], knots[-1] = min(knots[0], u.min()), max(knots[-1], u.max())
    model = replace(model, knots=knots, values=model.static(knots))
    model, best = move(samples, model, OUTPUT_ERROR, 12)
    model, _ = search_delay(samples, model, OUTPUT_ERROR, best)
    return model if noise == 'output error' else _whitened(samples, model)
