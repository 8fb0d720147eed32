# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Screening: the unexplained residual of a model, and fast tests of causes on it.

All tests regress the whitened residual on whitened columns, after removing what curve, dynamics
and the causes found so far could explain. Products of columns are summed once over sub-blocks of
half an hour. A step at any time, a drift or a daily cycle is then a weighted sum of these
products, without another pass over the data.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import Cause, FittedCause, Start, Values
from valveflow_ros.diagnosis.extended import (
    Drive,
    Extended,
    answer,
    drive,
    flow_of,
    region_path,
    response,
)
from valveflow_ros.diagnosis.fitting import (
    Task,
    base_mask,
    base_tangents,
    cause_tangents,
    improve,
    level_tangents,
)
from valveflow_ros.diagnosis.grids import DAY_S, Grids
from valveflow_ros.numerics import each_in_threads
from valveflow_ros.records import ByteArray, FloatArray

# The part that the model itself could explain; it is removed before a cause is judged.


def nuisance(task: Task, model: Extended) -> FloatArray:
    """Return whitened tangents of all free parameters of the model, columns scaled to 1.

    A delay at its bound 0 cannot decrease and is left out: it would absorb a clock offset.
    """
    free = np.flatnonzero(base_mask(task, model))
    base = base_tangents(task, model)
    first_delay = model.base.delay_places.start
    at_bound = [
        k for k, p in enumerate(free)
        if first_delay <= p < model.base.delay_places.stop
        and model.base.delays[p - first_delay] <= 0.0
    ]  # fmt: skip
    base = np.delete(base, at_bound, axis=1)
    table = task.innovations(
        np.column_stack([base, cause_tangents(task, model), level_tangents(task, model)])
    )
    norm = np.sqrt((table**2).sum(axis=0))
    return np.asarray(table[:, norm > 1e-9 * norm.max()] / norm[norm > 1e-9 * norm.max()])


HATS = 13
_SECANT = 0.004
EDGE_SHARE = 0.04  # of the record, at each end: a change there cannot be dated
_STEPS = 5
GAIN, INPUT, OFFSET, CURVE = 0, 1, 2, 3  # carriers (basic effects); the curve has HATS of them


