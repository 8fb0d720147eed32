# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt and line searches for any model whose cost is a sum of squares."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from valveflow_ros.records import FloatArray

Model = TypeVar('Model')

_FIRST_DAMPING, _LEAST_DAMPING = 1e-4, 1e-8
# A parameter is kept fixed if its derivative is below this fraction of the largest one.
_DEAD = 1e-9


def gauss_newton(
    model: Model,
    cost_of: Callable[[Model], float],
    equations: Callable[[Model], tuple[FloatArray, FloatArray]],
    shifted: Callable[[Model, FloatArray], Model | None],
    steps: int,
    *,
    trials: int = 6,
    least_gain: float = 1e-7,
) -> tuple[Model, float]:
    """Minimise the cost by Levenberg-Marquardt steps.

    Parameters
    ----------
    model : Model
    cost_of : callable
        Returns the sum of squared innovations.
    equations : callable
        Returns the normal matrix (P, P) and the products of tangents and residual (P,).
    shifted : callable
        Returns the model changed by a step (P,), or None if the changed model is invalid.
    steps : int
        Maximum number of steps.
    trials : int
        Maximum number of damping values per step, each ten times the previous one.
    least_gain : float
        The search ends when a step lowers the cost by less than this fraction of it.

    Returns
    -------
    model : Model
        The best model found.
    cost : float

    Notes
    -----
    Parameters are scaled so that the normal matrix has a diagonal of one (Marquardt, J. SIAM
    11, 1963). One damping is then suitable for MW, seconds and units of u.
    """
    cost, damping = cost_of(model), _FIRST_DAMPING
    for _ in range(steps):
        normal, slope = equations(model)
        scale = np.sqrt(np.maximum(np.diag(normal), 0.0))
        scale[scale <= _DEAD * scale.max(initial=0.0)] = np.inf
        normal = normal / np.outer(scale, scale)
        before = cost
        for _ in range(trials):
            step = np.linalg.solve(normal + damping * np.eye(len(scale)), slope / scale) / scale
            if 2.0 * float(slope @ step) < least_gain * cost:
                break  # no step can gain more in a linear model
            trial = shifted(model, step)
            if trial is not None and (value := cost_of(trial)) < cost:
                model, cost = trial, value
                break
            damping *= 10.0
        if before - cost < least_gain * cost or cost == before:
            break
        damping = max(damping / 10.0, _LEAST_DAMPING)
    return model, cost


def descend(
    model: Model,
    cost: float,
    cost_of: Callable[[Model], float],
    moved: Callable[[Model], Model | None],
) -> tuple[Model, float]:
    """Repeat one change while the cost falls; ``moved`` returns None if the change is invalid."""
    while (trial := moved(model)) is not None:
        value = cost_of(trial)
        if not value < cost:
            break
        model, cost = trial, value
    return model, cost
