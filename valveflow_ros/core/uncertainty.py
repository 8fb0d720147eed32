"""How sure the parameters of a refined model are."""

from __future__ import annotations

import numpy as np

from valveflow_ros.core.model import RegionalModel
from valveflow_ros.core.problem import Problem
from valveflow_ros.core.sums import gram
from valveflow_ros.core.whitening import whitened
from valveflow_ros.records import BoolArray, FloatArray

_MOST_BLOCKS = 60
_LEAST_IN_BLOCK = 50


def covariance_of(
    problem: Problem, model: RegionalModel, free: BoolArray, ar: FloatArray
) -> tuple[FloatArray, float]:
    """Return the covariance of the packed parameters and the sd of the innovations in MW.

    The inverse normal matrix, widened where sums of scores over blocks vary
    more than independent innovations would let them. Levels are held, so the
    errors of T and tau are somewhat too small. Parameters that are not free have
    covariance 0; a free one that the data do not move has NaN.
    """
    residual, jacobian, weight = problem.tangents(model)
    moved = free & (np.abs(jacobian).max(axis=0) > 0.0)
    both = whitened(np.column_stack([jacobian[:, moved], residual]), weight, ar)
    j, e = both[:, :-1], both[:, -1]
    sums = gram(both)
    scale = np.sqrt(np.maximum(np.diag(sums)[:-1], 1e-300))
    inverse = np.linalg.pinv(sums[:-1, :-1] / np.outer(scale, scale), hermitian=True)
    inverse = inverse / np.outer(scale, scale)
    variance = float(sums[-1, -1]) / max(len(e) - j.shape[1], 1)
    blocks = max(1, min(_MOST_BLOCKS, len(e) // _LEAST_IN_BLOCK))
    scores = np.array([s.sum(axis=0) for s in np.array_split(j * e[:, None], blocks)])
    robust = inverse @ gram(scores) @ inverse
    plain = inverse * variance
    # Few blocks make the robust form noisy; it may widen, never narrow.
    diagonal = np.maximum(np.diag(plain), 1e-300)
    widen = np.sqrt(np.maximum(1.0, np.diag(robust) / diagonal))
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(moved, moved)] = plain * np.outer(widen, widen)
    dead = np.flatnonzero(free & ~moved)
    covariance[dead, dead] = np.nan
    return covariance, float(np.sqrt(max(variance, 0.0)))


def bend_certainty(problem: Problem, model: RegionalModel, ar: FloatArray) -> FloatArray:
    """Return half the squared change of slope over its variance, for each inner knot (J - 1,).

    That is the log-likelihood a knee is worth, with the robust variance.
    """
    j = model.pieces
    free = np.zeros(len(model.pack()), dtype=bool)
    free[: j + 1] = True
    covariance = np.nan_to_num(covariance_of(problem, model, free, ar)[0][: j + 1, : j + 1])
    width = np.diff(model.knots)
    change = np.zeros((j - 1, j + 1))
    for k in range(j - 1):
        change[k, k] = 1.0 / width[k]
        change[k, k + 1] = -1.0 / width[k] - 1.0 / width[k + 1]
        change[k, k + 2] = 1.0 / width[k + 1]
    variance = np.einsum('kp,pq,kq->k', change, covariance, change)
    bend = np.diff(model.slopes())
    return np.asarray(0.5 * bend**2 / np.maximum(variance, 1e-300))
