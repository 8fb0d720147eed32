"""Where the simulation is wrong: the residual against what was measured, and after fast moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.diagnosis.structure import minutes, variables
from valveflow_ros.records import BoolArray, FloatArray

BINS = 20
_SHIFTS = 60
_SEED = 11
_NORMAL99 = 2.576
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
        How far the mean of a bin strays by chance in one of a hundred records, MW.
    share_before, share_after, share_chance : float
        Part of the residual's variance between bins, and what chance reaches in one of a
        hundred records (residual shifted in time).
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


def signatures(task: Task, before: Extended, after: Extended) -> tuple[Signature, ...]:
    """Return the residual against every variable, on all blocks."""
    old, good, _, _ = minutes(task, task.residual(before))
    new = minutes(task, task.residual(after))[0]
    values = {n: v for n, v in variables(task, before).items() if n in UNITS}
    values['direction'] = _direction(task)
    return tuple(
        _signature(name, values[name], old, new, good) for name in UNITS if name in values
    )


def _direction(task: Task) -> FloatArray:
    """Return where the opening stands inside a slack: -1 after closing, 1 after opening."""
    scene = task.scene
    v = minutes(task, scene.means(scene.coarse(np.where(np.isfinite(scene.v), scene.v, 0.0))))[0]
    out, state, half = np.empty(len(v)), v[0], 0.5 * _PLAY_PERCENT
    for t, here in enumerate(v):
        state = min(max(state, here - half), here + half)
        out[t] = (here - state) / half
    return out


def _signature(
    name: str, value: FloatArray, old: FloatArray, new: FloatArray, good: BoolArray
) -> Signature:
    # Values that many minutes share (the end of a slack) would make bins without any.
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
    """Return the mean residual around fast moves, opening and closing apart."""
    scene = task.scene
    v = scene.means(scene.coarse(np.where(np.isfinite(scene.v), scene.v, 0.0)))
    span = max(1, round(_FAST_S / scene.mean_s))
    change = np.concatenate([np.zeros(span), v[span:] - v[:-span]])
    old, new = task.residual(before), task.residual(after)
    first, last = round(_BEFORE_S / scene.mean_s), round(_AFTER_S / scene.mean_s)
    offsets = np.arange(-first, last + 1)
    out = []
    for up in (True, False):
        fast = (change if up else -change) > _FAST_PERCENT
        start = np.flatnonzero(fast & ~np.concatenate([[False], fast[:-1]]))
        start = start[(start >= first) & (start + last < len(v))]
        rows = start[:, None] + offsets[None, :]
        rows = rows[scene.scored[rows].all(axis=1)]
        if len(rows) < 10:
            continue
        noise = float(old[scene.scored].std())
        out.append(
            Answer(
                up, len(rows), np.asarray(offsets * scene.mean_s, dtype=np.float64),
                old[rows].mean(axis=0),
                new[rows].mean(axis=0), 2.0 * noise / np.sqrt(len(rows)),
            )
        )  # fmt: skip
    return tuple(out)
