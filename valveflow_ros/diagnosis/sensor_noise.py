"""The noise of the position sensor: what it adds to an opening that wanders."""

from __future__ import annotations

import numpy as np

from valveflow_ros.records import FloatArray

_KEPT = 0.8  # share of the increments that are no pulses of the frequency control
_OF_NORMAL = 0.4377  # their mean square in units of the whole, for a normal law
_PARTS, _LEAST_ROWS = 12, 50


def sensor_noise(v: FloatArray) -> float:
    """Return the sd of the white noise of a position in its own unit, rather too large than small.

    Rows apart by h differ by D(h) = E (v[t + h] - v[t])^2, which noise lifts by twice its
    variance however small h is. A parabola through D(1), D(2), D(3), at h = 0, is that lift.
    It is taken from parts of the record, and their standard error is added: paths drawn with no
    noise at all would be one path.

    Parameters
    ----------
    v : float64 (n,)
        Positions at a constant step, NaN where there is none.
    """
    parts = [p for p in np.array_split(v, _PARTS) if np.isfinite(p).sum() >= _LEAST_ROWS]
    if not parts:
        return 0.0
    lifts = np.array([_lift(p) for p in parts])
    error = float(lifts.std()) / np.sqrt(max(len(lifts) - 1, 1))
    return float(np.sqrt(max(float(lifts.mean()) + error, 0.0) / 2.0))


def _lift(v: FloatArray) -> float:
    """Return twice the variance of the noise, as told by one part; it may be negative."""
    lifted = []
    for h in (1, 2, 3):
        apart = np.abs(v[h:] - v[:-h])
        apart = apart[np.isfinite(apart)]
        if not len(apart):
            return 0.0
        # So many, not those below a limit: on a rounded record thousands lie at the limit.
        count = max(1, round(_KEPT * len(apart)))
        kept = np.partition(apart, count - 1)[:count]
        lifted.append(float(np.mean(kept**2)) / _OF_NORMAL)
    return 3.0 * lifted[0] - 3.0 * lifted[1] + lifted[2]
