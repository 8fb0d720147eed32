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

from dataclasses import dataclass, field, replace

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.fit.grow import choose_pieces, confidence, shifted
from valveflow_ros.fit.input_errors import corrected
from valveflow_ros.fit.jumps import find_jumps, supported_jumps
from valveflow_ros.fit.problem import Problem, Samples, free_parameters, move, search_levels
from valveflow_ros.fit.regions import find_regions
from valveflow_ros.fit.uncertainty import covariance_of
from valveflow_ros.fit.whitening import ORDER, fit_ar
from valveflow_ros.records import BoolArray, ByteArray, FloatArray

_LEAST_ROWS, _LEAST_S = 600, 3600.0
# What an autoregressive model must remember: white noise on top of slow noise has a long tail.
_MEMORY_S = 40.0
_NARROWEST = 0.01  # of the range of u: narrower pieces are not given to the search


@dataclass(frozen=True, slots=True)
class Refined:
    """The outcome.

    Attributes
    ----------
    model : RegionalModel
    covariance : float64 (P, P)
        Of the packed parameters, robust against what the AR model leaves (block scores).
    level_stderr : float64 (I - 1,)
        Of the levels between regions, MW.
    free : bool (P,)
        Which packed parameters were free; jumps not supported by the data are not.
    ar : float64 (k,)
        Of the residual of the last fit, whose rows are means over 2 s (or single rows).
    innovation_mw : float
        sd of that residual when whitened.
    prediction_mw : float
        How wrong the prediction is because parameters are, root mean square.
    residual_mw : float64 (m,), weight : uint8 (m,)
        Residual of the means and whether it was scored.
    row_sd_mw : float
        sd of the residual of single rows.
    confidence : dict
        Probability of each number of pieces; empty when it was given.
    """

    model: RegionalModel
    covariance: FloatArray
    level_stderr: FloatArray
    free: BoolArray
    ar: FloatArray
    innovation_mw: float
    prediction_mw: float
    residual_mw: FloatArray
    weight: ByteArray
    row_sd_mw: float
    confidence: dict[int, float] = field(default_factory=dict)


def refine(samples: Samples, start: RegionalModel, most_pieces: int | None = None) -> Refined:
    """Fit curve and dynamics together, from ``start``'s curve.

    Parameters
    ----------
    samples : Samples
        All rows of the window.
    start : RegionalModel
        The curve of the exact partition; its dynamics are not used.
    most_pieces : int, optional
        Choose the number of pieces too, up to this many; without it ``start``'s number stays,
        but for pieces narrower than a hundredth of the range, which are joined with others.
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
    problem, (model, likely) = Problem(samples), _outlined(samples, start, most_pieces)
    searched = model.pieces
    fine = Problem(samples.finer())
    order = int(np.clip(round(_MEMORY_S / (fine.samples.step_s * fine.samples.group)), ORDER, 20))
    free = free_parameters(model.pieces, model.regions)
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
    free = free_parameters(model.pieces, model.regions, jumps)
    if jumps.any():
        model, cost = move(fine, model, ar, free, 4)
    model = corrected(samples, fine, model, ar, free)
    found = _conclude(problem, fine, model, free, ar)
    return replace(found, confidence=shifted(likely, model.pieces - searched))


def search(samples: Samples, start: RegionalModel, most_pieces: int | None) -> RegionalModel:
    """Find regions and pieces on means of ten seconds: `refine` without its last fit.

    Raises
    ------
    TooFewSamplesError
        As for `refine`.
    """
    return _outlined(samples, start, most_pieces)[0]


def _outlined(
    samples: Samples, start: RegionalModel, most_pieces: int | None
) -> tuple[RegionalModel, dict[int, float]]:
    """Search on coarse rows, if there are enough of them."""
    _, weight = Problem(samples).answer(
        replace(start, levels=np.empty(0), time_constants=np.ones(1), delays=np.zeros(1))
    )
    rows, least = int(weight.sum()) * samples.group, least_rows(samples.step_s)
    if rows < least:
        raise TooFewSamplesError(
            'Rows that follow each other for longer than the transient', rows, least
        )
    return _search(Problem(samples.coarser()), _join(start), most_pieces)


def least_rows(step_s: float) -> int:
    """Return how many rows of a step a refinement needs: an hour, and not too few numbers."""
    return max(_LEAST_ROWS, round(_LEAST_S / step_s))


def _search(
    problem: Problem, start: RegionalModel, most_pieces: int | None
) -> tuple[RegionalModel, dict[int, float]]:
    """Find regions and, if asked, the number of pieces; and how probable each number is."""
    model, ar = find_regions(problem, start)
    if most_pieces is None:
        return model, {}
    grown = choose_pieces(problem, model, ar, most_pieces)
    return grown.model, confidence(grown.worth, most_pieces)


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


def _conclude(
    problem: Problem, fine: Problem, model: RegionalModel, free: BoolArray, ar: FloatArray
) -> Refined:
    """Add what is left over, and how sure the parameters are."""
    certainty = covariance_of(fine, model, free, ar)
    residual, weight = problem.answer(model)
    return Refined(
        model, certainty.covariance, certainty.level_stderr, free, ar, certainty.innovation_mw,
        certainty.prediction_mw, residual, weight, _row_sd(fine, model),
    )  # fmt: skip


def _row_sd(problem: Problem, model: RegionalModel) -> float:
    """Return the sd of single rows about the model, MW."""
    residual, weight = Problem(replace(problem.samples, group=1)).answer(model)
    return float(np.std(residual[weight > 0]))
