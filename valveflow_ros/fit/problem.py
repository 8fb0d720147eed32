# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measured rows, the residual and tangents of a model, and the fit of its parameters."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.fit.descent import descend, gauss_newton
from valveflow_ros.fit.kernels import answer_residual, normal_sums, square_sum, tangents
from valveflow_ros.numerics import cores, output_size, run_in_threads, runs
from valveflow_ros.records import BoolArray, ByteArray, FloatArray, IntArray

# The last fit averages few rows: a load controller that reacts to the power within the averaged
# rows would otherwise be taken for dynamics of the valve.
_FINE_S = 2.0
# The filters of a stretch of rows start this many time constants before it: their initial state
# then has no effect on the last bit of the answer.
_FORGOTTEN = 40.0
# Minimum number of means of a stretch; it also has at least eight times its lead. The division
# depends on rows and model only, so that the result does not depend on the machine.
_STRETCH = 8192
_FEW = 4
# Rows are taken as held by a historian if more than this part of them repeats the row before.
# A measured power hardly ever repeats by chance.
_HELD_SHARE = 0.3
# A shorter lag, as a fraction of the time between rows, does not show in them.
LEAST_LAG, _LONGEST_LAG_S, _LONGEST_DELAY_S = 0.1, 3600.0, 600.0
_TINY = 1e-7  # relative to 1 plus the size of a parameter
CLOSEST_KNOTS = 0.004  # of their range
_LEVEL_STEPS_MW = (6.0, 3.0, 1.5, 0.8, 0.4, 0.2, 0.1, 0.05)


@dataclass(frozen=True, slots=True)
class Samples:
    """All rows of the window, in the form that the model needs."""

    # u, power_mw: float64 (n,)
    u: FloatArray
    power_mw: FloatArray
    usable: ByteArray  # uint8 (n,), 0 if a row has no data; a gap restarts the filters
    step_s: float
    settle_s: float  # rows within this time after a gap are not scored
    group: int  # rows averaged before scoring
    # float64 (n,), optional: p^e of P = p^e F(u) + c; without it P = F(u).
    scale: FloatArray | None = None
    # float64 (n,), optional: p, 1 where a row has no data; only needed to fit the exponent of the
    # pressure.
    pressure_mpa: FloatArray | None = None

    @property
    def means(self) -> int:
        """Return the number of scored means."""
        return len(self.u) // self.group

    @property
    def scale_or_ones(self) -> FloatArray:
        """Return p^e, or ones for a form without p^e."""
        return np.ones(len(self.u)) if self.scale is None else self.scale

    @property
    def held(self) -> bool:
        """Return True if many rows repeat the row before: a historian held its values."""
        signals = self.u, self.scale_or_ones, self.power_mw
        same = np.all([np.diff(x) == 0.0 for x in signals], axis=0)
        return float(np.mean(same[self.usable[1:] > 0])) > _HELD_SHARE

    def simulated(self, model: RegionalModel) -> Samples:
        """Return held rows with the power that would have been stored if the model were true.

        Between two stored values the true input is taken as a straight line, up to a typical
        change: so it differs from the held rows about as the input of the plant does.
        """
        usable = self.usable > 0
        begin = usable & ~np.append(False, usable[:-1])
        rows = np.arange(len(usable))

        def stored(values: FloatArray) -> tuple[IntArray, IntArray]:
            new = np.append(True, values[1:] != values[:-1])
            at = np.flatnonzero(usable & (begin | new))
            return at, at[np.maximum(np.searchsorted(at, rows, side='right') - 1, 0)]

        def between(values: FloatArray) -> FloatArray:
            at, last = stored(values)
            change = np.abs(np.diff(values[at]))
            typical = float(np.median(change)) if len(change) else 0.0
            ahead = np.interp(rows, at, values[at]) - values[last]
            return np.asarray(values[last] + np.clip(ahead, -typical, typical))

        power, _ = model.respond(
            between(self.u), self.usable, self.step_s, self.settle_s, between(self.scale_or_ones)
        )
        return replace(self, power_mw=power[stored(self.power_mw)[1]])

    def with_exponent(self, by: float) -> Samples:
        """Return the rows with an exponent of the pressure that is larger by ``by``."""
        if not by or self.pressure_mpa is None:
            return self
        factor = self.pressure_mpa**by
        if self.scale is None:
            return replace(self, u=self.u * factor)
        return replace(self, scale=self.scale * factor)

    def model_with_exponent(self, model: RegionalModel, by: float) -> RegionalModel:
        """Return the model that is the same at the median pressure after `with_exponent`."""
        assert self.pressure_mpa is not None
        middle = float(np.median(self.pressure_mpa[self.usable > 0])) ** by
        if self.scale is None:
            return replace(model, knots=model.knots * middle)
        return replace(model, left=model.left / middle, right=model.right / middle)

    def finer(self) -> Samples:
        """Return the same rows with little averaging, for the last fit of all parameters."""
        return replace(self, group=max(1, min(self.group, round(_FINE_S / self.step_s))))

    def slower(self, mean_s: float) -> Samples:
        """Return the rows of `coarser`, scored as means over about ``mean_s``."""
        rows = self.coarser()
        return replace(rows, group=max(rows.group, round(mean_s / rows.step_s)))

    def coarser(self) -> Samples:
        """Return means over several rows, for searches; a scored mean then has two rows.

        The filter is exact for a flow that is linear between rows, so only changes
        that are faster than the rows are lost.
        """
        factor = self.group // 2
        if factor < 2:
            return self
        rows = len(self.u) // (2 * factor) * 2

        def mean(values: FloatArray) -> FloatArray:
            return np.asarray(values[: rows * factor].reshape(rows, factor).mean(axis=1))

        usable = np.asarray(self.usable[: rows * factor].reshape(rows, factor).min(axis=1))
        return replace(
            self,
            u=mean(self.u),
            power_mw=mean(self.power_mw),
            usable=usable,
            step_s=self.step_s * factor,
            group=2,
            scale=None if self.scale is None else mean(self.scale),
            pressure_mpa=None if self.pressure_mpa is None else mean(self.pressure_mpa),
        )


