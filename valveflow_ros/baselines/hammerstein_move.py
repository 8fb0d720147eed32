"""Move all parameters of a Hammerstein model together, by the prediction error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.baselines.hammerstein import HammersteinModel, tangents
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.whitening import whitened
from valveflow_ros.records import FloatArray
from valveflow_ros.sums import gram

OUTPUT_ERROR: FloatArray = np.empty(0)
_NARROWEST = 0.004  # of the range of u: as narrow as the proposed method lets a piece be
_DELAY_STEPS_S = (8.0, 4.0, 2.0, 1.0)


def cost(samples: Samples, model: HammersteinModel, ar: FloatArray) -> float:
    """Return the sum of squared prediction errors of the means."""
    residual, _, weight = tangents(samples, model, columns=0)
    e = whitened(residual, weight, ar)
    return float((e * e).sum())


def _possible(model: HammersteinModel) -> bool:
    least = _NARROWEST * (model.knots[-1] - model.knots[0])
    return bool(np.all(np.diff(model.knots) > least)) and model.stable()


def move(
    samples: Samples, model: HammersteinModel, ar: FloatArray, steps: int
) -> tuple[HammersteinModel, float]:
    """Levenberg-Marquardt over values, knots and both polynomials, the delay held.

    Parameters
    ----------
    ar : float64 (k,)
        Of the noise of the means; empty is the output error, which calls all noise white.
    """
    best = cost(samples, model, ar)
    damping = 1e-4
    for _ in range(steps):
        residual, jacobian, weight = tangents(samples, model)
        sums = gram(whitened(np.column_stack([jacobian, residual]), weight, ar))
        trial = None
        for _ in range(6):
            step = _step(sums, damping)
            candidate = model.unpack(model.pack() + step)
            value = cost(samples, candidate, ar) if _possible(candidate) else np.inf
            if value < best:
                trial = candidate
                break
            damping *= 10.0
        if trial is None:
            break
        gain, best, model = best - value, value, trial
        damping = max(damping / 10.0, 1e-9)
        if gain < 1e-6 * best:
            break
    return model, best


def _step(sums: FloatArray, damping: float) -> FloatArray:
    normal, slope = sums[:-1, :-1], sums[:-1, -1]
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-12 * np.diag(normal).max()))
    normal = normal / np.outer(scale, scale) + damping * np.eye(len(scale))
    return np.asarray(np.linalg.solve(normal, slope / scale) / scale)


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
