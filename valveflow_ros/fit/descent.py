# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Damped Gauss-Newton and searches along a line, for any model whose cost is a sum of squares."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from valveflow_ros.records import FloatArray

Model = TypeVar('Model')

_FIRST_DAMPING, _LEAST_DAMPING = 1e-4, 1e-8
# A parameter whose derivative is below this share of the largest is not moved.
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
    """Lower the cost by Levenberg-Marquardt steps.

    Parameters
    ----------
    model : Model
    cost_of : callable
        Returns the sum of squared innovations.
    equations : callable
        Returns the normal matrix (P, P) and the products of tangents and residual (P,).
    shifted : callable
        Returns the model moved by a step (P,), or None if that model is not possible.
    steps : int
        Most steps taken.
    trials : int
        Dampings tried for a step, each ten times the one before.
    least_gain : float
        The search ends when a step lowers the cost by less than this share of it.

    Returns
    -------
    model : Model
        The best one found.
    cost : float

    Notes
    -----
    Parameters are scaled to a normal matrix with a diagonal of one (Marquardt, J. SIAM 11,
    1963), so that one damping serves MW, seconds and units of u.
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
    """Repeat one move while the cost falls; None says that the move is not possible."""
    while (trial := moved(model)) is not None:
        value = cost_of(trial)
        if not value < cost:
            break
        model, cost = trial, value
    return model, cost