class Screening:
    """The unexplained residual of one model, prepared for tests of causes.

    Parameters
    ----------
    task : Task
    model : Extended
        The fitted model.
    rough : Grids, optional
        The record with longer model rows; the effect of a cause is computed on them, and the
        residual is that of the task.
    """

    def __init__(self, task: Task, model: Extended, rough: Grids | None = None) -> None:
        self.e = task.innovations(task.residual(model))
        task = replace(task, grids=rough) if rough is not None else task
        self.task, self.model, self.grids = task, model, task.grids
        self.here = answer(self.grids, model)
        self.variance = float(self.e @ self.e) / len(self.e)
        self.n = nuisance(task, model)
        self._inverse = np.linalg.pinv(self.n.T @ self.n, hermitian=True)
        self.rest = self.e - self.n @ (self._inverse @ (self.n.T @ self.e))
        self.floor = float(self.rest @ self.rest)
        self.hats = self._hat_knots()

    def _hat_knots(self) -> FloatArray:
        u = self.grids.u[self.grids.usable > 0]
        low, high = np.quantile(u, (0.005, 0.995))
        even = np.linspace(low, high, HATS)
        spread = np.quantile(u, np.linspace(0.005, 0.995, HATS))
        return np.asarray(0.5 * (even + spread))

    def carriers(self) -> FloatArray:
        """Return d power / d (gain, u, offset, curve at the hats), shape (m, 3 + HATS)."""
        grids, model = self.grids, self.model
        driven, x, path = self._driven()

        def scaled(factor: float) -> FloatArray:
            return answer(grids, model, replace(driven, u=driven.u * factor))

        gain = np.ones(len(x)) if driven.gain is None else driven.gain
        columns = [
            response(grids, model, x, path),
            (scaled(1.0 + _SECANT) - scaled(1.0 - _SECANT)) / (2.0 * _SECANT),
            np.ones(len(self.here)),
        ]
        for k in range(HATS):
            hat = np.interp(driven.u, self.hats, np.eye(HATS)[k])
            columns.append(response(grids, model, hat * gain, path))
        return np.column_stack(columns)

    def _driven(self) -> tuple[Drive, FloatArray, ByteArray]:
        """Return the inputs of the curve, x in MW and the region of every model row, (n,)."""
        driven = drive(self.grids, self.model)
        x = flow_of(self.model, driven)
        return driven, x, region_path(self.model, x)

    @functools.cached_property
    def sums(self) -> FloatArray:
        """Return products of the columns (tangents, carriers, residual), summed over sub-blocks.

        Shape (subs, P + 4 + HATS, P + 4 + HATS) with P tangents; sealed sub-blocks are zero. The
        tangents are *not* removed from the carriers here, but after weighting; see `modulated`.
        """
        carriers = self.task.innovations(self.carriers())
        table = np.column_stack([self.n, carriers, self.rest])
        sub = self.grids.sub[self.task.rows]
        edges = np.searchsorted(sub, np.arange(self.grids.subs + 1))
        return np.stack([table[a:b].T @ table[a:b] for a, b in itertools.pairwise(edges)])

    def modulated(self, which: list[int], weights: FloatArray) -> tuple[float, FloatArray]:
        """Return the log-likelihood gain of carriers times functions of time, and coefficients.

        Parameters
        ----------
        which : list of int, length k
            Carriers.
        weights : float64 (k, subs)
            Factor of each carrier in each sub-block.
        """
        p = self.n.shape[1]
        at = [p + c for c in which]
        cross = np.einsum('ks,spk->pk', weights, self.sums[:, :p][:, :, at])
        own = np.einsum('is,js,sij->ij', weights, weights, self.sums[:, at][:, :, at])
        toward = np.einsum('ks,sk->k', weights, self.sums[:, at, -1])
        own = own - cross.T @ self._inverse @ cross
        found = np.linalg.pinv(own, hermitian=True) @ toward
        return float(toward @ found) / (2.0 * self.variance), found

    def onsets(self, shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gains and coefficients of steps at each sub-block, shapes (subs, k).

        Parameters
        ----------
        shapes : float64 (k, 3 + HATS)
            Each row is a combination of carriers that begins at the onset.
        """
        p, c = self.n.shape[1], 3 + HATS
        after = np.cumsum(self.sums[::-1], axis=0)[::-1]
        cross = np.einsum('spc,kc->skp', after[:, :p, p : p + c], shapes)
        own = np.einsum('kc,scd,kd->sk', shapes, after[:, p : p + c, p : p + c], shapes)
        whole = np.maximum(own, 1e-12)
        own = own - np.einsum('skp,pq,skq->sk', cross, self._inverse, cross)
        toward = np.einsum('kc,sc->sk', shapes, after[:, p : p + c, -1])
        good = own > 1e-6 * whole
        found = np.where(good, toward / np.where(good, own, 1.0), 0.0)
        gains = found * toward / (2.0 * self.variance)
        margin = max(1, round(EDGE_SHARE * self.grids.subs))
        gains[:margin] = gains[-margin:] = 0.0
        return gains, found

    def displaced(self, cause: Cause, values: Values, extra: Values = ()) -> Start:
        """Simulate the model with a cause of given size and return its gain."""
        model = self.model.with_cause(FittedCause(cause, cause.clipped(values), extra))
        change = self.task.innovations(self._explained(model))
        left = self.rest - change
        toward = self.n.T @ left
        cost = float(left @ left) - float(toward @ self._inverse @ toward)
        return Start(cause.clipped(values), (self.floor - cost) / (2.0 * self.variance), extra)

    def fitted(self, cause: Cause, values: Values, base: RegionalModel | None = None) -> Start:
        """Return the start of a cause after a few steps of a fit of the whole model.

        It is for effects of which the curve and the dynamics of the model, fitted without them,
        contain much already. The steps begin at ``base``, by default that of the model.
        """
        model = self.model if base is None else replace(self.model, base=base)
        model, cost = improve(self.task, model.with_cause(FittedCause(cause, values)), _STEPS)
        gain = (self.task.cost(self.model) - cost) / (2.0 * self.variance)
        return Start(model.active[-1].values, gain, base=model.base)

    def _explained(self, model: Extended) -> FloatArray:
        """Return the change of the prediction by one more cause in MW, shape (m,)."""
        if not model.active[-1].cause.draws:
            return answer(self.grids, model) - self.here
        return self.grids.power - self.here - self.task.residual(model)

    def best(self, cause: Cause, grid: list[Values], keep: int = 1) -> list[Start]:
        """Return the starts with the largest gain."""
        tried = each_in_threads(lambda values: self.displaced(cause, values), grid)
        return [s for s in sorted(tried, key=lambda s: -s.gain)[:keep] if s.gain > 0.0]

    def scaled(self, cause: Cause, unit: Values) -> list[Start]:
        """Return the start of a cause with one parameter, from its effect at two small values.

        The size is estimated by regression on that effect, then simulated.
        """
        (size,) = unit
        tried = []
        for sign in (1.0, -1.0):
            model = self.model.with_cause(FittedCause(cause, (sign * size,)))
            change = self.task.innovations(answer(self.grids, model) - self.here)
            rest = change - self.n @ (self._inverse @ (self.n.T @ change))
            slope = float(rest @ self.rest) / max(float(rest @ rest), 1e-300)
            tried += [self.displaced(cause, (sign * size * f,)) for f in (slope, 0.5 * slope, 1.0)]
        good = [s for s in tried if s.gain > 0.0]
        return sorted(good, key=lambda s: -s.gain)[:1]

    def only(self, carrier: int) -> FloatArray:
        """Return the shape that consists of one carrier, (1, 3 + HATS)."""
        return np.eye(3 + HATS)[[carrier]]

    def best_onset(self, cause: Cause, shape: FloatArray) -> list[Start]:
        """Return the best start of a cause (size, onset) over onsets at every half hour."""
        gains, found = self.onsets(shape)
        sub = int(np.argmax(gains[:, 0]))
        size = float(found[sub, 0])
        at = self.onset_days(sub)
        return self.best(cause, [(size, at), (0.6 * size, at)])

    def onset_days(self, sub: int) -> float:
        """Return the beginning of a sub-block in days after the first row."""
        return self.sub_start_s(int(sub)) / DAY_S

    def sub_start_s(self, sub: int) -> float:
        """Return the beginning of a sub-block in seconds after the first row."""
        return float(np.searchsorted(self.grids.sub, sub)) * self.grids.mean_s

    @functools.cached_property
    def gain_by_sub(self) -> tuple[FloatArray, FloatArray]:
        """Return, by sub-block, the square of the gain column and its product with the residual.

        The tangents are not removed from the column: over the whole record the curve could explain
        all of the gain, and nothing would remain.
        """
        _, x, path = self._driven()
        column = self.task.innovations(response(self.grids, self.model, x, path))
        sub = self.grids.sub[self.task.rows]
        own, toward = (np.bincount(sub, column * x, self.grids.subs) for x in (column, self.rest))
        return np.asarray(own, dtype=np.float64), np.asarray(toward, dtype=np.float64)

    def scaled_height(self, cause: Cause, shape: Values) -> Start:
        """Return the start of a cause that is linear in its first parameter."""
        model = self.model.with_cause(FittedCause(cause, (1.0, *shape)))
        change = self.task.innovations(answer(self.grids, model) - self.here)
        change = change - self.n @ (self._inverse @ (self.n.T @ change))
        own, toward = float(change @ change), float(change @ self.rest)
        if not own > 0.0:
            return Start((0.0, *shape), 0.0)
        return Start((toward / own, *shape), toward * toward / own / (2.0 * self.variance))
