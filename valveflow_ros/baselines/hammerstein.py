"""A Hammerstein model: piecewise-linear input, one linear block for all loads."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.baselines import hammerstein_kernel as kernel
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import ByteArray, FloatArray


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
        """Tell whether the linear block comes to rest."""
        poles = np.roots(np.concatenate([[1.0], self.denominator]))
        return bool(np.all(np.abs(poles) < 1.0 - 1e-6))

    def run(self, samples: Samples) -> tuple[FloatArray, ByteArray]:
        """Return the simulated power in MW and where it has settled, shapes (n,)."""
        return self._run(samples.u, samples.usable, round(samples.settle_s / self.step_s))

    def _run(self, u: FloatArray, usable: ByteArray, settle: int) -> tuple[FloatArray, ByteArray]:
        answer = np.empty(len(u))
        settled = np.empty(len(u), dtype=np.uint8)
        kernel.run(
            u, usable, self.knots, self.values, self.b, self.denominator, self.delay,
            settle, answer, settled,
        )  # fmt: skip
        return answer, settled

    def step_response(self, seconds: FloatArray) -> FloatArray:
        """Return how much of a unit step of the flow the power has followed, shape (n,)."""
        rows = int(np.ceil(seconds.max() / self.step_s)) + self.delay + 2
        # One row of rest before the step; equilibrium is where `run` begins.
        flat = replace(self, knots=np.array([0.0, 1.0]), values=np.array([0.0, 1.0]))
        u = np.ones(rows + 1)
        u[0] = 0.0
        answer, _ = flat._run(u, np.ones(rows + 1, dtype=np.uint8), 0)
        return np.asarray(np.interp(seconds, np.arange(rows) * self.step_s, answer[1:]))

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
    m, group = samples.means, samples.group
    answer, weight = np.empty(m), np.empty(m, dtype=np.uint8)
    jacobian = np.empty((m, len(model.pack()) if columns is None else columns))
    kernel.tangents(
        samples.u, samples.usable, model.knots, model.values, model.b, model.denominator,
        model.delay, round(samples.settle_s / samples.step_s), group, answer, jacobian, weight,
    )  # fmt: skip
    power = samples.power_mw[: m * group].reshape(m, group).mean(axis=1)
    return np.where(weight > 0, power - answer, 0.0), jacobian, weight
