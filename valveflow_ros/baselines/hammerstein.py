# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A Hammerstein model, and its identification as in the literature.

It has a piecewise-linear input and one linear block for all loads. Knots, values and the block
are estimated together from the prediction error over all rows, as in ``nlhw`` of the System
Identification Toolbox, with which the paper compares (Section IV). The fit starts from several
sets of knots and searches orders and delay. Orders and noise model are chosen by the simulation
error on the last part of the identification data after a fit to the first part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.baselines.judged import cut_samples, run_mse
from valveflow_ros.curve.regional_model import curve, piece_of
from valveflow_ros.fit.descent import gauss_newton
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.whitening import fit_ar, whitened
from valveflow_ros.numerics import gram, jit
from valveflow_ros.records import ByteArray, FloatArray

# The model is ``x = F(u)`` with F continuous and piecewise linear, followed by one
# linear block ``y[t] = -f_1 y[t-1] - ... + b_0 x[t-d] + b_1 x[t-d-1] + ...``. Its static
# gain is 1, as eq. (5) of the paper sets K_g = 1: ``b_0`` follows from the others.


@jit
def _slopes_of_curve(
    u: float, knots: FloatArray, values: FloatArray, share: float, gains: FloatArray
) -> None:
    """Add ``share`` times the derivatives of F(u) by J + 1 values, then by J - 1 inner knots."""
    pieces = knots.size - 1
    k = piece_of(u, knots)
    width = knots[k + 1] - knots[k]
    w = (u - knots[k]) / width
    slope = (values[k + 1] - values[k]) / width
    gains[k] += share * (1.0 - w)
    gains[k + 1] += share * w
    if k > 0:
        gains[pieces + k] -= share * slope * (1.0 - w)
    if k < pieces - 1:
        gains[pieces + k + 1] -= share * slope * w


@jit
def _push(
    u: FloatArray, flow: FloatArray, knots: FloatArray, values: FloatArray, b: FloatArray,
    f: FloatArray, past: FloatArray, t: int, delay: int, age: int, gains: FloatArray,
    lag: FloatArray, sums: FloatArray,
) -> None:  # fmt: skip
    """Advance the derivatives by row ``t`` and add them to ``sums``.

    ``gains`` receives the terms of flow and past power, ``lag`` the derivatives after the poles.
    """
    n_curve = 2 * (knots.size - 1)
    gains[:] = 0.0
    first = flow[t - min(delay, age)]
    for j in range(b.size):
        back = t - min(delay + j, age)
        _slopes_of_curve(u[back], knots, values, b[j], gains)
        if j > 0:
            gains[n_curve + past.size + j - 1] = flow[back] - first
    for i in range(past.size):
        gains[n_curve + i] = first - past[i]
    for p in range(sums.size):
        value = gains[p]
        for i in range(f.size):
            value -= f[i] * lag[i, p]
        for i in range(f.size - 1, 0, -1):
            lag[i, p] = lag[i - 1, p]
        lag[0, p] = value
        sums[p] += value


@jit
def _next(flow: FloatArray, b: FloatArray, f: FloatArray, past: FloatArray, t: int, delay: int,
          age: int) -> float:  # fmt: skip
    """Advance the linear block by one row; the new power is inserted at the front of ``past``."""
    state = 0.0
    for j in range(b.size):
        state += b[j] * flow[t - min(delay + j, age)]
    for i in range(f.size):
        state -= f[i] * past[i]
    for i in range(f.size - 1, 0, -1):
        past[i] = past[i - 1]
    past[0] = state
    return state


