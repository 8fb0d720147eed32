"""How sure the parameters of the causes are: 95 % intervals.

Smooth parameters get the sandwich of the joint Gauss-Newton matrix with scores summed over
blocks; dead bands and limits the profile of the likelihood, widened by the same ratio of
robust to plain variance. Where the likelihood jumps (an onset, a level, a band of sticking) its
ratio is no chi-square: the highest of two random walks that fall away from the true place is
below c with probability (1 - exp(-c / 2))^2, which is 0.95 at c = 7.35 (Siegmund, Adv. Appl.
Prob. 20, 1988, 645; Eo and Morley, Quant. Econ. 6, 2015, 463). What acts on the opening is
known no better than the opening is measured: two standard deviations of its noise are added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from valveflow_ros.diagnosis.cause import Estimate, Kind, Stage, Unknown
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.evidence import colour, long_run_variance
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import (
    Task,
    base_tangents,
    cause_tangents,
    free,
    level_tangents,
)
from valveflow_ros.records import FloatArray

_Z95 = 1.959963984540054
_CHI95 = 3.841458820694124
_JUMP95 = 7.352
_NOISES = 2.0
_PLACES, _MISSES = 120, 8
_DOUBLINGS, _HALVINGS = 12, 7
_PROFILE_BLOCK_SUBS = 2


class Certainty:
    """The joint linearisation of a fitted model, from which all intervals come."""

    def __init__(self, task: Task, model: Extended) -> None:
        model = free(model, catalogue())
        self.task, self.model = task, model
        causes = cause_tangents(task, model)
        table = task.innovations(
            np.column_stack([causes, base_tangents(task, model), level_tangents(task, model)])
        )
        norm = np.sqrt((table**2).sum(axis=0))
        norm[norm <= 1e-9 * norm.max()] = np.inf
        self.table = table / norm
        self.norm = norm
        self.causes = causes.shape[1]
        self.e = task.innovations(task.residual(model))
        self.variance = float(self.e @ self.e) / len(self.e)
        self.inverse = np.linalg.pinv(self.table.T @ self.table, hermitian=True)
        scene = task.scene
        self._colour = colour(task, self.e)
        self._group = scene.sub[task.rows] // _PROFILE_BLOCK_SUBS

    def _widening(self, column: FloatArray) -> float:
        """Return robust over plain variance of the coefficient of a column, at least 1."""
        scores = np.bincount(self._group, column * self.e).astype(np.float64)
        scores = scores[np.bincount(self._group) > 0]
        plain = self.variance * float(column @ column)
        return max(1.0, long_run_variance(scores) / max(plain, 1e-300))

    def smooth(self) -> list[float]:
        """Return a standard error for every parameter that Gauss-Newton moves."""
        out = []
        for k in range(self.causes):
            influence = self.table @ self.inverse[:, k]
            error = np.sqrt(max(self.inverse[k, k], 0.0) * self.variance)
            out.append(float(error * np.sqrt(self._widening(influence)) / self.norm[k]))
        return out

    def profile(self, c: int, k: int, own: int | None) -> tuple[float, float]:
        """Return where the profile of the likelihood falls by half the 95 % point of chi^2.

        Parameters
        ----------
        c, k : int
            Cause and parameter.
        own : int or None
            Column of this parameter in the table, which must not follow.
        """
        keep = [j for j in range(self.table.shape[1]) if j != own]
        others = self.table[:, keep]
        inverse = np.linalg.pinv(others.T @ others, hermitian=True)

        def cost(value: float) -> float:
            a = self.model.active[c]
            values = list(a.values)
            values[k] = value
            e = self.task.innovations(
                self.task.residual(self.model.having(replace(a, values=tuple(values))))
            )
            toward = others.T @ e
            return float(e @ e) - float(toward @ inverse @ toward)

        cause = self.model.active[c].cause
        unknown, here = cause.unknowns[k], self.model.active[c].values[k]
        if unknown.kind is Kind.LINE:
            most = cost(here) + _JUMP95 * self.variance * self._colour
            low, high = (_last_place(cost, here, sign * unknown.step, unknown, most)
                         for sign in (-1.0, 1.0))  # fmt: skip
        else:
            influence = self.table @ self.inverse[:, own] if own is not None else np.ones(1)
            most = cost(here) + _CHI95 * self.variance * self._widening(influence)
            low = _crossing(cost, here, -unknown.step, unknown.low, most)
            high = _crossing(cost, here, unknown.step, unknown.high, most)
        if cause.stage is Stage.OPENING and unknown.unit == '%':
            margin = _NOISES * self.task.scene.reference.opening_noise
            low, high = max(low - margin, unknown.low), min(high + margin, unknown.high)
        return low, high

    def intervals(self) -> dict[str, dict[str, Estimate]]:
        """Return all estimates by cause and parameter."""
        errors = self.smooth()
        out: dict[str, dict[str, Estimate]] = {}
        column = 0
        for c, a in enumerate(self.model.active):
            out[a.name] = {}
            for k, unknown in enumerate(a.cause.unknowns):
                value = a.values[k]
                own = None if unknown.kind is Kind.LINE else column
                if own is not None and unknown.kind is Kind.SMOOTH:
                    low, high = value - _Z95 * errors[column], value + _Z95 * errors[column]
                else:
                    low, high = self.profile(c, k, own)
                column += own is not None
                out[a.name][unknown.name] = Estimate(
                    value, low, high + unknown.concealed, unknown.unit,
                    self.task.scene.start_ns if unknown.dated else None,
                )  # fmt: skip
        return out


def _crossing(
    cost: Callable[[float], float], here: float, step: float, bound: float, most: float
) -> float:
    """Return where the cost rises above ``most``, walking from ``here`` in steps that double."""
    inside, outside = here, here
    stride = 0.05 * step
    for _ in range(_DOUBLINGS):
        outside = here + stride
        beyond = outside <= bound if step < 0.0 else outside >= bound
        if beyond:
            outside = bound
        if cost(outside) > most:
            break
        if beyond:
            return bound
        inside, stride = outside, 2.0 * stride
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        inside, outside = (inside, middle) if cost(middle) > most else (middle, outside)
    return outside


def _last_place(
    cost: Callable[[float], float], here: float, step: float, unknown: Unknown, most: float
) -> float:
    """Return the last place in one direction whose cost is below ``most``.

    The cost is ragged: the walk goes on over some places that are too dear, in strides that
    grow where it gets far.
    """
    stride, place, last, misses = 0.02 * step, here, here, 0
    for count in range(_PLACES):
        place += stride
        if not unknown.low <= place <= unknown.high:
            return unknown.low if step < 0.0 else unknown.high
        if cost(place) <= most:
            last, misses = place, 0
        else:
            misses += 1
        if misses >= _MISSES:
            break
        if count % 10 == 9 and misses == 0:
            stride *= 2.0
    return last + stride if last != here else here + np.sign(step) * abs(stride)
