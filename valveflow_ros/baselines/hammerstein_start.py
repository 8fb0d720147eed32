"""Where the search for a Hammerstein model begins: least squares on a grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.baselines.hammerstein import HammersteinModel, tangents
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.whitening import whitened
from valveflow_ros.records import FloatArray
from valveflow_ros.sums import gram

_GRID_T_S = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0)
_GRID_DELAY_S = (0.0, 5.0, 15.0, 30.0)
_SEED = 20240229  # of the random knots; a fit is a pure function of its data
_RANDOM_STARTS = 4
_LEAST_PART = 0.05


def knots_to_try(u: FloatArray, pieces: int) -> list[FloatArray]:
    """Return sets of J + 1 knots over the range of ``u``: even, by quantiles, at random."""
    low, high = float(u.min()), float(u.max())
    even = np.linspace(low, high, pieces + 1)
    by_share = np.quantile(u, np.linspace(0.0, 1.0, pieces + 1))
    tried = [even, 0.5 * (even + by_share), _apart(by_share)]
    rng = np.random.default_rng(_SEED)
    for _ in range(_RANDOM_STARTS if pieces > 1 else 0):
        widths = _LEAST_PART + rng.dirichlet(np.ones(pieces))
        inner = low + (high - low) * np.cumsum(widths / widths.sum())[:-1]
        tried.append(np.concatenate([[low], inner, [high]]))
    return tried if pieces > 1 else tried[:1]


def _apart(knots: FloatArray) -> FloatArray:
    """Return knots that are nowhere closer than a twentieth of an even spacing."""
    least = 0.05 * (knots[-1] - knots[0]) / (len(knots) - 1)
    widths = np.maximum(np.diff(knots), least)
    inner = knots[0] + (knots[-1] - knots[0]) * np.cumsum(widths / widths.sum())
    return np.concatenate([knots[:1], inner[:-1], knots[-1:]])


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
