"""How much the data speak for a cause: on held-out blocks, robustly, and block by block."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from valveflow_ros.diagnosis.extended import Extended, answer
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.diagnosis.hidden import fair_open_residual
from valveflow_ros.diagnosis.nuisance import nuisance
from valveflow_ros.diagnosis.scene import FOLDS, SEALED_FOLD
from valveflow_ros.fit.whitening import inflation
from valveflow_ros.records import FloatArray

_LAGS = 3
_RIDGE = 1e-4  # of a column's own square
_MEMORY_S = 1200.0
LEAST_GAIN, LEAST_SIGN = 16.0, 1.0
_WALD_LEVEL, _WALD_EACH = 10.0, 5.0


def _by_block(task: Task, table: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Return products summed over blocks (blocks, P, P) and the blocks that have rows."""
    scene = task.scene
    block = scene.block_of_sub[scene.sub[task.rows]]
    edges = np.searchsorted(block, np.arange(scene.block_of_sub[-1] + 2))
    spans = [(a, b) for a, b in itertools.pairwise(edges) if b > a]
    have = np.flatnonzero(np.diff(edges) > 0)
    return np.stack([table[a:b].T @ table[a:b] for a, b in spans]), have


def held_out(task: Task, model: Extended) -> FloatArray:
    """Return the sum of squared innovations of each block under parameters fitted without it.

    Every fold's parameters are one Gauss-Newton step from the common optimum, using the
    sums of the other folds. What hardly shows in them (a knee that lies in one block) stays.
    """
    table = np.column_stack([nuisance(task, model), task.innovations(task.residual(model))])
    sums, blocks = _by_block(task, table)
    fold = blocks % FOLDS
    out = np.empty(len(blocks))
    for f in range(FOLDS):
        if f == SEALED_FOLD or not np.any(fold == f):
            continue
        train = sums[fold != f].sum(axis=0)
        normal = train[:-1, :-1] + _RIDGE * np.eye(len(train) - 1)
        step = np.linalg.solve(normal, train[:-1, -1])
        for b in np.flatnonzero(fold == f):
            own = sums[b]
            out[b] = own[-1, -1] - 2.0 * step @ own[:-1, -1] + step @ own[:-1, :-1] @ step
    return out


def long_run_variance(scores: FloatArray, lags: int = _LAGS) -> float:
    """Return the Newey-West variance of the sum of block scores."""
    centred = scores - scores.mean()
    total = float(centred @ centred)
    for k in range(1, min(lags, len(scores) - 1) + 1):
        total += 2.0 * (1.0 - k / (lags + 1.0)) * float(centred[k:] @ centred[:-k])
    return max(total, 0.1 * float(centred @ centred))


@dataclass(frozen=True, slots=True)
class Evidence:
    """What speaks for a cause.

    Attributes
    ----------
    gain : float
        Log-likelihood gained on held-out blocks.
    wald : float
        Squared size of the effect over its robust variance.
    sign : float
        Mean over standard error of the gains of single blocks.
    size : int
        Numbers chosen from the data; each by itself makes some Wald out of nothing.
    """

    gain: float
    wald: float
    sign: float
    size: int

    @property
    def least_wald(self) -> float:
        """Return what is asked of ``wald``."""
        return _WALD_LEVEL + _WALD_EACH * self.size

    @property
    def enough(self) -> bool:
        """Tell whether all three conditions are met."""
        return self.gain > LEAST_GAIN and self.wald > self.least_wald and self.sign > LEAST_SIGN

    def reason(self) -> str:
        """Say which conditions are not met."""
        told = []
        if not self.gain > LEAST_GAIN:
            told.append(
                f'it gains {self.gain:.1f} in log-likelihood on blocks it was not fitted to, '
                f'{LEAST_GAIN:.0f} are asked for'
            )
        if not self.wald > self.least_wald:
            told.append(
                f'its size is uncertain (Wald statistic {self.wald:.1f}, '
                f'{self.least_wald:.0f} are asked for)'
            )
        if not self.sign > LEAST_SIGN:
            told.append(f'too few blocks agree (t = {self.sign:.1f})')
        return '; '.join(told)


def colour(task: Task, e: FloatArray) -> float:
    """Return how many times the variance of a long mean of innovations exceeds that of white ones.

    Where the noise has a memory longer than the AR model holds, everything that varies slowly
    looks more certain than it is; log-likelihoods are divided by this.
    """
    rows = max(2, round(_MEMORY_S / task.scene.mean_s))
    return inflation(e, np.ones(len(e), dtype=np.uint8), min(rows, max(2, len(e) // 10)))


def weigh(task: Task, without: Extended, model: Extended, size: int) -> Evidence:
    """Compare two fitted models under one whitening.

    Parameters
    ----------
    size : int
        Numbers by which ``model`` exceeds ``without``.
    """
    e = task.innovations(task.residual(model))
    variance = float(e @ e) / len(e) * colour(task, e)
    gains = held_out(task, without) - held_out(task, model)
    spread = float(gains.std(ddof=1)) if len(gains) > 1 else 0.0
    sign = float(gains.mean()) / spread * np.sqrt(len(gains)) if spread > 0.0 else 0.0
    gain = float(gains.sum()) / (2.0 * variance) - _hindsight(task, model, e) / (2.0 * variance)
    return Evidence(gain, _wald(task, without, model, e), float(sign), size)


def _hindsight(task: Task, model: Extended, e: FloatArray) -> float:
    """Return what a hidden state explains only because it was found in the same rows."""
    if all(a.cause.infer is None for a in model.active):
        return 0.0
    fair = task.innovations(fair_open_residual(task, model))
    return max(float(fair @ fair - e @ e), 0.0)


def _wald(task: Task, without: Extended, model: Extended, e: FloatArray) -> float:
    """Return the squared robust t value of the difference of two models as a column."""
    scene = task.scene
    column = task.innovations(answer(scene, model) - answer(scene, without))
    n = nuisance(task, without)
    column = column - n @ (np.linalg.pinv(n.T @ n, hermitian=True) @ (n.T @ column))
    before = task.innovations(task.residual(without))
    block = scene.block_of_sub[scene.sub[task.rows]]
    scores = np.bincount(block, column * e).astype(np.float64)[np.bincount(block) > 0]
    variance = max(long_run_variance(scores), float(e @ e) / len(e) * float(column @ column))
    return float((column @ before) ** 2 / max(variance, 1e-300))
