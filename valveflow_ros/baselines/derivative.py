"""Equations for sparse identification: by derivatives of smoothed data, or in weak form.

A derivative of noisy power is mostly noise. Either the data are smoothed by
local polynomials (Savitzky and Golay) and the polynomial is differentiated, or
both sides are multiplied by a smooth test function that vanishes at the ends of
a window and integrated, which moves the derivative from the data to the test function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_coeffs

from valveflow_ros.baselines import library
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import ByteArray, FloatArray, IntArray

_ORDER = 2  # of the local polynomials
_STEEP = 4  # phi = (1 - s^2)^4: smooth enough that its derivative vanishes at the ends too


@dataclass(frozen=True, slots=True)
class Form:
    """How the equations are made.

    Attributes
    ----------
    kind : str
        'derivative' or 'weak'.
    window_s : float
        Width of the window.
    """

    kind: str
    window_s: float


_WINDOWS_S = (5.0, 11.0, 21.0, 61.0)
_WINDOWS_ROWS = (5, 7, 11, 21)  # where rows are too far apart for such windows
_FAR_S = 5.0


def forms_for(step_s: float) -> tuple[Form, ...]:
    """Return what to try for rows ``step_s`` apart."""
    windows: tuple[float, ...] = _WINDOWS_S
    if step_s > _FAR_S:
        windows = tuple(rows * step_s for rows in _WINDOWS_ROWS)
    return tuple(Form(kind, w) for kind in ('derivative', 'weak') for w in windows)


def half_width(form: Form, step_s: float) -> int:
    """Return how many rows a window reaches to each side, at least two."""
    return max(2, round(0.5 * form.window_s / step_s))


def equations(samples: Samples, form: Form) -> FloatArray:
    """Return rows ``[theta | y']``, shape (k, 15); both sides may be integrals.

    Windows overlap by half; what is nearer says little new.
    """
    half = half_width(form, samples.step_s)
    make = _weak if form.kind == 'weak' else _derivative
    if len(samples.u) <= 2 * half:
        return np.empty((0, library.SIZE + 1))
    centres = np.arange(half, len(samples.u) - half, half, dtype=np.int64)
    return make(samples, half, centres)


def _whole(usable: ByteArray, half: int, centres: IntArray) -> IntArray:
    """Return the centres whose window has no gap."""
    missing = np.concatenate([[0], np.cumsum(usable == 0)])
    return np.asarray(centres[missing[centres + half + 1] == missing[centres - half]])


def _convolved(values: FloatArray, weights: FloatArray, centres: IntArray) -> FloatArray:
    smoothed = np.convolve(values, weights, mode='valid')
    return np.asarray(smoothed[centres - len(weights) // 2])


def _derivative(samples: Samples, half: int, centres: IntArray) -> FloatArray:
    centres = _whole(samples.usable, half, centres)
    size, step = 2 * half + 1, samples.step_s
    value = savgol_coeffs(size, _ORDER)
    slope = savgol_coeffs(size, _ORDER, deriv=1, delta=step)
    y = _convolved(samples.power_mw, value, centres)
    u = _convolved(samples.u, value, centres)
    return np.column_stack([library.columns(y, u), _convolved(samples.power_mw, slope, centres)])


def _weak(samples: Samples, half: int, centres: IntArray) -> FloatArray:
    s = np.arange(-half, half + 1) / (half + 1.0)
    test = (1.0 - s**2) ** _STEEP
    slope = -2.0 * _STEEP * s * (1.0 - s**2) ** (_STEEP - 1) / ((half + 1.0) * samples.step_s)
    total = test.sum()
    out = np.empty((len(centres), library.SIZE + 1))
    rows = library.weak_rows(
        samples.power_mw, library.columns(samples.power_mw, samples.u), samples.usable,
        centres, test / total, slope / total, out,
    )  # fmt: skip
    return out[:rows]