@jit
def run_with_tangents(
    u: FloatArray, usable: ByteArray, knots: FloatArray, values: FloatArray, b: FloatArray,
    f: FloatArray, delay: int, settle: int, group: int, answer: FloatArray,
    jacobian: FloatArray, weight: ByteArray,
) -> None:  # fmt: skip
    """Write means over ``group`` rows of the simulated power and of its derivatives.

    Outputs are ``answer`` (m,), ``jacobian`` (m, P) and ``weight`` (m,), which is 1 if all rows of
    the mean are usable and settled. P = (J + 1) + (J - 1) + n_f + (n_b - 1): values, inner knots,
    f, b_1 and following, or only the first columns of these.
    """
    columns = jacobian.shape[1]
    n_curve = 2 * (knots.size - 1)
    n_f = f.size
    past = np.zeros(n_f)
    lag = np.zeros((n_f, columns))
    gains = np.zeros(n_curve + n_f + b.size - 1)
    sums = np.zeros(columns)
    flow = np.empty(u.size)
    age = 0
    for m in range(answer.size):
        total = 0.0
        sums[:] = 0.0
        good = True
        for t in range(m * group, (m + 1) * group):
            if not usable[t]:
                age = 0
                good = False
                continue
            flow[t] = curve(u[t], knots, values[:-1], values[1:])
            if age == 0:
                past[:] = flow[t]
            if columns > 0:
                if age == 0:
                    gains[:] = 0.0
                    _slopes_of_curve(u[t], knots, values, 1.0, gains)
                    for i in range(n_f):
                        lag[i] = gains[:columns]
                _push(u, flow, knots, values, b, f, past, t, delay, age, gains, lag, sums)
            total += _next(flow, b, f, past, t, delay, age)
            age += 1
            good = good and age > settle
        answer[m] = total / group
        for p in range(columns):
            jacobian[m, p] = sums[p] / group
        weight[m] = 1 if good else 0


@dataclass(frozen=True, slots=True)
class HammersteinModel:
    """Curve F of eq. (2) without jumps, and one discrete transfer function of static gain 1."""

    knots: FloatArray  # (J + 1,) % MPa^m; the outer pieces extend beyond the outer ones
    values: FloatArray  # (J + 1,) MW at the knots
    numerator: FloatArray  # (n_b - 1,) b_1 and following; b_0 makes the static gain 1
    denominator: FloatArray  # (n_f,) f_1 and following, after the leading 1
    delay: int  # rows
    step_s: float

    @property
    def pieces(self) -> int:
        """Return J."""
        return len(self.knots) - 1

    @property
    def b(self) -> FloatArray:
        """Return b_0 and following, shape (n_b,)."""
        first = 1.0 + self.denominator.sum() - self.numerator.sum()
        return np.concatenate([[first], self.numerator])

    @property
    def time_constants_s(self) -> FloatArray:
        """Return the time constants of the real positive poles, longest first."""
        poles = np.roots(np.concatenate([[1.0], self.denominator]))
        real = poles[(np.abs(poles.imag) < 1e-9) & (poles.real > 0.0) & (poles.real < 1.0)].real
        return np.asarray(np.sort(-self.step_s / np.log(real))[::-1])

    def slopes(self) -> FloatArray:
        """Return K_f, MW per unit of u, shape (J,)."""
        return np.asarray(np.diff(self.values) / np.diff(self.knots))

    def intercepts(self) -> FloatArray:
        """Return C, MW at u = 0, shape (J,)."""
        return np.asarray(self.values[:-1] - self.slopes() * self.knots[:-1])

    def static(self, u: FloatArray) -> FloatArray:
        """Evaluate F."""
        k = np.clip(np.searchsorted(self.knots, u, side='right') - 1, 0, self.pieces - 1)
        return np.asarray(self.slopes()[k] * (u - self.knots[k]) + self.values[k])

    def stable(self) -> bool:
        """Return True if the linear block is stable."""
        poles = np.roots(np.concatenate([[1.0], self.denominator]))
        return bool(np.all(np.abs(poles) < 1.0 - 1e-6))

    def run(self, samples: Samples) -> tuple[FloatArray, ByteArray]:
        """Return the simulated power in MW and a mask of settled rows, shapes (n,).

        After a gap the block starts in steady state; in a gap the power is NaN.
        """
        answer, _, settled = self.averaged(replace(samples, group=1), columns=0)
        return np.where(samples.usable > 0, answer, np.nan), settled

    def averaged(
        self, samples: Samples, columns: int | None = None
    ) -> tuple[FloatArray, FloatArray, ByteArray]:
        """Return means of the simulated power (m,), its derivatives (m, P) and the weight (m,).

        ``columns`` is the number of first derivatives to return.
        """
        m = samples.means
        answer, weight = np.empty(m), np.empty(m, dtype=np.uint8)
        jacobian = np.empty((m, len(self.pack()) if columns is None else columns))
        run_with_tangents(
            samples.u, samples.usable, self.knots, self.values, self.b, self.denominator,
            self.delay, round(samples.settle_s / self.step_s), samples.group, answer, jacobian,
            weight,
        )  # fmt: skip
        return answer, jacobian, weight

    def pack(self) -> FloatArray:
        """Return the parameters in the order of the kernel's columns."""
        return np.concatenate([self.values, self.knots[1:-1], self.denominator, self.numerator])

    def unpack(self, parameters: FloatArray) -> HammersteinModel:
        """Return the model with other parameters; the inverse of `pack`."""
        j, n_f = self.pieces, len(self.denominator)
        knots = self.knots.copy()
        knots[1:-1] = parameters[j + 1 : 2 * j]
        return replace(
            self, values=parameters[: j + 1].copy(), knots=knots,
            denominator=parameters[2 * j : 2 * j + n_f].copy(),
            numerator=parameters[2 * j + n_f :].copy(),
        )  # fmt: skip