class Problem:
    """Measured means, and residuals and tangents of a model for them."""

    def __init__(self, samples: Samples) -> None:
        self.samples = samples
        m = samples.means
        cut = m * samples.group
        self.settle = round(samples.settle_s / samples.step_s)
        self.u = np.ascontiguousarray(samples.u[:cut])
        self.usable = np.ascontiguousarray(samples.usable[:cut])
        self.scale = np.ascontiguousarray(samples.scale_or_ones[:cut])
        power = np.where(self.usable > 0, samples.power_mw[:cut], 0.0)
        self.power = power.reshape(m, samples.group).mean(axis=1)
        self.size = output_size(self.power)
        self._threads = cores()

    def answer(self, model: RegionalModel) -> tuple[FloatArray, ByteArray]:
        """Return residual means (m,) and their weight."""
        s = self.samples
        residual = np.empty(s.means)
        weight = np.empty(s.means, dtype=np.uint8)
        taps = model.taps(s.step_s)

        def stretch(begin: int, first: int, end: int) -> None:
            answer_residual(
                self.u, self.scale, model.offset, self.usable, self.power,
                model.knots, model.left, model.right, model.levels, taps, self.settle, s.group,
                begin, first, end, residual, weight,
            )  # fmt: skip

        # The answer is fast to compute: more and shorter stretches would be slower.
        run_in_threads(stretch, self._stretches(model, least=-(-s.means // _FEW)), self._threads)
        return residual, weight

    def tangents(
        self, model: RegionalModel, also: int = 0
    ) -> tuple[FloatArray, FloatArray, ByteArray]:
        """Return residual (m,), Jacobian of the prediction (m, P) and weight (m,).

        The Jacobian has ``also`` further columns at the end, which are not initialised.
        """
        s = self.samples
        residual = np.empty(s.means)
        jacobian = np.empty((s.means, model.size + also))
        weight = np.empty(s.means, dtype=np.uint8)
        added = np.full(len(self.u), model.offset)

        def stretch(begin: int, first: int, end: int) -> None:
            part = slice(first, end)
            self._tangents(
                model, added, begin, first, end, residual[part], jacobian[part], weight[part]
            )  # fmt: skip

        run_in_threads(stretch, self._stretches(model), self._threads)
        return residual, jacobian, weight

    def normal(self, model: RegionalModel, ar: FloatArray) -> tuple[FloatArray, int]:
        """Return `normal_equations` of the tangents without storing all tangents in memory.

        Returns
        -------
        sums : float64 (P + 1, P + 1)
            The residual is the last column.
        rows : int
        """
        order, columns = len(ar), model.size
        parts = self._stretches(model, also=order)
        added = np.full(len(self.u), model.offset)
        sums = np.zeros((len(parts), columns + 1, columns + 1))
        rows = np.zeros(len(parts), dtype=np.int64)

        def stretch(k: int, begin: int, first: int, end: int) -> None:
            back = min(first, order)
            n = end - first + back
            residual, jacobian = np.empty(n), np.empty((n, columns))
            weight = np.empty(n, dtype=np.uint8)
            self._tangents(model, added, begin, first - back, end, residual, jacobian, weight)
            rows[k] = normal_sums(
                jacobian, residual, weight, ar, back, n, sums[k], np.empty((0, columns))
            )  # fmt: skip

        run_in_threads(stretch, [(k, *part) for k, part in enumerate(parts)], self._threads)
        total = np.tril(sums.sum(axis=0))
        return total + np.tril(total, -1).T, int(rows.sum())

    def _tangents(
        self, model: RegionalModel, added: FloatArray, begin: int, first: int, end: int,
        residual: FloatArray, jacobian: FloatArray, weight: ByteArray,
    ) -> None:  # fmt: skip
        s = self.samples
        tangents(
            self.u, self.scale, added, self.usable, self.power,
            model.knots, model.left, model.right, model.levels,
            model.time_constants, model.delays, s.step_s, self.settle, s.group,
            begin, first, end, residual, jacobian, weight,
        )  # fmt: skip

    def cost(self, model: RegionalModel, ar: FloatArray) -> float:
        """Return the sum of squared innovations."""
        return self._scored(model, ar)[0]

    def gain(self, small: RegionalModel, large: RegionalModel, ar: FloatArray) -> float:
        """Return the log-likelihood gain of ``large`` over ``small``."""
        cost, rows = self._scored(large, ar)
        return float(0.5 * rows * np.log(self.cost(small, ar) / max(cost, 1e-300)))

    def _scored(self, model: RegionalModel, ar: FloatArray) -> tuple[float, int]:
        """Return the sum of squared innovations and their number."""
        residual, weight = self.answer(model)
        cost, rows = square_sum(residual, weight, ar)
        return float(cost), int(rows)

    def _stretches(
        self, model: RegionalModel, also: int = 0, least: int = 0
    ) -> list[tuple[int, int, int]]:
        s = self.samples
        return stretches(model, s.means, s.group, s.step_s, self.settle, also=also, least=least)


def stretches(
    model: RegionalModel, means: int, group: int, step_s: float, settle: int, *, also: int = 0,
    least: int = 0,
) -> list[tuple[int, int, int]]:  # fmt: skip
    """Divide means over ``group`` rows into stretches: start of the filters, first mean, end.

    ``also`` means before the first are correct, too; a stretch has at least ``least`` means.
    """
    memory_s = _FORGOTTEN * float(model.time_constants.max()) + float(model.delays.max())
    lead = math.ceil((memory_s / step_s + settle + 3) / group) + also
    length = max(_STRETCH, 8 * lead, least)
    return [(max(0, first - lead), first, end) for first, end in runs(means, length)]


def free_parameters(model: RegionalModel, jumps: BoolArray | None = None) -> BoolArray:
    """Return the mask of free parameters in packed order; no jumps unless ``jumps`` (J - 1,)."""
    free = np.ones(model.size, dtype=bool)
    free[2 * model.pieces : 3 * model.pieces - 1] = False if jumps is None else jumps
    return free


def within_bounds(model: RegionalModel, packed: FloatArray, step_s: float) -> RegionalModel:
    """Return the model of packed parameters, with each of them moved inside its limits.

    Lags and delays become such as rows ``step_s`` apart can show. Breakpoints are at least
    `CLOSEST_KNOTS` of their range apart.
    """
    packed, first = packed.copy(), model.dynamic_places.start
    lags, delays = slice(first, first + model.regions), model.delay_places
    packed[lags] = np.clip(packed[lags], np.log(LEAST_LAG * step_s), np.log(_LONGEST_LAG_S))
    packed[delays] = np.clip(packed[delays], 0.0, _LONGEST_DELAY_S)
    found = model.unpack(packed)
    knots = found.knots
    # Each breakpoint keeps room for those on both sides.
    room = CLOSEST_KNOTS * (knots[-1] - knots[0]) * np.arange(len(knots))
    spread = np.maximum.accumulate(knots - room)
    return replace(found, knots=np.minimum(spread, knots[-1] - room[-1]) + room)


def within_reach(
    model: RegionalModel, free: BoolArray, normal: FloatArray, slope: FloatArray, step_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return normal equations that hold the parameters at a bound that the slope points out of.

    A step that wants to move them is wrong for the others too (Bertsekas, SIAM J. Control Optim.
    20, 1982). The free parameters of the model come first in the equations.
    """
    packed = model.pack()
    at = slope[: int(free.sum())]
    wanted = np.zeros(len(packed))
    wanted[free] = _TINY * (1.0 + np.abs(packed[free])) * np.sign(at)
    moved = within_bounds(model, packed + wanted, step_s).pack() - packed
    held = np.abs(moved - wanted) > 0.5 * np.abs(wanted)
    # A breakpoint that pushes a held one is held too.
    moved = within_bounds(model, packed + np.where(held, 0.0, wanted), step_s).pack() - packed
    knots = slice(model.pieces + 1, 2 * model.pieces)
    pushed = (held & (np.abs(moved) > 0.5 * _TINY))[knots]
    held[knots][1:] |= pushed[:-1]
    held[knots][:-1] |= pushed[1:]
    places = np.flatnonzero(held[free])
    normal, slope = normal.copy(), slope.copy()
    normal[places], normal[:, places], slope[places] = 0.0, 0.0, 0.0
    return normal, slope


def move(
    problem: Problem, model: RegionalModel, ar: FloatArray, free: BoolArray, steps: int
) -> tuple[RegionalModel, float]:
    """Minimise the cost over the free parameters; the levels are kept fixed."""

    def equations(model: RegionalModel) -> tuple[FloatArray, FloatArray]:
        sums, _ = problem.normal(model, ar)
        return within_reach(
            model, free, sums[:-1, :-1][np.ix_(free, free)], sums[:-1, -1][free],
            problem.samples.step_s,
        )  # fmt: skip

    def shifted(model: RegionalModel, step: FloatArray) -> RegionalModel:
        packed = model.pack()
        packed[free] += step
        return within_bounds(model, packed, problem.samples.step_s)

    return gauss_newton(model, lambda m: problem.cost(m, ar), equations, shifted, steps)


def with_level_moved(
    model: RegionalModel, level: int, by: float, least: float = 1.0
) -> RegionalModel | None:
    """Return the model with one level moved; None if two levels are within ``least`` MW."""
    levels = model.levels.copy()
    levels[level] += by
    return None if np.any(np.diff(levels) <= least) else model.with_levels(levels)


def search_levels(
    problem: Problem, model: RegionalModel, ar: FloatArray, cost: float
) -> tuple[RegionalModel, float]:
    """Move each level in decreasing steps while the cost falls."""
    for k in range(len(model.levels)):
        for step, sign in itertools.product(_LEVEL_STEPS_MW, (1.0, -1.0)):
            model, cost = descend(
                model, cost, lambda m: problem.cost(m, ar),
                partial(
                    with_level_moved, level=k, by=sign * step * problem.size, least=problem.size
                ),
            )  # fmt: skip
    return model, cost
