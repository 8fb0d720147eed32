# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The fitted model: a piecewise-linear curve and dynamics by region."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.numerics import jit
from valveflow_ros.records import ByteArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class RegionalModel:
    """Curve F of eq. (2) and G_i of eq. (3)."""

    # Boundaries of the pieces in % MPa^m, (J + 1,); the outer pieces extend beyond the outer ones.
    knots: FloatArray
    # left, right: float64 (J,), flow in MW at the left and right end of each piece
    left: FloatArray
    right: FloatArray
    levels: FloatArray  # float64 (I - 1,), flow in MW at the boundaries between regions
    # time_constants, delays: float64 (I,), seconds. ``I = 0`` (empty) means that the dynamics are
    # unknown.
    time_constants: FloatArray
    delays: FloatArray
    # c of P = p^e F(V) + c; None if P = F(V p^m). With an offset, the values of pieces are in MW /
    # MPa^e, and flows are in MW.
    offset_mw: float | None = None

    @property
    def pieces(self) -> int:
        """Return J."""
        return len(self.left)

    @property
    def regions(self) -> int:
        """Return I."""
        return len(self.time_constants)

    @property
    def offset(self) -> float:
        """Return c in MW, 0 if the form has none."""
        return self.offset_mw or 0.0

    @property
    def size(self) -> int:
        """Return the number of packed parameters."""
        return 3 * self.pieces - 1 + 2 * self.regions + (self.offset_mw is not None)

    @property
    def dynamic_places(self) -> slice:
        """Return the positions of ln T and the delays among the packed parameters."""
        first = 3 * self.pieces - 1
        return slice(first, first + 2 * self.regions)

    @property
    def delay_places(self) -> slice:
        """Return the positions of the delays among the packed parameters."""
        first = 3 * self.pieces - 1 + self.regions
        return slice(first, first + self.regions)

    def slopes(self) -> FloatArray:
        """Return K_f, MW per unit of u, shape (J,)."""
        return np.asarray((self.right - self.left) / np.diff(self.knots))

    def intercepts(self) -> FloatArray:
        """Return C, MW at u = 0, shape (J,)."""
        return np.asarray(self.left - self.slopes() * self.knots[:-1])

    def static(self, u: FloatArray, scale: FloatArray | float = 1.0) -> FloatArray:
        """Return ``scale`` F(u) + c in MW, shape of ``u``; NaN in gives NaN out.

        Parameters
        ----------
        scale : float64, shape of ``u``, or float
            p^e; 1 if P = F(u).
        """
        return np.asarray(scale * self.shape(u) + self.offset)

    def shape(self, u: FloatArray) -> FloatArray:
        """Evaluate F; NaN for NaN, and for an infinite u on a flat piece."""
        piece = np.clip(np.searchsorted(self.knots, u, side='right') - 1, 0, self.pieces - 1)
        width = np.diff(self.knots)[piece]
        w = (u - self.knots[piece]) / width
        with np.errstate(invalid='ignore'):
            return np.asarray(self.left[piece] + (self.right - self.left)[piece] * w)

    def taps(self, step_s: float) -> FloatArray:
        """Return the filter of each region in the form of the kernels, shape (I, 7)."""
        return make_taps(self.time_constants, self.delays, step_s)

    def respond(
        self, u: FloatArray, usable: ByteArray, step_s: float, settle_s: float,
        scale: FloatArray | float = 1.0,
    ) -> tuple[FloatArray, ByteArray]:  # fmt: skip
        """Return the dynamic prediction in MW and a mask of settled rows, shapes (n,)."""
        answer, settled = np.empty(len(u)), np.empty(len(u), dtype=np.uint8)
        respond(
            self.static(u, scale), usable, self.levels, self.taps(step_s),
            round(settle_s / step_s), answer, settled,
        )  # fmt: skip
        return answer, settled

    def with_levels(self, levels: FloatArray) -> RegionalModel:
        """Return a copy with other boundaries between the regions."""
        return replace(self, levels=np.asarray(levels, dtype=np.float64))

    def pack(self) -> FloatArray:
        """Return the parameters in the order of the kernel's columns."""
        values = np.append(self.left[0], self.right)
        jumps = self.left[1:] - self.right[:-1]
        offset = [] if self.offset_mw is None else [self.offset_mw]
        return np.concatenate(
            [values, self.knots[1:-1], jumps, np.log(self.time_constants), self.delays, offset]
        )

    def unpack(self, parameters: FloatArray) -> RegionalModel:
        """Return the model with other parameters; the inverse of `pack`."""
        j, i = self.pieces, self.regions
        values, rest = parameters[: j + 1], parameters[j + 1 :]
        inner, jumps, rest = rest[: j - 1], rest[j - 1 : 2 * j - 2], rest[2 * j - 2 :]
        knots = self.knots.copy()
        knots[1:-1] = inner
        left = values[:-1].copy()
        left[1:] += jumps
        with np.errstate(over='ignore'):  # a too large step of the fit, which will be rejected
            time_constants = np.exp(rest[:i])
        return replace(
            self, knots=knots, left=left, right=values[1:].copy(),
            time_constants=time_constants, delays=rest[i : 2 * i].copy(),
            offset_mw=None if self.offset_mw is None else float(rest[2 * i]),
        )  # fmt: skip