def tangents(
    samples: Samples, model: HammersteinModel, columns: int | None = None
) -> tuple[FloatArray, FloatArray, ByteArray]:
    """Return residual means (m,), Jacobian of the simulation (m, P) and weight (m,).

    ``columns`` is the number of first derivatives to compute; default all.
    """
    answer, jacobian, weight = model.averaged(samples, columns)
    power = samples.power_mw[: samples.means * samples.group]
    power = power.reshape(samples.means, samples.group).mean(axis=1)
    return np.where(weight > 0, power - answer, 0.0), jacobian, weight


# The identification.

OUTPUT_ERROR: FloatArray = np.empty(0)
_NARROWEST = 0.004  # of the range of u: minimum width of a piece, as in the proposed method
_DELAY_STEPS_S = (8.0, 4.0, 2.0, 1.0)
_REFIT_STEPS = 4  # of a model whose delay was changed
# Initial models: least squares on a grid.
_GRID_T_S = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0)
_GRID_DELAY_S = (0.0, 5.0, 15.0, 30.0)
_SEED = 20240229  # seed of the random knots, so that a fit depends on its data only
_RANDOM_STARTS = 4
_LEAST_PART = 0.05
_KEPT_STARTS = 3
ORDERS = ((1, 1), (2, 2), (3, 3))  # taps n_b and poles n_f
_NEW_POLE = 0.5

Progress = Callable[[str], None]


def move(
    samples: Samples, model: HammersteinModel, ar: FloatArray, steps: int
) -> tuple[HammersteinModel, float]:
    """Fit values, knots and both polynomials by Levenberg-Marquardt with a fixed delay.

    ``ar`` (k,) is an AR model of the noise of the means; empty for the output error model (white
    noise).
    """

    def cost(model: HammersteinModel) -> float:
        residual, _, weight = tangents(samples, model, columns=0)
        e = whitened(residual, weight, ar)
        return float((e * e).sum())

    def equations(model: HammersteinModel) -> tuple[FloatArray, FloatArray]:
        residual, jacobian, weight = tangents(samples, model)
        sums = gram(whitened(np.column_stack([jacobian, residual]), weight, ar))
        return sums[:-1, :-1], sums[:-1, -1]

    def shifted(model: HammersteinModel, step: FloatArray) -> HammersteinModel | None:
        moved = model.unpack(model.pack() + step)
        least = _NARROWEST * (moved.knots[-1] - moved.knots[0])
        return moved if np.all(np.diff(moved.knots) > least) and moved.stable() else None

    return gauss_newton(model, cost, equations, shifted, steps, least_gain=1e-6)


