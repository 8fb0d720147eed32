# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The classical tests for a sticking valve in an oscillating loop, as published.

All tests take the controller output (the command) and the process variable without missing
rows. Each test applies to certain loops only; `judge` selects them and combines the results.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.records import FloatArray, IntArray

STICTION, NO_STICTION, UNDECIDED = 'stiction', 'no stiction', 'undecided'

# Horch's limits are phase shifts of a sinusoid of 30 and 60 degrees.
_SHIFT = (1.0 / 3.0, 2.0 / 3.0)
_HEIGHT = ((2.0 - np.sqrt(3.0)) / (2.0 + np.sqrt(3.0)), 1.0 / 3.0)
_STICKY_TRAVEL = 0.25  # Yamashita's limit
_SHAPE = (0.4, 0.6)  # He's limits
_LEAST_HALF_ROWS, _LEAST_HALVES = 5, 3
_ROWS_A_PERIOD = 24  # rows per period after averaging, before finding the direction of travel
_CROSSINGS = 10
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class Detection:
    """The result of one test.

    Attributes
    ----------
    answer : str
        `STICTION`, `NO_STICTION` or `UNDECIDED`.
    index : float
        The test statistic; NaN if it could not be computed.
    """

    answer: str
    index: float


@dataclass(frozen=True, slots=True)
class Oscillation:
    """Period and regularity of the oscillation of a series.

    Attributes
    ----------
    period : float
        In rows; NaN if the series does not oscillate.
    regularity : float
        Above 1 the oscillation is regular.
    """

    period: float
    regularity: float


def correlation(u: FloatArray, y: FloatArray) -> FloatArray:
    """Return the correlation of u(t) and y(t + lag) for lags -(n - 1) to n - 1, biased."""
    u, y = u - u.mean(), y - y.mean()
    scale = len(u) * float(u.std() * y.std())
    if not scale > 0.0:
        return np.zeros(2 * len(u) - 1)
    size = 1 << (2 * len(u) - 1).bit_length()
    product = np.conj(np.fft.rfft(u, size)) * np.fft.rfft(y, size)
    full = np.fft.irfft(product, size)
    return np.asarray(np.concatenate((full[-(len(u) - 1) :], full[: len(u)])) / scale)


def oscillation(x: FloatArray) -> Oscillation:
    """Return period and regularity of a series from the zero crossings of its autocorrelation.

    N. F. Thornhill, B. Huang, H. Zhang, "Detection of multiple oscillations in control loops",
    Journal of Process Control 13 (2003): with the mean and the standard deviation of the
    distances between crossings, regularity = mean / (3 std), over up to eleven crossings.
    """
    r = correlation(x, x)[len(x) - 1 :]
    places = crossings(r[: max(3 * len(r) // 4, 2)], 0.02)[:_CROSSINGS]
    if len(places) < 2:
        return Oscillation(np.nan, 0.0)
    # The first crossing is at a quarter of a period.
    gaps = np.diff(places)
    period = 2.0 * float(gaps.mean())
    if len(gaps) < 3:
        return Oscillation(period, 0.0)
    return Oscillation(period, float(gaps.mean()) / (3.0 * max(float(gaps.std()), _TINY)))


def crossings(x: FloatArray, band: float) -> FloatArray:
    """Return interpolated sign changes of a series between values beyond ``band``.

    If the series crosses zero several times without leaving the band, only the last crossing on
    the way to the other side counts.
    """
    beyond = np.flatnonzero(np.abs(x) > band)
    sides = np.sign(x[beyond])
    turn = np.flatnonzero(np.diff(sides))
    out = []
    for k in turn.tolist():
        a, b = int(beyond[k]), int(beyond[k + 1])
        inner = np.flatnonzero(np.sign(x[a : b + 1]) == sides[k])
        last = a + int(inner[-1])
        step = x[last] - x[last + 1]
        out.append(last + float(x[last] / step if step else 0.0))
    return np.array(out)


def horch(u: FloatArray, y: FloatArray) -> Detection:
    """Detect stiction by the phase between command and process variable.

    A. Horch, "A simple method for detection of stiction in control valves", Control Engineering
    Practice 7 (1999), with the decision regions of his thesis (KTH 2000). For a self-regulating
    process the cross-correlation is odd if the valve sticks, and even if a disturbance or a tight
    controller causes the oscillation. tau_l and tau_r are the distances from lag 0 to the first
    crossings, r0 the correlation at lag 0 and r_opt the extreme one between them:
    shift = |tau_l - tau_r| / (tau_l + tau_r) and height = ||r0| - |r_opt|| / (|r0| + |r_opt|).
    The index is the shift. The test does not apply to an integrating process.
    """
    r = correlation(u, y)
    middle = len(u) - 1
    right, left = _first_crossing(r[middle:]), _first_crossing(r[middle::-1])
    if not np.isfinite(left + right):
        return Detection(UNDECIDED, np.nan)
    if left + right == 0.0:  # exactly odd
        return Detection(STICTION, 1.0)
    between = np.abs(r[middle - int(left) : middle + int(right) + 1])
    first, most = abs(float(r[middle])), float(between.max())
    shift, height = abs(left - right) / (left + right), (most - first) / max(most + first, _TINY)
    if shift > _SHIFT[1] and height > _HEIGHT[1]:
        return Detection(STICTION, shift)
    if shift <= _SHIFT[0] and height <= _HEIGHT[0]:
        return Detection(NO_STICTION, shift)
    return Detection(UNDECIDED, shift)


def _first_crossing(side: FloatArray) -> float:
    """Return the lag of the first sign change, interpolated; NaN if there is none."""
    if abs(float(side[0])) < _TINY:
        return 0.0
    change = np.flatnonzero(np.sign(side[1:]) != np.sign(side[0]))
    if not len(change):
        return np.nan
    k = int(change[0])
    return float(k + side[k] / (side[k] - side[k + 1]))


def yamashita(u: FloatArray, y: FloatArray, period: float) -> Detection:
    """Detect stiction by how often the command moves while the flow does not.

    Y. Yamashita, "An automatic method for detection of valve stiction in process control loops",
    Control Engineering Practice 14 (2006). Command and flow increase, stay or decrease from row
    to row, by their normalised differences. The index is his rho_3: the fraction of moving rows in
    which only the command moves, without sequences that do not end like stiction. Unlike the
    paper, rows are first averaged to 24 per period to reduce noise. ``y`` is a flow; for a level,
    pass its differences.
    """
    group = max(1, int(period / _ROWS_A_PERIOD))
    n = len(u) // group * group
    a, b = (_symbols(x[:n].reshape(-1, group).mean(axis=1)) for x in (u, y))
    moving = int(((a != 0) | (b != 0)).sum())
    if moving < 2 * _LEAST_HALF_ROWS:
        return Detection(UNDECIDED, np.nan)
    rests = (a != 0) & (b == 0)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], 3 * a + b, [9]))))
    sticky = int(rests.sum())
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if rests[begin] and end < len(a):
            way, then = a[begin], (a[end], b[end])
            if then not in ((way, way), (0, way), (0, 0)):
                sticky -= end - begin
    index = sticky / moving
    return Detection(STICTION if index > _STICKY_TRAVEL else NO_STICTION, index)


