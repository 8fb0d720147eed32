# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where the simulation is wrong: the residual over measured variables and after fast moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from valveflow_ros.diagnosis.diagnose import Record
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.diagnosis.grids import ORDER
from valveflow_ros.diagnosis.result import Diagnosis
from valveflow_ros.diagnosis.structure import variables
from valveflow_ros.records import BoolArray, FloatArray

BINS = 20
_SHIFTS = 60
_SEED = 11
_MINUTE_S = 60.0
_NORMAL99 = 2.576
_LEAST_RANGE = 1e-6  # in the unit of any variable
_PLAY_PERCENT = 1.5
_FAST_PERCENT, _FAST_S = 0.8, 10.0
_BEFORE_S, _AFTER_S = 60.0, 300.0
UNITS = {
    'u': '% MPa^m', 'pressure given u': 'MPa off its line', 'temperature': 'degC', 'time': 's',
    'time of day': 's', 'ramp': 'u in 3 min', 'direction': 'share of the last 1.5 %',
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Signature:
    """Mean residual in bins of one variable.

    Attributes
    ----------
    variable, unit : str
    middle, before, after : float64 (k,)
        Middle of each bin, mean residual in MW of the plain and of the extended model.
    chance : float64 (k,)
        Absolute mean of a bin that is exceeded by chance in one of a hundred records, MW.
    share_before, share_after, share_chance : float
        Fraction of the residual's variance between bins, and the fraction reached by chance in
        one of a hundred records (estimated with the residual shifted in time).
    """

    variable: str
    unit: str
    middle: FloatArray
    before: FloatArray
    after: FloatArray
    chance: FloatArray
    share_before: float
    share_after: float
    share_chance: float


def _minutes(task: Task, series: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return means of a series (m,) over a minute, and which of them are complete."""
    rows = max(1, round(_MINUTE_S / task.grids.mean_s))
    m = len(series) // rows
    mean: FloatArray = series[: m * rows].reshape(m, rows).mean(axis=1)
    return mean, np.asarray(task.rows[: m * rows].reshape(m, rows).all(axis=1), dtype=bool)


def _variables(task: Task, model: Extended) -> dict[str, FloatArray]:
    values = {name: _minutes(task, x)[0] for name, x in variables(task, model).items()}
    return values | {'time of day': task.grids.clock_s(values['time'])}  # no mean over midnight


def signatures(task: Task, before: Extended, after: Extended) -> tuple[Signature, ...]:
    """Return the residual over every variable, on all blocks."""
    old, good = _minutes(task, task.residual(before))
    new = _minutes(task, task.residual(after))[0]
    values = {n: v for n, v in _variables(task, before).items() if n in UNITS}
    values['direction'] = _direction(task)
    return tuple(
        _signature(name, values[name], old, new, good)
        for name in UNITS if name in values and _varies(values[name][good])
    )  # fmt: skip


def _varies(values: FloatArray) -> bool:
    """Return False for rounding errors about a constant, as of a constant given by the user."""
    return float(np.ptp(values)) > _LEAST_RANGE


def _direction(task: Task) -> FloatArray:
    """Return the position inside a backlash gap: -1 after closing, 1 after opening."""
    grids = task.grids
    v = _minutes(task, grids.means(grids.coarse(np.where(np.isfinite(grids.v), grids.v, 0.0))))[0]
    out, state, half = np.empty(len(v)), v[0], 0.5 * _PLAY_PERCENT
    for t, here in enumerate(v):
        state = min(max(state, here - half), here + half)
        out[t] = (here - state) / half
    return out


def _signature(
    name: str, value: FloatArray, old: FloatArray, new: FloatArray, good: BoolArray
) -> Signature:
    # Values shared by many minutes (the end of the gap) would give empty bins.
    edges = np.unique(np.quantile(value[good], np.linspace(0.0, 1.0, BINS + 1)[1:-1]))
    cell = np.unique(np.searchsorted(edges, value[good], side='right'), return_inverse=True)[1]
    count = np.bincount(cell)

    def means(x: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(cell, x) / count)

    def share(x: FloatArray) -> float:
        x = x - x.mean()
        return float((count * means(x) ** 2).sum() / max(float(x @ x), 1e-300))

    rng = np.random.default_rng(_SEED)
    n = int(good.sum())
    low = min(n // 4, 1440)
    rolled = [np.roll(new[good], int(rng.integers(low, n - low))) for _ in range(_SHIFTS)]
    spread = np.sqrt(np.mean([(means(x) - x.mean()) ** 2 for x in rolled], axis=0))
    return Signature(
        name, UNITS[name], means(value[good]), means(old[good]), means(new[good]),
        _NORMAL99 * spread, share(old[good]), share(new[good]),
        float(np.quantile([share(x) for x in rolled], 0.99)),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Answer:
    """Mean residual around fast moves of the valve, in MW.

    ``up`` says whether the valve opened; ``chance`` is two standard errors.
    """

    up: bool
    moves: int
    time_s: FloatArray
    before: FloatArray
    after: FloatArray
    chance: float


def after_moves(task: Task, before: Extended, after: Extended) -> tuple[Answer, ...]:
    """Return the mean residual around fast moves, separately for opening and closing."""
    grids = task.grids
    v = grids.means(grids.coarse(np.where(np.isfinite(grids.v), grids.v, 0.0)))
    span = max(1, round(_FAST_S / grids.mean_s))
    change = np.concatenate([np.zeros(span), v[span:] - v[:-span]])
    old, new = task.residual(before), task.residual(after)
    first, last = round(_BEFORE_S / grids.mean_s), round(_AFTER_S / grids.mean_s)
    offsets = np.arange(-first, last + 1)
    out = []
    for up in (True, False):
        fast = (change if up else -change) > _FAST_PERCENT
        start = np.flatnonzero(fast & ~np.concatenate([[False], fast[:-1]]))
        start = start[(start >= first) & (start + last < len(v))]
        rows = start[:, None] + offsets[None, :]
        rows = rows[grids.scored[rows].all(axis=1)]
        if len(rows) < 10:
            continue
        noise = float(old[grids.scored].std())
        out.append(
            Answer(
                up, len(rows), np.asarray(offsets * grids.mean_s, dtype=np.float64),
                old[rows].mean(axis=0),
                new[rows].mean(axis=0), 2.0 * noise / np.sqrt(len(rows)),
            )
        )  # fmt: skip
    return tuple(out)


# Maps of the residual over two variables: an effect of both may be invisible over each alone.

CELLS = 14
PAIRS = (('time', 'u'), ('pressure given u', 'u'))
_MAP_SHIFTS, _MAP_SEED = 60, 13
_LEAST_MINUTES = 15


@dataclass(frozen=True, slots=True)
class ResidualMap:
    """Mean residual in cells of two variables.

    Attributes
    ----------
    across, up : str
        The variables on the horizontal and vertical axis.
    across_edges, up_edges : float64 (k + 1,), (m + 1,)
    before, after : float64 (m, k)
        Mean residual in MW of the plain and of the extended model; NaN in cells with too few
        minutes or with a mean that chance exceeds in one of a hundred records.
    shown_before, shown_after : int
        Number of cells outside the 99 % band of random noise.
    cells : int
        Number of cells with enough minutes; one in a hundred of them exceeds the limit by chance.
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
    """Return the residual over u and time, and over u and the pressure not explained by u."""
    old, good = _minutes(task, task.residual(before))
    new = _minutes(task, task.residual(after))[0]
    values = _variables(task, before)
    return tuple(_map(a, u, values, old, new, good) for a, u in PAIRS if _varies(values[a][good]))


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
    """Return the 99 % limit of each cell, from residuals shifted in time."""
    rng = np.random.default_rng(_MAP_SEED)
    low = min(len(x) // 4, 1440)
    shifted = [means(np.roll(x, int(rng.integers(low, len(x) - low)))) for _ in range(_MAP_SHIFTS)]
    return np.asarray(2.576 * np.sqrt(np.mean(np.square(shifted), axis=0)))


# Data for the figures of a diagnosis, from the record and the models.

Views = tuple[tuple[Signature, ...], tuple[Answer, ...], tuple[ResidualMap, ...]]


def views(record: Record, found: Diagnosis) -> Views:
    """Return residuals by variable, around fast moves and in maps, for both models."""
    bad, _ = record.faults()
    grids = record.grids(bad)
    task = Task(grids, grids.whole, np.zeros(ORDER))
    return (
        signatures(task, found.simulation, found.extended),
        after_moves(task, found.simulation, found.extended),
        residual_maps(task, found.simulation, found.extended),
    )
