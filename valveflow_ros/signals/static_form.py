# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The static power as a function of opening and pressure: P = p^e F(V p^q) + c.

The paper has e = c = 0 and q = m (Eq. 1): the breakpoints are at fixed integrated input u = V p^m.
The flow of a choked valve is p^m times an area that depends on the opening only (e = m, q = 0):
the breakpoints are at fixed openings, and c is the power without flow, which the paper's F
contains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.numerics import jit
from valveflow_ros.parameters import PARAMETERS
from valveflow_ros.records import FloatArray

INTEGRATED_INPUT = 'integrated_input'
OPENING = 'opening'
AXES = (INTEGRATED_INPUT, OPENING)
PAPER_EXPONENT = 1.125
# Allowed range of fitted exponents: 1 is ideal choked flow, 9/8 the paper's. Outside this range
# one form imitates the other.
EXPONENTS = 0.9, 1.25
LEAST_EXPONENT = PARAMETERS['pressure_exponent'].low or 0.0  # also of a fitted one

# Relative range of the pressure below which weather and the curve's own misfit decide form and
# exponent: on units at fixed pressure intervals of 0.007 were 0.03 off.
LEAST_PRESSURE_RANGE = 0.1


def pressure_range(pressure_mpa: FloatArray) -> float:
    """Return the range of nearly all pressures (n,), relative to their median."""
    low, middle, high = np.quantile(pressure_mpa, (0.02, 0.5, 0.98))
    return float((high - low) / max(middle, 1e-9))


def exponents_near(exponent: float) -> tuple[float, float]:
    """Return the range in which to search: around an unusual one, as 0.5 of a liquid, 20 %."""
    low, high = EXPONENTS
    if low <= exponent <= high:
        return EXPONENTS
    return max(0.8 * exponent, LEAST_EXPONENT), 1.2 * exponent


@dataclass(frozen=True, slots=True)
class StaticForm:
    """The argument and the factor of the curve."""

    axis: str = INTEGRATED_INPUT  # 'integrated_input': P = F(V p^m). 'opening': P = p^m F(V) + c.
    exponent: float = PAPER_EXPONENT  # m

    @property
    def scaled(self) -> bool:
        """Return True if the curve is multiplied by p^m."""
        return self.axis == OPENING

    @property
    def input_exponent(self) -> float:
        """Return q of u = V p^q."""
        return 0.0 if self.scaled else self.exponent

    @property
    def scale_exponent(self) -> float:
        """Return e of P = p^e F(u) + c."""
        return self.exponent if self.scaled else 0.0

    def scale(self, pressure_mpa: FloatArray | float) -> FloatArray | float:
        """Return p^e; 1 for a form without p^e."""
        return pressure_mpa**self.exponent if self.scaled else 1.0

    def of_rows(
        self, opening_percent: FloatArray, pressure_mpa: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return u and p^e of rows, (n,) each; None for a form without p^e.

        NaN if an input is NaN or the pressure is not positive.
        """
        if not self.scaled:
            return integrated_input(opening_percent, pressure_mpa, self.exponent), None
        ones = np.ones(len(opening_percent))
        scale = integrated_input(ones, pressure_mpa, self.exponent)
        u = np.where(np.isfinite(scale), opening_percent, np.nan)
        return u, np.where(np.isfinite(u), scale, np.nan)

    def of_integrated_input(
        self, u: FloatArray, opening_percent: FloatArray, exponent: float
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return u and p^e from V p^``exponent`` and the opening, which determine the pressure.

        NaN if the opening is not positive and the form needs the pressure.
        """
        if self == StaticForm(INTEGRATED_INPUT, exponent):
            return u, None
        return self.of_rows(opening_percent, pressure_of(u, opening_percent, exponent))

    @property
    def words(self) -> str:
        """Return the form as a formula."""
        m = f'{self.exponent:.4g}'
        return f'p^{m} F(V) + c' if self.scaled else f'F(V p^{m})'


def pressure_of(u: FloatArray, opening_percent: FloatArray, exponent: float) -> FloatArray:
    """Return the pressure in u = V p^``exponent``, MPa; NaN if V is not positive."""
    pressure = np.empty(len(u))
    _pressure_of(
        np.ascontiguousarray(u, dtype=np.float64),
        np.ascontiguousarray(opening_percent, dtype=np.float64), 1.0 / exponent, pressure,
    )  # fmt: skip
    return pressure


@jit
def _pressure_of(u: FloatArray, opening: FloatArray, power: float, out: FloatArray) -> None:
    """Write the pressure row by row; a loop gives the same rounding for any block size."""
    for t in range(u.size):
        known = opening[t] > 0.0 and u[t] > 0.0
        out[t] = (u[t] / opening[t]) ** power if known else np.nan


def integrated_input(
    opening_percent: FloatArray, pressure_mpa: FloatArray, exponent: float = 1.125
) -> FloatArray:
    """Return u = V p^m, eq. (1) of the paper with m = 9/8, in % MPa^m.

    NaN if an input is NaN or the pressure is not positive.
    """
    opening = np.ascontiguousarray(opening_percent, dtype=np.float64)
    pressure = np.ascontiguousarray(pressure_mpa, dtype=np.float64)
    u = np.empty(len(opening))
    _integrated_input(opening, pressure, exponent, u)
    return u


@jit
def _integrated_input(
    opening: FloatArray, pressure: FloatArray, exponent: float, out: FloatArray
) -> None:
    """Write u row by row; a loop gives the same rounding for any block size."""
    for t in range(opening.size):
        out[t] = opening[t] * pressure[t] ** exponent if pressure[t] > 0.0 else np.nan
