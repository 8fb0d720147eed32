# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""An autoregressive model that whitens the residual, so that its samples are independent."""

from __future__ import annotations

import numpy as np

from valveflow_ros.curve.regional_model import lagged_products, whiten
from valveflow_ros.fit.kernels import normal_sums
from valveflow_ros.numerics import cores, run_in_threads, runs
from valveflow_ros.records import ByteArray, FloatArray

ORDER = 4
_LARGEST_SUM = 0.95
# Sums are formed over stretches of this many rows and then added in order, so that the result
# does not depend on the number of threads.
_STRETCH = 16384


def fit_ar(residual: FloatArray, weight: ByteArray, order: int = ORDER) -> FloatArray:
    """Estimate AR coefficients by Yule-Walker over the weighted rows, shape (order,).

    Rows with weight 0 are ignored and separate their neighbours. A residual of
    zeros gives zeros.
    """
    products = lagged_products(residual, weight, order)
    if not products[0] > 0.0:
        return np.zeros(order)
    # A little white noise keeps the system solvable for an almost constant residual.
    products[0] *= 1.0 + 1e-9
    ar = yule_walker(products)
    # A residual that contains a misfit looks like a random walk. Whitening with a root at one
    # would remove the level and hide the misfit.
    total = float(ar.sum())
    return ar * (_LARGEST_SUM / total) if total > _LARGEST_SUM else ar


def yule_walker(products: FloatArray) -> FloatArray:
    """Return the AR coefficients (k,) of a process with these mean products at lags 0 to k.

    Raises `LinAlgError` if there is no solution, or a product is not finite.
    """
    if not np.isfinite(products).all():
        raise np.linalg.LinAlgError('the residual is not finite')
    # Levinson's recursion, because the last bits of a library's solver depend on the threads.
    ar, error = np.zeros(0), float(products[0])
    for k in range(len(products) - 1):
        if error == 0.0:
            raise np.linalg.LinAlgError('the products are those of fewer coefficients')
        reflection = (products[k + 1] - (ar * products[k:0:-1]).sum()) / error
        ar = np.append(ar - reflection * ar[::-1], reflection)
        error *= 1.0 - float(reflection) ** 2
    return ar


def normal_equations(
    jacobian: FloatArray, residual: FloatArray, weight: ByteArray, ar: FloatArray, blocks: int = 1
) -> tuple[FloatArray, FloatArray, int]:
    """Return products of whitened tangents and residual, block scores, and the number of rows.

    Parameters
    ----------
    jacobian : float64 (m, P)
    residual, weight : (m,)
    ar : float64 (k,)
    blocks : int
        Number of equal stretches of time for which scores are summed.

    Returns
    -------
    sums : float64 (P + 1, P + 1)
        The residual is the last column.
    scores : float64 (blocks, P)
    rows : int
    """
    columns = jacobian.shape[1]
    table = np.ascontiguousarray(jacobian)
    parts = runs(len(residual), _STRETCH)
    sums = np.zeros((len(parts), columns + 1, columns + 1))
    scores = np.zeros((len(parts), blocks, columns))
    rows = np.zeros(len(parts), dtype=np.int64)

    def add(k: int, first: int, end: int) -> None:
        rows[k] = normal_sums(table, residual, weight, ar, first, end, sums[k], scores[k])

    run_in_threads(add, [(k, *part) for k, part in enumerate(parts)], cores())
    return sums.sum(axis=0), scores.sum(axis=0), int(rows.sum())


def whitened(columns: FloatArray, weight: ByteArray, ar: FloatArray) -> FloatArray:
    """Return the innovations of each column, shape (rows left, columns)."""
    columns = np.atleast_2d(columns.T).T
    out = np.empty((columns.shape[0], columns.shape[1]))
    rows = 0
    buffer = np.empty(columns.shape[0])
    for k in range(columns.shape[1]):
        rows = whiten(np.ascontiguousarray(columns[:, k]), weight, ar, buffer)
        out[:rows, k] = buffer[:rows]
    return out[:rows]


def inflation(residual: FloatArray, weight: ByteArray, longest_lag: int) -> float:
    """Return the ratio of the variance of a long mean to that of white noise.

    It is the Bartlett-weighted sum of autocorrelations up to ``longest_lag``; at least 1.
    """
    products = lagged_products(residual, weight, longest_lag)
    if not products[0] > 0.0:
        return 1.0
    k = np.arange(1, longest_lag + 1)
    tapered = (1.0 - k / (longest_lag + 1.0)) * products[1:] / products[0]
    return float(max(1.0, 1.0 + 2.0 * tapered.sum()))
