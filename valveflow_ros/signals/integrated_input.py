"""The integrated input u of the paper; apart from the units, since it needs the compiler."""

from __future__ import annotations

import numpy as np

from valveflow_ros.numerics import jit
from valveflow_ros.records import FloatArray


def integrated_input(
    opening_percent: FloatArray, pressure_mpa: FloatArray, exponent: float = 1.125
) -> FloatArray:
    """Return u = V p^m, eq. (1) of the paper with m = 9/8, in % MPa^m.

    NaN where an input is NaN or the pressure is not positive.
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
    """Write u row by row; a loop, so that blocks of any size round alike."""
    for t in range(opening.size):
        out[t] = opening[t] * pressure[t] ** exponent if pressure[t] > 0.0 else np.nan
