"""Maps of the residual over two variables at once: what depends on both shows in neither alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.diagnosis.structure import minutes, variables
from valveflow_ros.records import BoolArray, FloatArray

CELLS = 14
PAIRS = (('time', 'u'), ('pressure given u', 'u'))
_SHIFTS, _SEED = 60, 13
_LEAST_MINUTES = 15


@dataclass(frozen=True, slots=True)
class ResidualMap:
    """Mean residual in cells of two variables.

    Attributes
    ----------
    across, up : str
        The variables.
    across_edges, up_edges : float64 (k + 1,), (m + 1,)
    before, after : float64 (m, k)
        Mean residual in MW of the plain and of the extended model, NaN where too few minutes
        lie or where it is within what chance reaches in one of a hundred records.
    shown_before, shown_after : int
        Cells beyond chance.
    cells : int
        Cells with enough minutes; one in a hundred of them is beyond chance by chance.
    """

    across: str
    up: str
    across_edges: FloatArray
    up_edges: FloatArray
    before: FloatArray
    after: FloatArray
    shown_before: int
    shown_after: int
    cells: int


def residual_maps(task: Task, before: Extended, after: Extended) -> tuple[ResidualMap, ...]:
    """Return the residual over u and time, and over u and the pressure that u does not explain."""
    old, good, _, _ = minutes(task, task.residual(before))
    new = minutes(task, task.residual(after))[0]
    values = variables(task, before)
    return tuple(_map(a, u, values, old, new, good) for a, u in PAIRS)


def _map(
    across: str, up: str, values: dict[str, FloatArray], old: FloatArray, new: FloatArray,
    good: BoolArray,
) -> ResidualMap:  # fmt: skip
    edges = [np.quantile(values[n][good], np.linspace(0.0, 1.0, CELLS + 1)) for n in (across, up)]
    place = [
        np.clip(np.searchsorted(e[1:-1], values[n][good], side='right'), 0, CELLS - 1)
        for n, e in zip((across, up), edges, strict=True)
    ]
    cell = place[1] * CELLS + place[0]
    count = np.bincount(cell, minlength=CELLS * CELLS)
    enough = count >= _LEAST_MINUTES

    def means(x: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(cell, x - x.mean(), CELLS * CELLS) / np.maximum(count, 1))

    chance = _chance(new[good], means)

    def beyond(x: FloatArray) -> FloatArray:
        mean = means(x[good])
        shown = np.where(enough & (np.abs(mean) > chance), mean, np.nan)
        return np.asarray(shown.reshape(CELLS, CELLS))

    before, after = beyond(old), beyond(new)
    return ResidualMap(
        across, up, edges[0], edges[1], before, after, int(np.isfinite(before).sum()),
        int(np.isfinite(after).sum()), int(enough.sum()),
    )  # fmt: skip


def _chance(x: FloatArray, means: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the size that one cell in a hundred reaches when the residual is shifted in time."""
    rng = np.random.default_rng(_SEED)
    low = min(len(x) // 4, 1440)
    shifted = [means(np.roll(x, int(rng.integers(low, len(x) - low)))) for _ in range(_SHIFTS)]
    return np.asarray(2.576 * np.sqrt(np.mean(np.square(shifted), axis=0)))