def search_delay(
    samples: Samples, model: HammersteinModel, best: float
) -> tuple[HammersteinModel, float]:
    """Change the delay by whole rows, with a refit, as long as the output error decreases."""
    rows = sorted({max(1, round(s / model.step_s)) for s in _DELAY_STEPS_S}, reverse=True)
    for size in rows:
        for sign in (1, -1):
            while model.delay + sign * size >= 0:
                shifted = replace(model, delay=model.delay + sign * size)
                trial, value = move(samples, shifted, OUTPUT_ERROR, _REFIT_STEPS)
                if not value < best * (1.0 - 1e-7):
                    break
                model, best = trial, value
    return model, best


def knots_to_try(u: FloatArray, pieces: int) -> list[FloatArray]:
    """Return sets of J + 1 knots over the range of ``u``: uniform, quantiles, random."""
    low, high = float(u.min()), float(u.max())
    even = np.linspace(low, high, pieces + 1)
    by_share = np.quantile(u, np.linspace(0.0, 1.0, pieces + 1))
    # Quantiles with a minimum distance of a twentieth of a uniform spacing.
    widths = np.maximum(np.diff(by_share), 0.05 * (high - low) / pieces)
    inner = low + (high - low) * np.cumsum(widths / widths.sum())[:-1]
    tried = [even, 0.5 * (even + by_share), np.concatenate([[low], inner, [high]])]
    rng = np.random.default_rng(_SEED)
    for _ in range(_RANDOM_STARTS if pieces > 1 else 0):
        widths = _LEAST_PART + rng.dirichlet(np.ones(pieces))
        inner = low + (high - low) * np.cumsum(widths / widths.sum())[:-1]
        tried.append(np.concatenate([[low], inner, [high]]))
    return tried if pieces > 1 else tried[:1]


def first_order(
    knots: FloatArray, time_constant_s: float, delay_s: float, step_s: float
) -> HammersteinModel:
    """Return a model with one pole and a flat curve."""
    denominator = np.array([-np.exp(-step_s / time_constant_s)])
    delay = round(delay_s / step_s)
    return HammersteinModel(knots, np.zeros(len(knots)), np.empty(0), denominator, delay, step_s)


def with_best_values(samples: Samples, model: HammersteinModel) -> tuple[HammersteinModel, float]:
    """Return the model with the values at the knots that fit best, and its squared error.

    For a given linear block and given knots the output is linear in the values.
    """
    zero = replace(model, values=np.zeros_like(model.values))
    residual, jacobian, weight = tangents(samples, zero, columns=model.pieces + 1)
    sums = gram(whitened(np.column_stack([jacobian, residual]), weight, np.empty(0)))
    # A knot without samples nearby is not determined by the data: use the minimum-norm solution.
    values = np.linalg.pinv(sums[:-1, :-1], rcond=1e-10, hermitian=True) @ sums[:-1, -1]
    left = float(sums[-1, -1] - values @ sums[:-1, -1])
    return replace(model, values=values), left


def starts(samples: Samples, pieces: int) -> list[HammersteinModel]:
    """Return the best model of the (T, tau) grid for each set of knots, best first."""
    u, step_s = samples.u[samples.usable > 0], samples.step_s
    found = []
    for knots in knots_to_try(u, pieces):
        tried = [
            with_best_values(samples, first_order(knots, t, d, step_s))
            for t in _GRID_T_S for d in _GRID_DELAY_S
        ]  # fmt: skip
        found.append(min(tried, key=lambda pair: pair[1]))
    return [model for model, _ in sorted(found, key=lambda pair: pair[1])]


