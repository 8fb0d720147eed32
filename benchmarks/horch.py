"""Horch's cross-correlation test for stiction, the baseline of `refinery_valves`.

A. Horch, "A simple method for detection of stiction in control valves", Control Engineering
Practice 7 (1999), with the decision regions of his thesis, "Condition monitoring of control
loops", KTH 2000. In an oscillating loop around a self-regulating process, controller output and
measured value are correlated oddly (a quarter of a period apart) where the valve sticks, and
evenly where a disturbance from outside or a tight controller swings the loop. On an
integrating process a sound loop is odd too and a sticking one even: the test says nothing
there, and Horch gave another one for it, on the distribution of the second derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.records import FloatArray

STICTION, NO_STICTION, UNDECIDED = 'stiction', 'no stiction', 'undecided'
# The borders are phase shifts of a sinusoid of 30 and 60 degrees.
_SHIFT = (1.0 / 3.0, 2.0 / 3.0)
_HEIGHT = ((2.0 - np.sqrt(3.0)) / (2.0 + np.sqrt(3.0)), 1.0 / 3.0)


@dataclass(frozen=True)
class Horch:
    """The test's answer with its two measures; NaN where there is no zero crossing."""

    answer: str
    shift: float
    height: float


def cross_correlation(u: FloatArray, y: FloatArray) -> FloatArray:
    """Return the correlation of u(t) and y(t + lag) for lags -(n - 1) to n - 1, biased."""
    u, y = u - u.mean(), y - y.mean()
    scale = len(u) * float(u.std() * y.std())
    return np.asarray(
        np.correlate(y, u, 'full') / scale if scale > 0 else np.zeros(2 * len(u) - 1)
    )


def _crossing(side: FloatArray) -> float:
    """Return the lag of the first change of sign, interpolated; NaN if there is none."""
    change = np.flatnonzero(np.sign(side[1:]) != np.sign(side[0]))
    if not len(change) or side[0] == 0.0:
        return 0.0 if side[0] == 0.0 else np.nan
    k = int(change[0])
    return float(k + side[k] / (side[k] - side[k + 1]))


def horch(u: FloatArray, y: FloatArray) -> Horch:
    """Tell stiction from other causes of an oscillation.

    With tau_l and tau_r the distances from lag 0 to the first zero crossing on either side, r0
    the correlation at lag 0 and r_opt the extreme one between the crossings,
    shift = |tau_l - tau_r| / (tau_l + tau_r) and height = ||r0| - |r_opt|| / (|r0| + |r_opt|):
    stiction where both lie above their upper border, none where both lie below the lower.
    """
    r = cross_correlation(u, y)
    middle = len(u) - 1
    right, left = _crossing(r[middle:]), _crossing(r[middle::-1])
    if not np.isfinite(left + right):
        return Horch(UNDECIDED, np.nan, np.nan)
    between = np.abs(r[middle - int(left) : middle + int(right) + 1])
    if left + right == 0.0:  # exactly odd
        return Horch(STICTION, 1.0, 1.0)
    first, most = abs(float(r[middle])), float(between.max())
    shift, height = abs(left - right) / (left + right), (most - first) / max(most + first, 1e-12)
    if shift > _SHIFT[1] and height > _HEIGHT[1]:
        return Horch(STICTION, shift, height)
    if shift <= _SHIFT[0] and height <= _HEIGHT[0]:
        return Horch(NO_STICTION, shift, height)
    return Horch(UNDECIDED, shift, height)