def _symbols(x: FloatArray) -> IntArray:
    """Return 1, 0 or -1 for each difference: above, within or below its standard deviation."""
    step = np.diff(x)
    z = (step - step.mean()) / max(float(step.std()), _TINY)
    return np.asarray(np.where(np.abs(z) > 1.0, np.sign(z), 0.0), dtype=np.int64)


def he(x: FloatArray) -> Detection:
    """Detect stiction by the shape of an oscillation: triangular with stiction, else sinusoidal.

    Q. P. He, J. Wang, M. Pottmann, S. J. Qin, "A curve fitting method for detecting valve stiction
    in oscillating control loops", Ind. Eng. Chem. Res. 46 (2007). ``x`` is the first signal that
    integrates the jumps of the valve: the command for a self-regulating process, the process
    variable for an integrating one. Half a sine and a triangle with free peak are fitted to each
    half period; the index is MSE_sine / (MSE_sine + MSE_triangle).
    """
    x = x - x.mean()
    x = x - _wander(x)
    places = np.ceil(crossings(x, 0.5 * float(x.std()))).astype(np.int64)
    sine = triangle = 0.0
    halves = 0
    for begin, end in zip(places[:-1].tolist(), places[1:].tolist(), strict=True):
        if end - begin < _LEAST_HALF_ROWS:
            continue
        piece, t = x[begin:end], (np.arange(end - begin) + 0.5) / (end - begin)
        shape = np.sin(np.pi * t)
        sine += _misfit(piece, shape)
        triangle += min(
            _misfit(piece, np.minimum(t / p, (1.0 - t) / (1.0 - p)))
            for p in np.linspace(0.1, 0.9, 17).tolist()
        )
        halves += 1
    if halves < _LEAST_HALVES:
        return Detection(UNDECIDED, np.nan)
    index = sine / max(sine + triangle, _TINY)
    if index > _SHAPE[1]:
        return Detection(STICTION, index)
    return Detection(NO_STICTION if index < _SHAPE[0] else UNDECIDED, index)


def _wander(x: FloatArray) -> FloatArray:
    """Return the moving mean over one period; zero if there is no oscillation."""
    period = oscillation(x).period
    if not np.isfinite(period) or period > len(x) / 2:
        return np.zeros(len(x))
    width = max(3, round(period))
    ones = np.convolve(np.ones(len(x)), np.ones(width), 'same')
    return np.asarray(np.convolve(x, np.ones(width), 'same') / ones)


def _misfit(piece: FloatArray, shape: FloatArray) -> float:
    """Return the squared error of a shape with the best height."""
    rest = piece - shape * float(piece @ shape) / float(shape @ shape)
    return float(rest @ rest)
