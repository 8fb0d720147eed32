# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of the parameters with noise that is correlated and depends on the operation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.fit.problem import Problem
from valveflow_ros.fit.whitening import normal_equations
from valveflow_ros.numerics import gram
from valveflow_ros.records import BoolArray, ByteArray, FloatArray

_MOST_BLOCKS = 60
# Weather and the load of a day last longer than the blocks above: the errors of the final fit are
# also taken from this many long blocks.
_LONG_BLOCKS = 10
# Smaller eigenvalues of the scaled normal matrix are rounding errors; some are negative.
_SINGULAR = 1e-12
_LEAST_IN_BLOCK_S = 500.0
# The answer is not smooth in a level: a central difference over this step averages it.
_LEVEL_STEP_MW = 2.0
_EXPONENT_STEP = 0.01


@dataclass(frozen=True, slots=True)
class Certainty:
    """Covariance of the estimates."""

    # Of the packed parameters, (P, P): 0 for fixed ones, and NaN for free ones that the data do
    # not determine.
    covariance: FloatArray
    level_stderr: FloatArray  # float64 (I - 1,), standard errors of the levels between regions, MW
    innovation_mw: float  # sd of the whitened residual
    # Error of the prediction due to the errors of the parameters: root mean square of all rows.
    # NaN if the fit is not the final one.
    prediction_mw: float
    # float64 (P + 1,), optional: Gauss-Newton step of the packed parameters and the exponent of
    # the pressure, without damping, if the exponent is free.
    step: FloatArray | None = None
    exponent_stderr: float = math.nan  # standard error of that exponent


def covariance_of(
    problem: Problem,
    model: RegionalModel,
    free: BoolArray,
    ar: FloatArray,
    final: bool = True,
    exponent: bool = False,
) -> Certainty:
    """Return the covariance of the packed parameters, and in the ``final`` fit of the levels.

    The inverse normal matrix is widened if sums of scores over blocks vary more than with
    independent innovations. In the final fit, and for an ``exponent`` of the pressure that is
    free, long blocks count too. Levels and exponent are parameters with derivatives by
    differences. The curve at the median pressure does not depend on the exponent, so the errors
    of slopes are those at the median pressure.
    """
    packed, levels = len(free), len(model.levels) if final else 0
    residual, jacobian, weight = problem.tangents(model, also=levels + exponent)
    _level_tangents(problem, model, jacobian[:, packed : packed + levels])
    if exponent:
        _exponent_tangent(problem, model, jacobian[:, packed + levels])
    free = np.append(free, np.ones(levels + exponent, dtype=bool))
    sums, scores, rows = normal_equations(jacobian, residual, weight, ar, _blocks(problem))
    moved = free & (np.diag(sums)[:-1] > 0.0)
    used = np.flatnonzero(np.append(moved, True))
    sums, scores = sums[np.ix_(used, used)], np.ascontiguousarray(scores[:, moved])
    scale = np.sqrt(np.maximum(np.diag(sums)[:-1], 1e-300))
    inverse = np.linalg.pinv(sums[:-1, :-1] / np.outer(scale, scale), _SINGULAR, hermitian=True)
    inverse = inverse / np.outer(scale, scale)
    variance = float(sums[-1, -1]) / max(rows - len(inverse), 1)
    robust = np.diag(inverse @ gram(scores) @ inverse)
    if final or exponent:
        long = np.array([part.sum(axis=0) for part in np.array_split(scores, _LONG_BLOCKS)])
        long_robust = np.diag(inverse @ gram(long) @ inverse)
        robust = np.maximum(robust, long_robust * (_LONG_BLOCKS / (_LONG_BLOCKS - 1)))
    plain = inverse * variance
    # The robust form is noisy with few blocks: it may only increase the variance.
    diagonal = np.maximum(np.diag(plain), 1e-300)
    widen = np.sqrt(np.maximum(1.0, robust / diagonal))
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(moved, moved)] = plain * np.outer(widen, widen)
    dead = np.flatnonzero(free & ~moved)
    covariance[dead, dead] = np.nan
    known = np.where(np.outer(moved, moved), covariance, 0.0)
    errors = np.sqrt(np.diag(covariance))
    return Certainty(
        covariance[:packed, :packed],
        errors[packed : packed + levels],
        float(np.sqrt(max(variance, 0.0))),
        _prediction_error(jacobian, weight, known) if final else math.nan,
        _full_step(inverse @ sums[:-1, -1], moved) if exponent and moved[-1] else None,
        float(errors[-1]) if exponent else math.nan,
    )


def _prediction_error(jacobian: FloatArray, weight: ByteArray, covariance: FloatArray) -> float:
    """Return the root mean square error of the answer due to errors of the parameters."""
    sums, _, rows = normal_equations(jacobian, np.zeros(len(weight)), weight, np.empty(0))
    square = np.sum(sums[:-1, :-1] * covariance) / max(rows, 1)
    return float(np.sqrt(max(square, 0.0)))


def _blocks(problem: Problem) -> int:
    """Return the number of time blocks into which the window is divided."""
    rows = max(1, round(_LEAST_IN_BLOCK_S / (problem.samples.step_s * problem.samples.group)))
    return max(1, min(_MOST_BLOCKS, problem.samples.means // rows))


def _full_step(step: FloatArray, moved: BoolArray) -> FloatArray:
    out = np.zeros(len(moved))
    out[moved] = step
    return out


def _exponent_tangent(problem: Problem, model: RegionalModel, column: FloatArray) -> None:
    """Write the answer's change per unit of the exponent of the pressure, shape (m,)."""
    s = problem.samples
    high, low = (
        Problem(s.with_exponent(by)).answer(s.model_with_exponent(model, by))[0]
        for by in (0.5 * _EXPONENT_STEP, -0.5 * _EXPONENT_STEP)
    )
    column[:] = (low - high) / _EXPONENT_STEP


def _level_tangents(problem: Problem, model: RegionalModel, columns: FloatArray) -> None:
    """Write the answer's change per MW of each level, shape (m, I - 1)."""
    step_mw = _LEVEL_STEP_MW * problem.size
    for k in range(columns.shape[1]):
        half = np.zeros(len(model.levels))
        half[k] = 0.5 * step_mw
        low, _ = problem.answer(model.with_levels(model.levels - half))
        high, _ = problem.answer(model.with_levels(model.levels + half))
        columns[:, k] = (low - high) / step_mw


def bend_certainty(problem: Problem, model: RegionalModel, ar: FloatArray) -> FloatArray:
    """Return half the squared change of slope over its variance, for each inner knot (J - 1,).

    That is the gain in log-likelihood by a breakpoint, with the robust variance.
    """
    j = model.pieces
    free = np.zeros(len(model.pack()), dtype=bool)
    free[: j + 1] = True
    covariance = covariance_of(problem, model, free, ar, final=False).covariance
    # A value without rows is unknown: a large variance gives its breakpoints no gain.
    covariance = np.nan_to_num(covariance[: j + 1, : j + 1], nan=1e12)
    width = np.diff(model.knots)
    change = np.zeros((j - 1, j + 1))
    for k in range(j - 1):
        change[k, k] = 1.0 / width[k]
        change[k, k + 1] = -1.0 / width[k] - 1.0 / width[k + 1]
        change[k, k + 2] = 1.0 / width[k + 1]
    variance = np.einsum('kp,pq,kq->k', change, covariance, change)
    bend = np.diff(model.slopes())
    return np.asarray(0.5 * bend**2 / np.maximum(variance, 1e-300))
