# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Sparse identification of nonlinear dynamics (SINDy), tuned on held-out data.

The model is ``y' = xi . theta(y, u)`` with theta = [1, y, u, y^2, y u, u^2, y^3, y^2 u, y u^2,
u^3, sin y, sin u, cos y, cos u]: the 14 entries of the paper's vector Xi (Section IV), of which
the first belongs to the constant. The solver is sequentially thresholded least squares. Columns
are first scaled to unit size so that one threshold suits all: u^3 is 1e10 and cos u is 1. The
method for derivatives and the threshold are chosen by the simulation error on the last part of
the identification data after a fit to the first part.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_coeffs

from valveflow_ros.baselines.judged import cut_samples, run_mse
from valveflow_ros.errors import DataError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.numerics import jit
from valveflow_ros.records import BoolArray, ByteArray, FloatArray, IntArray

NAMES = (
    '1', 'y', 'u', 'y^2', 'y u', 'u^2', 'y^3', 'y^2 u', 'y u^2', 'u^3',
    'sin y', 'sin u', 'cos y', 'cos u',
)  # fmt: skip
SIZE = len(NAMES)
_LONGEST_STEP_S = 5.0  # maximum step of the integration
_AWAY = 1e6  # MW; a larger solution has diverged


@jit
def columns(y: FloatArray, u: FloatArray) -> FloatArray:
    """Return the 14 functions at all rows, shape (n, 14)."""
    out = np.empty((y.size, SIZE))
    for t in range(y.size):
        a, b = y[t], u[t]
        out[t, 0], out[t, 1], out[t, 2] = 1.0, a, b
        out[t, 3], out[t, 4], out[t, 5] = a * a, a * b, b * b
        out[t, 6], out[t, 7], out[t, 8], out[t, 9] = a * a * a, a * a * b, a * b * b, b * b * b
        out[t, 10], out[t, 11] = math.sin(a), math.sin(b)
        out[t, 12], out[t, 13] = math.cos(a), math.cos(b)
    return out


@jit
def rate(y: float, u: float, xi: FloatArray) -> float:
    """Return y' in MW/s; absent functions are not computed."""
    powers = xi[0] + u * (xi[2] + u * (xi[5] + u * xi[9]))
    powers += y * (xi[1] + u * (xi[4] + u * xi[8]) + y * (xi[3] + u * xi[7] + y * xi[6]))
    if xi[10] != 0.0:
        powers += xi[10] * math.sin(y)
    if xi[11] != 0.0:
        powers += xi[11] * math.sin(u)
    if xi[12] != 0.0:
        powers += xi[12] * math.cos(y)
    if xi[13] != 0.0:
        powers += xi[13] * math.cos(u)
    return float(powers)


@jit
def _advance(y: float, before: float, now: float, xi: FloatArray, step_s: float) -> float:
    """Integrate over one row by Runge-Kutta of fourth order, in short enough steps."""
    parts = max(1, math.ceil(step_s / _LONGEST_STEP_S))
    h = step_s / parts
    move = (now - before) / parts
    u = before
    for _ in range(parts):
        k1 = rate(y, u, xi)
        k2 = rate(y + 0.5 * h * k1, u + 0.5 * move, xi)
        k3 = rate(y + 0.5 * h * k2, u + 0.5 * move, xi)
        k4 = rate(y + h * k3, u + move, xi)
        y += h * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0
        u += move
    return y


@jit
def simulate(
    u: FloatArray, usable: ByteArray, begin: FloatArray, xi: FloatArray, step_s: float,
    settle: int, answer: FloatArray, settled: ByteArray,
) -> None:  # fmt: skip
    """Integrate with u linear between rows.

    ``begin`` (n,) is the initial power after a gap. ``answer`` is NaN in gaps and
    infinite after the solution has diverged.
    """
    y = 0.0
    age = 0
    for t in range(u.size):
        if not usable[t]:
            age = 0
            answer[t] = np.nan
            settled[t] = 0
            continue
        if age == 0:
            y = begin[t]
        elif abs(y) < _AWAY:
            y = _advance(y, u[t - 1], u[t], xi, step_s)
        answer[t] = y if abs(y) < _AWAY else np.inf
        age += 1
        settled[t] = 1 if age > settle else 0


