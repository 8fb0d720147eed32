"""The integrated input u, and the units at the border under their old address."""

from __future__ import annotations

import numpy as np

from valveflow_ros.jit import jit
from valveflow_ros.records import FloatArray
from valveflow_ros.signals.unit_table import UNITS, Unit, convert, unit_of

__all__ = ['UNITS', 'Unit', 'convert', 'integrated_input', 'unit_of']


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
