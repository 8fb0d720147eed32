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

from valveflow_ros.core.grow import choose_pieces
from valveflow_ros.core.model import RegionalModel
from valveflow_ros.core.problem import Problem, Samples, free_parameters, move, search_levels
from valveflow_ros.core.regions import find_regions
from valveflow_ros.core.sums import gram
from valveflow_ros.core.uncertainty import covariance_of
from valveflow_ros.core.whitening import fit_ar, whitened
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.records import BoolArray, ByteArray, FloatArray

LEAST_ROWS = 3600
_JUMP_WALD = 20.0
_NARROWEST = 0.01  # of the range of u: narrower pieces are not given to the search


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
    free: BoolArray
    ar: FloatArray
    innovation_mw: float
    residual_mw: FloatArray
    weight: ByteArray


def refine(samples: Samples, start: RegionalModel, most_pieces: int | None = None) -> Refined:
    """Fit curve and dynamics together, from ``start``'s curve.

    Parameters
    ----------
    samples : Samples
        All rows of the window.
    start : RegionalModel
        The curve of the exact partition; its dynamics are not used.
    most_pieces : int, optional
        Choose the number of pieces too, up to this many; without it ``start``'s number stays.
        ``start`` should then have rather too many pieces than too few: the AR model takes the
        misfit of a curve that is too simple for noise.

    Raises
    ------
    TooFewSamplesError
        Too few rows lie far enough behind a gap.

    Returns
    -------
    Refined
    """
    problem = Problem(samples)
    _, weight = problem.answer(replace(start, levels=np.empty(0), time_constants=np.ones(1),
                                       delays=np.zeros(1)))  # fmt: skip
    if int(weight.sum()) * samples.group < LEAST_ROWS:
        raise TooFewSamplesError(
            'Rows that follow each other for longer than the transient',
            int(weight.sum()) * samples.group, LEAST_ROWS,
        )  # fmt: skip
    model = _search(Problem(samples.coarser()), _join(start), most_pieces)
    residual, weight = problem.answer(model)
    ar = fit_ar(residual, weight)
    free = free_parameters(model.pieces, model.regions, _jumps_supported(problem, model, ar))
    model, cost = move(problem, model, ar, free, 6)
    model, cost = search_levels(problem, model, ar, cost)
    model, cost = move(problem, model, ar, free, 6)
    return _conclude(problem, model, free, ar)


def _search(problem: Problem, start: RegionalModel, most_pieces: int | None) -> RegionalModel:
    """Find regions and, if asked, the number of pieces."""
    model, ar = find_regions(problem, start)
    return model if most_pieces is None else choose_pieces(problem, model, ar, most_pieces)


def _join(model: RegionalModel) -> RegionalModel:
    """Close the jumps of a curve, and take out knots too close to others to be moved.

    At each inner knot both ends take their mean. The exact partition may put a
    break round a handful of samples.
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


def _jumps_supported(problem: Problem, model: RegionalModel, ar: FloatArray) -> BoolArray:
    """Test each inner knot for a jump by its Wald statistic in the joint regression."""
    residual, jacobian, weight = problem.tangents(model)
    both = whitened(np.column_stack([jacobian, residual]), weight, ar)
    sums = gram(both)
    used = np.append(np.diag(sums)[:-1] > 0.0, False)
    inverse = np.linalg.pinv(sums[np.ix_(used, used)])
    step = np.zeros(len(used) - 1)
    variance = np.full(len(used) - 1, np.inf)
    step[used[:-1]] = inverse @ sums[used, -1]
    variance[used[:-1]] = np.diag(inverse) * sums[-1, -1] / max(len(both), 1)
    places = slice(2 * model.pieces, 3 * model.pieces - 1)
    return np.asarray(step[places] ** 2 / variance[places] > _JUMP_WALD)


def _conclude(problem: Problem, model: RegionalModel, free: BoolArray, ar: FloatArray) -> Refined:
    """Add what is left over, and how sure the parameters are."""
    covariance, innovation = covariance_of(problem, model, free, ar)
    residual, weight = problem.answer(model)
    return Refined(model, covariance, free, ar, innovation, residual, weight)