@jit
def weak_rows(
    y: FloatArray, theta_rows: FloatArray, usable: ByteArray, centres: IntArray,
    test: FloatArray, slope: FloatArray, out: FloatArray,
) -> int:  # fmt: skip
    """Write rows ``[integral of phi theta, - integral of phi' y]``; return their number.

    ``test`` and ``slope`` are phi and phi' on rows -w..w. A window with a gap is
    left out.
    """
    half = test.size // 2
    written = 0
    size = theta_rows.shape[1]
    for c in centres:
        good = True
        for k in range(test.size):
            good = good and usable[c - half + k] > 0
        if not good:
            continue
        for p in range(size + 1):
            out[written, p] = 0.0
        for k in range(test.size):
            t = c - half + k
            for p in range(size):
                out[written, p] += test[k] * theta_rows[t, p]
            out[written, size] -= slope[k] * y[t]
        written += 1
    return written


_START_S = 30.0  # averaging time of the initial power after a gap
_PLACES = 400  # minimum number of inputs at which the steady state is searched
_FINE_U = 0.25  # maximum step of u if sin u or cos u is present: 25 per period
_SWINGING = tuple(NAMES.index(name) for name in ('sin u', 'cos u'))
_GRID = 1500  # number of points for the search of a change of sign


@dataclass(frozen=True, slots=True)
class SparseModel:
    """y' = xi . theta(y, u)."""

    xi: FloatArray  # (14,) MW/s per unit of each function; 0 if the function is absent
    u_from: float  # the range of the data used for the fit
    u_to: float
    power_from: float
    power_to: float
    power_mean: float
    step_s: float

    @property
    def terms(self) -> tuple[str, ...]:
        """Return the names of the functions in the model."""
        return tuple(n for n, x in zip(NAMES, self.xi, strict=True) if x != 0.0)

    def run(self, samples: Samples) -> tuple[FloatArray, ByteArray]:
        """Return the simulated power in MW and a mask of settled rows, shapes (n,).

        After a gap it begins with the measured power of the first half minute.
        """
        rows = max(1, round(_START_S / samples.step_s))
        begin = np.full(len(samples.u), self.power_mean)
        starts = np.flatnonzero(np.diff(samples.usable.astype(np.int8), prepend=0) == 1)
        for t in starts:
            part = slice(t, t + rows)
            begin[t] = np.mean(samples.power_mw[part][samples.usable[part] > 0])
        answer = np.empty(len(samples.u))
        settled = np.empty(len(samples.u), dtype=np.uint8)
        simulate(
            samples.u, samples.usable, begin, self.xi, samples.step_s,
            round(samples.settle_s / samples.step_s), answer, settled,
        )  # fmt: skip
        return answer, settled

    def static(self, u: FloatArray) -> FloatArray:
        """Return the steady-state power of the model; NaN if there is none.

        A stable steady state is a power at which y' falls through zero. If there are several,
        the curve continues with the nearest one, from the middle of the data outwards. It is
        searched at equally spaced inputs and interpolated linearly. ``u`` should contain no
        rows of gaps, because they would enlarge the searched range.
        """
        u = np.asarray(u, dtype=np.float64)
        low, high = min(self.u_from, float(u.min())), max(self.u_to, float(u.max()))
        swings = bool(np.any(self.xi[list(_SWINGING)] != 0.0))
        count = math.ceil((high - low) / _FINE_U) + 1 if swings else 0
        places = np.linspace(low, high, max(_PLACES, count))
        return np.asarray(np.interp(u, places, self._rests(places)))

    def _rests(self, places: FloatArray) -> FloatArray:
        reach = 0.25 * (self.power_to - self.power_from)
        y = np.linspace(self.power_from - reach, self.power_to + reach, _GRID)
        curve = np.full(len(places), np.nan)
        middle = int(np.argmin(np.abs(places - 0.5 * (self.u_from + self.u_to))))
        for order in (range(middle, len(places)), range(middle, -1, -1)):
            near = curve[middle] if np.isfinite(curve[middle]) else self.power_mean
            for k in order:
                curve[k] = _rest(self.xi, float(places[k]), y, near)
                near = curve[k] if np.isfinite(curve[k]) else near
        return curve