@dataclass(frozen=True, slots=True)
class HammersteinFit:
    """The model and the evidence for its choice."""

    model: HammersteinModel
    noise: str  # 'output error' or 'autoregressive'
    # (n_b, n_f, noise, mean squared error in MW^2 on the held-out part)
    tried: tuple[tuple[int, int, str, float], ...]


def fit_hammerstein(
    samples: Samples, pieces: int, progress: Progress = lambda _: None
) -> HammersteinFit:
    """Identify a Hammerstein model of ``pieces`` pieces.

    Raises
    ------
    TooFewSamplesError
        Too few rows are far enough after a gap.
    """
    learn, judge = cut_samples(samples)
    progress('Hammerstein model: starts')
    coarse = _at_coarse(learn, pieces)
    progress('Hammerstein model: orders')
    candidates = _orders(learn, coarse)
    tried = [(len(m.b), len(m.denominator), noise, run_mse(m, judge)) for noise, m in candidates]
    noise, model = candidates[int(np.argmin([t[-1] for t in tried]))]
    progress('Hammerstein model: all data')
    return HammersteinFit(_on_all(samples, model, noise), noise, tuple(tried))


def _at_coarse(samples: Samples, pieces: int) -> HammersteinModel:
    """Return the best of several starts, fitted on averaged rows, at the step of the rows."""
    coarse = samples.coarser()
    moved = [move(coarse, s, OUTPUT_ERROR, 15) for s in starts(coarse, pieces)[:_KEPT_STARTS]]
    model, _ = min(moved, key=lambda pair: pair[1])
    factor = model.step_s / samples.step_s
    pole = np.maximum(-model.denominator, 1e-6) ** (1.0 / factor)
    return replace(
        model, denominator=-pole, delay=round(model.delay * factor), step_s=samples.step_s
    )


def _orders(samples: Samples, model: HammersteinModel) -> list[tuple[str, HammersteinModel]]:
    """Return a model of each order with both noise models; each fit starts from the last one."""
    found: list[tuple[str, HammersteinModel]] = []
    for n_b, n_f in ORDERS:
        model, best = move(samples, grown(model, n_b, n_f), OUTPUT_ERROR, 12)
        if not found:
            model, _ = search_delay(samples, model, best)
        found += [('output error', model), ('autoregressive', _whitened(samples, model))]
    return found


def _whitened(samples: Samples, model: HammersteinModel) -> HammersteinModel:
    """Refit with an AR model of the noise, which is far from white."""
    residual, _, weight = tangents(samples, model, columns=0)
    return move(samples, model, fit_ar(residual, weight), 8)[0]


def grown(model: HammersteinModel, n_b: int, n_f: int) -> HammersteinModel:
    """Add taps and poles without changing the model: a tap of 0, or a pole on a zero."""
    b, f = model.b, np.concatenate([[1.0], model.denominator])
    while len(f) - 1 < n_f and len(b) < n_b:
        f, b = np.convolve(f, [1.0, -_NEW_POLE]), np.convolve(b, [1.0, -_NEW_POLE])
    b = np.append(b, np.zeros(n_b - len(b)))
    f = np.append(f, np.zeros(n_f + 1 - len(f)))
    return replace(model, denominator=f[1:], numerator=b[1:])


def _on_all(samples: Samples, model: HammersteinModel, noise: str) -> HammersteinModel:
    u = samples.u[samples.usable > 0]
    knots = model.knots.copy()
    knots[0], knots[-1] = min(knots[0], u.min()), max(knots[-1], u.max())
    model = replace(model, knots=knots, values=model.static(knots))
    model, best = move(samples, model, OUTPUT_ERROR, 12)
    model, _ = search_delay(samples, model, best)
    return model if noise == 'output error' else _whitened(samples, model)
