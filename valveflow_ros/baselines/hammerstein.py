"""A Hammerstein model: piecewise-linear input, one linear block for all loads."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.curve.regional_model import curve, piece_of
from valveflow_ros.fit.problem import Samples
from valveflow_ros.numerics import jit
from valveflow_ros.records import ByteArray, FloatArray

# The model is ``x = F(u)`` with F continuous and piecewise linear, followed by one
# linear block ``y[t] = -f_1 y[t-1] - ... + b_0 x[t-d] + b_1 x[t-d-1] + ...``. Its static
# gain is 1, as eq. (5) of the paper sets K_g = 1: ``b_0`` follows from the others.


@jit
def _slopes_of_curve(
    u: float, knots: FloatArray, values: FloatArray, share: float, gains: FloatArray
) -> None:
    """Add ``share`` times the derivatives of F(u): J + 1 values, then J - 1 inner knots."""
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

    ``gains`` takes what flow and past power add, ``lag`` the derivatives behind the poles.
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
    """Advance the linear block by one row; ``past`` takes the new power in front."""
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

    Parameters
    ----------
    u, usable : (n,)
    knots, values : (J + 1,)
    b : (n_b,), f : (n_f,)
    answer : (m,), jacobian : (m, P), weight : (m,)
        Written. P = (J + 1) + (J - 1) + n_f + (n_b - 1): values, inner knots, f, b_1 and on
        (or fewer columns: the first so many of these). ``weight`` is 1 where all rows of the
        mean are usable and settled.
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
    """Curve F of eq. (2) without jumps, and one discrete transfer function of static gain 1.

    Attributes
    ----------
    knots : float64 (J + 1,)
        % MPa^m; beyond the outer ones the outer pieces go on.
    values : float64 (J + 1,)
        MW at the knots.
    numerator : float64 (n_b - 1,)
        b_1 and on; b_0 makes the static gain 1.
    denominator : float64 (n_f,)
        f_1 and on, after the leading 1.
    delay : int
        Rows.
    step_s : float
    """

    knots: FloatArray
    values: FloatArray
    numerator: FloatArray
    denominator: FloatArray
    delay: int
    step_s: float

    @property
    def pieces(self) -> int:
        """Return J."""
        return len(self.knots) - 1

    @property
    def b(self) -> FloatArray:
        """Return b_0 and on, shape (n_b,)."""
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
        """Return the simulated power in MW and where it has settled, shapes (n,).

        After a gap the block starts in equilibrium; in a gap the power is NaN.
        """
        answer, _, settled = self.averaged(replace(samples, group=1), columns=0)
        return np.where(samples.usable > 0, answer, np.nan), settled

    def averaged(
        self, samples: Samples, columns: int | None = None
    ) -> tuple[FloatArray, FloatArray, ByteArray]:
        """Return means of the simulated power (m,), its derivatives (m, P) and the weight (m,).

        ``columns`` asks for only the first so many derivatives.
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

    Parameters
    ----------
    columns : int, optional
        Only the first so many derivatives.
    """
    answer, jacobian, weight = model.averaged(samples, columns)
    power = samples.power_mw[: samples.means * samples.group]
    power = power.reshape(samples.means, samples.group).mean(axis=1)
    return np.where(weight > 0, power - answer, 0.0), jacobian, weight