def _rest(xi: FloatArray, u: float, y: FloatArray, near: float) -> float:
    """Return the stable steady state nearest to ``near``, NaN if there is none."""
    values = columns(y, np.full(len(y), u)) @ xi
    falls = np.flatnonzero((values[:-1] > 0.0) & (values[1:] <= 0.0))
    if not len(falls):
        return float('nan')
    share = values[falls] / (values[falls] - values[falls + 1])
    rests = y[falls] + share * (y[1] - y[0])
    return float(rests[np.argmin(np.abs(rests - near))])


# A derivative of noisy power is mostly noise. Either the data are smoothed by local polynomials
# (Savitzky and Golay) and the polynomial is differentiated, or both sides are multiplied by a
# smooth test function that vanishes at the ends of a window and integrated, which moves the
# derivative from the data to the test function.

_ORDER = 2  # degree of the local polynomials
_STEEP = 4  # phi = (1 - s^2)^4, whose derivative is also zero at the ends


@dataclass(frozen=True, slots=True)
class Form:
    """The method for the derivatives in the equations."""

    kind: str  # 'derivative' or 'weak'
    window_s: float


_WINDOWS_S = (5.0, 11.0, 21.0, 61.0)
_WINDOWS_ROWS = (5, 7, 11, 21)  # if the step of the rows is too large for these windows
_FAR_S = 5.0


def forms_for(step_s: float) -> tuple[Form, ...]:
    """Return the forms to try for rows with the step ``step_s``."""
    windows = [rows * step_s for rows in _WINDOWS_ROWS] if step_s > _FAR_S else _WINDOWS_S
    return tuple(Form(kind, w) for kind in ('derivative', 'weak') for w in windows)


def equations(samples: Samples, form: Form) -> FloatArray:
    """Return rows ``[theta | y']``, shape (k, 15); both sides may be integrals.

    Windows overlap by half; a larger overlap adds little information.
    """
    half = max(2, round(0.5 * form.window_s / samples.step_s))
    make = _weak if form.kind == 'weak' else _derivative
    if len(samples.u) <= 2 * half:
        return np.empty((0, SIZE + 1))
    centres = np.arange(half, len(samples.u) - half, half, dtype=np.int64)
    return make(samples, half, centres)


def _derivative(samples: Samples, half: int, centres: IntArray) -> FloatArray:
    # Windows without a gap.
    missing = np.concatenate([[0], np.cumsum(samples.usable == 0)])
    centres = centres[missing[centres + half + 1] == missing[centres - half]]
    size = 2 * half + 1
    value = savgol_coeffs(size, _ORDER)
    slope = savgol_coeffs(size, _ORDER, deriv=1, delta=samples.step_s)
    y, u, rate_of_y = (
        np.convolve(values, weights, mode='valid')[centres - half]
        for values, weights in (
            (samples.power_mw, value), (samples.u, value), (samples.power_mw, slope),
        )
    )  # fmt: skip
    return np.column_stack([columns(y, u), rate_of_y])


def _weak(samples: Samples, half: int, centres: IntArray) -> FloatArray:
    s = np.arange(-half, half + 1) / (half + 1.0)
    test = (1.0 - s**2) ** _STEEP
    slope = -2.0 * _STEEP * s * (1.0 - s**2) ** (_STEEP - 1) / ((half + 1.0) * samples.step_s)
    total = test.sum()
    out = np.empty((len(centres), SIZE + 1))
    rows = weak_rows(
        samples.power_mw, columns(samples.power_mw, samples.u), samples.usable,
        centres, test / total, slope / total, out,
    )  # fmt: skip
    return out[:rows]


THRESHOLDS = (0.0, *np.geomspace(1e-3, 1e3, 31).tolist())
_SPARE = 1.01  # allowed relative loss of a sparser model
_ROUNDS = 30

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class SparseFit:
    """The model and the evidence for its choice."""

    model: SparseModel
    form: Form
    threshold: float  # of the coefficients of scaled columns
    # The best result of each form on the held-out part: kind, window in s, functions, mean squared
    # error in MW^2.
    mse_by_form: tuple[tuple[str, float, int, float], ...]