# Curve and regional dynamics over measured inputs, row by row.
#
# The model is eqs. (2)-(5) of the paper with K_g = 1: x = F(u), and G_i of eq. (3)
# in the region i that x(t) lies in, discretised exactly for a flow that is
# linear between two rows: ``y[t] = a y[t-1] + b x(t-h-tau) + c x(t-tau)`` with
# ``a = exp(-h/T)``, ``b = (1-a) T/h - a`` and ``c = 1 - (1-a) T/h``. Delays need not be
# whole steps; with the two rows around each delayed instant that makes three
# taps.


@jit
def piece_of(u: float, knots: FloatArray) -> int:
    """Return the piece of ``u``; the outer pieces extend to infinity."""
    k = 0
    while k < knots.size - 2 and u >= knots[k + 1]:
        k += 1
    return k


@jit
def curve(u: float, knots: FloatArray, left: FloatArray, right: FloatArray) -> float:
    """Evaluate F: piece k runs from ``left[k]`` to ``right[k]`` in MW."""
    k = piece_of(u, knots)
    w = (u - knots[k]) / (knots[k + 1] - knots[k])
    return float(left[k] + (right[k] - left[k]) * w)


@jit
def region_of(x: float, levels: FloatArray) -> int:
    """Return the region of flow x; ``levels`` are the inner boundaries in MW."""
    r = 0
    while r < levels.size and x >= levels[r]:
        r += 1
    return r


# Columns of a table of taps, one row per region: decay, weights of the flows at `TAP_WHOLE`
# steps back and one and two before, b and c as above.
TAP_A, TAP_0, TAP_1, TAP_2, TAP_WHOLE, TAP_B, TAP_C = range(7)
TAPS = 7


@jit
def make_taps(time_constants: FloatArray, delays: FloatArray, step_s: float) -> FloatArray:
    """Return the taps of each region, shape (I, 7)."""
    taps = np.empty((time_constants.size, TAPS))
    for r in range(time_constants.size):
        a = np.exp(-step_s / time_constants[r])
        mean = (1.0 - a) * time_constants[r] / step_s
        b, c = mean - a, 1.0 - mean
        whole = np.floor(delays[r] / step_s)
        part = delays[r] / step_s - whole
        taps[r, TAP_A] = a
        taps[r, TAP_0] = c * (1.0 - part)
        taps[r, TAP_1] = c * part + b * (1.0 - part)
        taps[r, TAP_2] = b * part
        taps[r, TAP_WHOLE] = whole
        taps[r, TAP_B], taps[r, TAP_C] = b, c
    return taps


@jit
def lag_step(flow: FloatArray, at: int, age: int, tap: FloatArray, state: float) -> float:
    """Return the power of a row from that of the previous row, ``state``.

    ``flow[at]`` is the flow of this row; earlier flows have lower indices. A negative index
    counts from the end, so ``flow`` may be a ring buffer. ``age`` is the number of rows since the
    last gap; the flow before the gap is assumed equal to the first one after it.
    """
    whole = int(tap[TAP_WHOLE])
    return float(
        tap[TAP_A] * state
        + tap[TAP_0] * flow[at - min(whole, age)]
        + tap[TAP_1] * flow[at - min(whole + 1, age)]
        + tap[TAP_2] * flow[at - min(whole + 2, age)]
    )


@jit
def respond(
    x: FloatArray, usable: ByteArray, levels: FloatArray, taps: FloatArray, settle: int,
    answer: FloatArray, settled: ByteArray,
) -> None:  # fmt: skip
    """Filter the flow ``x`` (n,) into the power ``answer`` (n,).

    After a gap the filter starts in steady state, and ``settled`` is 0 for ``settle`` rows.
    """
    state = 0.0
    age = 0
    for t in range(x.size):
        if not usable[t]:
            age = 0
            answer[t] = np.nan
            settled[t] = 0
            continue
        if age == 0:
            state = x[t]
        state = lag_step(x, t, age, taps[region_of(x[t], levels)], state)
        answer[t] = state
        age += 1
        settled[t] = 1 if age > settle else 0


@jit
def whiten(series: FloatArray, weight: ByteArray, ar: FloatArray, out: FloatArray) -> int:
    """Write the innovations of ``series`` (m,) under AR coefficients ``ar``.

    Rows without a complete history are left out; return the number of rows written.
    """
    order = ar.size
    written = 0
    run = 0
    for t in range(series.size):
        run = run + 1 if weight[t] else 0
        if run > order:
            value = series[t]
            for k in range(order):
                value -= ar[k] * series[t - 1 - k]
            out[written] = value
            written += 1
    return written


@jit
def lagged_products(series: FloatArray, weight: ByteArray, order: int) -> FloatArray:
    """Return mean products at lags 0 to ``order`` over pairs of weighted rows."""
    out = np.zeros(order + 1)
    count: IntArray = np.zeros(order + 1, dtype=np.int64)
    for t in range(series.size):
        if not weight[t]:
            continue
        for k in range(min(order, t) + 1):
            if weight[t - k]:
                out[k] += series[t] * series[t - k]
                count[k] += 1
    for k in range(order + 1):
        out[k] /= max(count[k], 1)
    return out
