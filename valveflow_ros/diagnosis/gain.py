"""What a cause is worth on blocks of time that nothing was fitted to, opened once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task, base_tangents, cause_tangents
from valveflow_ros.diagnosis.hidden import fair_residual
from valveflow_ros.records import BoolArray, FloatArray, IntArray

_FLIPS = 100_000
_CHUNK = 5_000
_SEED = 7
_LEAST_SEGMENT_MEANS = 3


@dataclass(frozen=True, slots=True)
class Gain:
    """RMSE in MW on the sealed blocks without and with a cause, and the chance of such a gain."""

    rmse_before: float
    rmse_after: float
    p_value: float

    @property
    def reduction(self) -> float:
        """Return 1 - after / before."""
        return 1.0 - self.rmse_after / self.rmse_before if self.rmse_before > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class SegmentGain:
    """One special segment inside sealed blocks: kind, times in ns, RMSE before and after."""

    number: int
    start_ns: int
    end_ns: int
    rmse_before: float
    rmse_after: float


def rmse(task: Task, model: Extended, rows: BoolArray) -> float:
    """Return the root mean square of the residual over rows."""
    return float(np.sqrt(np.mean(fair_residual(task, model)[rows] ** 2)))


def sealed_gain(task: Task, before: Extended, after: Extended, tried: int) -> Gain:
    """Compare two models, both fitted to the open blocks, on the sealed ones."""
    rows = task.scene.sealed_rows
    sealed = replace(task, rows=rows)
    old, new = fair_residual(task, before), fair_residual(task, after)
    rest, change = sealed.innovations(old), sealed.innovations(old - new)
    scores = np.bincount(task.scene.sub[rows], rest * change).astype(np.float64)
    chance = sign_flip(scores[np.bincount(task.scene.sub[rows]) > 0])
    chance = min(1.0, chance * max(tried, 1))
    return Gain(rmse(task, before, rows), rmse(task, after, rows), chance)


def sign_flip(scores: FloatArray) -> float:
    """Return the chance that scores of either sign would sum to as much.

    A score is the product, summed over a sub-block, of what the cause predicts and what was
    left without it. What was fitted to other blocks cannot know the noise of these, so without
    the cause either sign is as likely; sub-blocks are long against the noise's correlation.
    """
    rng = np.random.default_rng(_SEED)
    total, least = float(scores.sum()), 0
    for _ in range(_FLIPS // _CHUNK):
        signs = rng.integers(0, 2, (_CHUNK, len(scores))) * 2 - 1
        least += int((signs @ scores >= total).sum())
    return (least + 1.0) / (_FLIPS + 1.0)


def noise_floor(task: Task, model: Extended, explained_mw2: float) -> float:
    """Return the RMSE that noise alone would leave on the sealed blocks, estimated.

    What the finite record costs in the parameters, and structure that is still there, are
    taken off.
    """
    rows = task.scene.sealed_rows
    columns = np.column_stack([base_tangents(task, model), cause_tangents(task, model)])
    table = task.innovations(columns)
    norm = np.sqrt((table**2).sum(axis=0))
    norm[norm <= 1e-9 * norm.max()] = np.inf
    e = task.innovations(task.residual(model))
    inverse = np.linalg.pinv((table / norm).T @ (table / norm), hermitian=True)
    inverse *= float(e @ e) / len(e)
    sealed = columns[rows] / norm
    spread = float(np.einsum('ij,jk,ik->i', sealed, inverse, sealed).mean())
    left = rmse(task, model, rows) ** 2 - spread - max(explained_mw2, 0.0)
    return float(np.sqrt(max(left, 0.0)))


def by_segment(
    task: Task, before: Extended, after: Extended, spans_ns: IntArray
) -> tuple[SegmentGain, ...]:
    """Return RMSE before and after in every special segment that lies in sealed blocks.

    Parameters
    ----------
    spans_ns : int64 (k, 2)
        First and last time of each segment.
    """
    scene = task.scene
    old, new = fair_residual(task, before), fair_residual(task, after)
    places = (spans_ns - scene.start_ns) / (scene.mean_s * 1e9)
    out = []
    for number, (a, b) in enumerate(places):
        first, end = max(0, int(np.ceil(a))), min(len(old), int(b))
        inside = np.zeros(len(old), dtype=bool)
        inside[first:end] = True
        inside &= scene.sealed_rows
        if end - first < _LEAST_SEGMENT_MEANS or inside.sum() < end - first:
            continue
        out.append(
            SegmentGain(
                number + 1, int(spans_ns[number, 0]), int(spans_ns[number, 1]),
                float(np.sqrt(np.mean(old[inside] ** 2))),
                float(np.sqrt(np.mean(new[inside] ** 2))),
            )
        )  # fmt: skip
    return tuple(out)