@dataclass(frozen=True, slots=True)
class _Candidate:
    form: Form
    threshold: float
    support: BoolArray
    mse: float


def thresholded(theta: FloatArray, target: FloatArray, threshold: float) -> FloatArray:
    """Solve theta (k, P) xi (P,) = target (k,) by sequentially thresholded least squares.

    Coefficients below the threshold are set to zero and the others are refitted until nothing
    changes.
    """
    kept = np.ones(theta.shape[1], dtype=bool)
    xi = np.zeros(theta.shape[1])
    for _ in range(_ROUNDS):
        xi[:] = 0.0
        if kept.any():
            xi[kept] = np.linalg.lstsq(theta[:, kept], target, rcond=None)[0]
        large = kept & (np.abs(xi) >= threshold)
        if np.array_equal(large, kept):
            break
        kept = large
    return xi


def _triangle(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scale columns to unit size and reduce all rows to a triangular matrix.

    Least squares in any subset of columns gives the same result with the triangle (15, 15) as
    with all rows. The scales (15,) are returned, too.
    """
    scale = np.sqrt(np.mean(rows**2, axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)
    triangle: FloatArray = np.asarray(np.linalg.qr(rows / scale / np.sqrt(len(rows)), mode='r'))
    return triangle, scale


def fit_sparse(samples: Samples, progress: Progress = lambda _: None) -> SparseFit:
    """Identify a sparse model.

    Raises
    ------
    TooFewSamplesError
        Too few usable rows, or too few that are far enough after a gap.
    DataError
        The simulation of every model of the library diverges on the data.
    """
    learn, judge = cut_samples(samples)
    judge = judge.coarser()
    candidates: list[_Candidate] = []
    for form in forms_for(samples.step_s):
        progress(f'sparse model: {form.kind}, {form.window_s:g} s')
        candidates += _of_form(learn, judge, form)
    finite = [c for c in candidates if np.isfinite(c.mse)]
    if not finite:
        raise DataError(
            'Sparse identification found no model: each one from its library of functions runs '
            'away when it is simulated.'
        )
    best = min(finite, key=lambda c: c.mse)
    near = [c for c in finite if c.mse <= _SPARE * best.mse]
    chosen = min(near, key=lambda c: (int(c.support.sum()), c.mse))
    progress('sparse model: all data')
    model = _on_support(samples, *_triangle(equations(samples, chosen.form)), chosen.support)
    best_of: dict[Form, _Candidate] = {}
    for c in candidates:
        best_of[c.form] = min(best_of.get(c.form, c), c, key=lambda each: each.mse)
    tried = tuple((f.kind, f.window_s, int(c.support.sum()), c.mse) for f, c in best_of.items())
    return SparseFit(model, chosen.form, chosen.threshold, tried)


def _of_form(learn: Samples, judge: Samples, form: Form) -> list[_Candidate]:
    rows = equations(learn, form)
    if len(rows) < 4 * SIZE:
        return []
    triangle, scale = _triangle(rows)
    found: dict[bytes, _Candidate] = {}
    for threshold in THRESHOLDS:
        support = thresholded(triangle[:, :-1], triangle[:, -1], threshold) != 0.0
        if support.any() and support.tobytes() not in found:
            model = _on_support(learn, triangle, scale, support)
            candidate = _Candidate(form, threshold, support, run_mse(model, judge))
            found[support.tobytes()] = candidate
    return list(found.values())


def _on_support(
    samples: Samples, triangle: FloatArray, scale: FloatArray, support: BoolArray
) -> SparseModel:
    xi = np.zeros(SIZE)
    xi[support] = np.linalg.lstsq(triangle[:, :-1][:, support], triangle[:, -1], rcond=None)[0]
    xi *= scale[-1] / scale[:-1]
    good = samples.usable > 0
    u, y = samples.u[good], samples.power_mw[good]
    return SparseModel(
        xi, float(u.min()), float(u.max()), float(y.min()), float(y.max()), float(y.mean()),
        samples.step_s,
    )  # fmt: skip
